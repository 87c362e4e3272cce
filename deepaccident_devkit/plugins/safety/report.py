"""`safety_report`: all that is known of a release's accidents, with a row for each."""

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
    replay_accident,
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


# Time to collision in seconds below which a pair counts as exposed.
CRITICAL_TTC: Final = InteractionConfig().taus[0]
# Decelerations in m/s² of the last moments to brake.
DECELERATIONS: Final = tuple(sorted({braking.deceleration for braking in BRAKINGS}))
_SIDES: Final = ("first", "second")
_COLLIDER_COLUMNS: Final = ("actor_id", "category", "agent", "turn", "speed", "side", "delta_v")
# Columns of the CSV file.
ROW_HEADING: Final = (
    "scenario",
    *(f"{side}_{name}" for side in _SIDES for name in _COLLIDER_COLUMNS),
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
    """Measures of the colliders over the recording; None for unknown values.

    Their smallest time to collision is left out: it is 0 where they touch.

    Attributes:
        time_exposed: Seconds with a time to collision of at most `CRITICAL_TTC`.
        pet: Post-encroachment time in seconds; 0 if their boxes touch.
    """

    time_exposed: float | None
    pet: float | None

    @classmethod
    def of(cls, pairs: InteractionPairs, first: int, second: int) -> PairMeasures | None:
        """Return the measures of two actors in `interactions(…).pairs`.

        None if the two never come under a threshold there.
        """
        index = pairs.position(first, second)
        if index is None:
            return None
        time_exposed, pet = known(pairs.tet[index, 0], 2), known(abs(pairs.pet[index]), 2)
        return cls(time_exposed=time_exposed, pet=pet)


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentRow(ShortRepr):
    """An accident.

    Attributes:
        story: Its facts, and sentences about them.
        replayed: Until when braking would have avoided it; None if the recording does not show it.
        times: How long before the impact sets of agents observed both colliders; None if the ego
            has no labels.
        twin: Where it parts from its twin; None without a twin.
        measures: Measures of the colliders over the recording.
    """

    story: Story
    replayed: Avoidability | None
    times: LeadTimes | None
    twin: TwinDiff | None
    measures: PairMeasures | None

    @property
    def scenario(self) -> str:
        """Token of the scenario."""
        return str(self.story.facts["scenario"])

    @property
    def colliders(self) -> list[dict[str, Any]]:
        """The two colliders, as facts of the story."""
        return list(self.story.facts["accident"]["pair"])

    @property
    def names(self) -> list[str]:
        """Names of the two colliders."""
        return [actor_name(collider) for collider in self.colliders]

    @property
    def severity(self) -> float:
        """The larger delta-v of the two, m/s; −1 if neither is known."""
        values = [collider["delta_v"] for collider in self.colliders]
        return max((value for value in values if value is not None), default=-1.0)

    @property
    def leads(self) -> dict[str, float | None]:
        """Agent → seconds before the impact at which it first observes both; then `all`.

        None for an agent without an observation.
        """
        lead_by_agent = self.story.facts["accident"]["seen"]
        together = None if self.times is None else round(self.times.together, 1)
        return {**{agent: lead_by_agent.get(agent) for agent in AGENTS}, "all": together}

    @property
    def brakes(self) -> list[str | None]:
        """The drivers that brake in `last_moments`: only the ego if it collides, otherwise both.

        None for a driver that is no agent.
        """
        braking = self.story.facts["accident"]["braking"]
        if braking is None:
            return []
        return list(braking["by"])

    @property
    def last_moments(self) -> dict[float, float | None]:
        """Deceleration → last seconds before the impact to brake and avoid it; None if too late."""
        if self.replayed is None:
            return {}
        row = BRAKERS.index("both")
        if len(self.brakes) == 1:
            row = self.replayed.accident.agents.index("ego_vehicle")
        decelerations, slacks = self.replayed.decelerations, self.replayed.slack[row]
        return {
            deceleration: known(slack, 2)
            for deceleration, slack in zip(decelerations.tolist(), slacks.tolist(), strict=True)
        }

    @property
    def parts(self) -> float | None:
        """Seconds before the impact at which the first actor acts differently in the twin.

        None if no actor does.
        """
        return None if self.twin is None else known(self.twin.to_dict()["time_to_impact"], 1)

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON; None for unknown values."""
        accident = self.story.facts["accident"]
        replayed, measures = self.replayed, self.measures
        return {
            "scenario": self.scenario,
            "colliders": self.colliders,
            **{name: accident[name] for name in ("gap", "closing_speed", "impact_angle")},
            "margin": None if replayed is None else replayed.check.margin,
            "head_on": None if replayed is None else replayed.head_on,
            "time_exposed": None if measures is None else measures.time_exposed,
            "pet": None if measures is None else measures.pet,
            "leads": self.leads,
            "brakes": self.brakes,
            "last_moments": {f"{key:g}": value for key, value in self.last_moments.items()},
            "twin": None if self.twin is None else self.twin.twin,
            "twin_parts": self.parts,
            "story": self.story.text,
            "unknown": list(self.story.facts["unknown"]),
        }


def actor_name(actor: Mapping[str, Any]) -> str:
    """Return the name of an actor of a story: `ego (car)`, or `cyclist 1234` if it is no agent."""
    category = actor["category"] or "road user"
    if actor["agent"]:
        return f"{short_name(actor['agent'])} ({category})"
    return f"{category} {actor['actor_id']}"


def csv_row(row: AccidentRow) -> list[Any]:
    """Return the cells of `ROW_HEADING`."""
    payload = row.to_dict()
    colliders = [collider[name] for collider in row.colliders for name in _COLLIDER_COLUMNS]
    measures = ("gap", "closing_speed", "impact_angle", "margin", "head_on", "time_exposed", "pet")
    moments = [row.last_moments.get(deceleration) for deceleration in DECELERATIONS]
    brakes = " ".join(agent or "none" for agent in row.brakes)
    return [
        *(row.scenario, *colliders, *map(payload.get, measures)),
        *(*row.leads.values(), brakes, *moments),
        *map(payload.get, ("twin", "twin_parts", "story")),
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyReport(Report):
    """The accidents of a release, or of some of its scenarios, in all respects.

    Attributes:
        scenarios: Number of examined scenarios.
        rows: One row for each accident, in the order of the release, also if it cannot be replayed.
        avoidability: Until when braking would have avoided them.
        ledger: Lead times: which agents observed the colliders first.
        twins: Where they part from their normal twins.
        normal: Stories of the scenarios that end without a collision, the most critical first, by
            the smallest time to collision of two moving actors; stories without such a time come
            last.
        broken: Scenarios that the index leaves out (`on_error='skip'`), of the entire release.
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
        """Folder of the release."""
        return self.avoidability.dataroot

    @property
    def version(self) -> str:
        """`v1` or `v1-mini`."""
        return self.avoidability.version

    @property
    def left_out(self) -> list[tuple[str, str, str]]:
        """Scenario, the parts that leave it out, and the reason; each reason once."""
        unknown_facts = [
            Skipped(scenario=story.facts["scenario"], reason=reason)
            for story in self.normal
            for reason in story.facts["unknown"]
        ]
        parts = {
            "braking: dropped": self.avoidability.dropped,
            "braking: skipped": self.avoidability.skipped,
            "lead times": self.ledger.skipped,
            "twins": self.twins.skipped,
            "stories": unknown_facts,
            "everything": self.broken,
        }
        parts_by_reason: dict[tuple[str, str], list[str]] = {}
        for name, omissions in parts.items():
            for skipped in omissions:
                parts_by_reason.setdefault((skipped.scenario, skipped.reason), []).append(name)
        return [
            (scenario, ", ".join(names), reason)
            for (scenario, reason), names in parts_by_reason.items()
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON; None for unknown values."""
        left_out = [
            {"scenario": scenario, "part": parts, "reason": reason}
            for scenario, parts, reason in self.left_out
        ]
        return {
            "dataroot": self.dataroot,
            "version": self.version,
            "fingerprint": self.twins.fingerprint,
            "scenarios": self.scenarios,
            "accidents": [row.to_dict() for row in self.rows],
            "lead_times": self.ledger.to_dict()["summary"],
            "margins": dict(self.avoidability.margins),
            "normal": [{**story.facts, "text": story.text} for story in self.normal],
            "torn": [asdict(twins) for twins in self.twins.torn],
            "left_out": left_out,
        }

    def named_tables(self) -> dict[str, Iterable[Row]]:
        """Return `accidents`, a row for each (metres, seconds, m/s, degrees), and `left_out`."""
        return {
            "accidents": [ROW_HEADING, *map(csv_row, self.rows)],
            "left_out": [("scenario", "part", "reason"), *self.left_out],
        }


@dataclass(frozen=True, slots=True)
class _Examination:
    """The results for one scenario; Skipped explains a missing one, None means no accident."""

    replayed: Avoidability | Skipped | Dropped | None
    times: LeadTimes | Skipped | None
    twin: TwinDiff | Skipped | None
    story: Story
    measures: PairMeasures | None


def safety_report(
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    **engine: Unpack[Engine],
) -> SafetyReport:
    """Return last moments to brake, lead times, twins and stories of scenarios.

    Each accident is replayed once.

    Args:
        dataset: The release.
        scenarios: Tokens or records of scenarios, such as `find` returns; None for all.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        TokenError: There is no such scenario.
    """
    results = each_scenario(_examine, dataset, scenarios, label="safety", at_once=1, **engine)
    examinations = those_of(_Examination, results)
    replays, times, twins, normal = [], [], [], []
    for examination in examinations:
        replays.append(examination.replayed)
        times.append(examination.times)
        twins.append(examination.twin)
        if examination.story.facts["collision"] is False:
            normal.append(examination.story)
    broken = [
        Skipped(scenario=problem.scenario, reason=" ".join(problem.messages))
        for problem in dataset.problems
    ]
    return SafetyReport(
        scenarios=len(examinations),
        rows=tuple(_accident_rows(examinations)),
        avoidability=report_of(dataset, replays),
        ledger=ledger_of(dataset, times, ObservationRule()),
        twins=twins_of(dataset, twins),
        normal=tuple(sorted(normal, key=_urgency)),
        broken=tuple(broken),
    )


def _examine(dataset: Dataset, record: ScenarioRecord) -> _Examination:
    replayed: Avoidability | Dropped | Skipped | None = tried(replay_accident, dataset, record)
    replay = replayed.why if isinstance(replayed, Dropped) else replayed
    facts = scenario_facts(dataset, record, replay)
    measures = None
    if facts["accident"] is not None:
        pairs = interactions(dataset, record).pairs
        actor_ids = [collider["actor_id"] for collider in facts["accident"]["pair"]]
        measures = PairMeasures.of(pairs, *actor_ids)
    return _Examination(
        replayed=replayed,
        times=tried(lead_times, dataset, record),
        twin=tried(partial(diff_of_accident, parting=Parting()), dataset, record),
        story=Story(facts=facts, text=story_text(facts)),
        measures=measures,
    )


def _accident_rows(examinations: Iterable[_Examination]) -> Iterator[AccidentRow]:
    for examination in examinations:
        if examination.story.facts["accident"] is None:
            continue
        replayed, times, twin = examination.replayed, examination.times, examination.twin
        yield AccidentRow(
            story=examination.story,
            replayed=replayed if isinstance(replayed, Avoidability) else None,
            times=None if isinstance(times, Skipped) else times,
            twin=None if isinstance(twin, Skipped) else twin,
            measures=examination.measures,
        )


def _urgency(story: Story) -> tuple[float, str]:
    nearest = story.facts["nearest"]
    min_ttc = None if nearest is None else nearest["min_ttc"]
    return float("inf") if min_ttc is None else min_ttc, story.facts["scenario"]
