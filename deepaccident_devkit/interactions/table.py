"""`Interactions`: pairs of a scenario that come close, as arrays, Arrow tables and records.

Infinite stands for never, null for an unknown value: an actor's velocity, or a direction where
boxes overlap.
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

_ROWS: Final = "interaction"
PAIRS: Final = "interaction_pair"
_FRAMES = ("min_ttc_frame", "min_gap_frame")


@dataclass(frozen=True, slots=True, kw_only=True)
class InteractionConfig:
    """Thresholds for interactions, and assumptions of their measures.

    A pair at a frame is an interaction if at least one of the two moves, their centres are within
    `radius`, and the time to collision is at most `max_ttc` or the gap at most `max_gap`.

    Attributes:
        radius: Largest distance between the centres, metres.
        max_ttc: Largest time to collision, seconds.
        max_gap: Largest gap, metres.
        horizon: Time to look ahead, seconds; a collision that would come later does not count.
        taus: The two thresholds of the times exposed and integrated (TET, TIT), seconds, stored as
            a tuple.
        standing_speed: Largest speed of a standing actor, m/s.
        class_masses: Class → mass at its median size, kilograms: an assumption, as the release has
            no masses; stored read-only.
    """

    radius: float = 200.0
    max_ttc: float = 10.0
    max_gap: float = 5.0
    horizon: float = 20.0
    taus: tuple[float, float] = (1.5, 3.0)
    standing_speed: float = 0.5
    class_masses: Mapping[str, float] = field(default_factory=lambda: CLASS_MASSES)

    def __post_init__(self) -> None:
        """Raise ConfigError unless the numbers are in range."""
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
        """Return a form that can be pickled, since read-only mappings cannot."""
        values = {column.name: getattr(self, column.name) for column in fields(self)}
        values["class_masses"] = dict(self.class_masses)
        return partial(InteractionConfig, **values), ()


def _not_negative(name: str, value: object) -> float:
    """Return a value as a finite number from 0, or raise ConfigError."""
    number = checked_number(name, value, error=ConfigError)
    if not 0 <= number < math.inf:
        raise ConfigError(f"{name}: expected a number from 0, found {value!r}")
    return number


def _number(doc: str, unit: str) -> Number:
    """Return the kind of a column of floats."""
    return Number(dtype="float64", doc=doc, unit=unit)


class InteractionRecord(TypedDict):
    """A pair of road users at a moment at which it comes under a threshold (`InteractionConfig`).

    Derived from `track`, made when it is first asked for, and kept in a file a scenario beside the
    tables. Seen from above; velocities are the tracks', displacements where these are unknown.
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
            "Time to collision of the boxes at steady velocities; infinite if never, "
            "or after the horizon.",
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
            "As `ttc`, each with its acceleration along its heading, until it stops "
            "or the horizon.",
            "s",
        ),
    ]
    delta_v: Annotated[
        list[float] | None,
        Vector(
            shape=(2,),
            doc="Change of velocity of the first and the second if they collided now, "
            "with assumed masses.",
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
    """A pair of road users that is under a threshold at least once, over its recording.

    Least and most are over all frames at which both are annotated and at least one moves, not only
    those in `interaction`. A pair that is not here was never under a threshold.
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
            "Post-encroachment time over the recording: positive if the first was there first, "
            "negative if the second was, 0 if they touch, infinite if their ways do not meet.",
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


@cache
def interaction_specs() -> Mapping[str, TableSpec]:
    """Return the columns of the derived tables: of pairs at moments, and of pairs."""
    return {_ROWS: spec_of(_ROWS, InteractionRecord), PAIRS: spec_of(PAIRS, InteractionPairRecord)}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InteractionPairs(FrozenArrays):
    """L pairs of a scenario that come under a threshold, over the recording; read-only arrays.

    Minima and maxima are over all frames at which both actors are annotated and at least one moves.
    Infinite stands for never.

    Attributes:
        scenario: Token.
        actor_ids: CARLA ids, shape (L, 2), the smaller first; rows ascend.
        num_frames: Numbers of frames that count, shape (L,).
        moving: Whether each of the two actors moves at some frame, shape (L,).
        min_ttc: Minimum time to collision, shape (L,), seconds.
        min_ttc_frame: First frame of the minimum time to collision, shape (L,), numbered from 1; 0
            without one.
        min_gap: Minimum gap, shape (L,), metres.
        min_gap_frame: First frame of the minimum gap, shape (L,).
        max_drac: Largest deceleration to avoid a crash, shape (L,), m/s²; infinite where the boxes
            touch.
        min_mttc: Minimum time to collision with accelerations, shape (L,), seconds.
        pet: Post-encroachment time, shape (L,), seconds, positive if the first actor was in the
            area first.
        tet: Time exposed for each of the config's `taus`, shape (L, 2), seconds.
        tit: Time integrated for each of the config's `taus`, shape (L, 2), s².
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
        """Return the number of pairs."""
        return len(self.actor_ids)

    def position(self, first: int, second: int) -> int | None:
        """Return the position of the pair of two actors, in any order.

        None if the pair never came under a threshold.
        """
        positions = np.flatnonzero((self.actor_ids == sorted((first, second))).all(axis=1))
        return int(positions[0]) if len(positions) else None

    def to_arrow(self) -> Any:
        """Return a `pyarrow.Table` with the fields of `interaction_pair` (schema/README.md).

        Tokens are texts.
        """
        columns: dict[str, Any] = {"scenario_token": [self.scenario] * len(self)}
        columns.update(_actor_tokens(self.scenario, self.actor_ids))
        for name in _FRAMES:
            columns[f"{name}_token"] = _frame_tokens(self.scenario, getattr(self, name))
        return _arrow_table(PAIRS, self, columns)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Interactions(FrozenArrays):
    """Pairs of a scenario at the N moments at which they are under a threshold; read-only arrays.

    Rows ascend by frame, then by pair. Infinite stands for never, NaN for unknown: an actor's
    velocity, or the closing speed of boxes that touch.

    Attributes:
        scenario: Token.
        config: Thresholds and assumptions.
        labelled: Whether there are labels; without them there are no rows, and nothing is known.
        frame: Numbers of the frames from 1, shape (N,).
        actor_ids: CARLA ids, shape (N, 2), the smaller first.
        gap: Gap between the boxes, shape (N,), metres.
        closing_speed: Speed with which the gap shrinks, shape (N,), m/s.
        ttc: Time to collision, shape (N,), seconds.
        ttc_1d: Time to collision along the heading of the following actor, shape (N,), seconds.
        drac: Deceleration to avoid a crash, shape (N,), m/s².
        mttc: Time to collision with accelerations, shape (N,), seconds.
        delta_v: Change of each actor's velocity if they collided now, shape (N, 2), m/s, with
            assumed masses.
        impact_angle: Heading of the second actor relative to the first's, shape (N,), radians in
            (−π, π].
        pairs: The same pairs over the recording.
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
        """Return the number of rows: pairs at moments."""
        return len(self.frame)

    def __repr__(self) -> str:
        """Return the numbers of pairs and rows, and the most critical pair in which both move."""
        if not self.labelled:
            return f"Interactions({self.scenario}: no labels)"
        num_pairs = len(self.pairs)
        num_rows = len(self)
        pairs_text = f"{num_pairs} pair{'s' * (num_pairs != 1)}"
        rows_text = f"{num_rows} row{'s' * (num_rows != 1)}"
        text = f"Interactions({self.scenario}: {pairs_text}, {rows_text}"
        times = np.where(self.pairs.moving, self.pairs.min_ttc, np.inf)
        if not np.isfinite(times).any():
            return f"{text})"
        row = int(times.argmin())
        first, second = self.pairs.actor_ids[row].tolist()
        frame = self.pairs.min_ttc_frame[row]
        least_ttc = f"least TTC of moving pairs {times[row]:.2f} s"
        return f"{text}; {least_ttc}: actors {first} and {second} at frame {frame})"

    def of_pair(self, first: int, second: int) -> IntArray:
        """Return the positions of the rows of two actors, in any order."""
        return np.flatnonzero((self.actor_ids == sorted((first, second))).all(axis=1))

    def to_arrow(self) -> Any:
        """Return a `pyarrow.Table` with the fields of `interaction` (schema/README.md).

        Tokens are texts.
        """
        columns = {"frame_token": _frame_tokens(self.scenario, self.frame)}
        return _arrow_table(_ROWS, self, columns | _actor_tokens(self.scenario, self.actor_ids))


def array_names(kind: type) -> list[str]:
    """Return the fields of a class of this module that its table has under the same name."""
    special = {"scenario", "config", "labelled", "frame", "actor_ids", "pairs", *_FRAMES}
    return [field.name for field in fields(kind) if field.name not in special]


def _arrow_table(name: str, arrays: Any, tokens: Mapping[str, Any]) -> Any:
    """Return a table from the arrays of a class of this module, and tokens for its keys."""
    import pyarrow as pa

    columns = {}
    for column in interaction_specs()[name].columns:
        if isinstance(column.kind, Key):
            columns[column.field] = pa.array(tokens[column.field], type=pa.string())
            continue
        values: AnyArray = getattr(arrays, column.field)
        unknown: BoolArray = np.isnan(values.sum(axis=tuple(range(1, values.ndim))))
        if isinstance(column.kind, Vector):
            vectors = [
                None if is_null else vector
                for is_null, vector in zip(unknown.tolist(), values.tolist(), strict=True)
            ]
            vector_type = pa.list_(pa.float64(), column.kind.length)
            columns[column.field] = pa.array(vectors, type=vector_type)
        else:
            columns[column.field] = pa.array(values, mask=unknown)
    return pa.table(columns)


def _actor_tokens(scenario: str, actor_ids: IntArray) -> dict[str, list[str]]:
    """Return the columns with the tokens of both actors of each row."""
    first_ids, second_ids = actor_ids.T.tolist()
    return {
        "first_token": [instance_token(scenario, actor) for actor in first_ids],
        "second_token": [instance_token(scenario, actor) for actor in second_ids],
    }


def _frame_tokens(scenario: str, frames: IntArray) -> list[str | None]:
    """Return the tokens of frames, None for frame 0."""
    return [frame_token(scenario, frame) if frame else None for frame in frames.tolist()]
