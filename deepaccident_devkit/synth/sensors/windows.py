"""Where in a picture road users can be: rectangles around their boxes."""

from itertools import combinations

import numpy as np

from deepaccident_devkit.arrays import BoolArray, Float32Array, FloatArray
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.geometry.boxes import CORNER_SIGNS
from deepaccident_devkit.synth.sensors.agents import Camera
from deepaccident_devkit.synth.sensors.scene import Scene

CLOSE = 0.05
"""Metres ahead of the camera from which on corners are projected."""
_EDGES = np.array([(a, b) for a, b in combinations(range(8), 2) if (CORNER_SIGNS[a] == CORNER_SIGNS[b]).sum() == 2])
"""Pairs of corners between which the edges of a box run."""
_SPARE = 1.0
"""Pixels around a rectangle."""


def rectangles(corners: FloatArray, slope: FloatArray, size: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Least and greatest column and row, (A, 2) each, not rounded, of boxes (A, 8, 3) in the optical frame.

    Of who is partly behind the camera, what is ahead of it counts; of who is behind it altogether they are equal.

    Args:
        corners: metres; x right, y down, z ahead.
        slope: (2,) or (A, 2), of one pixel, across and down.
        size: of the picture, width and height, pixels.
    """
    low, high = _spans(corners[..., :2] / np.maximum(corners[..., 2:], CLOSE), corners[..., 2] >= CLOSE)
    partly = np.flatnonzero((corners[..., 2].min(axis=1) < CLOSE) & (corners[..., 2].max(axis=1) > CLOSE))
    if len(partly):
        cut, crosses = _cut_edges(corners[partly])
        ahead = np.concatenate([corners[partly], cut], axis=1)
        shown = np.concatenate([corners[partly, :, 2] >= CLOSE, crosses], axis=1)
        low[partly], high[partly] = _spans(ahead[..., :2] / np.maximum(ahead[..., 2:], CLOSE), shown)
    middle = np.array(size) / 2
    return low / slope + middle, high / slope + middle


def _spans(places: FloatArray, counted: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Least and greatest of the points (A, K, 2) that are counted (A, K); 0 where none is."""
    low = np.where(counted[..., None], places, np.inf).min(axis=1)
    high = np.where(counted[..., None], places, -np.inf).max(axis=1)
    none = ~counted.any(axis=1)
    low[none], high[none] = 0, 0
    return low, high


def _cut_edges(corners: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Where the twelve edges of boxes (A, 8, 3) come `CLOSE` to the camera, (A, 12, 3), and which of them do."""
    one, other = corners[:, _EDGES[:, 0]], corners[:, _EDGES[:, 1]]
    crosses = (one[..., 2] < CLOSE) != (other[..., 2] < CLOSE)
    way = np.where(crosses, other[..., 2] - one[..., 2], 1.0)
    share = (CLOSE - one[..., 2]) / way
    cut = one + share[..., None] * (other - one)
    cut[..., 2] = CLOSE
    return cut, crosses


def nearest_movers(scene: Scene, camera: Camera, ground_from_camera: SE3) -> Float32Array:
    """How near, metres ahead, pixels may show someone who moves; infinite where nobody is.

    Returns:
        (H + 2, W + 2): two pixels more down and right than the picture has.
    """
    corners = scene.box_corners[scene.setting.moving]
    optics = camera.optics
    slope = np.full(2, 1 / optics.intrinsic[0, 0])
    local = (corners - ground_from_camera.translation) @ ground_from_camera.rotation
    low, high = rectangles(local, slope, (optics.width, optics.height))
    nearest = np.full((optics.height + 2, optics.width + 2), np.inf, dtype=np.float32)
    ends = (optics.width + 2, optics.height + 2)
    first = np.floor(low - _SPARE).clip(0, ends).astype(int).tolist()
    last = np.ceil(high + _SPARE + 2).clip(0, ends).astype(int).tolist()
    ahead = (local[:, :, 2].min(axis=1) - CLOSE).astype(np.float32)
    for row in np.flatnonzero((high > low).all(axis=1)).tolist():
        window = nearest[first[row][1] : last[row][1], first[row][0] : last[row][0]]
        np.minimum(window, ahead[row], out=window)
    return nearest
