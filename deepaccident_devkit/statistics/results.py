"""The parts of statistics: counts by a word, histograms, quantiles, colliding pairs; each also as rows of CSV."""

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
"""The groups of counts: all scenarios, those of each split, those whose split is unknown."""

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
"""How a scenario can end, as the reference's statistics say it: designs 1–6 signalised, 7–12 not; the reference calls
a collision of two agents that realises none of them `none`."""

CRITICAL: Final = "scenario_min_ttcs"
"""Name of the histogram of the most critical pairs."""
PROBABILITIES: Final = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
"""Of all quantiles; the first and last are the extremes."""

_Cell = str | int | float | None
StatisticsRow = tuple[_Cell, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class LeftOut(ShortRepr):
    """Items that a table does not count, since they have no value.

    Attributes:
        what: what they are and why.
        counts: group → how many.
    """

    what: str
    counts: Mapping[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class CountTable(ShortRepr):
    """How many there are of each value of a word.

    Attributes:
        name: of the table, also of its file.
        title: for people.
        field: what the values are, such as `weather`.
        counted: what is counted: `scenarios`, `frames`, `instances`, `annotations`.
        counts: value → group → how many.
        left_out: what is not counted.
    """

    name: str
    title: str
    field: str
    counted: str
    counts: Mapping[str, Mapping[str, int]]
    left_out: LeftOut | None = None

    def total(self, group: str = TOTAL) -> int:
        """Everything that is counted in a group."""
        return sum(row[group] for row in self.counts.values())

    def rows(self) -> list[StatisticsRow]:
        """A heading, then a row a value."""
        rows: list[StatisticsRow] = [(value, *row.values()) for value, row in self.counts.items()]
        return [(self.field, *GROUPS), *rows]


@dataclass(frozen=True, slots=True, kw_only=True)
class Histogram(ShortRepr):
    """How a number is distributed.

    Attributes:
        name: of the table, also of its file.
        title: for people.
        field: what the number is.
        unit: of the number.
        counted: what is counted.
        edges: B + 1 ascending edges; a bin holds its lower edge, the last one both.
        counts: group → how many in each of the B bins.
        outside: group → how many lie below the first edge or above the last.
        left_out: what has no value.
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
        """Everything that is counted in a group, outside of the bins too."""
        return sum(self.counts[group]) + self.outside[group]

    def bin_labels(self) -> list[str]:
        """What each bin of whole numbers holds: `30–39`, …, `90–100`."""
        return [f"{low:g}–{high - (high < self.edges[-1]):g}" for low, high in pairwise(self.edges)]

    def rows(self) -> list[StatisticsRow]:
        """A heading, a row a bin, and one of what lies outside."""
        bins = zip(self.edges[:-1], self.edges[1:], *self.counts.values(), strict=True)
        heading = (f"{self.field} from ({self.unit})", f"to ({self.unit})", *GROUPS)
        return [heading, *bins, ("outside", None, *self.outside.values())]


@dataclass(frozen=True, slots=True, kw_only=True)
class QuantileRow(ShortRepr):
    """The quantiles of one number of one category in one group.

    Attributes:
        field: what the number is.
        category: whose it is.
        group: of `GROUPS`.
        number: how many values there are.
        values: the quantiles at `PROBABILITIES`, linear between neighbours; None without a value.
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
        name: of the table, also of its file.
        title: for people.
        unit: of all values.
        counted: what the values belong to.
        quantiles: the rows.
        left_out: what has no value.
    """

    name: str
    title: str
    unit: str
    counted: str
    quantiles: tuple[QuantileRow, ...]
    left_out: LeftOut | None = None

    def row(self, field: str, category: str, group: str = TOTAL) -> QuantileRow:
        """The row of a field, category and group; raises KeyError."""
        for row in self.quantiles:
            if (row.field, row.category, row.group) == (field, category, group):
                return row
        raise KeyError((field, category, group))

    def median(self, field: str, category: str, group: str = TOTAL) -> float | None:
        """The median of a field, category and group, None without a value; raises KeyError."""
        values = self.row(field, category, group).values
        return None if values is None else values[PROBABILITIES.index(0.5)]

    def rows(self) -> list[StatisticsRow]:
        """A heading, then a row a field, category and group."""
        names = [f"q{round(100 * probability)} ({self.unit})" for probability in PROBABILITIES]
        absent = (None,) * len(PROBABILITIES)
        return [
            ("field", "category", "group", "number", *names),
            *(
                (row.field, row.category, row.group, row.number, *(row.values or absent))
                for row in self.quantiles
            ),
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class CollisionPair(ShortRepr):
    """The colliding pair of a scenario at its last frame, by the merged tracks.

    The first of the pair is the agent that comes first in `taxonomy.AGENTS`; without an agent, meta's first.

    Attributes:
        scenario: its token.
        split: the group that it counts for, besides `total`.
        end: of `ENDS`.
        actor: name of the first's agent, None if it records nothing.
        category: of the first.
        other: name of the other's agent, None if it records nothing.
        other_category: of the other.
        angle: the other's heading less the first's, degrees, counter-clockwise, in [−15, 345): 0 same direction,
            90 the other drives to the first's left, 180 head-on, 270 to its right.
        x: centre of the other, forward of the first's centre, metres.
        y: the same, to the left.
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
    """A heading, then a row a pair."""
    return [
        tuple(field.name for field in fields(CollisionPair)),
        *(astuple(pair) for pair in pairs),
    ]


StatisticsTable = CountTable | Histogram | QuantileTable


def scenario_end(scenario: ScenarioRecord, agents: Sequence[AgentRecord]) -> str | None:
    """How a scenario ended, one of `ENDS`, by it and its agents here; None without meta, or where meta is silent."""
    collision = scenario["collision"]
    if scenario["weather"] is None:  # there is no meta
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
    """Of a collision that realises no design: whether its pair are agents; None where meta is silent."""
    here = {agent["name"]: agent["actor_id"] for agent in agents if not agent["is_infrastructure"]}
    names = collision["agents"] or (None, None)
    missing = set(VEHICLE_AGENTS) - set(
        here
    )  # of a partial download: meta's names stand for their ids
    if None in here.values() or (missing and collision["agents"] is None):
        return None
    if not all(
        actor in here.values() or name in missing
        for actor, name in zip(collision["ids"], names, strict=True)
    ):
        return WITH_OTHER
    story = ("road_type", "spawn_side", "ego_direction", "other_direction")
    return None if None in [scenario[word] for word in story] else NO_DESIGN  # type: ignore[literal-required]


def word_of(scenario: ScenarioRecord, field: str) -> str | None:
    """What a scenario counts as in tables of a field of its record."""
    if field != "collision":
        return scenario[field]  # type: ignore[literal-required,no-any-return]
    if scenario["weather"] is None:  # there is no meta
        return None
    return "yes" if scenario["collision"] else "no"
