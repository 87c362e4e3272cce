"""The rotating LiDAR: 32 channels over 40° of elevation, 70 m, with noise and lost returns.

Weather adds its effects. If only labels are made, only the rays that may pass through the boxes of
road users are followed.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.plugins.synth.sensors.agents import Agent
from deepaccident_devkit.plugins.synth.sensors.caster import NO_HIT, make_caster
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
ELEVATION = (-30.0, 10.0)
"""Elevation of the lowest and the highest channel, degrees."""
AZIMUTHS = 1400
"""Number of rays in a turn of a channel; the release's LiDAR sends out 2,750 and loses 48 % of
them at random."""
RANGE = 70.0
RANGE_NOISE = 0.05
"""Standard deviation along the ray, metres, as in the release."""
# Margin around a box; no road user moves this far between the point cloud and the count.
_BOX_MARGIN_M = 0.06
# The distance of a box is multiplied by this, because a box on a slope leans.
_LEANING_FACTOR = 0.98
# Attenuation of the intensity for each metre of dry air, as in the release.
_ATTENUATION = 0.03
# Smallest intensity at which no return is lost, and share of lost returns at intensity 0. Both are
# CARLA's defaults.
_SAFE_INTENSITY = 0.8
_MAX_LOSS = 0.4
_NUM_RANDOM_NUMBERS = 1 << 18
# Smallest and largest distance from which raindrops return a ray.
_MIN_DROP_DISTANCE_M = 1.5
_MAX_DROP_DISTANCE_M = 12.0


@cache
def lidar_ray_directions() -> FloatArray:
    """Return the unit vectors of all rays in the LiDAR frame, channel after channel from the top.

    The shape is (32 · 1400, 3).
    """
    elevations = np.linspace(ELEVATION[1], ELEVATION[0], LIDAR_CHANNELS)
    elevation = np.deg2rad(elevations)[:, None]
    azimuth = np.linspace(np.pi, -np.pi, AZIMUTHS, endpoint=False)
    level_length = np.cos(elevation)
    directions = np.empty((LIDAR_CHANNELS, AZIMUTHS, 3))
    directions[..., 0] = level_length * np.cos(azimuth)
    directions[..., 1] = level_length * np.sin(azimuth)
    directions[..., 2] = np.sin(elevation)
    return readonly(directions.reshape(-1, 3))


def rotate_rays(rotation: FloatArray, rows: IntArray | slice = slice(None)) -> Float32Array:
    """Return the directions (K, 3) of some or all rays, rotated by a matrix (3, 3).

    Each direction does not depend on the others.
    """
    x, y, z = _list_direction_columns()[:, rows]
    matrix = rotation.astype(np.float32)
    rotated = np.empty((len(x), 3), dtype=np.float32)
    for axis, (x_part, y_part, z_part) in enumerate(matrix):
        rotated[:, axis] = x * x_part + y * y_part + z * z_part
    return rotated


def mark_rays_to_boxes(scene: Scene, ground_from_lidar: SE3, *groups: IntArray) -> BoolArray:
    """Mark the rays that may pass through a box of each group of actors.

    They are the rays in a window around each box.

    Args:
        scene: The scene.
        ground_from_lidar: Pose of the LiDAR.
        *groups: Rows of the actors of each group.

    Returns:
        Whether each ray may pass through a box of the group, shape (G, 32 · 1400), bool.
    """
    rows = np.concatenate(groups)
    frames = scene.frames[rows]
    half_size = scene.actors.size[rows, :2] / 2
    ground_corners = scene.box_corners[rows].reshape(-1, 3)
    corners = ground_from_lidar.inverse().apply(ground_corners).reshape(-1, 8, 3)
    offsets = ground_from_lidar.translation - frames[:, :3, 3]
    box_from_lidar = np.einsum("nk,nkl->nl", offsets, frames[:, :3, :3])
    from_box = np.abs(box_from_lidar[:, :2]) - half_size - _BOX_MARGIN_M
    gap = np.maximum(from_box, 0.0)
    nearest = np.hypot(gap[:, 0], gap[:, 1]) * _LEANING_FACTOR
    farthest = np.hypot(corners[..., 0], corners[..., 1]).max(axis=1)
    height = corners[..., 2]
    top_channel, end_channel = _find_channels(
        height.min(axis=1), height.max(axis=1), nearest, farthest
    )
    start, count = _find_azimuths(corners, is_around=nearest == 0)
    # Two turns, for windows across the end.
    mask = np.zeros((len(groups), LIDAR_CHANNELS, 2 * AZIMUTHS), dtype=bool)
    group_of_row = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    for row in np.flatnonzero(nearest < RANGE).tolist():
        channels = slice(top_channel[row], end_channel[row])
        azimuths = slice(start[row], start[row] + count[row])
        mask[group_of_row[row], channels, azimuths] = True
    one_turn = mask[..., :AZIMUTHS] | mask[..., AZIMUTHS:]
    return np.asarray(one_turn.reshape(len(groups), -1))


def find_rays_through(size: tuple[float, float, float], position: FloatArray) -> IntArray:
    """Return the rows of the rays that pass through a box with the same heading as the LiDAR.

    Args:
        size: Length, width, height of the box, metres.
        position: Position of the LiDAR in the frame of the box's middle on the road, shape (3,),
            metres.
    """
    middle = np.array([0.0, 0.0, BOX_CLEARANCE + size[2] / 2]) - position
    half_size = np.array(size) / 2 + _BOX_MARGIN_M
    directions = lidar_ray_directions()
    with np.errstate(divide="ignore"):
        to_low_planes = (middle - half_size) / directions
        to_high_planes = (middle + half_size) / directions
    entry_distance = np.minimum(to_low_planes, to_high_planes).max(axis=1)
    exit_distance = np.maximum(to_low_planes, to_high_planes).min(axis=1)
    return np.flatnonzero((exit_distance > 0) & (entry_distance <= exit_distance))


def _find_channels(
    low: FloatArray, high: FloatArray, nearest: FloatArray, farthest: FloatArray
) -> tuple[IntArray, IntArray]:
    """Find the channels with rays between two heights at a range of distances.

    Args:
        low: Lower heights, shape (N,), metres.
        high: Upper heights, shape (N,).
        nearest: Smallest distances, shape (N,).
        farthest: Largest distances, shape (N,).

    Returns:
        First channel, and last channel plus 1, shape (N,) each.
    """
    bottom = low - _BOX_MARGIN_M
    top = high + _BOX_MARGIN_M
    min_distance = np.maximum(nearest, 1e-3)
    bottom_distance = np.where(bottom < 0, min_distance, farthest)
    top_distance = np.where(top > 0, min_distance, farthest)
    low_elevation = np.arctan2(bottom, bottom_distance)
    high_elevation = np.arctan2(top, top_distance)
    min_elevation, max_elevation = np.deg2rad(ELEVATION)
    step = (max_elevation - min_elevation) / (LIDAR_CHANNELS - 1)
    start = np.floor((max_elevation - high_elevation) / step)
    stop = np.ceil((max_elevation - low_elevation) / step + 1)
    start = start.clip(0, LIDAR_CHANNELS)
    stop = stop.clip(0, LIDAR_CHANNELS)
    return start.astype(np.int64), stop.astype(np.int64)


def _find_azimuths(corners: FloatArray, *, is_around: BoolArray) -> tuple[IntArray, IntArray]:
    """Find the azimuths of the rays to boxes.

    Args:
        corners: Corners of the boxes in the LiDAR frame, shape (N, 8, 3), metres.
        is_around: Whether each box surrounds the LiDAR, so that it covers all azimuths, shape (N,),
            bool.

    Returns:
        First azimuth and number of azimuths, shape (N,) each.
    """
    middle_x, middle_y = corners[..., :2].mean(axis=1).T
    middle = np.arctan2(middle_y, middle_x)
    bearing = np.arctan2(corners[..., 1], corners[..., 0]) - middle[:, None]
    full_turn = 2 * np.pi
    angle = np.abs((bearing + np.pi) % full_turn - np.pi)
    half_angle = np.where(is_around, np.pi, angle.max(axis=1))
    column = (np.pi - middle) / full_turn * AZIMUTHS
    half_width = half_angle / full_turn * AZIMUTHS + 1
    start = np.floor(column - half_width).astype(np.int64)
    last = np.ceil(column + half_width).astype(np.int64)
    count = last + 1 - start
    return start % AZIMUTHS, np.minimum(count, AZIMUTHS)


@cache
def _list_direction_columns() -> Float32Array:
    """Return the columns of `lidar_ray_directions`, shape (3, 32 · 1400)."""
    directions = lidar_ray_directions()
    columns = directions.T.astype(np.float32)
    return readonly(np.ascontiguousarray(columns))


@dataclass(frozen=True, slots=True)
class Air:
    """The effect of the weather on a ray.

    Attributes:
        lost: Share of the returns from `RANGE` metres that are lost, in addition to the weak ones;
            from nearer, the share falls with the square of the distance.
        attenuation: Attenuation of the intensity for each metre, in addition to dry air's.
        drops: Share of all rays that return from a raindrop.
    """

    lost: float = 0.0
    attenuation: float = 0.0
    drops: float = 0.0


AIR_OF_WEATHER = {
    "Clear": Air(),
    "Cloudy": Air(),
    "Wet": Air(0.03, 0.001),
    "WetCloudy": Air(0.03, 0.001),
    "SoftRain": Air(0.15, 0.004, 0.0002),
    "MidRain": Air(0.25, 0.008, 0.0005),
    "HardRain": Air(0.4, 0.014, 0.0015),
}
"""Air of each weather (of `taxonomy.WEATHERS`)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lidar:
    """The LiDAR of an agent, and its rays' hits on the agent's own body, which never change.

    Attributes:
        row: Row of the agent's own actor; None for the pole.
        body: Rows of the rays that pass through the agent's own box, shape (K,).
        distance: Distances to their hits on its body, shape (K,), float32, metres; infinite if they
            do not meet it.
        face: Faces that they meet there, as in `Scene.cast`, shape (K,).
    """

    row: int | None
    body: IntArray
    distance: Float32Array
    face: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """N points of one turn.

    Attributes:
        xyz: Points in the LiDAR frame, as stored, shape (N, 3), float32, metres.
        ray: Row of each point's ray in `lidar_ray_directions`, shape (N,), int64.
        face: Face of each point, as in `Scene.cast`, shape (N,); `caster.NO_HIT` for a raindrop.
        reach: Distances without the noise, shape (N,), float32, metres.
    """

    xyz: Float32Array
    ray: IntArray
    face: AnyArray
    reach: Float32Array


