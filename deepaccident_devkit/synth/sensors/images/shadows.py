"""Shadows on the ground."""

import numpy as np

from deepaccident_devkit.arrays import ByteArray, FloatArray, IntArray
from deepaccident_devkit.synth.roads import MAP_CELLS, MAP_EXTENT, MAP_RESOLUTION, Terrain


def with_shadows(picture: ByteArray, corners: FloatArray, to_sun: FloatArray, brightness: float) -> ByteArray:
    """A new picture of the ground with the shadows of some solids.

    Args:
        picture: (3000, 3000, 3) uint8, cells as in `roads.GroundMap`.
        corners: (P, 8, 3) of convex solids, metres, ground frame, z above the ground below them.
        to_sun: (3,) direction of the sun.
        brightness: of the ground in the shadow, as a share of what it is in the light.
    """
    import cv2

    shadowed = picture.copy()
    dimmed = (np.arange(256) * brightness).astype(np.uint8)
    for outline in _outlines(corners, to_sun):
        low, high = np.maximum(outline.min(axis=0), 0), np.minimum(outline.max(axis=0) + 1, MAP_CELLS)
        if (low >= high).any():
            continue
        mask = np.zeros(high[::-1] - low[::-1], dtype=np.uint8)
        cv2.fillConvexPoly(mask, cv2.convexHull((outline - low).astype(np.int32)), 1)
        rows, columns = np.nonzero(mask)
        # dimmed from the picture given, so that where two shadows overlap it is no darker
        shadowed[rows + low[1], columns + low[0]] = dimmed[picture[rows + low[1], columns + low[0]]]
    return shadowed


def above_ground(corners: FloatArray, terrain: Terrain) -> FloatArray:
    """Corners (P, 8, 3) with z counted from the ground below each solid's middle."""
    if terrain.is_flat:
        return corners
    lowered = corners.copy()
    lowered[..., 2] -= terrain.height(corners[..., :2].mean(axis=1))[:, None]
    return lowered


def _outlines(corners: FloatArray, to_sun: FloatArray) -> IntArray:
    """Map cells (column, row) that the corners' shadows fall on, (P, 8, 2)."""
    fallen: FloatArray = corners[..., :2] - np.maximum(corners[..., 2:], 0.0) * (to_sun[:2] / to_sun[2])
    cells: IntArray = np.floor((fallen + MAP_EXTENT) / MAP_RESOLUTION).astype(np.int64)
    return cells
