"""`Interactions`: pairs in a scenario that come close, as arrays, Arrow tables and records.

Infinity means never. Null means unknown, such as an actor's velocity, or the closing speed of
overlapping boxes.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cache, partial
from types import MappingProxyType
from typing import Annotated, Any, TypedDict

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
from deepaccident_devkit.support.values import ReadOnlyValues
from deepaccident_devkit.tables.columns import Key, Number, TableSpec, Vector
from deepaccident_devkit.tables.records import spec_of
from deepaccident_devkit.tables.tokens import frame_token, instance_token

_INTERACTIONS = "interaction"
PAIRS = "interaction_pair"
# Fields of pairs that are frame numbers; the table stores tokens of frames instead.
_FRAME_FIELDS = ("min_ttc_frame", "min_gap_frame")


@dataclass(frozen=True, slots=True, kw_only=True)
class InteractionConfig:
    """Thresholds that define interactions, and assumptions of their measures.

    A pair is an interaction in a frame if at least one of the two moves, their centres are within
    `radius`, and either the time to collision is at most `max_ttc` or the gap at most `max_gap`.

    Attributes:
        radius: Largest distance between the centres in metres.
        max_ttc: Largest time to collision in seconds.
        max_gap: Largest gap in metres.
        horizon: Time to look ahead in seconds; later collisions are ignored.
        taus: The two thresholds in seconds for the time-exposed and time-integrated measures (TET,
            TIT); stored as a tuple.
        standing_speed: Speed in m/s up to which an actor counts as standing.
        class_masses: Class → mass in kilograms at the class's median size; assumed, because the
            release contains no masses; stored read-only.
    """

    radius: float = 200.0
    max_ttc: float = 10.0
    max_gap: float = 5.0
    horizon: float = 20.0
    taus: tuple[float, float] = (1.5, 3.0)
    standing_speed: float = 0.5
    class_masses: Mapping[str, float] = field(default_factory=lambda: CLASS_MASSES)

    def __post_init__(self) -> None:
        """Raise a ConfigError if a number is out of range."""
        for name in ("radius", "max_ttc", "max_gap", "horizon", "standing_speed"):
            object.__setattr__(self, name, _check_not_negative(name, getattr(self, name)))
        taus = tuple(_check_not_negative("taus", tau) for tau in self.taus)
        if len(taus) != 2:
            raise ConfigError(f"taus: expected two thresholds in seconds, found {len(taus)}")
        if self.horizon < self.max_ttc:
            raise ConfigError(
                f"horizon: expected at least max_ttc, {self.max_ttc} s, found {self.horizon} s"
            )
        object.__setattr__(self, "taus", taus)
        object.__setattr__(self, "class_masses", MappingProxyType(dict(self.class_masses)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Return a value that can be pickled, because read-only mappings cannot."""
        values = {column.name: getattr(self, column.name) for column in fields(self)}
        values["class_masses"] = dict(self.class_masses)
        return partial(InteractionConfig, **values), ()


def _check_not_negative(name: str, value: object) -> float:
    """Return `value` if it is finite and not negative; otherwise raise a ConfigError."""
    number = checked_number(name, value, error=ConfigError)
    if not 0 <= number < math.inf:
        raise ConfigError(f"{name}: expected a number from 0, found {value!r}")
    return number


def _float_column(doc: str, unit: str) -> Number:
    """Describe a column of floats for the schema."""
    return Number(dtype="float64", doc=doc, unit=unit)


