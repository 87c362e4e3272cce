"""Road users: who they are and where they are at any time, in the ground frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import FloatArray, IntArray, readonly
from deepaccident_devkit.synth import solids
from deepaccident_devkit.synth.solids import Solids
from deepaccident_devkit.taxonomy import CATEGORIES, STATIC_ACTOR_ID


class Motion(Protocol):
    """Where something is at any time; times are seconds since the first recorded frame."""

    def poses(self, times: ArrayLike) -> FloatArray:
        """(T, 3) x, y (metres), yaw (radians) of the box's centre in the ground frame at times (T,)."""
        ...

    def velocities(self, times: ArrayLike) -> FloatArray:
        """(T, 2) m/s in the ground frame at times (T,)."""
        ...


@dataclass(frozen=True, slots=True)
class Uniform:
    """Straight on at a constant speed (or standing still, at speed 0).

    Attributes:
        x: at time 0, metres.
        y: at time 0, metres.
        yaw: radians.
        speed: m/s.
    """

    x: float
    y: float
    yaw: float
    speed: float = 0.0

    def poses(self, times: ArrayLike) -> FloatArray:
        """See `Motion`."""
        return _along(self.x, self.y, self.yaw, self.speed * np.asarray(times, dtype=np.float64))

    def velocities(self, times: ArrayLike) -> FloatArray:
        """See `Motion`."""
        return _directed(self.yaw, np.full(np.shape(times), self.speed))


@dataclass(frozen=True, slots=True)
class SetOff:
    """Stand, accelerate evenly from `start_time` on, then keep the speed; straight on.

    Attributes:
        x: where it stands, metres.
        y: where it stands, metres.
        yaw: radians.
        speed: that it reaches, m/s.
        acceleration: m/s².
        start_time: seconds.
    """

    x: float
    y: float
    yaw: float
    speed: float
    acceleration: float
    start_time: float

    def poses(self, times: ArrayLike) -> FloatArray:
        """See `Motion`."""
        since = self._since(times)
        ramp = np.minimum(since, self._ramp_time)
        distance = self.acceleration / 2 * ramp**2 + self.speed * (since - ramp)
        return _along(self.x, self.y, self.yaw, distance)

    def velocities(self, times: ArrayLike) -> FloatArray:
        """See `Motion`."""
        return _directed(self.yaw, self.acceleration * np.minimum(self._since(times), self._ramp_time))

    def delayed(self, seconds: float) -> "SetOff":
        """The same motion, later."""
        return replace(self, start_time=self.start_time + seconds)

    def time_to(self, distance: float) -> float:
        """Seconds from `start_time` until this far, metres; beyond the acceleration."""
        return distance / self.speed + self._ramp_time / 2

    @property
    def _ramp_time(self) -> float:
        return self.speed / self.acceleration

    def _since(self, times: ArrayLike) -> FloatArray:
        return np.maximum(np.asarray(times, dtype=np.float64) - self.start_time, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Actor:
    """One road user.

    Attributes:
        actor_id: the label's id; from `STATIC_ACTOR_ID` on it is parked.
        object_id: the BEV camera's own id, 1 to 65535.
        category: one of `taxonomy.CATEGORIES`.
        size: length, width, height of the label box, metres.
        shape: its solids, x forward, origin on the road below the box's centre.
        motion: of the box's centre.
        origin: (x, y) of its reference point (the ego origin of an agent) seen from the box's centre, metres.
    """

    actor_id: int
    object_id: int
    category: str
    size: tuple[float, float, float]
    shape: Solids
    motion: Motion
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
        solids: of all actors, each in its own frame.
        solid_actor: (P,) int64, row of the actor that each solid belongs to.
    """

    all: tuple[Actor, ...]
    actor_id: IntArray
    object_id: IntArray
    category: IntArray
    size: FloatArray
    origin: FloatArray
    solids: Solids
    solid_actor: IntArray

    @classmethod
    def of(cls, actors: Sequence[Actor]) -> "Actors":
        """Gather actors, sorted by id."""
        ordered = tuple(sorted(actors, key=lambda actor: actor.actor_id))
        counts = [len(actor.shape) for actor in ordered]
        return cls(
            all=ordered,
            actor_id=readonly(np.array([actor.actor_id for actor in ordered], dtype=np.int64)),
            object_id=readonly(np.array([actor.object_id for actor in ordered], dtype=np.int64)),
            category=readonly(np.array([CATEGORIES.index(actor.category) for actor in ordered], dtype=np.int8)),
            size=readonly(np.array([actor.size for actor in ordered], dtype=np.float64)),
            origin=readonly(np.array([actor.origin for actor in ordered], dtype=np.float64)),
            solids=solids.concatenate([actor.shape for actor in ordered]),
            solid_actor=readonly(np.repeat(np.arange(len(ordered)), counts)),
        )

    def __len__(self) -> int:
        """Number of actors."""
        return len(self.all)

    def row_of(self, actor_id: int) -> int:
        """Row of the actor with this id."""
        return int(np.flatnonzero(self.actor_id == actor_id)[0])

    def at(self, time: float) -> "Snapshot":
        """Where all of them are at a time, seconds."""
        poses = np.concatenate([actor.motion.poses([time]) for actor in self.all])
        velocities = np.concatenate([actor.motion.velocities([time]) for actor in self.all])
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


def place(corners: FloatArray, poses: FloatArray) -> FloatArray:
    """Points (P, K, 3) of P bodies' own frames, set at poses (P, 3) x, y, yaw."""
    cos, sin = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
    result = np.empty_like(corners)
    result[..., 0] = cos * corners[..., 0] - sin * corners[..., 1] + poses[:, None, 0]
    result[..., 1] = sin * corners[..., 0] + cos * corners[..., 1] + poses[:, None, 1]
    result[..., 2] = corners[..., 2]
    return result


def _along(x: float, y: float, yaw: float, distance: FloatArray) -> FloatArray:
    return np.stack([x + np.cos(yaw) * distance, y + np.sin(yaw) * distance, np.full(distance.shape, yaw)], axis=-1)


def _directed(yaw: float, speed: FloatArray) -> FloatArray:
    return np.stack([np.cos(yaw) * speed, np.sin(yaw) * speed], axis=-1)
