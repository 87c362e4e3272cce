"""`SafetyReport`: all that safety computes of a release, each scenario looked at once, as a row an accident."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.files import writable_folder
from deepaccident_devkit.interactions import interactions
from deepaccident_devkit.parallel import Places, run_batch
from deepaccident_devkit.safety.accidents import Skipped
from deepaccident_devkit.safety.avoidability import Avoidability
from deepaccident_devkit.safety.avoidability_report import AvoidabilityReport, Dropped, looked_into, report_of
from deepaccident_devkit.safety.lead_times import LeadTimes, lead_times
from deepaccident_devkit.safety.ledger_report import LeadTimeLedger
from deepaccident_devkit.safety.observation import ObservationRule
from deepaccident_devkit.safety.report_rows import ROW_HEADING, AccidentRow, PairMeasures, csv_row
from deepaccident_devkit.safety.scenarios import sorted_out, tried
from deepaccident_devkit.safety.stories import Story, scenario_facts
from deepaccident_devkit.safety.story_text import story_text
from deepaccident_devkit.safety.tables import write_csv
from deepaccident_devkit.safety.twin_diff import Parting, TwinDiff
from deepaccident_devkit.safety.twin_report import TwinReport, diff_of_accident
from deepaccident_devkit.safety.twins import torn_twins

if TYPE_CHECKING:
    from concurrent.futures import Executor


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyReport(ShortRepr):
    """The accidents of a release, or of some of its scenarios, from every side.

    Attributes:
        scenarios: how many were looked at.
        rows: an accident each, in the order of the release; also of those that cannot be replayed.
        avoidability: until when braking would have avoided them.
        ledger: who observed the colliders first.
        twins: where they part from their normal twins.
        normal: the stories of the scenarios that end without a collision, the most critical first: by the least time to
            collision of two that move; those without one last.
        broken: scenarios that the index leaves out (`on_error='skip'`), of the whole release.
    """

    scenarios: int
    rows: tuple[AccidentRow, ...]
    avoidability: AvoidabilityReport
    ledger: LeadTimeLedger
    twins: TwinReport
    normal: tuple[Story, ...]
    broken: tuple[Skipped, ...]

    @property
    def dataroot(self) -> str:
        """The release's folder."""
        return self.avoidability.dataroot

    @property
    def version(self) -> str:
        """`v1` or `v1-mini`."""
        return self.avoidability.version

    @property
    def left_out(self) -> list[tuple[str, str, str]]:
        """Scenario, what it is left out of, and why: each reason once."""
        parts = {
            "braking: dropped": self.avoidability.dropped,
            "braking: skipped": self.avoidability.skipped,
            "lead times": self.ledger.skipped,
            "twins": self.twins.skipped,
            "stories": [
                Skipped(scenario=each.facts["scenario"], reason=reason)
                for each in self.normal
                for reason in each.facts["unknown"]
            ],
            "everything": self.broken,
        }
        reasons: dict[tuple[str, str], list[str]] = {}
        for name, skipped in parts.items():
            for each in skipped:
                reasons.setdefault((each.scenario, each.reason), []).append(name)
        return [(scenario, ", ".join(names), reason) for (scenario, reason), names in reasons.items()]

    def to_dict(self) -> dict[str, Any]:
        """For JSON; None for what is not known."""
        return {
            "dataroot": self.dataroot,
            "version": self.version,
            "scenarios": self.scenarios,
            "accidents": [each.to_dict() for each in self.rows],
            "lead_times": self.ledger.to_dict()["summary"],
            "margins": dict(self.avoidability.margins),
            "normal": [{**each.facts, "text": each.text} for each in self.normal],
            "torn": [asdict(each) for each in self.twins.torn],
            "left_out": [dict(zip(("scenario", "part", "reason"), each, strict=True)) for each in self.left_out],
        }

    def to_json(self) -> str:
        """One JSON object."""
        return json.dumps(self.to_dict(), indent=2, ensure_ascii=False, allow_nan=False)

    def to_csv(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write `accidents.csv`, a row an accident, and `left_out.csv` into a folder, over those that are there.

        Metres, seconds, m/s, degrees; a cell is empty where nothing is known. Returns their paths.

        Raises:
            ConfigError: `folder` cannot be written to, or is not one.
        """
        folder = writable_folder(folder)
        return [
            write_csv(folder / "accidents.csv", [ROW_HEADING, *map(csv_row, self.rows)]),
            write_csv(folder / "left_out.csv", [("scenario", "part", "reason"), *self.left_out]),
        ]


@dataclass(frozen=True, slots=True)
class _Looked:
    """What one scenario gives; Skipped says why there is nothing, None that there is no accident."""

    replayed: Avoidability | Skipped | Dropped | None
    times: LeadTimes | Skipped | None
    twin: TwinDiff | Skipped | None
    story: Story
    measures: PairMeasures | None


def safety_report(
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> SafetyReport:
    """Last moments to brake, lead times, twins and stories of scenarios, with each accident replayed once.

    Args:
        dataset: the release.
        scenarios: tokens or records of those to look at, such as `find` gives; None for all.
        workers: processes; None chooses by the amount of work.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a bar.

    Raises:
        TokenError: no such scenario.
        ChoiceError: `workers` is less than 1.
        WorkerError: a worker was killed, or cannot do the work.
    """
    chosen = range(len(dataset.scenario)) if scenarios is None else [dataset.getind("scenario", s) for s in scenarios]
    looked = run_batch(
        partial(_looked_at, dataset),
        sorted(set(chosen)),
        workers=workers,
        executor=executor,
        label="safety",
        progress=progress,
        places=Places(reads=dataset.places),
    )
    times, twins = sorted_out([each.times for each in looked]), sorted_out([each.twin for each in looked])
    where = {"dataroot": str(dataset.dataroot), "version": dataset.version}
    return SafetyReport(
        scenarios=len(looked),
        rows=tuple(_rows(looked)),
        avoidability=report_of(dataset, [each.replayed for each in looked]),
        ledger=LeadTimeLedger(
            **where,
            rule=ObservationRule(),
            accidents=times.results,
            skipped=times.skipped,
            without_accident=times.others,
        ),
        twins=TwinReport(
            **where,
            diffs=twins.results,
            skipped=twins.skipped,
            torn=torn_twins({record["token"]: record["split"] for record in dataset.scenario}),
        ),
        normal=tuple(sorted((each.story for each in looked if each.story.facts["collision"] is False), key=_urgency)),
        broken=tuple(Skipped(scenario=each.scenario, reason=" ".join(each.messages)) for each in dataset.problems),
    )


def _looked_at(dataset: Dataset, row: int) -> _Looked:
    record = dataset.scenario[row]
    replayed = looked_into(dataset, record["token"])
    facts = scenario_facts(dataset, record, replayed.why if isinstance(replayed, Dropped) else replayed)
    measures = None
    if facts["accident"] is not None:
        found = interactions(dataset, record).pairs
        first, second = (each["actor_id"] for each in facts["accident"]["pair"])
        measures = PairMeasures.of(found, first, second)
    return _Looked(
        replayed=replayed,
        times=tried(lead_times, dataset, record),
        twin=tried(partial(diff_of_accident, parting=Parting()), dataset, record),
        story=Story(facts=facts, text=story_text(facts)),
        measures=measures,
    )


def _rows(looked: Iterable[_Looked]) -> Iterator[AccidentRow]:
    for each in looked:
        if each.story.facts["accident"] is not None:
            yield AccidentRow(
                story=each.story,
                replayed=each.replayed if isinstance(each.replayed, Avoidability) else None,
                times=None if isinstance(each.times, Skipped) else each.times,
                twin=None if isinstance(each.twin, Skipped) else each.twin,
                measures=each.measures,
            )


def _urgency(story: Story) -> tuple[float, str]:
    nearest = story.facts["nearest"]
    least = None if nearest is None else nearest["min_ttc"]
    return float("inf") if least is None else least, story.facts["scenario"]
