"""A scenario's static world, and one moment of it, ready to be recorded."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from deepaccident_devkit.geometry.boxes import CORNER_SIGNS
from deepaccident_devkit.plugins.synth.actors import Actors, Snapshot
from deepaccident_devkit.plugins.synth.roads import Terrain
from deepaccident_devkit.plugins.synth.sensors.caster import (
    GROUND,
    NO_HIT,
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

# Points where bodies touch the ground: their distance ahead of and behind the middle as a share of
# the length, and to its side as a fraction of the width.
_AXLE_SHARE = 0.3
_WHEEL_SHARE = 0.4
# Owner row of solids that do not belong to a road user.
_NO_OWNER = -1
_UPRIGHT_CATEGORY = CATEGORIES.index("pedestrian")
_FENCE_HEIGHT_M = 1e3
# Largest angle between two lines that count as one, radians; and the share of its length by which a
# ray may miss a thing and still be cast.
_LINE_TOLERANCE = 1e-6
_LENGTH_TOLERANCE = 1e-3
# Number of sensor poses that are remembered: five LiDARs, thirty cameras, and a reserve.
_MAX_REMEMBERED_POSES = 40


def place_on_ground(
    terrain: Terrain, poses: FloatArray, size: FloatArray, is_upright: BoolArray
) -> FloatArray:
    """Return the frames of bodies on the ground.

    Args:
        terrain: Shape of the ground.
        poses: x, y (metres), yaw (radians) of the boxes' centres, shape (A, 3).
        size: Length, width, height, shape (A, 3), metres.
        is_upright: Whether each body stays upright on a slope, shape (A,), bool.

    Returns:
        Frames (A, 4, 4): origin on the ground below the box's centre, x forward, z up.
    """
    cos = np.cos(poses[:, 2])
    sin = np.sin(poses[:, 2])
    zero = np.zeros(len(poses))
    forward = np.stack([cos, sin, zero], axis=1)
    left = np.stack([-sin, cos, zero], axis=1)
    height = zero
    if not terrain.is_flat:
        axle_distance = _AXLE_SHARE * size[:, :1]
        wheel_distance = _WHEEL_SHARE * size[:, 1:2]
        xy = poses[:, :2]
        to_front = axle_distance * forward[:, :2]
        to_left = wheel_distance * left[:, :2]
        contacts = [xy + to_front, xy - to_front, xy + to_left, xy - to_left]
        contact_height = terrain.height(np.concatenate(contacts))
        front, rear, port, starboard = contact_height.reshape(4, -1)
        pitch_slope = (front - rear) / (2 * axle_distance[:, 0])
        roll_slope = (port - starboard) / (2 * wheel_distance[:, 0])
        forward[:, 2] = np.where(is_upright, 0.0, pitch_slope)
        left[:, 2] = np.where(is_upright, 0.0, roll_slope)
        height = (front + rear + port + starboard) / 4
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    up = np.cross(forward, left)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    frames = np.zeros((len(poses), 4, 4))
    frames[:, :3, 0] = forward
    frames[:, :3, 1] = np.cross(up, forward)
    frames[:, :3, 2] = up
    frames[:, :2, 3] = poses[:, :2]
    frames[:, 2, 3] = height
    frames[:, 3, 3] = 1.0
    return frames


def move_points(points: FloatArray, frames: FloatArray) -> FloatArray:
    """Move points (P, K, 3) in the own frames of P bodies by the bodies' frames (P, 4, 4)."""
    rotation = np.swapaxes(frames[:, :3, :3], 1, 2)
    rotated: FloatArray = points @ rotation
    translation = frames[:, None, :3, 3]
    return rotated + translation


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Solids in the ground frame.

    Attributes:
        solids: Solids in their owners' frames, with their colours.
        corners: Corners, shape (P, 8, 3), float64, metres, ground frame.
        owner: Row of the actor that each solid belongs to, or −1 (none), shape (P,), int64.
    """

    solids: Solids
    corners: FloatArray
    owner: IntArray

    @cached_property
    def quads(self) -> FloatArray:
        """Corners of all faces, shape (F, 4, 3), metres."""
        return face_corners(self.corners)

    @cached_property
    def planes(self) -> tuple[FloatArray, FloatArray]:
        """Outward unit normals (F, 3) and offsets (F,) of the faces, normal · p on the face."""
        return face_planes(self.quads)

    @cached_property
    def colors(self) -> FloatArray:
        """RGB colours of the faces in white light, shape (F, 3), float64, 0 to 255."""
        colors = self.solids.colors.reshape(-1, 3)
        return colors.astype(np.float64)

    @cached_property
    def face_owner(self) -> IntArray:
        """Row of the actor that each face belongs to, or −1 (none), shape (F,)."""
        return np.repeat(self.owner, FACES_A_SOLID)


class Setting:
    """The static world, and the road users that move.

    Attributes:
        world: The static world without vehicles.
        actors: All road users.
        terrain: Shape of the ground.
        static: Surfaces of things and of parked vehicles.
        moving: Rows of the actors that are not parked, shape (M,).
        parked: Rows of the parked actors, shape (A − M,).
        moving_shapes: Solids of the moving actors, each in its owner's frame.
        moving_owner: Row of the actor that each of these solids belongs to, shape (Q,).
        props: Rows of the world's solids among the solids of `static`, shape (W,).
        caster: Caster of rays against the static world and the ground.
    """

    # the world and its road users
    world: World
    actors: Actors
    terrain: Terrain
    # static surfaces
    static: Surfaces
    props: IntArray
    # moving and parked road users
    moving: IntArray
    parked: IntArray
    moving_shapes: Solids
    moving_owner: IntArray
    # rays
    caster: Caster

    def __init__(self, world: World, actors: Actors) -> None:
        self.world = world
        self.actors = actors
        self.terrain = world.terrain
        is_parked = np.array([actor.parked for actor in actors.all], dtype=bool)
        is_parked_solid = is_parked[actors.solid_actor]
        frames = self.frames(actors.at(0.0).poses)
        parked_solids = np.flatnonzero(is_parked_solid)
        owners = actors.solid_actor[parked_solids]
        parked_corners = move_points(actors.solids.corners[parked_solids], frames[owners])
        num_props = len(world.props)
        self.static = Surfaces(
            concatenate_solids([actors.solids.select(parked_solids), world.props]),
            np.concatenate([parked_corners, world.props.corners]),
            np.concatenate([owners, np.full(num_props, _NO_OWNER)]),
        )
        self.props = len(parked_solids) + np.arange(num_props)
        self.moving = np.flatnonzero(~is_parked)
        self.parked = np.flatnonzero(is_parked)
        moving_solids = np.flatnonzero(~is_parked_solid)
        self.moving_shapes = actors.solids.select(moving_solids)
        self.moving_owner = actors.solid_actor[moving_solids]
        self.caster = make_caster(self.static.corners, self.terrain)
        self._fence = make_caster(_make_fences(self.static.corners))
        self._casts_by_pose: dict[bytes, tuple[AnyArray, AnyArray] | None] = {}

    @property
    def faces(self) -> int:
        """Number of static faces; the numbers of moving faces begin with this one."""
        return len(self.static.corners) * FACES_A_SOLID

    @cached_property
    def face_owner(self) -> IntArray:
        """Row of the actor that each face belongs to, including moving faces, or −1 (none).

        The shape is (F + 2,). The last two are for `caster.GROUND` and `caster.NO_HIT`, so that
        every face can be used as an index.
        """
        static_owner = self.static.face_owner
        moving_owner = np.repeat(self.moving_owner, FACES_A_SOLID)
        no_owners = [_NO_OWNER, _NO_OWNER]
        return np.concatenate([static_owner, moving_owner, no_owners])

    def frames(self, poses: FloatArray) -> FloatArray:
        """Return the actors' frames on the ground, (A, 4, 4), at poses (A, 3)."""
        is_upright = self.actors.category == _UPRIGHT_CATEGORY
        return place_on_ground(self.terrain, poses, self.actors.size, is_upright)

    def cast_columns(
        self, origin: FloatArray, rays: AnyArray, limit: float = np.inf
    ) -> tuple[AnyArray, AnyArray]:
        """Cast columns of rays as `caster.cast` does, but skip rays that meet the ground first.

        Such rays are known on flat ground, where all rays of a column go over the same line; if
        they do not, all are cast.

        Args:
            origin: Origin of the rays, shape (3,), metres.
            rays: Directions, shape (R, C, 3).
            limit: Distance up to which results must be correct, in lengths of the ray.

        Returns:
            Distances and faces, shape (R · C,) each.
        """
        flat_rays = rays.reshape(-1, 3)
        if not self.terrain.is_flat or not _share_ground_lines(rays):
            return self.caster.cast(origin, flat_rays)
        distance = plane_distance(origin[2], flat_rays[:, 2]).astype(np.float32)
        meets_ground = np.isfinite(distance)
        face = np.where(meets_ground, np.int32(GROUND), np.int32(NO_HIT))
        free_length = self._free_length(origin, rays[0])
        level = np.sqrt(rays[..., 0] ** 2 + rays[..., 1] ** 2)
        relevant_distance = np.minimum(distance, limit).reshape(rays.shape[:2])
        level_length = relevant_distance * level
        may_hit = level_length > free_length * (1 - _LENGTH_TOLERANCE)
        rows = np.flatnonzero(may_hit.ravel())
        distance[rows], face[rows] = self.caster.cast(origin, flat_rays.take(rows, axis=0))
        return distance, face

    def _free_length(self, origin: FloatArray, directions: AnyArray) -> AnyArray:
        """Return how far rays travel until they are above or below the first object.

        Before that distance, no ray over the same line hits an object.

        Args:
            origin: Origin of the rays, shape (3,), metres.
            directions: Directions, shape (N, 3).

        Returns:
            Distances (N,), metres; infinite if there is no object.
        """
        level = directions * np.array([1, 1, 0], dtype=np.float32)
        x, y, _ = origin
        distance, _ = self._fence.cast(np.array([x, y, 0.0]), level)
        return np.asarray(distance * np.linalg.norm(level, axis=1))

    def remember_cast(
        self, pose: bytes, cast: Callable[[], tuple[AnyArray, AnyArray]]
    ) -> tuple[AnyArray, AnyArray]:
        """Cast the rays of a sensor, or return their hits from memory.

        The hits are kept from the second call for the same pose on. Do not change them.

        Args:
            pose: Pose of the sensor, as bytes.
            cast: Function that casts the rays of the sensor.
        """
        is_known_pose = pose in self._casts_by_pose
        result = self._casts_by_pose.pop(pose, None) or cast()
        self._casts_by_pose[pose] = result if is_known_pose else None
        if len(self._casts_by_pose) > _MAX_REMEMBERED_POSES:
            oldest_pose = next(iter(self._casts_by_pose))
            del self._casts_by_pose[oldest_pose]
        return result


