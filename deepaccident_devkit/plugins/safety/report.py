"""`safety_report`: everything that is known about a release's accidents, one row per accident."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.collisions.outcomes import BRAKINGS
from deepaccident_devkit.collisions.recorded import (
    Skipped,
    map_scenarios,
    select_results,
    try_scenario,
)
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
from deepaccident_devkit.support.arrays import ShortRepr, json_numbers
from deepaccident_devkit.support.reports import Report, Row
from deepaccident_devkit.support.values import ReadOnlyValues
from deepaccident_devkit.taxonomy import AGENTS, short_name

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine
    from deepaccident_devkit.tables.records import ScenarioRecord


# Time to collision in seconds below which a pair counts as exposed.
CRITICAL_TTC: Final = InteractionConfig().taus[0]
# Decelerations in m/s² for which the last moment to brake is listed.
DECELERATIONS: Final = tuple(sorted({braking.deceleration for braking in BRAKINGS}))

_COLLIDER_COLUMNS = ("actor_id", "category", "agent", "turn", "speed", "side", "delta_v")
# Columns of the CSV file.
ROW_HEADING: Final = (
    "scenario",
    *(f"first_{name}" for name in _COLLIDER_COLUMNS),
    *(f"second_{name}" for name in _COLLIDER_COLUMNS),
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
    """How near two colliders come during the recording; None for unknown values.

    The smallest time to collision is left out because it is 0 for colliders that touch.

    Attributes:
        time_exposed: Seconds with a time to collision of at most `CRITICAL_TTC`.
        pet: Post-encroachment time in seconds; 0 if their boxes touch.
    """

    time_exposed: float | None
    pet: float | None

    @classmethod
    def of(cls, pairs: InteractionPairs, first: int, second: int) -> PairMeasures | None:
        """Return the measures of two actors from `interactions(…).pairs`.

        Return None if the actors are not among the pairs because they never come near enough.
        """
        index = pairs.position(first, second)
        if index is None:
            return None
        pet = abs(pairs.pet[index])
        return cls(time_exposed=json_numbers(pairs.tet[index, 0], 2), pet=json_numbers(pet, 2))


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentRow(ShortRepr):
    """Everything that is known about one accident.

    Attributes:
        story: Facts, and sentences about them.
        replayed: Replay that shows how late braking could still have avoided the accident; None if
            the recording does not show the impact.
        times: Lead times of sets of agents; None if the ego has no labels.
        twin: Comparison with the twin; None without a twin.
        measures: How near the colliders come during the recording.
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
        """Facts about the two colliders."""
        return list(self.story.facts["accident"]["pair"])

    @property
    def names(self) -> list[str]:
        """Names of the two colliders."""
        return [actor_name(collider) for collider in self.colliders]

    @property
    def severity(self) -> float:
        """The larger delta-v of the two colliders in m/s; −1 if neither is known."""
        severity = -1.0
        for collider in self.colliders:
            if collider["delta_v"] is not None:
                severity = max(severity, collider["delta_v"])
        return severity

    @property
    def leads(self) -> dict[str, float | None]:
        """Seconds before the impact at which each agent, and finally `all`, first observes both.

        None for an agent that never observes both.
        """
        seen = self.story.facts["accident"]["seen"]
        leads: dict[str, float | None] = {agent: seen.get(agent) for agent in AGENTS}
        leads["all"] = None
        if self.times is not None:
            leads["all"] = round(self.times.together, 1)
        return leads

    @property
    def brakes(self) -> list[str | None]:
        """The drivers who brake in `last_moments`: the ego if it is a collider, otherwise both.

        None for a driver that is not an agent.
        """
        braking = self.story.facts["accident"]["braking"]
        if braking is None:
            return []
        return list(braking["by"])

    @property
    def last_moments(self) -> dict[float, float | None]:
        """Deceleration → last moment at which braking avoids the accident, in seconds before it.

        None if braking cannot avoid it even from the start of the recording.
        """
        if self.replayed is None:
            return {}
        row = BRAKERS.index("both")
        if len(self.brakes) == 1:
            row = self.replayed.accident.agents.index("ego_vehicle")
        decelerations = self.replayed.decelerations.tolist()
        moments = json_numbers(self.replayed.slack[row], 2)
        return dict(zip(decelerations, moments, strict=True))

    @property
    def parts(self) -> float | None:
        """Seconds before the impact when the first actor begins to act differently in the twin.

        None if no actor does, or if there is no twin.
        """
        if self.twin is None:
            return None
        seconds: float | None = json_numbers(self.twin.to_dict()["time_to_impact"], 1)
        return seconds

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON; None for unknown values."""
        accident = self.story.facts["accident"]
        replayed = self.replayed
        measures = self.measures
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
            "last_moments": {
                f"{deceleration:g}": moment for deceleration, moment in self.last_moments.items()
            },
            "twin": None if self.twin is None else self.twin.twin,
            "twin_parts": self.parts,
            "story": self.story.text,
            "unknown": list(self.story.facts["unknown"]),
        }


def actor_name(actor: ReadOnlyValues) -> str:
    """Name a story's actor: `ego (car)`, or `cyclist 1234` if it is not an agent."""
    category = actor["category"] or "road user"
    if actor["agent"]:
        return f"{short_name(actor['agent'])} ({category})"
    return f"{category} {actor['actor_id']}"


