"""`Interactions`: the pairs of a scenario that come near each other, as arrays, Arrow tables and records.

Infinite stands for never, null for what cannot be known: an actor's velocity, or a direction where boxes overlap.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cache, partial
from types import MappingProxyType
from typing import Annotated, Any, Final, TypedDict

import numpy as np

from deepaccident_devkit.collisions.recorded import CLASS_MASSES
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    checked_number,
)
from deepaccident_devkit.tables.columns import Key, Number, TableSpec, Vector
from deepaccident_devkit.tables.records import spec_of
from deepaccident_devkit.tables.tokens import frame_token, instance_token


@dataclass(frozen=True, slots=True, kw_only=True)
class InteractionConfig:
    """Which pairs at which frames count as interactions, and how their measures are made.

    A pair at a frame is one if at least one of the two moves, their centres are within `radius`, and the time to
    collision is at most `max_ttc` or the gap at most `max_gap`.

    Attributes:
        radius: metres between the centres.
        max_ttc: seconds.
        max_gap: metres.
        horizon: seconds; a collision that would come later counts as none.
        taus: seconds, the two thresholds of the times exposed and integrated (TET, TIT), kept as a tuple.
        standing_speed: m/s; up to it an actor stands.
        class_masses: class → kilograms at its median size: an assumption, as the release has no masses; kept read-only.
    """

    radius: float = 200.0
    max_ttc: float = 10.0
    max_gap: float = 5.0
    horizon: float = 20.0
    taus: tuple[float, float] = (1.5, 3.0)
    standing_speed: float = 0.5
    class_masses: Mapping[str, float] = field(default_factory=lambda: CLASS_MASSES)

    def __post_init__(self) -> None:
        """Check the numbers; raises ConfigError."""
        for name in ("radius", "max_ttc", "max_gap", "horizon", "standing_speed"):
            object.__setattr__(self, name, _not_negative(name, getattr(self, name)))
        taus = tuple(_not_negative("taus", tau) for tau in self.taus)
        if len(taus) != 2:
            raise ConfigError(f"taus: expected two thresholds in seconds, found {len(taus)}")
        if self.horizon < self.max_ttc:
            raise ConfigError(
                f"horizon: expected at least max_ttc, {self.max_ttc} s, found {self.horizon} s"
            )
        object.__setattr__(self, "taus", taus)
        object.__setattr__(self, "class_masses", MappingProxyType(dict(self.class_masses)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Read-only mappings cannot be pickled."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return partial(InteractionConfig, **{**values, "class_masses": dict(self.class_masses)}), ()


def _not_negative(name: str, value: object) -> float:
    number = checked_number(name, value, error=ConfigError)
    if not 0 <= number < math.inf:
        raise ConfigError(f"{name}: expected a number from 0, found {value!r}")
    return number


def _number(doc: str, unit: str) -> Number:
    return Number(dtype="float64", doc=doc, unit=unit)


class InteractionRecord(TypedDict):
    """A pair of road users at a moment at which it comes under a threshold (`InteractionConfig`).

    Derived from `track`, made when it is first asked for, and kept in a file a scenario beside the tables. Seen from
    above; velocities are the tracks', displacements where these are unknown.
    """

    frame_token: Annotated[str, Key(table="frame", doc="The moment.")]
    first_token: Annotated[str, Key(table="instance", doc="The one with the smaller actor id.")]
    second_token: Annotated[str, Key(table="instance", doc="The other.")]
    gap: Annotated[float, _number("Between the boxes; 0 where they touch.", "m")]
    closing_speed: Annotated[
        float | None,
        _number(
            "With which the gap shrinks, negative where it grows; null where the boxes touch.",
            "m/s",
        ),
    ]
    ttc: Annotated[
        float | None,
        _number(
            "Time to collision of the boxes at steady velocities; infinite if never, or after the horizon.",
            "s",
        ),
    ]
    ttc_1d: Annotated[
        float | None,
        _number("Time to collision along the heading of the one behind, the less of both.", "s"),
    ]
    drac: Annotated[
        float | None,
        _number("Deceleration rate to avoid a crash: relative speed over twice the `ttc`.", "m/s²"),
    ]
    mttc: Annotated[
        float | None,
        _number(
            "As `ttc`, each with its acceleration along its heading, until it stops or the horizon.",
            "s",
        ),
    ]
    delta_v: Annotated[
        list[float] | None,
        Vector(
            shape=(2,),
            doc="Change of velocity of the first and the second if they collided now, with assumed masses.",
            unit="m/s",
        ),
    ]
    impact_angle: Annotated[
        float,
        _number(
            "The second's heading as the first sees it, in (−π, π]: 0 the same, ±π head-on.", "rad"
        ),
    ]


class InteractionPairRecord(TypedDict):
    """A pair of road users that comes under a threshold at one moment at least, over its whole recording.

    Least and most are over all frames at which both are annotated and at least one moves, not only those in
    `interaction`. A pair that is not here was never under a threshold.
    """

    scenario_token: Annotated[str, Key(table="scenario", doc="Its scenario.")]
    first_token: Annotated[str, Key(table="instance", doc="The one with the smaller actor id.")]
    second_token: Annotated[str, Key(table="instance", doc="The other.")]
    num_frames: Annotated[
        int, Number(dtype="int64", doc="Frames that the least and most are over.")
    ]
    moving: Annotated[
        bool, Number(dtype="bool", doc="Whether each of the two moves at some frame.")
    ]
    min_ttc: Annotated[float, _number("Least time to collision; infinite if there is none.", "s")]
    min_ttc_frame_token: Annotated[
        str | None, Key(table="frame", doc="The first moment of the least `ttc`.")
    ]
    min_gap: Annotated[float, _number("Least gap.", "m")]
    min_gap_frame_token: Annotated[
        str, Key(table="frame", doc="The first moment of the least gap.")
    ]
    max_drac: Annotated[
        float, _number("Most deceleration needed; infinite where the boxes touch.", "m/s²")
    ]
    min_mttc: Annotated[float, _number("Least time to collision with accelerations.", "s")]
    pet: Annotated[
        float,
        _number(
            "Post-encroachment time over the recording: positive if the first was there first, negative if the second "
            "was, 0 if they touch, infinite if their ways do not meet.",
            "s",
        ),
    ]
    tet: Annotated[
        list[float],
        Vector(
            shape=(2,), doc="Time exposed: with a `ttc` of at most 1.5 s, and of 3 s.", unit="s"
        ),
    ]
    tit: Annotated[
        list[float],
        Vector(
            shape=(2,), doc="Time integrated: sum of threshold − `ttc` over that time.", unit="s²"
        ),
    ]


_ROWS: Final = "interaction"
PAIRS: Final = "interaction_pair"


@cache
def interaction_specs() -> Mapping[str, TableSpec]:
    """The derived tables: of pairs at moments, and of pairs."""
    return {_ROWS: spec_of(_ROWS, InteractionRecord), PAIRS: spec_of(PAIRS, InteractionPairRecord)}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InteractionPairs(FrozenArrays):
    """The L pairs of a scenario that come under a threshold, over the recording; arrays are read-only.

    Least and most are over all frames at which both are annotated and at least one moves. Infinite is never.

    Attributes:
        scenario: token.
        actor_ids: (L, 2) CARLA ids, the smaller first; rows ascend.
        num_frames: (L,) frames that count.
        moving: (L,) whether each of the two moves at some frame.
        min_ttc: (L,) least time to collision, seconds.
        min_ttc_frame: (L,) its first frame, numbered from 1; 0 without one.
        min_gap: (L,) least gap, metres.
        min_gap_frame: (L,) its first frame.
        max_drac: (L,) most deceleration needed, m/s²; infinite where they touch.
        min_mttc: (L,) least time to collision with accelerations, seconds.
        pet: (L,) post-encroachment time, seconds, positive if the first of the two was there first.
        tet: (L, 2) time exposed at each of the config's `taus`, seconds.
        tit: (L, 2) time integrated at each of them, s².
    """

    scenario: str
    actor_ids: IntArray
    num_frames: IntArray
    moving: BoolArray
    min_ttc: FloatArray
    min_ttc_frame: IntArray
    min_gap: FloatArray
    min_gap_frame: IntArray
    max_drac: FloatArray
    min_mttc: FloatArray
    pet: FloatArray
    tet: FloatArray
    tit: FloatArray

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.actor_ids)

    def position(self, first: int, second: int) -> int | None:
        """The position of the pair of two actors, in any order; None if it never came under a threshold."""
        found = np.flatnonzero((self.actor_ids == sorted((first, second))).all(axis=1))
        return int(found[0]) if len(found) else None

    def to_arrow(self) -> Any:
        """A `pyarrow.Table` with the fields of `interaction_pair` (schema/README.md), tokens as texts."""
        columns = {
            "scenario_token": [self.scenario] * len(self),
            **_actor_tokens(self.scenario, self.actor_ids),
            **{
                f"{name}_token": _frame_tokens(self.scenario, getattr(self, name))
                for name in _FRAMES
            },
        }
        return _arrow_table(PAIRS, self, columns)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Interactions(FrozenArrays):
    """The pairs of a scenario at the N moments at which they are under a threshold; arrays are read-only.

    Rows ascend by frame, then by pair. Infinite is never; NaN is unknown: an actor's velocity, or the closing speed of
    boxes that touch.

    Attributes:
        scenario: token.
        config: the thresholds and assumptions.
        labelled: whether there are labels; without them there are no rows, and nothing is known.
        frame: (N,) numbers from 1.
        actor_ids: (N, 2) CARLA ids, the smaller first.
        gap: (N,) between the boxes, metres.
        closing_speed: (N,) with which the gap shrinks, m/s.
        ttc: (N,) time to collision, seconds.
        ttc_1d: (N,) the same along the heading of the one behind, seconds.
        drac: (N,) deceleration needed, m/s².
        mttc: (N,) time to collision with accelerations, seconds.
        delta_v: (N, 2) change of each one's velocity if they collided now, m/s, with assumed masses.
        impact_angle: (N,) the second's heading as the first sees it, radians in (−π, π].
        pairs: the same pairs over the recording.
    """

    scenario: str
    config: InteractionConfig
    labelled: bool
    frame: IntArray
    actor_ids: IntArray
    gap: FloatArray
    closing_speed: FloatArray
    ttc: FloatArray
    ttc_1d: FloatArray
    drac: FloatArray
    mttc: FloatArray
    delta_v: FloatArray
    impact_angle: FloatArray
    pairs: InteractionPairs

    def __len__(self) -> int:
        """Number of pairs at moments."""
        return len(self.frame)

    def __repr__(self) -> str:
        """How many there are, and the most critical of two that move."""
        if not self.labelled:
            return f"Interactions({self.scenario}: no labels)"
        count = len(self.pairs)
        text = f"Interactions({self.scenario}: {count} pair{'s' * (count != 1)}, {len(self)} row{'s' * (len(self) != 1)}"
        times = np.where(self.pairs.moving, self.pairs.min_ttc, np.inf)
        if not np.isfinite(times).any():
            return f"{text})"
        row = int(times.argmin())
        first, second = self.pairs.actor_ids[row].tolist()
        frame = self.pairs.min_ttc_frame[row]
        return f"{text}; least TTC of moving pairs {times[row]:.2f} s: actors {first} and {second} at frame {frame})"

    def of_pair(self, first: int, second: int) -> IntArray:
        """The positions of the rows of two actors, in any order."""
        return np.flatnonzero((self.actor_ids == sorted((first, second))).all(axis=1))

    def to_arrow(self) -> Any:
        """A `pyarrow.Table` with the fields of `interaction` (schema/README.md), tokens as texts."""
        columns = {"frame_token": _frame_tokens(self.scenario, self.frame)}
        return _arrow_table(_ROWS, self, columns | _actor_tokens(self.scenario, self.actor_ids))


_FRAMES = ("min_ttc_frame", "min_gap_frame")


def array_names(kind: type) -> list[str]:
    """The fields of a class of this module that are columns of its table under the same name."""
    others = {"scenario", "config", "labelled", "frame", "actor_ids", "pairs", *_FRAMES}
    return [field.name for field in fields(kind) if field.name not in others]


def _arrow_table(name: str, arrays: Any, given: Mapping[str, Any]) -> Any:
    import pyarrow as pa

    columns = {}
    for column in interaction_specs()[name].columns:
        if isinstance(column.kind, Key):
            columns[column.field] = pa.array(given[column.field], type=pa.string())
            continue
        values: AnyArray = getattr(arrays, column.field)
        unknown: BoolArray = np.isnan(values.sum(axis=tuple(range(1, values.ndim))))
        if isinstance(column.kind, Vector):
            rows = [
                None if null else each
                for null, each in zip(unknown.tolist(), values.tolist(), strict=True)
            ]
            columns[column.field] = pa.array(rows, type=pa.list_(pa.float64(), column.kind.length))
        else:
            columns[column.field] = pa.array(values, mask=unknown)
    return pa.table(columns)


def _actor_tokens(scenario: str, actor_ids: IntArray) -> dict[str, list[str]]:
    sides = zip(("first_token", "second_token"), actor_ids.T.tolist(), strict=True)
    return {name: [instance_token(scenario, actor) for actor in actors] for name, actors in sides}


def _frame_tokens(scenario: str, frames: IntArray) -> list[str | None]:
    return [frame_token(scenario, frame) if frame else None for frame in frames.tolist()]
