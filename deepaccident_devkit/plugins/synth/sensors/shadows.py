"""Shadows on the ground and on façades, and the ground as pictures of lower and lower resolution."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.plugins.synth import roads
from deepaccident_devkit.plugins.synth.roads import (
    MAP_CELLS,
    MAP_EXTENT,
    MAP_RESOLUTION,
    GroundMap,
    Terrain,
)
from deepaccident_devkit.plugins.synth.sensors.caster import NOTHING
from deepaccident_devkit.plugins.synth.sensors.light import Light
from deepaccident_devkit.plugins.synth.sensors.paint import Colors, Facades, OnFacades
from deepaccident_devkit.plugins.synth.sensors.scene import Scene, Setting, moved
from deepaccident_devkit.support.arrays import ByteArray, Float32Array, FloatArray, IntArray


def add_shadows(
    picture: ByteArray, corners: FloatArray, to_sun: FloatArray, brightness: float
) -> IntArray:
    """Paint the shadows of solids into a picture of the ground, (3000, 3000, 3) cells of `roads.GroundMap`, in place.

    Corners are (P, 8, 3), metres, ground frame, z above the ground below them; `brightness` is the share of that in the
    sun. Returns the cells in the shadow (K,), as rows of 3000 · 3000; those in two shadows are there twice.
    """
    cells = _shadowed(_outlines(corners, to_sun))
    dimmed, flat = (np.arange(256) * brightness).astype(np.uint8), picture.reshape(-1, 3)
    # all cells are read before one is written, so that two shadows together are not darker than one
    flat[cells] = dimmed[flat.take(cells, axis=0)]
    return cells


def _shadowed(outlines: IntArray) -> IntArray:
    """The cells (K,) inside convex outlines (P, 8, 2), column and row of each corner; one outline after the other."""
    import cv2

    cells = [np.zeros(0, dtype=np.int64)]
    lows, highs = (
        np.maximum(outlines.min(axis=1), 0),
        np.minimum(outlines.max(axis=1) + 1, MAP_CELLS),
    )
    for solid in np.flatnonzero((lows < highs).all(axis=1)).tolist():
        low, high = lows[solid], highs[solid]
        mask = np.zeros(high[::-1] - low[::-1], dtype=np.uint8)
        cv2.fillConvexPoly(mask, cv2.convexHull((outlines[solid] - low).astype(np.int32)), 1)
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
    fallen: FloatArray = corners[..., :2] - np.maximum(corners[..., 2:], 0.0) * (
        to_sun[:2] / to_sun[2]
    )
    return np.asarray(np.floor((fallen + MAP_EXTENT) / MAP_RESOLUTION).astype(np.int64))


# Distance on a façade between two rays to the sun, metres.
_CELL = 0.4
# Distance from the wall to where these rays begin, metres.
_OFF = 0.05
# Points to look up in one call: OpenCV accepts no wider picture.
_AT_ONCE = 32000
# Least cosine of the angle from a façade's normal to the sun; for façades with a smaller one no rays are cast.
_GRAZING = 0.02


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
    return WallShadows(
        np.concatenate([np.full((len(lit), 1), 255, dtype=np.uint8), lit], axis=1), column, density
    )


def _sun_on(setting: Setting, light: Light, faces: IntArray, counts: IntArray) -> ByteArray:
    """Which cells of façades the sun reaches, (R, sum of `counts`, and two more for each façade) uint8, 0 or 255."""
    quads, normals = setting.still.quads[faces], setting.still.planes[0][faces]
    along, foot, top = (
        quads[..., :2].sum(axis=2),
        quads[..., 2].min(axis=1),
        quads[..., 2].max(axis=1),
    )
    every = np.arange(len(faces))
    first, last = quads[every, along.argmin(axis=1)], quads[every, along.argmax(axis=1)]
    strips = counts + 2
    which = np.repeat(every, strips)
    cell = (np.arange(len(which)) - np.repeat(strips.cumsum() - strips, strips) - 1).clip(
        0, counts[which] - 1
    )
    share = (cell + 0.5) / counts[which]
    places = first[which] + (last - first)[which] * share[:, None] + normals[which] * _OFF
    rows = int(np.ceil((top - foot).max() / _CELL))
    points = np.broadcast_to(places, (rows, *places.shape)).copy()
    points[..., 2] = foot[which] + (np.arange(rows)[:, None] + 0.5) * _CELL
    rays = np.broadcast_to(light.to_sun.astype(np.float32), (points.size // 3, 3))
    _, met = setting.caster.cast(points.reshape(-1, 3), rays)
    return np.where(met == NOTHING, np.uint8(255), np.uint8(0)).reshape(rows, -1)


def shadows_on(
    painted: NDArray[np.uint32], places: OnFacades, shadows: WallShadows, colors: Colors
) -> None:
    """Darken façades of a picture (R, C), as `Colors` has them, where the sun does not reach them, in place."""
    import cv2

    if shadows.lit.size == 1:
        return
    first = shadows.column.take(places.face)
    sunny = np.flatnonzero(first > 0)
    face, pixel = places.face.take(sunny), places.pixel.take(sunny)
    column = places.across.take(sunny) * shadows.density.take(face) + first.take(sunny)
    row = places.up.take(sunny) * np.float32(1 / _CELL) - np.float32(0.5)
    seen = np.empty(len(row), dtype=np.uint8)
    for start in range(0, len(row), _AT_ONCE):
        block = slice(start, start + _AT_ONCE)
        found = cv2.remap(
            shadows.lit,
            column[None, block],
            row[None, block],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        seen[block] = np.asarray(found)[0]
    flat = painted.reshape(-1)
    dark, edge = np.flatnonzero(seen == 0), np.flatnonzero((seen > 0) & (seen < 255))
    flat[pixel.take(dark)] = colors.shaded.take(face.take(dark))
    weight, shaded = seen[edge, None] / np.float32(255), colors.shaded[face[edge]]
    lit = flat[pixel[edge]]
    mixed = lit.view(np.uint8).reshape(-1, 4) * weight + shaded.view(np.uint8).reshape(-1, 4) * (
        1 - weight
    )
    flat[pixel[edge]] = mixed.astype(np.uint8).view(np.uint32)[:, 0]


_COLORS = {
    roads.TERRAIN: (126, 134, 100),
    roads.ROAD: (92, 93, 96),
    roads.WHITE: (226, 226, 222),
    roads.YELLOW: (222, 184, 72),
    roads.SIDEWALK: (168, 164, 156),
    roads.GRASS: (112, 132, 84),
}
# Standard deviation of the ground's brightness from cell to cell.
_GRAIN = 5.0
# Standard deviation of the ground's brightness over some metres.
_PATCHES = 5.0
_TILE = 500
# How many pictures there are, and how much coarser each is than the one before.
LEVELS, SHRINK = 3, 4
# Shadows of the sky's light below and around a vehicle: metres beyond its box, and the remaining brightness.
_CLOSE_BY = ((0.35, 0.8), (0.1, 0.65))


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Pictures of the whole map, fine to coarse, (3000, 3000, 3), (750, 750, 3), … uint8, cells as in `GroundMap`."""

    levels: tuple[ByteArray, ...]

    def at(self, x: Float32Array, y: Float32Array, level: int) -> ByteArray:
        """Colours (R, C, 3) at points `x` and `y`, (R, C) metres; beyond the map, the colour of its corner."""
        import cv2

        picture = self.levels[level]
        scale = np.float32(len(picture) / (2 * MAP_EXTENT))
        shift = np.float32(MAP_EXTENT) * scale - np.float32(0.5)
        found = cv2.remap(
            picture,
            x * scale + shift,
            y * scale + shift,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=picture[0, 0].astype(float).tolist(),
        )
        return np.asarray(found)