def _share_ground_lines(rays: AnyArray) -> bool:
    """Return whether the rays (R, C, 3) of each column go over the same line on the ground."""
    top = rays[0, :, :2]
    bottom = rays[-1, :, :2]
    cross_product = top[:, 0] * bottom[:, 1] - top[:, 1] * bottom[:, 0]
    scale = (np.abs(top) * np.abs(bottom)).sum(axis=1)
    is_parallel = np.abs(cross_product) <= _LINE_TOLERANCE * scale
    return bool(is_parallel.all())


def _make_fences(corners: FloatArray) -> FloatArray:
    """Return upright boxes around solids, from deep below the ground to high above it.

    Args:
        corners: Corners of the solids, shape (P, 8, 3), metres.

    Returns:
        Corners of the boxes, shape (P, 8, 3), metres.
    """
    low = corners.min(axis=1)
    high = corners.max(axis=1)
    low[:, 2] = -_FENCE_HEIGHT_M
    high[:, 2] = _FENCE_HEIGHT_M
    return np.asarray(np.where(CORNER_SIGNS > 0, high[:, None], low[:, None]))


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything at one moment, in the ground frame.

    Attributes:
        setting: The static world.
        snapshot: Positions of the road users, seen from above.
        frames: Frames of the road users on the ground, as in `place_on_ground`, shape (A, 4, 4).
        movers: Surfaces of the road users that are not parked.
        caster: Caster of rays against `movers`.
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
        """Corners of the label boxes on the ground, shape (A, 8, 3), metres."""
        half_size = self.actors.size[:, None, :] / 2
        corners = half_size * CORNER_SIGNS
        corners[:, :, 2] += half_size[:, :, 2] + BOX_CLEARANCE
        return move_points(corners, self.frames)

    @property
    def face_owner(self) -> IntArray:
        """Row of the actor that each face belongs to, as in `Setting.face_owner`."""
        return self.setting.face_owner

    def cast(
        self, origin: FloatArray, directions: AnyArray, *, mover_rays: IntArray | None = None
    ) -> tuple[AnyArray, AnyArray]:
        """Find where N rays from above the ground first meet a surface or the ground.

        Args:
            origin: Origin of the rays, as for `Caster.cast`.
            directions: Directions, shape (N, 3).
            mover_rays: Rows of the rays that can meet a moving road user; None for all.

        Returns:
            Distances (N,) in lengths of the direction, infinite if a ray meets nothing; and the
            faces (N,), or `caster.GROUND` or `caster.NO_HIT`.
        """
        rows = np.arange(len(directions)) if mover_rays is None else mover_rays
        mover_distance, mover_face = self._cast_at_movers(origin, directions, rows)
        reach = np.full(len(directions), np.inf, dtype=np.float32)
        reach[rows] = mover_distance
        distance, face = self.setting.caster.cast(origin, directions, reach)
        hits = np.flatnonzero(mover_distance < distance[rows])
        distance[rows[hits]] = mover_distance[hits]
        face[rows[hits]] = mover_face[hits]
        return distance, face

    def with_movers(
        self,
        origin: FloatArray,
        directions: AnyArray,
        static_hits: tuple[AnyArray, AnyArray],
        mover_rays: IntArray,
    ) -> tuple[AnyArray, AnyArray]:
        """Add moving road users to the hits of rays at the static world.

        Args:
            origin: Origin of the rays, as for `cast`.
            directions: Directions, shape (N, 3).
            static_hits: Distances and faces of the rays without moving road users.
            mover_rays: Rows of the rays that can meet a moving road user.

        Returns:
            Distances and faces, as from `cast`.
        """
        static_distance, static_face = static_hits
        mover_distance, mover_face = self._cast_at_movers(origin, directions, mover_rays)
        hits = np.flatnonzero(mover_distance < static_distance[mover_rays])
        distance = static_distance.copy()
        face = static_face.copy()
        distance[mover_rays[hits]] = mover_distance[hits]
        face[mover_rays[hits]] = mover_face[hits]
        return distance, face

    def _cast_at_movers(
        self, origin: FloatArray, directions: AnyArray, rows: IntArray
    ) -> tuple[AnyArray, AnyArray]:
        """Return distances and faces where the rays of `rows` meet a moving road user."""
        rays = directions.take(rows, axis=0)
        ray_origin = origin if origin.ndim == 1 else origin[rows]
        distance, face = self.caster.cast(ray_origin, rays)
        return distance, face + self.setting.faces


def make_scene(setting: Setting, time: float) -> Scene:
    """Make the scene at a time, seconds since the first recorded frame."""
    snapshot = setting.actors.at(time)
    frames = setting.frames(snapshot.poses)
    corners = move_points(setting.moving_shapes.corners, frames[setting.moving_owner])
    movers = Surfaces(setting.moving_shapes, corners, setting.moving_owner)
    return Scene(setting, snapshot, frames, movers, make_caster(corners))
