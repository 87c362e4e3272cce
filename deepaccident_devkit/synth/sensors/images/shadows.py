"""Shadows on the ground, and on façades at the side of the sun."""

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import ByteArray, Float32Array, FloatArray, IntArray
from deepaccident_devkit.synth.roads import MAP_CELLS, MAP_EXTENT, MAP_RESOLUTION, Terrain
from deepaccident_devkit.synth.sensors.caster import NOTHING
from deepaccident_devkit.synth.sensors.images.facades import Facades, OnFacades
from deepaccident_devkit.synth.sensors.images.light import Light
from deepaccident_devkit.synth.sensors.images.paint import Colors
from deepaccident_devkit.synth.sensors.setting import Setting


def add_shadows(picture: ByteArray, corners: FloatArray, to_sun: FloatArray, brightness: float) -> IntArray:
    """Paint the shadows of solids into a picture of the ground, in place.

    Args:
        picture: (3000, 3000, 3) uint8, cells as in `roads.GroundMap`.
        corners: (P, 8, 3) corners of convex solids, metres, ground frame, z above the ground below them.
        to_sun: (3,) direction to the sun.
        brightness: brightness of the ground in the shadow, as a share of that in the sun.

    Returns:
        the cells in the shadow (K,), as rows of 3000 · 3000; those in two shadows are there twice.
    """
    cells = _shadowed(_outlines(corners, to_sun))
    dimmed, flat = (np.arange(256) * brightness).astype(np.uint8), picture.reshape(-1, 3)
    # all cells are read before one is written, so that two shadows together are not darker than one
    flat[cells] = dimmed[flat[cells]]
    return cells


def _shadowed(outlines: IntArray) -> IntArray:
    """The cells (K,) inside convex outlines (P, 8, 2), column and row of each corner; one outline after the other."""
    import cv2

    cells = [np.zeros(0, dtype=np.int64)]
    for outline in outlines:
        low, high = np.maximum(outline.min(axis=0), 0), np.minimum(outline.max(axis=0) + 1, MAP_CELLS)
        if (low >= high).any():
            continue
        mask = np.zeros(high[::-1] - low[::-1], dtype=np.uint8)
        cv2.fillConvexPoly(mask, cv2.convexHull((outline - low).astype(np.int32)), 1)
        rows, columns = np.nonzero(mask)
        cells.append((rows + low[1]) * MAP_CELLS + columns + low[0])
    return np.concatenate(cells)


def above_ground(corners: FloatArray, terrain: Terrain) -> FloatArray:
    """Corners (P, 8, 3) with z above the ground below each solid's middle."""
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


_CELL = 0.4
"""Distance on a façade between two rays to the sun, metres."""
_OFF = 0.05
"""Distance from the wall to where these rays begin, metres."""
_AT_ONCE = 32000
"""Points to look up in one call: OpenCV accepts no wider picture."""
_GRAZING = 0.02
"""Least cosine of the angle from a façade's normal to the sun; for façades with a smaller one no rays are cast."""


@dataclass(frozen=True, slots=True, eq=False)
class WallShadows:
    """How much sun reaches the façades.

    Attributes:
        lit: (R, C) uint8, 0 in the shadow to 255 in the sun; first one column in the sun, then the columns of each
            façade, with one more column at each end; rows upwards.
        column: (F,) float32, the column where each face begins; 0 for faces without columns.
        density: (F,) float32, columns a metre.
    """

    lit: ByteArray
    column: Float32Array
    density: Float32Array


def wall_shadows(setting: Setting, facades: Facades, light: Light) -> WallShadows:
    """The shadows on the façades of what stands still."""
    normals, _ = setting.still.planes
    sunny = np.flatnonzero((facades.length > 0) & (normals @ light.to_sun > _GRAZING))
    column, density = np.zeros((2, len(normals)), dtype=np.float32)
    if not len(sunny):
        return WallShadows(np.full((1, 1), 255, dtype=np.uint8), column, density)
    counts = np.ceil(facades.length[sunny] / _CELL).astype(np.int64)
    density[sunny] = counts / facades.length[sunny]
    first = 1 + (counts + 2).cumsum() - (counts + 2)
    column[sunny] = first + 0.5
    lit = _sun_on(setting, light, sunny, counts)
    return WallShadows(np.concatenate([np.full((len(lit), 1), 255, dtype=np.uint8), lit], axis=1), column, density)


def _sun_on(setting: Setting, light: Light, faces: IntArray, counts: IntArray) -> ByteArray:
    """Which cells of façades the sun reaches, (R, sum of `counts`, and two more for each façade) uint8, 0 or 255."""
    quads, normals = setting.still.quads[faces], setting.still.planes[0][faces]
    along, foot, top = quads[..., :2].sum(axis=2), quads[..., 2].min(axis=1), quads[..., 2].max(axis=1)
    every = np.arange(len(faces))
    first, last = quads[every, along.argmin(axis=1)], quads[every, along.argmax(axis=1)]
    strips = counts + 2
    which = np.repeat(every, strips)
    cell = (np.arange(len(which)) - np.repeat(strips.cumsum() - strips, strips) - 1).clip(0, counts[which] - 1)
    share = (cell + 0.5) / counts[which]
    places = first[which] + (last - first)[which] * share[:, None] + normals[which] * _OFF
    rows = int(np.ceil((top - foot).max() / _CELL))
    points = np.broadcast_to(places, (rows, *places.shape)).copy()
    points[..., 2] = foot[which] + (np.arange(rows)[:, None] + 0.5) * _CELL
    rays = np.broadcast_to(light.to_sun.astype(np.float32), (points.size // 3, 3))
    _, met = setting.caster.cast(points.reshape(-1, 3), rays)
    return np.where(met == NOTHING, np.uint8(255), np.uint8(0)).reshape(rows, -1)


def shadows_on(picture: ByteArray, places: OnFacades, shadows: WallShadows, colors: Colors) -> None:
    """Darken the façades that pixels show where the sun does not reach them, in place.

    Args:
        picture: (R, C, 3).
        places: the pixels that show façades.
        shadows: the shadows on façades.
        colors: the colours of the faces.
    """
    import cv2

    if shadows.lit.size == 1:
        return
    column = places.across * shadows.density[places.face] + shadows.column[places.face]
    row = places.up * np.float32(1 / _CELL) - np.float32(0.5)
    seen = np.empty(len(row), dtype=np.uint8)
    for start in range(0, len(row), _AT_ONCE):
        block = slice(start, start + _AT_ONCE)
        found = cv2.remap(
            shadows.lit, column[None, block], row[None, block], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        seen[block] = np.asarray(found)[0]
    flat = picture.reshape(-1, 3)
    dark, edge = np.flatnonzero(seen == 0), np.flatnonzero((seen > 0) & (seen < 255))
    flat[places.pixel[dark]] = colors.shaded[places.face[dark]]
    weight = seen[edge, None] / np.float32(255)
    mixed = flat[places.pixel[edge]] * weight + colors.shaded[places.face[edge]] * (1 - weight)
    flat[places.pixel[edge]] = mixed.astype(np.uint8)
