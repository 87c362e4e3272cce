"""The rotating LiDAR: 32 channels over 40° of elevation, 70 m, with noise, lost returns and the effects of weather.

If only labels are made, only the rays that may pass through the boxes of road users are followed.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.plugins.synth.sensors.agents import Agent
from deepaccident_devkit.plugins.synth.sensors.caster import NOTHING, make_caster
from deepaccident_devkit.plugins.synth.sensors.scene import Scene, Setting
from deepaccident_devkit.plugins.synth.shapes import BOX_CLEARANCE
from deepaccident_devkit.plugins.synth.solids import FACES_A_SOLID
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
    readonly,
)

LIDAR_CHANNELS = 32
# Elevation of the lowest and the highest channel, degrees.
ELEVATION = (-30.0, 10.0)
# Rays a turn and channel. The release's LiDAR sends out 2,750, of which it loses 48 % at random.
AZIMUTHS = 1400
RANGE = 70.0
# Metres around a box that count as inside: more than anybody moves between the point cloud and the count.
_SPARE = 0.06
# The distance of a box is multiplied by this, because a box on a slope leans.
_CLOSER = 0.98


@cache
def lidar_ray_directions() -> FloatArray:
    """Unit vectors of all rays in the LiDAR frame, (32 · 1400, 3), channel after channel from the top."""
    elevation = np.deg2rad(np.linspace(ELEVATION[1], ELEVATION[0], LIDAR_CHANNELS))[:, None]
    azimuth = np.linspace(np.pi, -np.pi, AZIMUTHS, endpoint=False)[None, :]
    directions = [
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.broadcast_to(np.sin(elevation), (LIDAR_CHANNELS, AZIMUTHS)),
    ]
    return readonly(np.stack(directions, axis=-1).reshape(-1, 3))


def turned_rays(rotation: FloatArray, rows: IntArray | slice = slice(None)) -> Float32Array:
    """Directions (K, 3) of some or all rays, turned by a rotation (3, 3); each one does not depend on the others."""
    x, y, z = _direction_columns()[:, rows]
    turn = rotation.astype(np.float32)
    turned = np.empty((len(x), 3), dtype=np.float32)
    for axis in range(3):
        turned[:, axis] = x * turn[axis, 0] + y * turn[axis, 1] + z * turn[axis, 2]
    return turned


def rays_to_boxes(scene: Scene, ground_from_lidar: SE3, *groups: IntArray) -> BoolArray:
    """Which rays may pass through a box of each group of actors, (G, 32 · 1400): those in a window around each box."""
    rows = np.concatenate(groups)
    frames, half = scene.frames[rows], scene.actors.size[rows, :2] / 2
    corners = (
        ground_from_lidar.inverse().apply(scene.box_corners[rows].reshape(-1, 3)).reshape(-1, 8, 3)
    )
    place = np.einsum(
        "nk,nkl->nl", ground_from_lidar.translation - frames[:, :3, 3], frames[:, :3, :3]
    )
    gap = np.maximum(np.abs(place[:, :2]) - half - _SPARE, 0.0)
    reach = np.hypot(corners[..., 0], corners[..., 1])
    nearest = np.hypot(gap[:, 0], gap[:, 1]) * _CLOSER
    first, last = _channels(
        corners[..., 2].min(axis=1), corners[..., 2].max(axis=1), nearest, reach.max(axis=1)
    )
    start, count = _azimuths(corners, around=nearest == 0)
    met = np.zeros(
        (len(groups), LIDAR_CHANNELS, 2 * AZIMUTHS), dtype=bool
    )  # 2 turns, for windows across the end
    group = np.repeat(np.arange(len(groups)), [len(each) for each in groups])
    for row in np.flatnonzero(nearest < RANGE).tolist():
        met[group[row], first[row] : last[row], start[row] : start[row] + count[row]] = True
    return np.asarray((met[..., :AZIMUTHS] | met[..., AZIMUTHS:]).reshape(len(groups), -1))


def rays_through(size: tuple[float, float, float], place: FloatArray) -> IntArray:
    """Rows of the rays that pass through a box of a size (metres) with the same heading as the LiDAR.

    `place` (3,) is the LiDAR's place in the frame of the box's middle on the road, metres.
    """
    middle = np.array([0.0, 0.0, BOX_CLEARANCE + size[2] / 2]) - place
    half = np.array(size) / 2 + _SPARE
    with np.errstate(divide="ignore"):
        one, other = ((middle + side * half) / lidar_ray_directions() for side in (-1, 1))
    enters, leaves = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
    return np.flatnonzero((leaves > 0) & (enters <= leaves))


def _channels(
    low: FloatArray, high: FloatArray, nearest: FloatArray, farthest: FloatArray
) -> tuple[IntArray, IntArray]:
    """First channel, and last channel plus 1, whose rays pass between two heights (N,) at a range of distances (N,)."""
    bottom, top, close = low - _SPARE, high + _SPARE, np.maximum(nearest, 1e-3)
    lowest = np.arctan2(bottom, np.where(bottom < 0, close, farthest))
    highest = np.arctan2(top, np.where(top > 0, close, farthest))
    upper = np.deg2rad(ELEVATION[1])
    step = (upper - np.deg2rad(ELEVATION[0])) / (LIDAR_CHANNELS - 1)
    first = np.floor((upper - highest) / step).clip(0, LIDAR_CHANNELS).astype(np.int64)
    return first, np.ceil((upper - lowest) / step + 1).clip(0, LIDAR_CHANNELS).astype(np.int64)


def _azimuths(corners: FloatArray, *, around: BoolArray) -> tuple[IntArray, IntArray]:
    """First azimuth and number of azimuths of the rays to boxes (N, 8, 3); all azimuths if a box is `around`."""
    middle = np.arctan2(*corners[..., :2].mean(axis=1).T[::-1])
    aside = np.abs(
        (np.arctan2(corners[..., 1], corners[..., 0]) - middle[:, None] + np.pi) % (2 * np.pi)
        - np.pi
    )
    half_turn = np.where(around, np.pi, aside.max(axis=1))
    column = (np.pi - middle) / (2 * np.pi) * AZIMUTHS
    wide = half_turn / (2 * np.pi) * AZIMUTHS + 1
    start = np.floor(column - wide).astype(np.int64)
    return start % AZIMUTHS, np.minimum(
        np.ceil(column + wide).astype(np.int64) + 1 - start, AZIMUTHS
    )


@cache
def _direction_columns() -> Float32Array:
    """The same as `lidar_ray_directions`, as (3, 32 · 1400)."""
    return readonly(np.ascontiguousarray(lidar_ray_directions().T.astype(np.float32)))


# Standard deviation along the ray, metres, as in the release.
RANGE_NOISE = 0.05
# Attenuation of the intensity for each metre of dry air, as in the release.
_ATTENUATION = 0.03
# The intensity from which on no return is lost, and the share of lost returns at intensity 0: CARLA's defaults.
_SURE, _LOST_DARK = 0.8, 0.4
_NUMBERS = 1 << 18
# The least and the largest distance from which raindrops return a ray, metres.
_NEAREST_DROP, _FARTHEST_DROP = 1.5, 12.0


@dataclass(frozen=True, slots=True)
class Air:
    """What the weather does to a ray.

    Attributes:
        lost: share of the returns from `RANGE` metres that are lost, in addition to the weak ones; from nearer, the
            share falls with the square of the distance.
        attenuation: attenuation of the intensity for each metre, in addition to that of dry air.
        drops: share of all rays that return from a raindrop.
    """

    lost: float = 0.0
    attenuation: float = 0.0
    drops: float = 0.0


# Weather (of `taxonomy.WEATHERS`) → its air.
AIR_OF_WEATHER = {
    "Clear": Air(),
    "Cloudy": Air(),
    "Wet": Air(0.03, 0.001),
    "WetCloudy": Air(0.03, 0.001),
    "SoftRain": Air(0.15, 0.004, 0.0002),
    "MidRain": Air(0.25, 0.008, 0.0005),
    "HardRain": Air(0.4, 0.014, 0.0015),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lidar:
    """The LiDAR of an agent, and where its rays meet the agent's own body, which never changes.

    Attributes:
        row: row of the agent's own actor; None for the pole.
        body: (K,) rows of the rays that pass through the agent's own box.
        distance: (K,) float32, metres to where they meet its body; infinite if they do not.
        face: (K,) the faces that they meet there, as in `Scene.cast`.
    """

    row: int | None
    body: IntArray
    distance: Float32Array
    face: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """N points of one turn.

    Attributes:
        xyz: (N, 3) float32, metres, in the LiDAR frame, as stored.
        ray: (N,) int64, row of each point's ray in `lidar_ray_directions`.
        face: (N,) the face that each lies on, as in `Scene.cast`; `caster.NOTHING` for a raindrop.
        reach: (N,) float32, distance without the noise, metres.
    """

    xyz: Float32Array
    ray: IntArray
    face: AnyArray
    reach: Float32Array


def make_lidar(setting: Setting, agent: Agent) -> Lidar:
    """The LiDAR of an agent."""
    if agent.row is None:
        nothing = np.zeros(0, dtype=np.int64)
        return Lidar(row=None, body=nothing, distance=np.zeros(0, dtype=np.float32), face=nothing)
    place = (agent.box_from_ego @ agent.ego_from_lidar).translation
    body = rays_through(setting.actors.all[agent.row].size, place)
    solids = np.flatnonzero(setting.moving_owner == agent.row)
    caster = make_caster(setting.moving_shapes.corners[solids])
    distance, face = caster.cast(place, turned_rays(np.eye(3), body))
    first = setting.faces + FACES_A_SOLID * int(solids[0])
    return Lidar(
        row=agent.row, body=body, distance=distance, face=np.where(face >= 0, face + first, face)
    )


def scan(
    scene: Scene,
    lidar: Lidar,
    ground_from_lidar: SE3,
    air: Air,
    rng: np.random.Generator,
    *,
    boxed: bool = False,
) -> Scan:
    """What a LiDAR at this pose measures; the number of random draws does not depend on what the rays meet.

    If `boxed`, only rays are followed that may pass through a label box. Then all points in boxes are there, equal to
    the bit, but only few points outside the boxes.
    """
    cast = _cast_boxed if boxed else cast_all
    rows, distance, face = cast(scene, lidar, ground_from_lidar)
    normal, even = _random_numbers()
    noise, luck, wet = rng.integers(0, _NUMBERS - len(lidar_ray_directions()), 3)
    reach = distance.astype(np.float32)
    returned = returns(reach, even[luck + rows], air)
    if air.drops:
        drop = np.flatnonzero(even[wet + rows] < air.drops)
        place = _NEAREST_DROP + (_FARTHEST_DROP - _NEAREST_DROP) * even[luck + rows[drop]]
        reach[drop] = np.minimum(place, reach[drop])
        face[drop], returned[drop] = NOTHING, True
    back = np.flatnonzero(returned)
    ray, reach = rows[back], reach[back]
    measured = np.maximum(reach + np.float32(RANGE_NOISE) * normal[noise + ray], np.float32(0.1))
    return Scan(
        (lidar_ray_directions().take(ray, axis=0) * measured[:, None]).astype(np.float32),
        ray,
        face[back],
        reach,
    )


def intensity(points: Scan, air: Air) -> Float32Array:
    """The intensity of the points (N,), 0 to 1: it depends only on the air on the way, as in the release."""
    return _brightness(points.reach, air)


def _brightness(reach: AnyArray, air: Air) -> Float32Array:
    return np.asarray(np.exp(-(_ATTENUATION + air.attenuation) * reach), dtype=np.float32)


def cast_all(
    scene: Scene, lidar: Lidar, ground_from_lidar: SE3
) -> tuple[IntArray, AnyArray, AnyArray]:
    """The rows of all rays; how far they go, correct up to `RANGE`; and what they meet."""
    setting, rays = scene.setting, turned_rays(ground_from_lidar.rotation)
    pose = ground_from_lidar.matrix.tobytes()
    origin, columns = ground_from_lidar.translation, rays.reshape(LIDAR_CHANNELS, AZIMUTHS, 3)
    still = setting.kept(pose, lambda: setting.cast_columns(origin, columns, RANGE))
    near = np.flatnonzero(
        rays_to_boxes(scene, ground_from_lidar, _others(setting.moving, lidar))[0]
    )
    distance, face = scene.with_movers(origin, rays, still, near)
    met = np.isfinite(lidar.distance)
    distance[lidar.body[met]], face[lidar.body[met]] = lidar.distance[met], lidar.face[met]
    return np.arange(len(rays)), distance, face


def _cast_boxed(
    scene: Scene, lidar: Lidar, ground_from_lidar: SE3
) -> tuple[IntArray, AnyArray, AnyArray]:
    """The same as `cast_all`, for only the rays that may pass through a box."""
    setting = scene.setting
    near, others = rays_to_boxes(
        scene, ground_from_lidar, _others(setting.moving, lidar), setting.parked
    )
    wanted = near | others
    wanted[lidar.body[np.isfinite(lidar.distance)]] = False
    rows = np.flatnonzero(wanted)
    rays = turned_rays(ground_from_lidar.rotation, rows)
    distance, face = scene.cast(
        ground_from_lidar.translation, rays, near=np.flatnonzero(near[rows])
    )
    own = np.flatnonzero(~wanted[lidar.body])
    return (
        np.concatenate([rows, lidar.body[own]]),
        np.concatenate([distance, lidar.distance[own]]),
        np.concatenate([face, lidar.face[own]]),
    )


@cache
def _random_numbers() -> tuple[Float32Array, Float32Array]:
    """Random numbers of the standard normal distribution, and uniform ones from 0 to 1, (2 ** 18,) each.

    Each turn takes them from another place: to draw new ones would take as long as to cast the rays to the boxes.
    """
    rng = np.random.default_rng(0)
    normal, even = (
        rng.standard_normal(_NUMBERS, dtype=np.float32),
        rng.random(_NUMBERS, dtype=np.float32),
    )
    return readonly(normal), readonly(even)


def _others(rows: IntArray, lidar: Lidar) -> IntArray:
    return rows if lidar.row is None else rows[rows != lidar.row]


def returns(reach: Float32Array, luck: Float32Array, air: Air) -> NDArray[np.bool_]:
    """Which rays (N,) return, by the distance in metres at which they met something: of the weak ones fewer."""
    near = np.minimum(reach, RANGE)
    lost = (
        _LOST_DARK * np.maximum(1 - _brightness(near, air) / _SURE, 0)
        + air.lost * (near / RANGE) ** 2
    )
    return np.asarray((reach <= RANGE) & (luck >= lost))