def make_lidar(setting: Setting, agent: Agent) -> Lidar:
    """Make the LiDAR of an agent."""
    if agent.row is None:
        no_rows = np.zeros(0, dtype=np.int64)
        no_distances = np.zeros(0, dtype=np.float32)
        return Lidar(row=None, body=no_rows, distance=no_distances, face=no_rows)
    position = (agent.box_from_ego @ agent.ego_from_lidar).translation
    body = find_rays_through(setting.actors.all[agent.row].size, position)
    solids = np.flatnonzero(setting.moving_owner == agent.row)
    caster = make_caster(setting.moving_shapes.corners[solids])
    distance, face = caster.cast(position, rotate_rays(np.eye(3), body))
    first_face = setting.faces + FACES_A_SOLID * int(solids[0])
    scene_face = np.where(face >= 0, face + first_face, face)
    return Lidar(row=agent.row, body=body, distance=distance, face=scene_face)


def scan(
    scene: Scene,
    lidar: Lidar,
    ground_from_lidar: SE3,
    air: Air,
    rng: np.random.Generator,
    *,
    boxed: bool = False,
) -> Scan:
    """Simulate a turn of a LiDAR.

    The number of random draws does not depend on the surfaces that the rays meet.

    Args:
        scene: The scene.
        lidar: The LiDAR.
        ground_from_lidar: Pose of the LiDAR.
        air: Effect of the weather.
        rng: Generator of random numbers.
        boxed: Whether only rays are followed that may pass through a label box. The result then
            contains all points in boxes, bit-identical, but only a few points outside the boxes.
    """
    cast = _cast_to_boxes if boxed else cast_all
    rows, distance, face = cast(scene, lidar, ground_from_lidar)
    normal, uniform = _draw_random_numbers()
    max_start = _NUM_RANDOM_NUMBERS - len(lidar_ray_directions())
    noise_start, loss_start, drop_start = rng.integers(0, max_start, 3)
    reach = distance.astype(np.float32)
    has_returned = draw_returns(reach, uniform[loss_start + rows], air)
    if air.drops:
        drops = np.flatnonzero(uniform[drop_start + rows] < air.drops)
        share = uniform[loss_start + rows[drops]]
        drop_distance = _MIN_DROP_DISTANCE_M + (_MAX_DROP_DISTANCE_M - _MIN_DROP_DISTANCE_M) * share
        reach[drops] = np.minimum(drop_distance, reach[drops])
        face[drops] = NO_HIT
        has_returned[drops] = True
    points = np.flatnonzero(has_returned)
    ray = rows[points]
    reach = reach[points]
    noise = np.float32(RANGE_NOISE) * normal[noise_start + ray]
    measured = np.maximum(reach + noise, np.float32(0.1))
    directions = lidar_ray_directions().take(ray, axis=0)
    xyz = (directions * measured[:, None]).astype(np.float32)
    return Scan(xyz, ray, face[points], reach)


