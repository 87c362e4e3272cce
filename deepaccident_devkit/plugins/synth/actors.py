"""Road users: their bodies, their identity and their motion, in the ground frame."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.plugins.synth import solids
from deepaccident_devkit.plugins.synth.shapes import MODELS, shape_of
from deepaccident_devkit.plugins.synth.solids import Color, Solids
from deepaccident_devkit.support.arrays import (
    AnyArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    readonly,
)
from deepaccident_devkit.taxonomy import CATEGORIES, STATIC_ACTOR_ID

_BoxSize = tuple[float, float, float]

# A time may be this far before the first sample or after the last one.
_TIME_TOLERANCE_S = 1e-9
MEDIAN_SIZES: dict[str, _BoxSize] = {
    "car": (4.60, 1.93, 1.52),
    "truck": (8.47, 2.89, 3.83),
    "van": (4.48, 1.99, 2.04),
    "motorcycle": (2.21, 0.86, 1.53),
    "cyclist": (1.64, 0.37, 1.77),
    "pedestrian": (0.38, 0.38, 1.86),
}
"""Median length, width and height in the real release, metres (docs/format.md, Label)."""
# Shares of the median length, width and height by which a body may differ from it.
_SIZE_SPREAD = (0.05, 0.05, 0.04)
_MAX_ORIGIN_M = 0.3
_PAINTS: tuple[Color, ...] = (
    (196, 30, 36), (28, 74, 160), (226, 228, 230), (150, 155, 160), (46, 50, 56), (236, 196, 56),
    (40, 120, 72), (120, 40, 44), (88, 142, 196), (214, 120, 44),
)  # fmt: skip
_CLOTHES: tuple[Color, ...] = (
    (168, 44, 52), (52, 84, 150), (70, 110, 70), (200, 176, 120), (90, 70, 110), (64, 66, 74),
    (214, 212, 206),
)  # fmt: skip
_TRUCK_BOXES: tuple[Color, ...] = (
    (226, 226, 222),
    (180, 190, 200),
    (200, 170, 120),
    (90, 120, 150),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampledMotion(FrozenArrays):
    """A motion in straight lines between samples; before the first and after the last it stands.

    Times are seconds since the first recorded frame. The motions of M actors with the same times
    can be in one.

    Attributes:
        start: Time of the first sample, seconds.
        period: Time between samples, seconds.
        samples: x, y (metres), yaw (radians, without jumps) of the box's centre, shape (S, 3);
            (S, M, 3) for M actors.
        sample_velocities: Velocities, shape (S, 2), m/s; (S, M, 2) for M actors.
    """

    start: float
    period: float
    samples: FloatArray
    sample_velocities: FloatArray

    def poses(self, times: ArrayLike) -> FloatArray:
        """Return x, y (metres), yaw (radians) of the box's centre at times (T,).

        The shape is (T, 3), or (T, M, 3) for M actors.
        """
        requested = np.asarray(times, dtype=np.float64)
        return self._between(self.samples, requested)

    def velocities(self, times: ArrayLike) -> FloatArray:
        """Return velocities, m/s in the ground frame, at times (T,).

        The shape is (T, 2), or (T, M, 2) for M actors.
        """
        requested = np.asarray(times, dtype=np.float64)
        end = self.start + self.period * (len(self.samples) - 1)
        begun = requested >= self.start - _TIME_TOLERANCE_S
        moving = begun & (requested <= end + _TIME_TOLERANCE_S)
        values = self._between(self.sample_velocities, requested)
        return np.where(_expanded(moving, values), values, 0.0)

    def _between(self, values: FloatArray, times: FloatArray) -> FloatArray:
        """Return values (S, …) interpolated at times (T,)."""
        position = np.clip((times - self.start) / self.period, 0.0, len(values) - 1.0)
        low = np.minimum(position.astype(np.int64), max(len(values) - 2, 0))
        high = np.minimum(low + 1, len(values) - 1)
        before = values[low]
        after = values[high]
        return np.asarray(before + _expanded(position - low, before) * (after - before))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Actor:
    """One road user.

    Attributes:
        actor_id: Id in labels; an actor with the id `STATIC_ACTOR_ID` or more is parked.
        object_id: The BEV camera's own id, 1 to 65535.
        category: One of `taxonomy.CATEGORIES`.
        size: Length, width, height of the label box, metres.
        shape: Solids, x forward, origin on the road below the box's centre.
        motion: Motion of the box's centre.
        origin: Position (x, y) of its reference point (the ego origin of an agent) relative to the
            box's centre, metres.
    """

    actor_id: int
    object_id: int
    category: str
    size: tuple[float, float, float]
    shape: Solids
    motion: SampledMotion
    origin: tuple[float, float] = (0.0, 0.0)

    @property
    def parked(self) -> bool:
        """Whether it stands as a static vehicle."""
        return self.actor_id >= STATIC_ACTOR_ID


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Actors:
    """All A road users of a scenario as arrays, in the order of their ids; read-only.

    Attributes:
        all: The actors.
        actor_id: Actor ids, shape (A,), int64.
        object_id: Object ids, shape (A,), int64.
        category: Indices into `taxonomy.CATEGORIES`, shape (A,), int8.
        size: Sizes, shape (A, 3), float64, metres.
        origin: Origins as in `Actor`, shape (A, 2), float64, metres.
        solids: The solids of all actors, each in its actor's own coordinate frame.
        solid_actor: Row of the actor that each solid belongs to, shape (P,), int64.
        motions: Rows of actors, with their motion; actors with samples at the same times share one
            motion.
    """

    all: tuple[Actor, ...]
    actor_id: IntArray
    object_id: IntArray
    category: IntArray
    size: FloatArray
    origin: FloatArray
    solids: Solids
    solid_actor: IntArray
    motions: tuple[tuple[list[int], SampledMotion], ...]

    @classmethod
    def of(cls, actors: Sequence[Actor]) -> "Actors":
        """Gather actors, sorted by id."""
        ordered = tuple(sorted(actors, key=lambda actor: actor.actor_id))
        categories = [CATEGORIES.index(actor.category) for actor in ordered]
        solid_counts = [len(actor.shape) for actor in ordered]
        return cls(
            all=ordered,
            actor_id=readonly(np.array([actor.actor_id for actor in ordered], dtype=np.int64)),
            object_id=readonly(np.array([actor.object_id for actor in ordered], dtype=np.int64)),
            category=readonly(np.array(categories, dtype=np.int8)),
            size=readonly(np.array([actor.size for actor in ordered], dtype=np.float64)),
            origin=readonly(np.array([actor.origin for actor in ordered], dtype=np.float64)),
            solids=solids.concatenate_solids([actor.shape for actor in ordered]),
            solid_actor=readonly(np.repeat(np.arange(len(ordered)), solid_counts)),
            motions=_grouped([actor.motion for actor in ordered]),
        )

    def __len__(self) -> int:
        """Return the number of actors."""
        return len(self.all)

    def row_of(self, actor_id: int) -> int:
        """Return the row of the actor with this id."""
        return int(np.flatnonzero(self.actor_id == actor_id)[0])

    def at(self, time: float) -> "Snapshot":
        """Return the positions of all actors at a time, seconds."""
        poses = np.empty((len(self), 3))
        velocities = np.empty((len(self), 2))
        for rows, motion in self.motions:
            poses[rows] = motion.poses([time])[0]
            velocities[rows] = motion.velocities([time])[0]
        return Snapshot(readonly(poses), readonly(velocities))


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """The positions of all actors at one moment, in the ground frame.

    Attributes:
        poses: x, y (metres), yaw (radians) of the boxes' centres, shape (A, 3).
        velocities: Velocities, shape (A, 2), m/s.
    """

    poses: FloatArray
    velocities: FloatArray


def _grouped(motions: Sequence[SampledMotion]) -> tuple[tuple[list[int], SampledMotion], ...]:
    """Group motions with the same times, as in `Actors.motions`."""
    rows_by_times: dict[Hashable, list[int]] = {}
    for row, motion in enumerate(motions):
        key = (motion.start, motion.period, len(motion.samples))
        rows_by_times.setdefault(key, []).append(row)
    groups = []
    for rows in rows_by_times.values():
        groups.append((rows, _joined([motions[row] for row in rows])))
    return tuple(groups)


def _joined(motions: Sequence[SampledMotion]) -> SampledMotion:
    """Join several motions with the same times into one."""
    return replace(
        motions[0],
        samples=np.stack([motion.samples for motion in motions], axis=1),
        sample_velocities=np.stack([motion.sample_velocities for motion in motions], axis=1),
    )


def _expanded(weights: AnyArray, values: FloatArray) -> AnyArray:
    """Reshape weights (T,) of the first axis of values (T, …), to be multiplied with them."""
    shape = weights.shape + (1,) * (values.ndim - weights.ndim)
    return weights.reshape(shape)


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """The body of an actor.

    Attributes:
        category: One of `taxonomy.CATEGORIES`.
        size: Length, width, height of the label box, metres.
        shape: Solids, x forward, origin on the road below the box's centre.
        origin: Position (x, y) of its reference point relative to the box's centre, metres.
    """

    category: str
    size: _BoxSize
    shape: Solids
    origin: tuple[float, float]


def random_body(rng: np.random.Generator, category: str) -> Body:
    """Draw a body of a category, near the median size of the real release."""
    factors = 1 + np.array(_SIZE_SPREAD) * rng.uniform(-1, 1, 3)
    size_array = (np.array(MEDIAN_SIZES[category]) * factors).astype(np.float32)
    size: _BoxSize = tuple(size_array.tolist())
    color, accent = _colors(rng, category)
    model = int(rng.integers(len(MODELS[category])))
    shape = shape_of(category, size, color, accent, model=model)
    # An ego origin is ahead of the box's centre, mostly by some centimetres, seldom by up to 0.3 m.
    origin_x = round(float(_MAX_ORIGIN_M * rng.random() ** 3), 4)
    return Body(category, size, shape, (origin_x, 0.0))


def _colors(rng: np.random.Generator, category: str) -> tuple[Color, Color]:
    """Draw the main colour and the accent of a body."""
    paints = _CLOTHES if category == "pedestrian" else _PAINTS
    accents = _TRUCK_BOXES if category == "truck" else _CLOTHES
    color = paints[rng.integers(len(paints))]
    return color, accents[rng.integers(len(accents))]
