"""Road users: what they are made of, who they are and where they are at any time, in the ground frame."""

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

# Seconds: a time may be this far before the first sample or after the last one and still counts as inside.
_SLACK = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampledMotion(FrozenArrays):
    """Where something is at any time: straight lines between samples; before the first and after the last it stands.

    Times are seconds since the first recorded frame. Several with the same times can be in one, M of them.

    Attributes:
        start: time of the first sample, seconds.
        period: seconds between samples.
        samples: (S, 3) x, y (metres), yaw (radians, without jumps) of the box's centre; (S, M, 3) for M actors.
        sample_velocities: (S, 2) m/s; (S, M, 2) for M actors.
    """

    start: float
    period: float
    samples: FloatArray
    sample_velocities: FloatArray

    def poses(self, times: ArrayLike) -> FloatArray:
        """(T, 3) x, y (metres), yaw (radians) of the box's centre at times (T,); (T, M, 3) for M."""
        return self._between(self.samples, np.asarray(times, dtype=np.float64))

    def velocities(self, times: ArrayLike) -> FloatArray:
        """(T, 2) m/s in the ground frame at times (T,); (T, M, 2) for M actors."""
        wanted = np.asarray(times, dtype=np.float64)
        end = self.start + self.period * (len(self.samples) - 1)
        inside = (wanted >= self.start - _SLACK) & (wanted <= end + _SLACK)
        values = self._between(self.sample_velocities, wanted)
        return np.where(_over(inside, values), values, 0.0)

    def _between(self, values: FloatArray, times: FloatArray) -> FloatArray:
        place = np.clip((times - self.start) / self.period, 0.0, len(values) - 1.0)
        low = np.minimum(place.astype(np.int64), max(len(values) - 2, 0))
        high = np.minimum(low + 1, len(values) - 1)
        before, after = values[low], values[high]
        return np.asarray(before + _over(place - low, before) * (after - before))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Actor:
    """One road user.

    Attributes:
        actor_id: the label's id; an actor whose id is `STATIC_ACTOR_ID` or more is parked.
        object_id: the BEV camera's own id, 1 to 65535.
        category: one of `taxonomy.CATEGORIES`.
        size: length, width, height of the label box, metres.
        shape: its solids, x forward, origin on the road below the box's centre.
        motion: how the box's centre moves.
        origin: (x, y) of its reference point (the ego origin of an agent) seen from the box's centre, metres.
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
    """All road users of a scenario as arrays, in the order of their ids; read-only.

    Attributes:
        all: the actors.
        actor_id: (A,) int64.
        object_id: (A,) int64.
        category: (A,) int8, index into `taxonomy.CATEGORIES`.
        size: (A, 3) float64, metres.
        origin: (A, 2) float64, as in `Actor`.
        solids: the solids of all actors, each in its actor's own coordinate frame.
        solid_actor: (P,) int64, row of the actor that each solid belongs to.
        motions: rows of actors, with their motion; actors whose samples have the same times share one motion.
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
        return cls(
            all=ordered,
            actor_id=readonly(np.array([actor.actor_id for actor in ordered], dtype=np.int64)),
            object_id=readonly(np.array([actor.object_id for actor in ordered], dtype=np.int64)),
            category=readonly(
                np.array([CATEGORIES.index(actor.category) for actor in ordered], dtype=np.int8)
            ),
            size=readonly(np.array([actor.size for actor in ordered], dtype=np.float64)),
            origin=readonly(np.array([actor.origin for actor in ordered], dtype=np.float64)),
            solids=solids.concatenate_solids([actor.shape for actor in ordered]),
            solid_actor=readonly(
                np.repeat(np.arange(len(ordered)), [len(actor.shape) for actor in ordered])
            ),
            motions=_together([actor.motion for actor in ordered]),
        )

    def __len__(self) -> int:
        """Number of actors."""
        return len(self.all)

    def row_of(self, actor_id: int) -> int:
        """Row of the actor with this id."""
        return int(np.flatnonzero(self.actor_id == actor_id)[0])

    def at(self, time: float) -> "Snapshot":
        """Where all of them are at a time, seconds."""
        poses, velocities = np.empty((len(self), 3)), np.empty((len(self), 2))
        for rows, motion in self.motions:
            poses[rows], velocities[rows] = motion.poses([time])[0], motion.velocities([time])[0]
        return Snapshot(readonly(poses), readonly(velocities))


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """Where all actors are at one moment, in the ground frame.

    Attributes:
        poses: (A, 3) x, y (metres), yaw (radians) of the boxes' centres.
        velocities: (A, 2) m/s.
    """

    poses: FloatArray
    velocities: FloatArray