def intensity(points: Scan, air: Air) -> Float32Array:
    """Return the intensity of the points (N,), 0 to 1.

    It depends only on the air on the way, as in the release.
    """
    return _compute_intensity(points.reach, air)


def _compute_intensity(reach: AnyArray, air: Air) -> Float32Array:
    """Return the intensity of returns from distances in metres."""
    attenuation = _ATTENUATION + air.attenuation
    return np.asarray(np.exp(-attenuation * reach), dtype=np.float32)


def cast_all(
    scene: Scene, lidar: Lidar, ground_from_lidar: SE3
) -> tuple[IntArray, AnyArray, AnyArray]:
    """Cast all rays of a LiDAR.

    Returns:
        The rows of the rays, their distances (correct up to `RANGE`), and the faces that they meet.
    """
    setting = scene.setting
    rays = rotate_rays(ground_from_lidar.rotation)
    pose = ground_from_lidar.matrix.tobytes()
    origin = ground_from_lidar.translation
    columns = rays.reshape(LIDAR_CHANNELS, AZIMUTHS, 3)
    static_hits = setting.remember_cast(pose, lambda: setting.cast_columns(origin, columns, RANGE))
    moving_rows = _drop_own_row(setting.moving, lidar)
    [to_movers] = mark_rays_to_boxes(scene, ground_from_lidar, moving_rows)
    mover_rays = np.flatnonzero(to_movers)
    distance, face = scene.with_movers(origin, rays, static_hits, mover_rays)
    hits_body = np.isfinite(lidar.distance)
    body = lidar.body[hits_body]
    distance[body] = lidar.distance[hits_body]
    face[body] = lidar.face[hits_body]
    return np.arange(len(rays)), distance, face


