"""Parts of the statistics, with their CSV rows: counts by word, histograms, quantiles, pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from itertools import pairwise
from typing import TYPE_CHECKING

from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.taxonomy import SPLITS, VEHICLE_AGENTS

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import AgentRecord, CollisionRecord, ScenarioRecord

TOTAL = "total"
UNKNOWN_SPLIT = "unknown"
GROUPS = (TOTAL, *SPLITS, UNKNOWN_SPLIT)
"""The groups of counts: all scenarios, each split, and scenarios without a known split."""

NO_ACCIDENT = "no accident"
WITH_PEDESTRIAN = "collide with pedestrians"
WITH_OTHER = "collide with other vehicles"
NO_DESIGN = "no design"
ENDS = (
    NO_ACCIDENT,
    WITH_PEDESTRIAN,
    WITH_OTHER,
    *(f"design {number}" for number in range(1, 13)),
    NO_DESIGN,
)
"""How a scenario can end, as in the reference's statistics.

Designs 1–6 have traffic lights, 7–12 do not. The reference uses `none` for a collision of two
agents that follows none of the designs.
"""

CRITICAL = "scenario_min_ttcs"
"""Name of the histogram of each scenario's most critical pair."""
PROBABILITIES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
"""Probabilities at which all quantiles are computed; 0 and 1 are the extremes."""

# A cell of a table.
_Cell = str | int | float | None
StatisticsRow = tuple[_Cell, ...]
"""A row of a table, as written to CSV."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LeftOut(ShortRepr):
    """Items that a table does not count because they have no value.

    Attributes:
        what: Description of the items, and why they are left out.
        counts: Group → number of items.
    """

    what: str
    counts: Mapping[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class CountTable(ShortRepr):
    """Counts by the values of a field.

    Attributes:
        name: Name of the table and of its file.
        title: Title for display.
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
        """Return the sum of a group's counts over all values."""
        return sum(row[group] for row in self.counts.values())

    def rows(self) -> list[StatisticsRow]:
        """Return a heading, then one row per value."""
        rows: list[StatisticsRow] = [(self.field, *GROUPS)]
        for value, counts in self.counts.items():
            rows.append((value, *counts.values()))
        return rows


@dataclass(frozen=True, slots=True, kw_only=True)
class Histogram(ShortRepr):
    """Distribution of a number.

    Attributes:
        name: Name of the table and of its file.
        title: Title for display.
        field: Name of the number.
        unit: Unit of the number.
        counted: What is counted.
        edges: B + 1 ascending edges; a bin includes its lower edge, the last bin both edges.
        counts: Group → counts in the B bins.
        outside: Group → number of values below the lowest edge or above the highest.
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
        """Return the sum of a group's counts, including values outside the bins."""
        inside = sum(self.counts[group])
        return inside + self.outside[group]

    def bin_labels(self) -> list[str]:
        """Return the range of each bin in whole numbers: `30–39`, …, `90–100`."""
        labels = []
        for low, high in pairwise(self.edges):
            highest = high - (high < self.edges[-1])
            labels.append(f"{low:g}–{highest:g}")
        return labels

    def rows(self) -> list[StatisticsRow]:
        """Return a heading, a row per bin, and a row for values outside the bins."""
        lower_edges = self.edges[:-1]
        upper_edges = self.edges[1:]
        bins = zip(lower_edges, upper_edges, *self.counts.values(), strict=True)
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
        values: Quantiles at `PROBABILITIES`, interpolated linearly; None without values.
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
        name: Name of the table and of its file.
        title: Title for display.
        unit: Unit of all values.
        counted: What the values describe.
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
        """Return the row of a field, category and group; raise KeyError if it does not exist."""
        for row in self.quantiles:
            if (row.field, row.category, row.group) == (field, category, group):
                return row
        raise KeyError((field, category, group))

    def median(self, field: str, category: str, group: str = TOTAL) -> float | None:
        """Return a median, or None without a value; raise KeyError if the row does not exist."""
        values = self.row(field, category, group).values
        if values is None:
            return None
        return values[PROBABILITIES.index(0.5)]

    def rows(self) -> list[StatisticsRow]:
        """Return a heading, then a row per field, category and group."""
        names = [f"q{round(100 * probability)} ({self.unit})" for probability in PROBABILITIES]
        rows: list[StatisticsRow] = [("field", "category", "group", "number", *names)]
        for row in self.quantiles:
            values = row.values or (None,) * len(PROBABILITIES)
            rows.append((row.field, row.category, row.group, row.number, *values))
        return rows


@dataclass(frozen=True, slots=True, kw_only=True)
class CollisionPair(ShortRepr):
    """The colliding pair of a scenario in its last frame, from the merged tracks.

    The first actor is the agent that comes first in `taxonomy.AGENTS`. If neither is an agent, it
    is the one that meta lists first. Attributes call the first `actor`, the second `other`.

    Attributes:
        scenario: Token of the scenario.
        split: Group in which the pair counts, apart from `total`.
        end: One of `ENDS`.
        actor: Name of the first actor if it is an agent; None otherwise.
        category: Category of the actor.
        other: Name of the other actor if it is an agent; None otherwise.
        other_category: Category of the other.
        angle: Heading of the other minus heading of the first, counter-clockwise, in degrees in
            [−15, 345): 0 for the same direction, 90 if the other drives to the first's left, 180 if
            they meet head-on, 270 if it drives to the first's right.
        x: Distance in metres by which the other's centre is in front of the first's.
        y: Distance in metres by which the other's centre is to the left of the first's.
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
    """Return a heading, then one row per pair."""
    heading = tuple(field.name for field in fields(CollisionPair))
    return [heading, *map(astuple, pairs)]


StatisticsTable = CountTable | Histogram | QuantileTable


def scenario_end(scenario: ScenarioRecord, agents: Sequence[AgentRecord]) -> str | None:
    """Return which of `ENDS` a scenario has; None if it has no meta, or meta does not say.

    Args:
        scenario: Record of the scenario.
        agents: The scenario's agents in the release.
    """
    collision = scenario["collision"]
    if scenario["weather"] is None:  # the scenario has no meta file
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
    """Return the end of a collision that follows no design, by how many of its pair are agents.

    Return None if meta does not say so.
    """
    vehicles = [agent for agent in agents if not agent["is_infrastructure"]]
    agent_ids = [agent["actor_id"] for agent in vehicles]
    # Agents that are missing from a partial download are only known from their names in meta.
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
    """Return the word under which a scenario is counted in the table of a field."""
    if field != "collision":
        return scenario[field]  # type: ignore[literal-required,no-any-return]
    if scenario["weather"] is None:  # the scenario has no meta file
        return None
    return "yes" if scenario["collision"] else "no"
