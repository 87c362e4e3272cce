"""When the accidents of a release could have been avoided: computed in parallel, as text, CSV and JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.files import writable_folder
from deepaccident_devkit.parallel import Places, run_batch
from deepaccident_devkit.safety.accidents import Skipped, accident_of
from deepaccident_devkit.safety.avoidability import BRAKERS, Avoidability, avoidability_of, unusable
from deepaccident_devkit.safety.avoidability_shares import GROUPS, OutcomeShares, group_of, outcome_shares
from deepaccident_devkit.safety.outcomes import MOST_MARGIN, OUTCOMES, undisturbed
from deepaccident_devkit.safety.tables import write_csv
from deepaccident_devkit.text import columns_text
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from concurrent.futures import Executor

Row = Sequence[object]
_SHARES: Final = (0.5, 0.9)
"""Shares of accidents for which the text gives the seconds of warning that they need."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AvoidabilityReport(ShortRepr):
    """When accidents could have been avoided by braking.

    Attributes:
        dataroot: the release's folder.
        version: `v1` or `v1-mini`.
        accidents: those whose recording shows them, in the release's order.
        dropped: those whose recording does not: the two are too far apart at the end.
        skipped: scenarios of which meta or labels are missing.
        margins: scenario → metres between the two at the last frame, for all accidents, dropped ones too.
    """

    dataroot: str
    version: str
    accidents: tuple[Avoidability, ...]
    dropped: tuple[Skipped, ...]
    skipped: tuple[Skipped, ...]
    margins: Mapping[str, float]

    @property
    def shares(self) -> list[OutcomeShares]:
        """Shares of outcomes by the seconds of warning, for each group of accidents and for each who is warned."""
        return outcome_shares(self.accidents)

    def to_dict(self) -> dict[str, Any]:
        """Values for JSON: counts, what is left out and why, and the last moments of each accident."""
        return {
            "dataroot": self.dataroot,
            "version": self.version,
            "dropped": {each.scenario: each.reason for each in self.dropped},
            "skipped": {each.scenario: each.reason for each in self.skipped},
            "margins": dict(self.margins),
            "accidents": [{"group": group_of(each), **each.to_dict(warnings=False)} for each in self.accidents],
        }

    def to_json(self) -> str:
        """`to_dict` as text."""
        return json.dumps(self.to_dict(), indent=2, ensure_ascii=False)

    def to_csv(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write a file a table into a folder, each atomically, over those that are there; returns their paths.

        Args:
            folder: where; it is made if it is not there.

        Raises:
            ConfigError: `folder` cannot be written to, or is not one.
        """
        folder = writable_folder(folder)
        contents: dict[str, Iterable[Row]] = {
            "last_moments": self._last_moment_rows(),
            "secondary_contacts": self._secondary_rows(),
            "outcome_shares": self._share_rows(),
            "self_check": self._check_rows(),
            "left_out": self._left_out_rows(),
        }
        return [write_csv(folder / f"avoidability_{name}.csv", rows) for name, rows in contents.items()]

    def to_text(self) -> str:
        """Some aligned blocks for a terminal."""
        counts = f"{len(self.accidents)} accidents"
        left_out = {"dropped, as the two are too far apart at the end": self.dropped, "skipped": self.skipped}
        for word, which in left_out.items():
            counts += f"; {len(which)} {word}" if which else ""
        blocks = [f"DeepAccident {self.version} at {self.dataroot}\n{counts}"]
        blocks += [
            self._group_text(group) for group in GROUPS if any(group_of(each) == group for each in self.accidents)
        ]
        if self.margins:
            blocks.append(self._margins_text())
        blocks += [
            "\n".join([f"{word}:", *(f"  {each.reason}" for each in which)])
            for word, which in left_out.items()
            if which
        ]
        return "\n\n".join(blocks)

    @property
    def margin_counts(self) -> dict[str, int]:
        """Size in words → how many of the `margins` are of that size."""
        bounds = [0, 0.01, 0.1, 0.5, MOST_MARGIN]
        counts = np.histogram(list(self.margins.values()), bins=[*bounds, np.inf])[0].tolist()
        names = [f"below {bound:g} m" for bound in bounds[1:]] + [f"{MOST_MARGIN:g} m or more"]
        return dict(zip(names, counts, strict=True))

    def members(self, group: str) -> list[Avoidability]:
        """The accidents of one of `GROUPS`."""
        return [each for each in self.accidents if group_of(each) == group]

    def _group_text(self, group: str) -> str:
        """A line for each who brakes and how hard: how many are avoidable, and how much warning they need."""
        members = self.members(group)
        reactions = sorted({braking.reaction for braking in members[0].brakings})
        heading = ["brakes", "m/s²", "avoidable", "hit only after the end"]
        rows = [heading + [f"reaction {each:g} s" for each in reactions]]
        slack = np.stack([each.slack for each in members])
        extrapolated = np.stack([each.last_moments.extrapolated for each in members]).reshape(slack.shape)
        for row, brakers in enumerate(BRAKERS):
            for column, deceleration in enumerate(members[0].decelerations.tolist()):
                needed = np.sort(slack[:, row, column])  # those that nothing avoids are last
                places = [int(np.ceil(share * len(needed))) - 1 for share in _SHARES]
                counts = (np.isfinite(needed).sum(), extrapolated[:, row, column].sum())
                cells = [" / ".join(_seconds_text(needed[place] + each) for place in places) for each in reactions]
                rows.append([brakers, f"{deceleration:g}", *(str(count) for count in counts), *cells])
        meant = " and ".join(f"{share:.0%}" for share in _SHARES)
        return (
            f"{group}: {len(members)} accidents; seconds of warning that {meant} of them need\n{columns_text(rows)}\n"
            f"{_secondary_text(members)}"
        )

    def _margins_text(self) -> str:
        """How many margins of the self-check there are of each size; the largest by name."""
        lines = [f"  {name}: {count}" for name, count in self.margin_counts.items() if count]
        largest = max(self.margins, key=lambda name: self.margins[name])
        lines.append(f"  the largest: {self.margins[largest]:.3f} m, {largest}")
        return "\n".join(["gaps at the last frame, which count as contact:", *lines])

    def _last_moment_rows(self) -> Iterator[Row]:
        names = ("brakers", "deceleration", "avoidable", "last_moment", "slack", "switches", "extrapolated")
        yield ("scenario", "group", "first_id", "first", "second_id", "second", *names, "secondary")
        for each in self.accidents:
            accident = each.accident
            who = [value for pair in zip(accident.actor_ids, accident.categories, strict=True) for value in pair]
            for row in each.last_moment_rows():
                values = (row[name] for name in names)
                yield (accident.scenario, group_of(each), *who, *values, len(row["secondary"]))

    def _secondary_rows(self) -> Iterator[Row]:
        names = ("actor_id", "other_id", "category", "time", "extrapolated")
        yield ("scenario", "brakers", "deceleration", *names)
        for each in self.accidents:
            for row in each.last_moment_rows():
                for contact in row["secondary"]:
                    values = (contact[name] for name in names)
                    yield (each.accident.scenario, row["brakers"], row["deceleration"], *values)

    def _share_rows(self) -> Iterator[Row]:
        yield (
            *("group", "warned", "reaction", "deceleration", "lead", "accidents", *OUTCOMES),
            *("extrapolated", "relative_speed", "delta_v", "delta_v_least", "delta_v_most"),
        )
        for each in self.shares:
            for column, braking in enumerate(each.brakings):
                for row, lead in enumerate(each.leads.tolist()):
                    values = [*each.shares[row, column], each.extrapolated[row, column]]
                    values += [each.relative_speed[row, column], *each.delta_v[row, column]]
                    key = (each.group, each.warned, braking.reaction, braking.deceleration, round(lead, 1))
                    yield (*key, int(each.accidents[row]), *(round(float(value), 6) for value in values))

    def _check_rows(self) -> Iterator[Row]:
        sides = ("first", "second")
        yield (
            *("scenario", "margin", "time", "end", *(f"speed_{side}" for side in sides)),
            *(f"delta_v_{side}{end}" for side in sides for end in ("", "_least", "_most")),
        )
        for each in self.accidents:
            told = each.to_dict(warnings=False)["recorded"]
            changes = zip(told["delta_v"], told["delta_v_ranges"], strict=True)
            delta_v = [value for change, both in changes for value in (change, *both)]
            key = (each.accident.scenario, told["margin"], told["time"], round(each.accident.duration, 1))
            yield (*key, *told["speeds"], *delta_v)

    def _left_out_rows(self) -> Iterator[Row]:
        yield ("scenario", "why", "reason", "margin")
        for word, which in (("dropped", self.dropped), ("skipped", self.skipped)):
            for each in which:
                yield (each.scenario, word, each.reason, self.margins.get(each.scenario))


def avoidability_report(
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> AvoidabilityReport:
    """When the accidents of scenarios could have been avoided by braking, in the nine ways of `BRAKINGS`.

    Args:
        dataset: the release.
        scenarios: tokens or records; None for all. Those whose meta file names no collision do not count.
        workers: processes; None chooses by the amount of work.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a bar.

    Raises:
        TokenError: no such scenario.
        ChoiceError: `workers` is less than 1.
        WorkerError: a worker was killed, or cannot do the work.
    """
    chosen = dataset.scenario if scenarios is None else scenarios
    tokens = [dataset.get("scenario", each)["token"] for each in chosen]
    found = run_batch(
        partial(looked_into, dataset),
        tokens,
        workers=workers,
        executor=executor,
        label="replaying",
        progress=progress,
        places=Places(reads=dataset.places),
    )
    return report_of(dataset, found)


def report_of(dataset: Dataset, found: Sequence[Avoidability | Skipped | Dropped | None]) -> AvoidabilityReport:
    """The report of what `looked_into` gave for scenarios, in their order."""
    margins: dict[str, float] = {}
    for each in found:
        if isinstance(each, Avoidability):
            margins[each.accident.scenario] = each.check.margin
        elif isinstance(each, Dropped):
            margins[each.why.scenario] = each.margin
    return AvoidabilityReport(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        accidents=tuple(each for each in found if isinstance(each, Avoidability)),
        dropped=tuple(each.why for each in found if isinstance(each, Dropped)),
        skipped=tuple(each for each in found if isinstance(each, Skipped)),
        margins=margins,
    )


@dataclass(frozen=True, slots=True)
class Dropped:
    """An accident that its recording does not show.

    Attributes:
        why: in words.
        margin: metres between the two at the last frame.
    """

    why: Skipped
    margin: float


def looked_into(dataset: Dataset, scenario: str) -> Avoidability | Skipped | Dropped | None:
    """When a scenario's accident could have been avoided, or why it cannot be told; None if it has no collision.

    Args:
        dataset: the release.
        scenario: token.
    """
    try:
        accident = accident_of(dataset, scenario)
    except NotAvailableError as error:
        return Skipped(scenario=scenario, reason=str(error))
    if accident is None:
        return None
    check = undisturbed(accident)
    if not check.usable:
        return Dropped(Skipped(scenario=scenario, reason=unusable(accident, check)), check.margin)
    return avoidability_of(accident, scenario_tracks(dataset, scenario))


def _secondary_text(accidents: Sequence[Avoidability]) -> str:
    """In how many replays of braking at the last moment another actor is touched."""
    touched = [{each.replay for each in accident.secondary} for accident in accidents]
    before = [{each.replay for each in accident.secondary if not each.extrapolated} for accident in accidents]
    replays = sum(int(np.isfinite(accident.last_moments.time).sum()) for accident in accidents)
    return (
        f"other road users, who do not react, are touched in {sum(map(len, before))} of {replays} replays of the last "
        f"moment before the recording ends, in {sum(map(len, touched))} if all go straight on for 3 s"
    )


def _seconds_text(seconds: float) -> str:
    return f"{seconds:.2f}" if np.isfinite(seconds) else "–"
