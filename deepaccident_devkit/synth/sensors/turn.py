"""A turn of the LiDAR: the rays of its 32 channels, and which of them may pass through road users' boxes."""

from functools import cache

import numpy as np

from deepaccident_devkit.arrays import BoolArray, Float32Array, FloatArray, IntArray, readonly
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.synth.sensors.scene import Scene
from deepaccident_devkit.synth.shapes import BOX_CLEARANCE

CHANNELS = 32
ELEVATION = (-30.0, 10.0)
"""Degrees of the lowest and the highest channel."""
AZIMUTHS = 1400
"""The release's LiDAR sends out 2,750 rays a turn and channel, of which it drops 48 % by chance."""
RANGE = 70.0
_SPARE = 0.06
"""Metres around a box that count as in it: more than anybody goes between the cloud and the count."""
_CLOSER = 0.98
"""By this a box is taken to be nearer than it is: on a slope it leans."""


@cache
def ray_directions() -> FloatArray:
    """Unit vectors of all rays in the LiDAR frame, (32 · 1400, 3), channel after channel from the top."""
    elevation = np.deg2rad(np.linspace(ELEVATION[1], ELEVATION[0], CHANNELS))[:, None]
    azimuth = np.linspace(np.pi, -np.pi, AZIMUTHS, endpoint=False)[None, :]
    directions = [
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.broadcast_to(np.sin(elevation), (CHANNELS, AZIMUTHS)),
    ]
    return readonly(np.stack(directions, axis=-1).reshape(-1, 3))


def turned_rays(rotation: FloatArray, rows: IntArray | slice = slice(None)) -> Float32Array:
    """Directions (K, 3) of some rays, or of all, turned by a rotation (3, 3); each is the same whatever others are."""
    x, y, z = _direction_columns()[:, rows]
    turn = rotation.astype(np.float32)
    turned = np.empty((len(x), 3), dtype=np.float32)
    for axis in range(3):
        turned[:, axis] = x * turn[axis, 0] + y * turn[axis, 1] + z * turn[axis, 2]
    return turned


def rays_to_boxes(scene: Scene, ground_from_lidar: SE3, *groups: IntArray) -> BoolArray:
    """Which rays may pass through the box of an actor of each group of rows, (G, 32 · 1400): those in windows there."""
    rows = np.concatenate(groups)
    frames, half = scene.frames[rows], scene.actors.size[rows, :2] / 2
    corners = ground_from_lidar.inverse().apply(scene.box_corners[rows].reshape(-1, 3)).reshape(-1, 8, 3)
    place = np.einsum("nk,nkl->nl", ground_from_lidar.translation - frames[:, :3, 3], frames[:, :3, :3])
    gap = np.maximum(np.abs(place[:, :2]) - half - _SPARE, 0.0)
    reach = np.hypot(corners[..., 0], corners[..., 1])
    nearest = np.hypot(gap[:, 0], gap[:, 1]) * _CLOSER
    first, last = _channels(corners[..., 2].min(axis=1), corners[..., 2].max(axis=1), nearest, reach.max(axis=1))
    start, count = _azimuths(corners, around=nearest == 0)
    met = np.zeros((len(groups), CHANNELS, 2 * AZIMUTHS), dtype=bool)  # a turn more, for windows over the seam
    group = np.repeat(np.arange(len(groups)), [len(each) for each in groups])
    for row in np.flatnonzero(nearest < RANGE).tolist():
        met[group[row], first[row] : last[row], start[row] : start[row] + count[row]] = True
    return np.asarray((met[..., :AZIMUTHS] | met[..., AZIMUTHS:]).reshape(len(groups), -1))


def rays_through(size: tuple[float, float, float], place: FloatArray) -> IntArray:
    """Rows of the rays that pass through a box of some size, metres, which is turned as the LiDAR is.

    `place` (3,) is the LiDAR's in the frame of the box's middle on the road, metres.
    """
    middle = np.array([0.0, 0.0, BOX_CLEARANCE + size[2] / 2]) - place
    half = np.array(size) / 2 + _SPARE
    with np.errstate(divide="ignore"):
        one, other = ((middle + side * half) / ray_directions() for side in (-1, 1))
    enters, leaves = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
    return np.flatnonzero((leaves > 0) & (enters <= leaves))


def _channels(
    low: FloatArray, high: FloatArray, nearest: FloatArray, farthest: FloatArray
) -> tuple[IntArray, IntArray]:
    """First channel, and the one after the last, whose rays pass between heights (N,) over some distances (N,)."""
    bottom, top, close = low - _SPARE, high + _SPARE, np.maximum(nearest, 1e-3)
    lowest = np.arctan2(bottom, np.where(bottom < 0, close, farthest))
    highest = np.arctan2(top, np.where(top > 0, close, farthest))
    upper = np.deg2rad(ELEVATION[1])
    step = (upper - np.deg2rad(ELEVATION[0])) / (CHANNELS - 1)
    first = np.floor((upper - highest) / step).clip(0, CHANNELS).astype(np.int64)
    return first, np.ceil((upper - lowest) / step + 1).clip(0, CHANNELS).astype(np.int64)


def _azimuths(corners: FloatArray, *, around: BoolArray) -> tuple[IntArray, IntArray]:
    """First azimuth, and how many, of the rays that meet boxes (N, 8, 3) from above; all where a box is `around`."""
    middle = np.arctan2(*corners[..., :2].mean(axis=1).T[::-1])
    aside = np.abs((np.arctan2(corners[..., 1], corners[..., 0]) - middle[:, None] + np.pi) % (2 * np.pi) - np.pi)
    half_turn = np.where(around, np.pi, aside.max(axis=1))
    column = (np.pi - middle) / (2 * np.pi) * AZIMUTHS
    wide = half_turn / (2 * np.pi) * AZIMUTHS + 1
    start = np.floor(column - wide).astype(np.int64)
    return start % AZIMUTHS, np.minimum(np.ceil(column + wide).astype(np.int64) + 1 - start, AZIMUTHS)


@cache
def _direction_columns() -> Float32Array:
    """As `ray_directions`, (3, 32 · 1400)."""
    return readonly(np.ascontiguousarray(ray_directions().T.astype(np.float32)))
