"""What stands still during a scenario, and one moment of it, ready to be recorded."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from deepaccident_devkit.geometry.boxes import CORNER_SIGNS
from deepaccident_devkit.plugins.synth.actors import Actors, Snapshot
from deepaccident_devkit.plugins.synth.roads import Terrain
from deepaccident_devkit.plugins.synth.sensors.caster import (
    GROUND,
    NOTHING,
    Caster,
    make_caster,
    plane_distance,
)
from deepaccident_devkit.plugins.synth.shapes import BOX_CLEARANCE
from deepaccident_devkit.plugins.synth.solids import (
    FACES_A_SOLID,
    Solids,
    concatenate_solids,
    face_corners,
    face_planes,
)
from deepaccident_devkit.plugins.synth.world import World
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.taxonomy import CATEGORIES

# Where bodies touch the ground: the share of the length ahead of and behind the middle, and of the width beside it.
_AXLES, _WHEELS = 0.3, 0.4


def placed_on(
    terrain: Terrain, poses: FloatArray, size: FloatArray, upright: BoolArray
) -> FloatArray:
    """The frames of bodies on the ground, (A, 4, 4): origin on the ground below the box's centre, x forward, z up.

    Poses are (A, 3) x, y (metres), yaw (radians) of the boxes' centres, sizes (A, 3) length, width, height, metres;
    those that are `upright` (A,) stay so on a slope.
    """
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    zero = np.zeros(len(poses))
    forward, left = np.stack([cos, sin, zero], axis=1), np.stack([-sin, cos, zero], axis=1)
    height = zero
    if not terrain.is_flat:
        ahead, aside = _AXLES * size[:, :1], _WHEELS * size[:, 1:2]
        xy = poses[:, :2]
        at = [xy + ahead * forward[:, :2], xy - ahead * forward[:, :2]]
        at += [xy + aside * left[:, :2], xy - aside * left[:, :2]]
        front, rear, port, starboard = terrain.height(np.concatenate(at)).reshape(4, -1)
        tilted = ~upright
        forward[tilted, 2] = ((front - rear) / (2 * ahead[:, 0]))[tilted]
        left[tilted, 2] = ((port - starboard) / (2 * aside[:, 0]))[tilted]
        height = (front + rear + port + starboard) / 4
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    up = np.cross(forward, left)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    frames = np.zeros((len(poses), 4, 4))
    frames[:, :3, 0], frames[:, :3, 1], frames[:, :3, 2] = forward, np.cross(up, forward), up
    frames[:, :2, 3], frames[:, 2, 3] = poses[:, :2], height
    frames[:, 3, 3] = 1.0
    return frames


def moved(corners: FloatArray, frames: FloatArray) -> FloatArray:
    """Points (P, K, 3) in the own frames of P bodies, moved by the bodies' frames (P, 4, 4)."""
    turned: FloatArray = corners @ np.swapaxes(frames[:, :3, :3], 1, 2)
    return turned + frames[:, None, :3, 3]


