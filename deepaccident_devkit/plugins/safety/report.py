"""`safety_report`: the accidents of a release from every side, a row an accident."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.collisions.outcomes import BRAKINGS
from deepaccident_devkit.collisions.recorded import Skipped, each_scenario, those_of, tried
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.descriptions.avoidability import BRAKERS, Avoidability
from deepaccident_devkit.descriptions.observation import ObservationRule
from deepaccident_devkit.descriptions.stories import Story, scenario_facts, story_text
from deepaccident_devkit.interactions import InteractionConfig, InteractionPairs, interactions
from deepaccident_devkit.plugins.safety.avoidability_report import (
    AvoidabilityReport,
    Dropped,
    looked_into,
    report_of,
)
from deepaccident_devkit.plugins.safety.lead_times import (
    LeadTimeLedger,
    LeadTimes,
    lead_times,
    ledger_of,
)
from deepaccident_devkit.plugins.safety.twins import (
    Parting,
    TwinDiff,
    TwinReport,
    diff_of_accident,
    twins_of,
)
from deepaccident_devkit.support.arrays import ShortRepr, known
from deepaccident_devkit.support.reports import Report, Row
from deepaccident_devkit.taxonomy import AGENTS, short_name

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine
    from deepaccident_devkit.tables.records import ScenarioRecord


# Seconds: the time to collision under which a pair counts as exposed.
CRITICAL_TTC: Final = InteractionConfig().taus[0]
# m/s² of the last moments to brake.
DECELERATIONS: Final = tuple(sorted({each.deceleration for each in BRAKINGS}))
_SIDES: Final = ("first", "second")
_OF_COLLIDERS: Final = ("actor_id", "category", "agent", "turn", "speed", "side", "delta_v")
# Columns of the CSV file.
ROW_HEADING: Final = (
    "scenario",
    *(f"{side}_{name}" for side in _SIDES for name in _OF_COLLIDERS),
    *("gap", "closing_speed", "impact_angle", "margin", "head_on", "time_exposed", "pet"),
    *(f"lead_{agent}" for agent in AGENTS),
    "lead_all",
    "brakes",
    *(f"last_moment_{deceleration:g}" for deceleration in DECELERATIONS),
    *("twin", "twin_parts"),
    "story",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PairMeasures:
    """Measures of the colliders over the recording; None for what is not known.

    Their least time to collision is left out: it is 0 where they touch.

    Attributes:
        time_exposed: seconds with a time to collision of at most `CRITICAL_TTC`.
        pet: post-encroachment time, seconds; 0 if their boxes touch.
    """

    time_exposed: float | None
    pet: float | None

    @classmethod
    def of(cls, pairs: InteractionPairs, first: int, second: int) -> PairMeasures | None:
        """Those of two actors in `interactions(…).pairs`; None if they never come under a threshold there."""
        at = pairs.position(first, second)
        return (
            None
            if at is None
            else cls(time_exposed=known(pairs.tet[at, 0], 2), pet=known(abs(pairs.pet[at]), 2))
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentRow(ShortRepr):
    """An accident.

    Attributes:
        story: its facts, and sentences of them.
        replayed: until when braking would have avoided it; None if the recording does not show it.
        times: how long before the impact sets of agents observed both; None if there are no labels of the ego.
        twin: where it parts from its twin; None without one.
        measures: of the colliders over the recording.
    """

    story: Story
    replayed: Avoidability | None
    times: LeadTimes | None
    twin: TwinDiff | None
    measures: PairMeasures | None

    @property
    def scenario(self) -> str:
        """Token."""
        return str(self.story.facts["scenario"])

    @property
    def colliders(self) -> list[dict[str, Any]]:
        """The two as the story's facts tell them."""
        return list(self.story.facts["accident"]["pair"])

    @property
    def names(self) -> list[str]:
        """What the two are called."""
        return [actor_name(each) for each in self.colliders]

    @property
    def severity(self) -> float:
        """The larger delta-v of the two, m/s; −1 if none is known."""
        return max(
            (each["delta_v"] for each in self.colliders if each["delta_v"] is not None),
            default=-1.0,
        )

    @property
    def leads(self) -> dict[str, float | None]:
        """Agent → seconds before the impact at which it alone first observes both; then `all`. None: not there."""
        seen = self.story.facts["accident"]["seen"]
        together = None if self.times is None else round(self.times.together, 1)
        return {**{agent: seen.get(agent) for agent in AGENTS}, "all": together}

    @property
    def brakes(self) -> list[str | None]:
        """Who brakes in `last_moments`: the ego alone if it collides, both else; None for one that is no agent."""
        braking = self.story.facts["accident"]["braking"]
        return [] if braking is None else list(braking["by"])

    @property
    def last_moments(self) -> dict[float, float | None]:
        """Deceleration → seconds before the impact at which braking still avoids it; None if it never does."""
        if self.replayed is None:
            return {}
        row = BRAKERS.index("both")
        if len(self.brakes) == 1:
            row = self.replayed.accident.agents.index("ego_vehicle")
        values = zip(
            self.replayed.decelerations.tolist(), self.replayed.slack[row].tolist(), strict=True
        )
        return {deceleration: known(slack, 2) for deceleration, slack in values}

    @property
    def parts(self) -> float | None:
        """Seconds before the impact at which the first actor acts otherwise in the twin; None if none does."""
        return None if self.twin is None else known(self.twin.to_dict()["time_to_impact"], 1)

    def to_dict(self) -> dict[str, Any]:
        """For JSON; None for what is not known."""
        accident = self.story.facts["accident"]
        replayed = self.replayed
        return {
            "scenario": self.scenario,
            "colliders": self.colliders,
            **{name: accident[name] for name in ("gap", "closing_speed", "impact_angle")},
            "margin": None if replayed is None else replayed.check.margin,
            "head_on": None if replayed is None else replayed.head_on,
            "time_exposed": None if self.measures is None else self.measures.time_exposed,
            "pet": None if self.measures is None else self.measures.pet,
            "leads": self.leads,
            "brakes": self.brakes,
            "last_moments": {f"{key:g}": value for key, value in self.last_moments.items()},
            "twin": None if self.twin is None else self.twin.twin,
            "twin_parts": self.parts,
            "story": self.story.text,
            "unknown": list(self.story.facts["unknown"]),
        }