def _cast_to_boxes(
    scene: Scene, lidar: Lidar, ground_from_lidar: SE3
) -> tuple[IntArray, AnyArray, AnyArray]:
    """Cast only the rays that may pass through a box.

    Returns:
        As from `cast_all`, for these rays.
    """
    setting = scene.setting
    moving_rows = _drop_own_row(setting.moving, lidar)
    to_movers, to_parked = mark_rays_to_boxes(scene, ground_from_lidar, moving_rows, setting.parked)
    is_cast = to_movers | to_parked
    is_cast[lidar.body[np.isfinite(lidar.distance)]] = False
    rows = np.flatnonzero(is_cast)
    rays = rotate_rays(ground_from_lidar.rotation, rows)
    mover_rays = np.flatnonzero(to_movers[rows])
    distance, face = scene.cast(ground_from_lidar.translation, rays, mover_rays=mover_rays)
    own = np.flatnonzero(~is_cast[lidar.body])
    all_rows = np.concatenate([rows, lidar.body[own]])
    all_distances = np.concatenate([distance, lidar.distance[own]])
    all_faces = np.concatenate([face, lidar.face[own]])
    return all_rows, all_distances, all_faces


@cache
def _draw_random_numbers() -> tuple[Float32Array, Float32Array]:
    """Return standard normal random numbers, and uniform ones from 0 to 1, (2 ** 18,) each.

    Each turn takes them from another position: to draw new ones would take as long as to cast the
    rays to the boxes.
    """
    rng = np.random.default_rng(0)
    normal = rng.standard_normal(_NUM_RANDOM_NUMBERS, dtype=np.float32)
    uniform = rng.random(_NUM_RANDOM_NUMBERS, dtype=np.float32)
    return readonly(normal), readonly(uniform)


def _drop_own_row(rows: IntArray, lidar: Lidar) -> IntArray:
    """Return rows of actors, without the row of the LiDAR's own agent."""
    if lidar.row is None:
        return rows
    other_rows: IntArray = rows[rows != lidar.row]
    return other_rows


def draw_returns(reach: Float32Array, chance: Float32Array, air: Air) -> NDArray[np.bool_]:
    """Draw which rays (N,) come back to the sensor; weak ones do so less often.

    Args:
        reach: Distances at which they met something, shape (N,), metres.
        chance: Random numbers from 0 to 1, shape (N,).
        air: Effect of the weather.
    """
    limited_reach = np.minimum(reach, RANGE)
    weakness = np.maximum(1 - _compute_intensity(limited_reach, air) / _SAFE_INTENSITY, 0)
    loss = _MAX_LOSS * weakness + air.lost * (limited_reach / RANGE) ** 2
    is_in_range = reach <= RANGE
    return np.asarray(is_in_range & (chance >= loss))