# The owner of what belongs to no road user.
_NO_OWNER = -1
_UPRIGHT = CATEGORIES.index("pedestrian")
_ENDLESS = 1e3
# The largest angle between two lines that count as one; the share of its length that a ray may be shorter.
_LEVEL, _CAREFUL = 1e-6, 1e-3
# How many poses of sensors are remembered: of five LiDARs and thirty cameras, and a reserve.
_POSES_KEPT = 40


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Solids in the ground frame.

    Attributes:
        solids: the solids in their owners' frames; their colours are used.
        corners: (P, 8, 3) float64, metres, ground frame.
        owner: (P,) int64, row of the actor that each solid belongs to, or −1 (none).
    """

    solids: Solids
    corners: FloatArray
    owner: IntArray

    @cached_property
    def quads(self) -> FloatArray:
        """The corners of all faces, (F, 4, 3), metres."""
        return face_corners(self.corners)

    @cached_property
    def planes(self) -> tuple[FloatArray, FloatArray]:
        """Outward unit normals (F, 3) of the faces and their offsets (F,), normal · p on the face."""
        return face_planes(self.quads)

    @cached_property
    def colors(self) -> FloatArray:
        """RGB of the faces in white light, (F, 3) float64, 0 to 255."""
        return self.solids.colors.reshape(-1, 3).astype(np.float64)

    @cached_property
    def face_owner(self) -> IntArray:
        """Row of the actor that each face belongs to, (F,), or −1 (none)."""
        return np.repeat(self.owner, FACES_A_SOLID)


class Setting:
    """All that stands still, and the road users that move.

    Attributes:
        world: the place.
        actors: all road users.
        terrain: the shape of the ground.
        still: surfaces of things and of parked vehicles.
        moving: (M,) rows of the actors that are not parked.
        parked: (A − M,) rows of the parked actors.
        moving_shapes: the solids of the moving actors, each in its owner's frame.
        moving_owner: (Q,) row of the actor to which each of these solids belongs.
        props: (W,) rows of the world's solids among those of `still`.
        caster: casts rays against what stands still and the ground.
    """

    world: World
    actors: Actors
    terrain: Terrain
    still: Surfaces
    props: IntArray
    moving: IntArray
    parked: IntArray
    moving_shapes: Solids
    moving_owner: IntArray
    caster: Caster

    def __init__(self, world: World, actors: Actors) -> None:
        self.world, self.actors, self.terrain = world, actors, world.terrain
        parked = np.array([actor.parked for actor in actors.all], dtype=bool)
        solid_parked = parked[actors.solid_actor]
        frames = self.frames(actors.at(0.0).poses)
        vehicles = np.flatnonzero(solid_parked)
        placed = moved(actors.solids.corners[vehicles], frames[actors.solid_actor[vehicles]])
        self.still = Surfaces(
            concatenate_solids([actors.solids.select(vehicles), world.props]),
            np.concatenate([placed, world.props.corners]),
            np.concatenate([actors.solid_actor[vehicles], np.full(len(world.props), _NO_OWNER)]),
        )
        self.props = len(vehicles) + np.arange(len(world.props))
        self.moving, self.parked = np.flatnonzero(~parked), np.flatnonzero(parked)
        self.moving_shapes = actors.solids.select(np.flatnonzero(~solid_parked))
        self.moving_owner = actors.solid_actor[~solid_parked]
        self.caster = make_caster(self.still.corners, self.terrain)
        self._fence: Caster = make_caster(_endless(self.still.corners))
        self._kept: dict[bytes, tuple[AnyArray, AnyArray] | None] = {}

    @property
    def faces(self) -> int:
        """How many faces stand still; the numbers of moving faces begin with this one."""
        return len(self.still.corners) * FACES_A_SOLID

    @cached_property
    def face_owner(self) -> IntArray:
        """Row of the actor to which each face belongs, moving faces too, (F + 2,), or −1 (none).

        The last two are for `caster.GROUND` and `caster.NOTHING`, so that every face can be used as an index.
        """
        return np.concatenate(
            [
                self.still.face_owner,
                np.repeat(self.moving_owner, FACES_A_SOLID),
                [_NO_OWNER, _NO_OWNER],
            ]
        )

    def frames(self, poses: FloatArray) -> FloatArray:
        """The actors' frames on the ground, (A, 4, 4), at poses (A, 3)."""
        return placed_on(self.terrain, poses, self.actors.size, self.actors.category == _UPRIGHT)

    def cast_columns(
        self, origin: FloatArray, rays: AnyArray, limit: float = np.inf
    ) -> tuple[AnyArray, AnyArray]:
        """What `caster.cast` does for columns of rays (R, C, 3), (R · C,), but skips rays that meet the ground first.

        It knows them on flat ground, where all rays of a column go over the same line; if they do not, all are cast.
        Results must be correct up to a limit, in lengths of the ray.
        """
        flat = rays.reshape(-1, 3)
        if not self.terrain.is_flat or not _in_columns(rays):
            return self.caster.cast(origin, flat)
        distance = plane_distance(origin[2], flat[:, 2]).astype(np.float32)
        face = np.where(np.isfinite(distance), np.int32(GROUND), np.int32(NOTHING))
        clear = self._clear(origin, rays[0])
        level = np.sqrt(rays[..., 0] ** 2 + rays[..., 1] ** 2)
        ends = np.minimum(distance, limit).reshape(rays.shape[:2]) * level
        open_ = np.flatnonzero((ends > clear * (1 - _CAREFUL)).ravel())
        distance[open_], face[open_] = self.caster.cast(origin, flat.take(open_, axis=0))
        return distance, face

    def _clear(self, origin: FloatArray, directions: AnyArray) -> AnyArray:
        """Metres over the ground, (N,), from the origin of rays (N, 3) to the first thing above or below each of them.

        No ray over the same line meets a thing before that. Infinite if there is nothing.
        """
        level = directions * np.array([1, 1, 0], dtype=np.float32)
        reached, _ = self._fence.cast(np.array([*origin[:2], 0.0]), level)
        return np.asarray(reached * np.linalg.norm(level, axis=1))

    def kept(
        self, pose: bytes, cast: Callable[[], tuple[AnyArray, AnyArray]]
    ) -> tuple[AnyArray, AnyArray]:
        """The result of `cast`; from memory if it was called twice for the same pose before. Do not change it."""
        stands = pose in self._kept
        found = self._kept.pop(pose, None) or cast()
        self._kept[pose] = found if stands else None
        if len(self._kept) > _POSES_KEPT:
            del self._kept[next(iter(self._kept))]
        return found