def actor_name(actor: Mapping[str, Any]) -> str:
    """An actor of a story's facts: `ego (car)`, or `cyclist 1234` for one that is no agent."""
    category = actor["category"] or "road user"
    return (
        f"{short_name(actor['agent'])} ({category})"
        if actor["agent"]
        else f"{category} {actor['actor_id']}"
    )


def csv_row(row: AccidentRow) -> list[Any]:
    """The cells of `ROW_HEADING`."""
    told = row.to_dict()
    colliders = [each[name] for each in row.colliders for name in _OF_COLLIDERS]
    measures = ("gap", "closing_speed", "impact_angle", "margin", "head_on", "time_exposed", "pet")
    moments = [row.last_moments.get(deceleration) for deceleration in DECELERATIONS]
    brakes = " ".join(each or "none" for each in row.brakes)
    return [
        *(row.scenario, *colliders, *map(told.get, measures)),
        *(*row.leads.values(), brakes, *moments, *map(told.get, ("twin", "twin_parts", "story"))),
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyReport(Report):
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
        return [
            (scenario, ", ".join(names), reason) for (scenario, reason), names in reasons.items()
        ]

    def to_dict(self) -> dict[str, Any]:
        """For JSON; None for what is not known."""
        return {
            "dataroot": self.dataroot,
            "version": self.version,
            "fingerprint": self.twins.fingerprint,
            "scenarios": self.scenarios,
            "accidents": [each.to_dict() for each in self.rows],
            "lead_times": self.ledger.to_dict()["summary"],
            "margins": dict(self.avoidability.margins),
            "normal": [{**each.facts, "text": each.text} for each in self.normal],
            "torn": [asdict(each) for each in self.twins.torn],
            "left_out": [
                dict(zip(("scenario", "part", "reason"), each, strict=True))
                for each in self.left_out
            ],
        }

    def named_tables(self) -> dict[str, Iterable[Row]]:
        """`accidents`, a row an accident (metres, seconds, m/s, degrees), and `left_out`."""
        return {
            "accidents": [ROW_HEADING, *map(csv_row, self.rows)],
            "left_out": [("scenario", "part", "reason"), *self.left_out],
        }


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
    **how: Unpack[Engine],
) -> SafetyReport:
    """Last moments to brake, lead times, twins and stories of scenarios, with each accident replayed once.

    Args:
        dataset: the release.
        scenarios: tokens or records of those to look at, such as `find` gives; None for all.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        TokenError: no such scenario.
    """
    looked = those_of(
        _Looked, each_scenario(_looked_at, dataset, scenarios, label="safety", at_once=1, **how)
    )
    return SafetyReport(
        scenarios=len(looked),
        rows=tuple(_rows(looked)),
        avoidability=report_of(dataset, [each.replayed for each in looked]),
        ledger=ledger_of(dataset, [each.times for each in looked], ObservationRule()),
        twins=twins_of(dataset, [each.twin for each in looked]),
        normal=tuple(
            sorted(
                (each.story for each in looked if each.story.facts["collision"] is False),
                key=_urgency,
            )
        ),
        broken=tuple(
            Skipped(scenario=each.scenario, reason=" ".join(each.messages))
            for each in dataset.problems
        ),
    )


def _looked_at(dataset: Dataset, record: ScenarioRecord) -> _Looked:
    replayed: Avoidability | Dropped | Skipped | None = tried(looked_into, dataset, record)
    facts = scenario_facts(
        dataset, record, replayed.why if isinstance(replayed, Dropped) else replayed
    )
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
