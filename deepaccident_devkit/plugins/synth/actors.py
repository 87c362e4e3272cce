"""Road users: their bodies, identities and motions, in the ground frame."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.plugins.synth import solids
from deepaccident_devkit.plugins.synth.shapes import MODELS, make_shape
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

# Largest distance of a time from the first or last sample at which the actor still moves.
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
    """A motion in straight lines between samples.

    Before the first sample and after the last one, the actor stands still.

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
        requested_times = np.asarray(times, dtype=np.float64)
        return self._interpolate(self.samples, requested_times)

    def velocities(self, times: ArrayLike) -> FloatArray:
        """Return velocities, m/s in the ground frame, at times (T,).

        The shape is (T, 2), or (T, M, 2) for M actors.
        """
        requested_times = np.asarray(times, dtype=np.float64)
        end = self.start + self.period * (len(self.samples) - 1)
        has_begun = requested_times >= self.start - _TIME_TOLERANCE_S
        is_moving = has_begun & (requested_times <= end + _TIME_TOLERANCE_S)
        values = self._interpolate(self.sample_velocities, requested_times)
        return np.where(_add_axes(is_moving, values.ndim), values, 0.0)

    def _interpolate(self, values: FloatArray, times: FloatArray) -> FloatArray:
        """Return values (S, …) interpolated at times (T,)."""
        last_row = len(values) - 1
        position = np.clip((times - self.start) / self.period, 0.0, float(last_row))
        low = np.minimum(position.astype(np.int64), max(last_row - 1, 0))
        high = np.minimum(low + 1, last_row)
        before = values[low]
        after = values[high]
        weight = _add_axes(position - low, values.ndim)
        return np.asarray(before + weight * (after - before))


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
        """Whether it is a parked vehicle."""
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
        actor_ids = [actor.actor_id for actor in ordered]
        object_ids = [actor.object_id for actor in ordered]
        categories = [CATEGORIES.index(actor.category) for actor in ordered]
        sizes = [actor.size for actor in ordered]
        origins = [actor.origin for actor in ordered]
        shapes = [actor.shape for actor in ordered]
        solid_counts = [len(shape) for shape in shapes]
        return cls(
            all=ordered,
            actor_id=readonly(np.array(actor_ids, dtype=np.int64)),
            object_id=readonly(np.array(object_ids, dtype=np.int64)),
            category=readonly(np.array(categories, dtype=np.int8)),
            size=readonly(np.array(sizes, dtype=np.float64)),
            origin=readonly(np.array(origins, dtype=np.float64)),
            solids=solids.concatenate_solids(shapes),
            solid_actor=readonly(np.repeat(np.arange(len(ordered)), solid_counts)),
            motions=_group_motions([actor.motion for actor in ordered]),
        )

    def __len__(self) -> int:
        """Return the number of actors."""
        return len(self.all)

    def row_of(self, actor_id: int) -> int:
        """Return the row of the actor with this id."""
        [row] = np.flatnonzero(self.actor_id == actor_id)
        return int(row)

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


def _group_motions(motions: Sequence[SampledMotion]) -> tuple[tuple[list[int], SampledMotion], ...]:
    """Group motions with the same times, as in `Actors.motions`."""
    rows_by_times: dict[Hashable, list[int]] = {}
    for row, motion in enumerate(motions):
        times = (motion.start, motion.period, len(motion.samples))
        rows_by_times.setdefault(times, []).append(row)
    groups = []
    for rows in rows_by_times.values():
        members = [motions[row] for row in rows]
        joined = replace(
            members[0],
            samples=np.stack([motion.samples for motion in members], axis=1),
            sample_velocities=np.stack([motion.sample_velocities for motion in members], axis=1),
        )
        groups.append((rows, joined))
    return tuple(groups)


def _add_axes(weights: AnyArray, ndim: int) -> AnyArray:
    """Reshape weights (T,) to (T, 1, …) with `ndim` axes, so that they broadcast along axis 0."""
    shape = weights.shape + (1,) * (ndim - weights.ndim)
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
    drawn_size = (np.array(MEDIAN_SIZES[category]) * factors).astype(np.float32)
    size: _BoxSize = tuple(drawn_size.tolist())
    color, accent = _draw_colors(rng, category)
    model = int(rng.integers(len(MODELS[category])))
    shape = make_shape(category, size, color, accent, model=model)
    # An ego origin is ahead of the box's centre, mostly by some centimetres, seldom by up to 0.3 m.
    offset = _MAX_ORIGIN_M * rng.random() ** 3
    return Body(category, size, shape, (round(offset, 4), 0.0))


def _draw_colors(rng: np.random.Generator, category: str) -> tuple[Color, Color]:
    """Draw the main colour and the accent of a body."""
    if category == "pedestrian":
        paints = _CLOTHES
    else:
        paints = _PAINTS
    accents = _TRUCK_BOXES if category == "truck" else _CLOTHES
    color = paints[rng.integers(len(paints))]
    return color, accents[rng.integers(len(accents))]