def _in_columns(rays: AnyArray) -> bool:
    """Whether the rays (R, C, 3) of each column go over the same line on the ground."""
    first, last = rays[0, :, :2], rays[-1, :, :2]
    aside = first[:, 0] * last[:, 1] - first[:, 1] * last[:, 0]
    return bool((np.abs(aside) <= _LEVEL * (np.abs(first) * np.abs(last)).sum(axis=1)).all())


def _endless(corners: FloatArray) -> FloatArray:
    """Upright boxes (P, 8, 3) around solids, from deep below the ground to high above it."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    low[:, 2], high[:, 2] = -_ENDLESS, _ENDLESS
    return np.asarray(np.where(CORNER_SIGNS > 0, high[:, None], low[:, None]))


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything at one moment, in the ground frame.

    Attributes:
        setting: what stands still.
        snapshot: where the road users are, seen from above.
        frames: (A, 4, 4) their frames on the ground, as in `placed_on`.
        movers: surfaces of those who are not parked.
        caster: casts rays against `movers`.
    """

    setting: Setting
    snapshot: Snapshot
    frames: FloatArray
    movers: Surfaces
    caster: Caster

    @property
    def actors(self) -> Actors:
        """The road users."""
        return self.setting.actors

    @cached_property
    def box_corners(self) -> FloatArray:
        """Corners of the label boxes on the ground, (A, 8, 3), metres."""
        offsets = self.actors.size[:, None, :] / 2 * CORNER_SIGNS
        offsets[:, :, 2] += self.actors.size[:, 2:] / 2 + BOX_CLEARANCE
        return moved(offsets, self.frames)

    @property
    def face_owner(self) -> IntArray:
        """The same as `Setting.face_owner`."""
        return self.setting.face_owner

    def cast(
        self, origin: FloatArray, directions: AnyArray, *, near: IntArray | None = None
    ) -> tuple[AnyArray, AnyArray]:
        """Where N rays from above the ground first meet a surface or the ground; arguments as for `Caster.cast`.

        `near` are rows of the rays that can meet a moving road user; None for all. Returns (N,) distances in lengths of
        the direction, infinite if a ray meets nothing; and (N,) the faces met, or `caster.GROUND` or `caster.NOTHING`.
        """
        rows = np.arange(len(directions)) if near is None else near
        reached, met = self._cast_at_movers(origin, directions, rows)
        reach = np.full(len(directions), np.inf, dtype=np.float32)
        reach[rows] = reached
        distance, face = self.setting.caster.cast(origin, directions, reach)
        ahead = np.flatnonzero(reached < distance[rows])
        distance[rows[ahead]], face[rows[ahead]] = reached[ahead], met[ahead]
        return distance, face

    def with_movers(
        self,
        origin: FloatArray,
        directions: AnyArray,
        still: tuple[AnyArray, AnyArray],
        near: IntArray,
    ) -> tuple[AnyArray, AnyArray]:
        """What rays meet, given that they meet `still` without moving road users; all else is as in `cast`."""
        reached, met = self._cast_at_movers(origin, directions, near)
        ahead = np.flatnonzero(reached < still[0][near])
        distance, face = still[0].copy(), still[1].copy()
        distance[near[ahead]], face[near[ahead]] = reached[ahead], met[ahead]
        return distance, face

    def _cast_at_movers(
        self, origin: FloatArray, directions: AnyArray, rows: IntArray
    ) -> tuple[AnyArray, AnyArray]:
        """How far the rays of `rows` go until they meet a moving road user, and the faces that they meet."""
        rays = directions.take(rows, axis=0)
        reached, met = self.caster.cast(origin if origin.ndim == 1 else origin[rows], rays)
        return reached, met + self.setting.faces


def make_scene(setting: Setting, time: float) -> Scene:
    """The scene at a time, seconds since the first recorded frame."""
    snapshot = setting.actors.at(time)
    frames = setting.frames(snapshot.poses)
    corners = moved(setting.moving_shapes.corners, frames[setting.moving_owner])
    movers = Surfaces(setting.moving_shapes, corners, setting.moving_owner)
    return Scene(setting, snapshot, frames, movers, make_caster(corners))
