"""Parts of statistics, also as rows of CSV: counts by word, histograms, quantiles, pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.taxonomy import SPLITS, VEHICLE_AGENTS

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import AgentRecord, CollisionRecord, ScenarioRecord

TOTAL: Final = "total"
UNKNOWN_SPLIT: Final = "unknown"
GROUPS: Final = (TOTAL, *SPLITS, UNKNOWN_SPLIT)
"""The groups of counts: all scenarios, each split, and scenarios without a known split."""

NO_ACCIDENT: Final = "no accident"
WITH_PEDESTRIAN: Final = "collide with pedestrians"
WITH_OTHER: Final = "collide with other vehicles"
NO_DESIGN: Final = "no design"
ENDS: Final = (
    NO_ACCIDENT,
    WITH_PEDESTRIAN,
    WITH_OTHER,
    *(f"design {number}" for number in range(1, 13)),
    NO_DESIGN,
)
"""How a scenario can end, as in the reference's statistics.

Designs 1–6 are signalised, 7–12 are not; the reference calls a collision of two agents that
realises none of them `none`.
"""

CRITICAL: Final = "scenario_min_ttcs"
"""Name of the histogram of the most critical pairs."""
PROBABILITIES: Final = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
"""Probabilities of all quantiles; 0 and 1 are the extremes."""

_Cell = str | int | float | None
StatisticsRow = tuple[_Cell, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class LeftOut(ShortRepr):
    """Items that a table does not count, since they have no value.

    Attributes:
        what: Description of the items and of the reason.
        counts: Group → number of items.
    """

    what: str
    counts: Mapping[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class CountTable(ShortRepr):
    """Counts by the values of a field.

    Attributes:
        name: Name of the table, also of its file.
        title: Title for people.
        field: Field of the values, such as `weather`.
        counted: What is counted: `scenarios`, `frames`, `instances`, `annotations`.
        counts: Value → group → count.
        left_out: Items that are not counted.
    """

    name: str
    title: str
    field: str
    counted: str
    counts: Mapping[str, Mapping[str, int]]
    left_out: LeftOut | None = None

    def total(self, group: str = TOTAL) -> int:
        """Return the sum over all values in a group."""
        return sum(row[group] for row in self.counts.values())

    def rows(self) -> list[StatisticsRow]:
        """Return a heading, then a row a value."""
        rows: list[StatisticsRow] = [(self.field, *GROUPS)]
        for value, counts in self.counts.items():
            rows.append((value, *counts.values()))
        return rows


@dataclass(frozen=True, slots=True, kw_only=True)
class Histogram(ShortRepr):
    """Distribution of a number.

    Attributes:
        name: Name of the table, also of its file.
        title: Title for people.
        field: Name of the number.
        unit: Unit of the number.
        counted: What is counted.
        edges: B + 1 ascending edges; a bin holds its lower edge, the highest bin both edges.
        counts: Group → count in each of the B bins.
        outside: Group → count under the lowest edge or over the highest.
        left_out: Items without a value.
    """

    name: str
    title: str
    field: str
    unit: str
    counted: str
    edges: tuple[float, ...]
    counts: Mapping[str, tuple[int, ...]]
    outside: Mapping[str, int]
    left_out: LeftOut | None = None

    def total(self, group: str = TOTAL) -> int:
        """Return the sum over a group, with the values outside of the bins."""
        return sum(self.counts[group]) + self.outside[group]

    def bin_labels(self) -> list[str]:
        """Return the range of whole numbers in each bin: `30–39`, …, `90–100`."""
        labels = []
        for low, high in pairwise(self.edges):
            highest = high - (high < self.edges[-1])
            labels.append(f"{low:g}–{highest:g}")
        return labels

    def rows(self) -> list[StatisticsRow]:
        """Return a heading, a row a bin, and a row of values outside."""
        bins = zip(self.edges[:-1], self.edges[1:], *self.counts.values(), strict=True)
        heading = (f"{self.field} from ({self.unit})", f"to ({self.unit})", *GROUPS)
        outside = ("outside", None, *self.outside.values())
        return [heading, *bins, outside]


@dataclass(frozen=True, slots=True, kw_only=True)
class QuantileRow(ShortRepr):
    """Quantiles of a number for one category in one group.

    Attributes:
        field: Name of the number.
        category: Category of the objects.
        group: One of `GROUPS`.
        number: Number of values.
        values: Quantiles at `PROBABILITIES`, linear between neighbours; None without a value.
    """

    field: str
    category: str
    group: str
    number: int
    values: tuple[float, ...] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class QuantileTable(ShortRepr):
    """Quantiles of one or more numbers, by category and group.

    Attributes:
        name: Name of the table, also of its file.
        title: Title for people.
        unit: Unit of all values.
        counted: What the values belong to.
        quantiles: Rows of the table.
        left_out: Items without a value.
    """

    name: str
    title: str
    unit: str
    counted: str
    quantiles: tuple[QuantileRow, ...]
    left_out: LeftOut | None = None

    def row(self, field: str, category: str, group: str = TOTAL) -> QuantileRow:
        """Return the row of a field, category and group; raises KeyError."""
        for row in self.quantiles:
            if (row.field, row.category, row.group) == (field, category, group):
                return row
        raise KeyError((field, category, group))

    def median(self, field: str, category: str, group: str = TOTAL) -> float | None:
        """Return a median, None without a value; raises KeyError."""
        values = self.row(field, category, group).values
        if values is None:
            return None
        return values[PROBABILITIES.index(0.5)]

    def rows(self) -> list[StatisticsRow]:
        """Return a heading, then a row a field, category and group."""
        names = [f"q{round(100 * probability)} ({self.unit})" for probability in PROBABILITIES]
        rows: list[StatisticsRow] = [("field", "category", "group", "number", *names)]
        for row in self.quantiles:
            values = row.values or (None,) * len(PROBABILITIES)
            rows.append((row.field, row.category, row.group, row.number, *values))
        return rows


@dataclass(frozen=True, slots=True, kw_only=True)
class CollisionPair(ShortRepr):
    """The colliding pair of a scenario at its last frame, by the merged tracks.

    The actor of the pair is the agent that comes first in `taxonomy.AGENTS`; without an agent, it
    is the one that meta lists first. The other actor is called the other.

    Attributes:
        scenario: Token of the scenario.
        split: Group that the pair counts for, besides `total`.
        end: One of `ENDS`.
        actor: Name of the actor's agent, None if it records nothing.
        category: Category of the actor.
        other: Name of the other's agent, None if it records nothing.
        other_category: Category of the other.
        angle: The other's heading less the actor's, degrees, counter-clockwise, in [−15, 345):
            0 same direction, 90 the other drives to the actor's left, 180 head-on, 270 to its
            right.
        x: Centre of the other in front of the actor's centre, metres.
        y: Centre of the other to the left of the actor's centre, metres.
    """

    scenario: str
    split: str
    end: str
    actor: str | None
    category: str
    other: str | None
    other_category: str
    angle: float
    x: float
    y: float


def collision_rows(pairs: tuple[CollisionPair, ...]) -> list[StatisticsRow]:
    """Return a heading, then a row a pair."""
    heading = tuple(field.name for field in fields(CollisionPair))
    return [heading, *map(astuple, pairs)]


StatisticsTable = CountTable | Histogram | QuantileTable


def scenario_end(scenario: ScenarioRecord, agents: Sequence[AgentRecord]) -> str | None:
    """Return how a scenario ended, one of `ENDS`; None without meta, or where meta is silent.

    `agents` are the scenario's agents in the release.
    """
    collision = scenario["collision"]
    if scenario["weather"] is None:  # The scenario has no meta.
        return None
    if collision is None:
        return NO_ACCIDENT
    if "pedestrian" in collision["classes"]:
        return WITH_PEDESTRIAN
    if scenario["accident_type"] is not None:
        return f"design {scenario['accident_type']}"
    return _undesigned_end(scenario, collision, agents)


def _undesigned_end(
    scenario: ScenarioRecord, collision: CollisionRecord, agents: Sequence[AgentRecord]
) -> str | None:
    """Return the end of a collision without a design: whether its pair are agents.

    None is returned where meta is silent.
    """
    vehicles = [agent for agent in agents if not agent["is_infrastructure"]]
    agent_ids = [agent["actor_id"] for agent in vehicles]
    # Of agents that a partial download lacks, meta's names stand for the ids.
    missing_agents = set(VEHICLE_AGENTS) - {agent["name"] for agent in vehicles}
    if None in agent_ids or (missing_agents and collision["agents"] is None):
        return None
    names = collision["agents"] or (None, None)
    for actor, name in zip(collision["ids"], names, strict=True):
        if actor not in agent_ids and name not in missing_agents:
            return WITH_OTHER
    for field in ("road_type", "spawn_side", "ego_direction", "other_direction"):
        if scenario[field] is None:
            return None
    return NO_DESIGN


def word_of(scenario: ScenarioRecord, field: str) -> str | None:
    """Return the word that a scenario counts under in tables of a field of its record."""
    if field != "collision":
        return scenario[field]  # type: ignore[literal-required,no-any-return]
    if scenario["weather"] is None:  # The scenario has no meta.
        return None
    return "yes" if scenario["collision"] else "no"