def _together(motions: Sequence[SampledMotion]) -> tuple[tuple[list[int], SampledMotion], ...]:
    """The motions, grouped as in `Actors.motions`."""
    rows_of: dict[Hashable, list[int]] = {}
    for row, motion in enumerate(motions):
        rows_of.setdefault((motion.start, motion.period, len(motion.samples)), []).append(row)
    return tuple((rows, _joined([motions[row] for row in rows])) for rows in rows_of.values())


def _joined(motions: Sequence[SampledMotion]) -> SampledMotion:
    """One motion made of several with the same times."""
    return replace(
        motions[0],
        samples=np.stack([motion.samples for motion in motions], axis=1),
        sample_velocities=np.stack([motion.sample_velocities for motion in motions], axis=1),
    )


def _over(weights: AnyArray, values: FloatArray) -> AnyArray:
    """Weights (T,) of the first axis of values (T, …), shaped to be multiplied with them."""
    return weights.reshape(weights.shape + (1,) * (values.ndim - weights.ndim))


_BoxSize = tuple[float, float, float]

# Median length, width and height in the real release, metres (docs/format.md, Label).
MEDIAN_SIZES: dict[str, _BoxSize] = {
    "car": (4.60, 1.93, 1.52),
    "truck": (8.47, 2.89, 3.83),
    "van": (4.48, 1.99, 2.04),
    "motorcycle": (2.21, 0.86, 1.53),
    "cyclist": (1.64, 0.37, 1.77),
    "pedestrian": (0.38, 0.38, 1.86),
}
# By which share of the median length, width and height a body may differ from it.
_SPREAD = (0.05, 0.05, 0.04)
_FARTHEST_ORIGIN = 0.3
_PAINTS: tuple[Color, ...] = (
    (196, 30, 36), (28, 74, 160), (226, 228, 230), (150, 155, 160), (46, 50, 56), (236, 196, 56), (40, 120, 72),
    (120, 40, 44), (88, 142, 196), (214, 120, 44),
)  # fmt: skip
_CLOTHES: tuple[Color, ...] = (
    (168, 44, 52), (52, 84, 150), (70, 110, 70), (200, 176, 120), (90, 70, 110), (64, 66, 74), (214, 212, 206),
)  # fmt: skip
_TRUCK_BOXES: tuple[Color, ...] = (
    (226, 226, 222),
    (180, 190, 200),
    (200, 170, 120),
    (90, 120, 150),
)


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """What an actor is made of.

    Attributes:
        category: one of `taxonomy.CATEGORIES`.
        size: length, width, height of the label box, metres.
        shape: its solids, x forward, origin on the road below the box's centre.
        origin: (x, y) of its reference point seen from the box's centre, metres.
    """

    category: str
    size: _BoxSize
    shape: Solids
    origin: tuple[float, float]


def random_body(rng: np.random.Generator, category: str) -> Body:
    """A road user of this category, near the median size of the real release."""
    factors = 1 + np.array(_SPREAD) * rng.uniform(-1, 1, 3)
    size: _BoxSize = tuple((np.array(MEDIAN_SIZES[category]) * factors).astype(np.float32).tolist())
    color, accent = _colors(rng, category)
    shape = shape_of(category, size, color, accent, model=int(rng.integers(len(MODELS[category]))))
    # an ego origin lies ahead of the box's centre, mostly by some centimetres, seldom by up to 0.3 m
    return Body(category, size, shape, (round(float(_FARTHEST_ORIGIN * rng.random() ** 3), 4), 0.0))


def _colors(rng: np.random.Generator, category: str) -> tuple[Color, Color]:
    paints = _CLOTHES if category == "pedestrian" else _PAINTS
    accents = _TRUCK_BOXES if category == "truck" else _CLOTHES
    return paints[rng.integers(len(paints))], accents[rng.integers(len(accents))]