def csv_row(row: AccidentRow) -> list[Any]:
    """Return an accident's cells in the CSV file, in the order of `ROW_HEADING`."""
    payload = row.to_dict()
    colliders: list[Any] = []
    for collider in row.colliders:
        colliders += map(collider.get, _COLLIDER_COLUMNS)
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
    """Everything that is known about the accidents of a release, or of some of its scenarios.

    Attributes:
        scenarios: Number of examined scenarios.
        rows: One row per accident, in the order of the release; this includes accidents that cannot
            be replayed.
        avoidability: Report on how late braking could still have avoided them.
        ledger: Lead times, which show which agents observed the colliders first.
        twins: Comparison with their normal twins.
        normal: Stories of the scenarios that end without a collision, sorted by the smallest time
            to collision between two moving actors; stories in which it is undefined come last.
        broken: Scenarios of the entire release that the index leaves out (`on_error='skip'`).
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
        """Scenarios that are left out, the part of the report that omits each, and the reason."""
        unknown_facts = []
        for story in self.normal:
            for reason in story.facts["unknown"]:
                unknown_facts.append(Skipped(scenario=story.facts["scenario"], reason=reason))
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
        """Return the tables `accidents` (metres, seconds, m/s, degrees) and `left_out`."""
        return {
            "accidents": [ROW_HEADING, *map(csv_row, self.rows)],
            "left_out": [("scenario", "part", "reason"), *self.left_out],
        }


@dataclass(frozen=True, slots=True)
class _Examination:
    """The results for one scenario; None if it has no accident, Skipped if a result failed."""

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
    """Report last moments to brake, lead times, twins and stories of scenarios.

    Each accident is replayed only once.

    Args:
        dataset: The release.
        scenarios: Tokens or records of scenarios, such as `find` returns; None for all.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        TokenError: If the release has no such scenario.
    """
    results = map_scenarios(
        _examine, dataset, scenarios, label="Examining accidents", at_once=1, **engine
    )
    examinations = select_results(_Examination, results)
    replays = [examination.replayed for examination in examinations]
    times = [examination.times for examination in examinations]
    twins = [examination.twin for examination in examinations]
    stories = [examination.story for examination in examinations]
    normal = [story for story in stories if story.facts["collision"] is False]
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
    """Compute all results for one scenario."""
    replayed: Avoidability | Dropped | Skipped | None = try_scenario(
        replay_accident, dataset, record
    )
    replay = replayed.why if isinstance(replayed, Dropped) else replayed
    facts = scenario_facts(dataset, record, replay)
    measures = None
    if facts["accident"] is not None:
        pairs = interactions(dataset, record).pairs
        actor_ids = [collider["actor_id"] for collider in facts["accident"]["pair"]]
        measures = PairMeasures.of(pairs, *actor_ids)
    return _Examination(
        replayed=replayed,
        times=try_scenario(lead_times, dataset, record),
        twin=try_scenario(partial(diff_of_accident, parting=Parting()), dataset, record),
        story=Story(facts=facts, text=story_text(facts)),
        measures=measures,
    )


def _accident_rows(examinations: Iterable[_Examination]) -> Iterator[AccidentRow]:
    """Yield a row for each examined scenario that has an accident."""
    for examination in examinations:
        if examination.story.facts["accident"] is None:
            continue
        replayed = examination.replayed
        times = examination.times
        twin = examination.twin
        yield AccidentRow(
            story=examination.story,
            replayed=replayed if isinstance(replayed, Avoidability) else None,
            times=None if isinstance(times, Skipped) else times,
            twin=None if isinstance(twin, Skipped) else twin,
            measures=examination.measures,
        )


def _urgency(story: Story) -> tuple[float, str]:
    """Return a key that sorts stories by smallest time to collision, then by scenario."""
    min_ttc = math.inf
    nearest = story.facts["nearest"]
    if nearest is not None and nearest["min_ttc"] is not None:
        min_ttc = nearest["min_ttc"]
    return min_ttc, story.facts["scenario"]