class InteractionRecord(TypedDict):
    """A pair of road users at a moment at which it comes under a threshold (`InteractionConfig`).

    Derived from `track`, made when it is first asked for, and kept in a file a scenario beside the
    tables. Seen from above; velocities are the tracks', displacements where these are unknown.
    """

    frame_token: Annotated[str, Key(table="frame", doc="The moment.")]
    first_token: Annotated[str, Key(table="instance", doc="The one with the smaller actor id.")]
    second_token: Annotated[str, Key(table="instance", doc="The other.")]
    gap: Annotated[float, _float_column("Distance between the boxes; 0 if they touch.", "m")]
    closing_speed: Annotated[
        float | None,
        _float_column(
            "Speed at which the gap shrinks, negative if it grows; null if the boxes touch.",
            "m/s",
        ),
    ]
    ttc: Annotated[
        float | None,
        _float_column(
            "Time to collision of the boxes at constant velocities; infinite if they never "
            "collide, or only after the horizon.",
            "s",
        ),
    ]
    ttc_1d: Annotated[
        float | None,
        _float_column(
            "Time to collision along the heading of the road user behind; the smaller "
            "value of both orders.",
            "s",
        ),
    ]
    drac: Annotated[
        float | None,
        _float_column(
            "Deceleration rate to avoid a crash: relative speed over twice the `ttc`.", "m/s²"
        ),
    ]
    mttc: Annotated[
        float | None,
        _float_column(
            "Like `ttc`, but each road user keeps its acceleration along its heading, until it "
            "stops or the horizon ends.",
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
        _float_column(
            "Heading of the second relative to the first, in (−π, π]: 0 is the same "
            "heading, ±π is head-on.",
            "rad",
        ),
    ]


class InteractionPairRecord(TypedDict):
    """A pair of road users that is under a threshold at least once, over its recording.

    Least and most are over all frames at which both are annotated and at least one moves, not only
    the ones in `interaction`. A pair that is not here was never under a threshold.
    """

    scenario_token: Annotated[str, Key(table="scenario", doc="Its scenario.")]
    first_token: Annotated[str, Key(table="instance", doc="The one with the smaller actor id.")]
    second_token: Annotated[str, Key(table="instance", doc="The other.")]
    num_frames: Annotated[
        int,
        Number(
            dtype="int64", doc="Number of frames over which the least and most values are taken."
        ),
    ]
    moving: Annotated[
        bool, Number(dtype="bool", doc="Whether each of the two moves at some frame.")
    ]
    min_ttc: Annotated[
        float, _float_column("Least time to collision; infinite if there is none.", "s")
    ]
    min_ttc_frame_token: Annotated[
        str | None, Key(table="frame", doc="The first moment of the least `ttc`.")
    ]
    min_gap: Annotated[float, _float_column("Least gap.", "m")]
    min_gap_frame_token: Annotated[
        str, Key(table="frame", doc="The first moment of the least gap.")
    ]
    max_drac: Annotated[
        float, _float_column("Most deceleration needed; infinite if the boxes touch.", "m/s²")
    ]
    min_mttc: Annotated[float, _float_column("Least time to collision with accelerations.", "s")]
    pet: Annotated[
        float,
        _float_column(
            "Post-encroachment time over the recording: positive if the first passes first, "
            "negative if the second does, 0 if they touch, infinite if their paths do not cross.",
            "s",
        ),
    ]
    tet: Annotated[
        list[float],
        Vector(
            shape=(2,),
            doc="Time exposed: time with a `ttc` of at most 1.5 s, and of at most 3 s.",
            unit="s",
        ),
    ]
    tit: Annotated[
        list[float],
        Vector(
            shape=(2,), doc="Time integrated: threshold − `ttc`, summed over that time.", unit="s²"
        ),
    ]


@cache
def interaction_specs() -> Mapping[str, TableSpec]:
    """Return the specifications of the two derived tables: pairs in single frames, and pairs."""
    moments = spec_of(_INTERACTIONS, InteractionRecord)
    pairs = spec_of(PAIRS, InteractionPairRecord)
    return {_INTERACTIONS: moments, PAIRS: pairs}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InteractionPairs(FrozenArrays):
    """L pairs of a scenario that are under a threshold in some frame; read-only arrays.

    Minima and maxima are over all frames in which both actors are annotated and at least one moves.
    Infinity means never.

    Attributes:
        scenario: Token of the scenario.
        actor_ids: CARLA ids, shape (L, 2), the smaller one first; pairs are in ascending order.
        num_frames: Numbers of frames that count, shape (L,).
        moving: Whether each of the two actors moves at some frame, shape (L,).
        min_ttc: Minimum time to collision in seconds, shape (L,).
        min_ttc_frame: Number (from 1) of the first frame with the minimum time to collision, shape
            (L,); 0 if there is none.
        min_gap: Minimum gap in metres, shape (L,).
        min_gap_frame: Number of the first frame with the minimum gap, shape (L,).
        max_drac: Largest deceleration needed to avoid a crash in m/s², shape (L,); infinite where
            the boxes touch.
        min_mttc: Minimum time to collision with accelerations in seconds, shape (L,).
        pet: Post-encroachment time in seconds, shape (L,); positive if the first actor was in the
            area first.
        tet: Time exposed in seconds for each of the config's `taus`, shape (L, 2).
        tit: Time integrated in s² for each of the config's `taus`, shape (L, 2).
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
        """Return the index of the pair of two actors, passed in either order.

        Return None if the pair was never under a threshold.
        """
        pair = sorted((first, second))
        positions = np.flatnonzero((self.actor_ids == pair).all(axis=1))
        if not len(positions):
            return None
        return int(positions[0])

    def to_arrow(self) -> Any:
        """Return a `pyarrow.Table` with the fields of `interaction_pair` (schema/README.md).

        Tokens are stored as text.
        """
        tokens = _actor_tokens(self.scenario, self.actor_ids)
        tokens["scenario_token"] = [self.scenario] * len(self)
        for name in _FRAME_FIELDS:
            frames = getattr(self, name)
            tokens[f"{name}_token"] = _frame_tokens(self.scenario, frames)
        return _make_arrow_table(PAIRS, self, tokens)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Interactions(FrozenArrays):
    """Pairs of a scenario in the N cases (frames) where they are under a threshold; read-only.

    Rows are sorted by frame, then by pair. Infinity means never. NaN means unknown, such as an
    actor's velocity, or the closing speed of boxes that touch.

    Attributes:
        scenario: Token of the scenario.
        config: Thresholds and assumptions.
        labelled: Whether the scenario has labels; without them, there are no rows.
        frame: Frame numbers from 1, shape (N,).
        actor_ids: CARLA ids, shape (N, 2), the smaller one first.
        gap: Gap between the boxes in metres, shape (N,).
        closing_speed: Speed at which the gap shrinks in m/s, shape (N,).
        ttc: Time to collision in seconds, shape (N,).
        ttc_1d: Time to collision along the following actor's heading in seconds, shape (N,).
        drac: Deceleration needed to avoid a crash in m/s², shape (N,).
        mttc: Time to collision with accelerations in seconds, shape (N,).
        delta_v: Velocity change of each actor if the two collided now in m/s, shape (N, 2), with
            assumed masses.
        impact_angle: Heading of the second actor relative to the first in radians, in (−π, π],
            shape (N,).
        pairs: The N pairs, described over the whole recording.
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
        """Return the number of rows, which are pairs in single frames."""
        return len(self.frame)

    def __repr__(self) -> str:
        """Return the numbers of pairs and rows, and the most critical pair of moving actors."""
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
        """Return the indices of the rows for two actors, passed in either order."""
        pair = sorted((first, second))
        return np.flatnonzero((self.actor_ids == pair).all(axis=1))

    def to_arrow(self) -> Any:
        """Return a `pyarrow.Table` with the fields of `interaction` (schema/README.md).

        Tokens are stored as text.
        """
        tokens = _actor_tokens(self.scenario, self.actor_ids)
        tokens["frame_token"] = _frame_tokens(self.scenario, self.frame)
        return _make_arrow_table(_INTERACTIONS, self, tokens)


def array_names(kind: type) -> list[str]:
    """Return the fields of `kind` that its table stores under the same name."""
    other_fields = {
        "scenario",
        "config",
        "labelled",
        "frame",
        "actor_ids",
        "pairs",
        *_FRAME_FIELDS,
    }
    return [field.name for field in fields(kind) if field.name not in other_fields]


def _make_arrow_table(name: str, arrays: Any, tokens: ReadOnlyValues) -> Any:
    """Build a table from the arrays of an object of this module, and tokens as its keys."""
    import pyarrow as pa

    columns = {}
    for column in interaction_specs()[name].columns:
        field_name = column.field
        if isinstance(column.kind, Key):
            columns[field_name] = pa.array(tokens[field_name], type=pa.string())
            continue
        values: AnyArray = getattr(arrays, field_name)
        components = tuple(range(1, values.ndim))
        is_unknown: BoolArray = np.isnan(values.sum(axis=components))
        if isinstance(column.kind, Vector):
            vectors = values.tolist()
            for row in np.flatnonzero(is_unknown).tolist():
                vectors[row] = None
            vector_type = pa.list_(pa.float64(), column.kind.length)
            columns[field_name] = pa.array(vectors, type=vector_type)
        else:
            columns[field_name] = pa.array(values, mask=is_unknown)
    return pa.table(columns)


def _actor_tokens(scenario: str, actor_ids: IntArray) -> dict[str, list[Any]]:
    """Return two columns: the tokens of each row's actors."""
    first_ids, second_ids = actor_ids.T.tolist()
    return {
        "first_token": [instance_token(scenario, actor) for actor in first_ids],
        "second_token": [instance_token(scenario, actor) for actor in second_ids],
    }


def _frame_tokens(scenario: str, frames: IntArray) -> list[str | None]:
    """Return the tokens of frames; None for frame 0."""
    tokens = []
    for frame in frames.tolist():
        token = frame_token(scenario, frame) if frame else None
        tokens.append(token)
    return tokens