def still_ground(setting: Setting, light: Light, rng: np.random.Generator) -> Ground:
    """The ground with the shadows of all that stands still; `rng` draws its grain."""
    lit = light.sky + light.sun * light.to_sun[2]
    plain = _picture(setting.world.ground, lit, light.wet_ground, rng)
    add_shadows(
        plain, above_ground(setting.still.corners, setting.terrain), light.to_sun, light.in_shadow
    )
    return _with_coarser(plain, _coarser(plain, len(plain) // SHRINK))


class PassingGround:
    """The ground at one moment after another: with the shadows of moving road users, and dark edges around vehicles.

    To copy the ground that stands `still` would take longer than to put back what the last moment changed.
    """

    def __init__(self, still: Ground) -> None:
        self._still, self._now = still.levels[:2], [level.copy() for level in still.levels[:2]]
        self._changed = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)

    def at(self, scene: Scene, light: Light) -> Ground:
        """The ground at a moment; it is correct until the next call."""
        for now, still, changed in zip(self._now, self._still, self._changed, strict=True):
            now.reshape(-1, 3)[changed] = still.reshape(-1, 3).take(changed, axis=0)
        finest, coarser = self._now
        corners = above_ground(
            scene.movers.corners[scene.movers.solids.main], scene.setting.terrain
        )
        cells = [add_shadows(finest, corners, light.to_sun, light.in_shadow)]
        upwards = np.array([0.0, 0.0, 1.0])
        for beyond, brightness in _CLOSE_BY:
            cells.append(add_shadows(finest, _slabs(scene, beyond), upwards, brightness))
        fine = np.concatenate(cells)
        self._changed = fine, _follow(coarser, finest, fine)
        return _with_coarser(finest, coarser)


def _with_coarser(*levels: ByteArray) -> Ground:
    """The ground with these pictures, fine to coarse, and with coarser ones of the last of them."""
    while len(levels) < LEVELS:
        levels = (*levels, _coarser(levels[-1], len(levels[-1]) // SHRINK))
    return Ground(levels)


def _coarser(picture: ByteArray, width: int) -> ByteArray:
    """A picture (R, C, 3) with `width` columns and as many times fewer rows, each cell the mean of those it covers."""
    import cv2

    size = width, len(picture) * width // picture.shape[1]
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _follow(coarser: ByteArray, finest: ByteArray, cells: IntArray) -> IntArray:
    """Make the second picture agree with the finest one, in place, where cells of that (K,) have changed.

    To make all of it again would take most of a moment's time if the images are small. Returns its own cells (L,) that
    may have changed.
    """
    row, column = np.divmod(cells, MAP_CELLS)
    changed = np.zeros(coarser.shape[:2], dtype=bool)
    changed[row // SHRINK, column // SHRINK] = True
    own = np.flatnonzero(changed)
    rows, columns = np.divmod(own, coarser.shape[1])
    squares = finest.reshape(len(coarser), SHRINK, -1, SHRINK, 3)[rows, :, columns]
    if len(squares):
        side_by_side = squares.transpose(1, 0, 2, 3).reshape(SHRINK, -1, 3)
        coarser[rows, columns] = _coarser(side_by_side, len(squares))[0]
    return own


def _slabs(scene: Scene, beyond: float) -> FloatArray:
    """Flat bodies (A, 8, 3) that reach some metres beyond the road users' boxes."""
    half = scene.actors.size / 2 + (beyond, beyond, 0.0)
    signs = np.array([[1, 1], [1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1], [-1, -1], [-1, 1]])
    corners = np.zeros((len(half), 8, 3))
    corners[:, :, :2] = half[:, None, :2] * signs
    placed = moved(corners, scene.frames)
    placed[:, :, 2] = 0.0
    return placed


def _picture(ground: GroundMap, lit: FloatArray, wet: float, rng: np.random.Generator) -> ByteArray:
    """The map in colour, (3000, 3000, 3): grain and patches from a tile, repeated."""
    import cv2

    palette = np.zeros((256, 3))
    for code, color in _COLORS.items():
        palette[code] = np.array(color) * lit * wet
    patches = cv2.resize(
        rng.normal(0, _PATCHES, (25, 25)), (_TILE, _TILE), interpolation=cv2.INTER_CUBIC
    )
    grain = (
        (rng.normal(0, _GRAIN, (_TILE, _TILE)) + np.asarray(patches))
        .round()
        .clip(-32, 32)
        .astype(np.int16)
    )
    scale = float(lit.mean()) * wet
    shades = (
        (palette[:, None, :] + scale * np.arange(-32, 33)[None, :, None])
        .clip(0, 255)
        .astype(np.uint8)
    )
    repeated, picture = (
        np.tile(grain + 32, MAP_CELLS // _TILE),
        np.empty((MAP_CELLS, MAP_CELLS, 3), dtype=np.uint8),
    )
    for top in range(0, MAP_CELLS, _TILE):
        place = ground.codes[top : top + _TILE].astype(np.intp) * shades.shape[1] + repeated
        picture[top : top + _TILE] = shades.reshape(-1, 3).take(place, axis=0)
    return picture
