"""Shadows on the ground and on façades, and the ground as pictures of several resolutions."""

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
from deepaccident_devkit.plugins.synth.sensors.caster import NO_HIT
from deepaccident_devkit.plugins.synth.sensors.light import Light
from deepaccident_devkit.plugins.synth.sensors.paint import Colors, Facades, OnFacades
from deepaccident_devkit.plugins.synth.sensors.scene import Scene, Setting, moved
from deepaccident_devkit.support.arrays import ByteArray, Float32Array, FloatArray, IntArray

# Distance on a façade between two rays to the sun.
_CELL_SIZE_M = 0.4
# Distance from the wall to where these rays begin.
_WALL_CLEARANCE_M = 0.05
# Points to look up in one call: OpenCV accepts no wider picture.
_MAX_LOOKUP_POINTS = 32000
# Smallest cosine of the angle from a façade's normal to the sun; no rays are cast for façades with
# a smaller one.
_MIN_SUN_COSINE = 0.02
_COLOR_BY_CODE = {
    roads.TERRAIN: (126, 134, 100),
    roads.ROAD: (92, 93, 96),
    roads.WHITE: (226, 226, 222),
    roads.YELLOW: (222, 184, 72),
    roads.SIDEWALK: (168, 164, 156),
    roads.GRASS: (112, 132, 84),
}
# Standard deviation of the ground's brightness from cell to cell.
_GRAIN_STD = 5.0
# Standard deviation of the ground's brightness over some metres.
_PATCH_STD = 5.0
_TILE_CELLS = 500
_MAX_GRAIN = 32
LEVELS, SHRINK = 3, 4
"""Number of pictures, and how much coarser each is than the one before."""
# Shadows of the sky's light around a vehicle: metres beyond its box, and the remaining brightness.
_CONTACT_SHADOWS = ((0.35, 0.8), (0.1, 0.65))


def add_shadows(
    picture: ByteArray, corners: FloatArray, to_sun: FloatArray, brightness: float
) -> IntArray:
    """Paint the shadows of solids into a picture of the ground, in place.

    Args:
        picture: Cells of `roads.GroundMap`, shape (3000, 3000, 3).
        corners: Corners of the solids, shape (P, 8, 3), metres, ground frame, z above the ground
            below them.
        to_sun: Unit vector to the sun, shape (3,).
        brightness: Brightness in the shadow as a share of the brightness in the sun.

    Returns:
        Cells in the shadow, shape (K,), as rows of 3000 · 3000; cells in two shadows are there
        twice.
    """
    cells = _shadowed(_outlines(corners, to_sun))
    dimmed = (np.arange(256) * brightness).astype(np.uint8)
    flat = picture.reshape(-1, 3)
    # All cells are read before one is written, so that two shadows together are no darker than one.
    flat[cells] = dimmed[flat.take(cells, axis=0)]
    return cells


def _shadowed(outlines: IntArray) -> IntArray:
    """Return the cells (K,) in convex outlines, one outline after the other.

    Args:
        outlines: Column and row of each corner, shape (P, 8, 2).
    """
    import cv2

    cells = [np.zeros(0, dtype=np.int64)]
    lows = np.maximum(outlines.min(axis=1), 0)
    highs = np.minimum(outlines.max(axis=1) + 1, MAP_CELLS)
    for solid in np.flatnonzero((lows < highs).all(axis=1)).tolist():
        low = lows[solid]
        high = highs[solid]
        mask = np.zeros(high[::-1] - low[::-1], dtype=np.uint8)
        hull = cv2.convexHull((outlines[solid] - low).astype(np.int32))
        cv2.fillConvexPoly(mask, hull, 1)
        rows, columns = np.nonzero(mask)
        cells.append((rows + low[1]) * MAP_CELLS + columns + low[0])
    return np.concatenate(cells)


def above_ground(corners: FloatArray, terrain: Terrain) -> FloatArray:
    """Return corners (P, 8, 3) with z above the ground below each solid's middle."""
    if terrain.is_flat:
        return corners
    lowered = corners.copy()
    ground_height = terrain.height(corners[..., :2].mean(axis=1))
    lowered[..., 2] -= ground_height[:, None]
    return lowered


def _outlines(corners: FloatArray, to_sun: FloatArray) -> IntArray:
    """Return the map cells (column, row) that the corners' shadows fall on, shape (P, 8, 2)."""
    height = np.maximum(corners[..., 2:], 0.0)
    shadows: FloatArray = corners[..., :2] - height * (to_sun[:2] / to_sun[2])
    return np.asarray(np.floor((shadows + MAP_EXTENT) / MAP_RESOLUTION).astype(np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class WallShadows:
    """The sunlight on the façades.

    Attributes:
        lit: Sunlight, shape (R, C), uint8, 0 in the shadow to 255 in the sun; first one column in
            the sun, then the columns of each façade, with one more column at each end; rows
            upwards.
        column: Column where each face begins, shape (F,), float32; 0 for faces without columns.
        density: Columns a metre, shape (F,), float32.
    """

    lit: ByteArray
    column: Float32Array
    density: Float32Array


def wall_shadows(setting: Setting, facades: Facades, light: Light) -> WallShadows:
    """Compute the shadows on the façades of the static world."""
    normals, _ = setting.static.planes
    sunny = np.flatnonzero((facades.length > 0) & (normals @ light.to_sun > _MIN_SUN_COSINE))
    column, density = np.zeros((2, len(normals)), dtype=np.float32)
    if not len(sunny):
        return WallShadows(np.full((1, 1), 255, dtype=np.uint8), column, density)
    counts = np.ceil(facades.length[sunny] / _CELL_SIZE_M).astype(np.int64)
    density[sunny] = counts / facades.length[sunny]
    first_columns = 1 + (counts + 2).cumsum() - (counts + 2)
    column[sunny] = first_columns + 0.5
    lit = _sun_on(setting, light, sunny, counts)
    sunny_column = np.full((len(lit), 1), 255, dtype=np.uint8)
    return WallShadows(np.concatenate([sunny_column, lit], axis=1), column, density)


def _sun_on(setting: Setting, light: Light, faces: IntArray, counts: IntArray) -> ByteArray:
    """Compute which cells of façades the sun reaches.

    Args:
        setting: The static world.
        light: The light.
        faces: Faces of the façades.
        counts: Number of columns of each façade.

    Returns:
        Sunlight (R, sum of `counts`, and two more for each façade), uint8, 0 or 255.
    """
    normals, _ = setting.static.planes
    quads = setting.static.quads[faces]
    normals = normals[faces]
    along = quads[..., :2].sum(axis=2)
    height = quads[..., 2]
    foot = height.min(axis=1)
    top = height.max(axis=1)
    face_rows = np.arange(len(faces))
    starts = quads[face_rows, along.argmin(axis=1)]
    ends = quads[face_rows, along.argmax(axis=1)]
    num_columns = counts + 2
    face_of_column = np.repeat(face_rows, num_columns)
    first_columns = np.repeat(num_columns.cumsum() - num_columns, num_columns)
    cell = np.arange(len(face_of_column)) - first_columns - 1
    cell = cell.clip(0, counts[face_of_column] - 1)
    share = (cell + 0.5) / counts[face_of_column]
    columns = starts[face_of_column] + (ends - starts)[face_of_column] * share[:, None]
    columns = columns + normals[face_of_column] * _WALL_CLEARANCE_M
    num_rows = int(np.ceil((top - foot).max() / _CELL_SIZE_M))
    points = np.broadcast_to(columns, (num_rows, *columns.shape)).copy()
    row_heights = (np.arange(num_rows)[:, None] + 0.5) * _CELL_SIZE_M
    points[..., 2] = foot[face_of_column] + row_heights
    rays = np.broadcast_to(light.to_sun.astype(np.float32), (points.size // 3, 3))
    _, face = setting.caster.cast(points.reshape(-1, 3), rays)
    return np.where(face == NO_HIT, np.uint8(255), np.uint8(0)).reshape(num_rows, -1)


def shadows_on(
    painted: NDArray[np.uint32], pixels: OnFacades, shadows: WallShadows, colors: Colors
) -> None:
    """Darken façades of a picture where the sun does not reach them, in place.

    Args:
        painted: Picture as in `Colors`, shape (R, C).
        pixels: Pixels of the picture that show façades.
        shadows: Shadows on the façades.
        colors: Colours of the moment.
    """
    import cv2

    if shadows.lit.size == 1:
        return
    first_column = shadows.column.take(pixels.face)
    has_shadows = np.flatnonzero(first_column > 0)
    face = pixels.face.take(has_shadows)
    pixel = pixels.pixel.take(has_shadows)
    across = pixels.across.take(has_shadows) * shadows.density.take(face)
    column = across + first_column.take(has_shadows)
    up = pixels.up.take(has_shadows) * np.float32(1 / _CELL_SIZE_M)
    row = up - np.float32(0.5)
    sunlight = np.empty(len(row), dtype=np.uint8)
    for start in range(0, len(row), _MAX_LOOKUP_POINTS):
        block = slice(start, start + _MAX_LOOKUP_POINTS)
        values = cv2.remap(
            shadows.lit,
            column[None, block],
            row[None, block],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        sunlight[block] = np.asarray(values)[0]
    flat = painted.reshape(-1)
    dark = np.flatnonzero(sunlight == 0)
    flat[pixel.take(dark)] = colors.shaded.take(face.take(dark))
    edge = np.flatnonzero((sunlight > 0) & (sunlight < 255))
    weight = sunlight[edge, None] / np.float32(255)
    lit_bytes = flat[pixel[edge]].view(np.uint8).reshape(-1, 4)
    shaded_bytes = colors.shaded[face[edge]].view(np.uint8).reshape(-1, 4)
    mixed = lit_bytes * weight + shaded_bytes * (1 - weight)
    flat[pixel[edge]] = mixed.astype(np.uint8).view(np.uint32)[:, 0]


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Pictures of the complete map, fine to coarse.

    Attributes:
        levels: RGB pictures, shapes (3000, 3000, 3), (750, 750, 3), …, uint8, with cells as in
            `GroundMap`.
    """

    levels: tuple[ByteArray, ...]

    def at(self, x: Float32Array, y: Float32Array, level: int) -> ByteArray:
        """Return the colours (R, C, 3) at points `x` and `y`, (R, C) metres.

        Beyond the map it is the colour of its corner.
        """
        import cv2

        picture = self.levels[level]
        scale = np.float32(len(picture) / (2 * MAP_EXTENT))
        shift = np.float32(MAP_EXTENT) * scale - np.float32(0.5)
        colors = cv2.remap(
            picture,
            x * scale + shift,
            y * scale + shift,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=picture[0, 0].astype(float).tolist(),
        )
        return np.asarray(colors)


def static_ground(setting: Setting, light: Light, rng: np.random.Generator) -> Ground:
    """Paint the ground with the shadows of the static world; `rng` draws its grain."""
    brightness = light.sky + light.sun * light.to_sun[2]
    picture = _picture(setting.world.ground, brightness, light.wet_ground, rng)
    corners = above_ground(setting.static.corners, setting.terrain)
    add_shadows(picture, corners, light.to_sun, light.in_shadow)
    coarser = _coarser(picture, len(picture) // SHRINK)
    return _with_coarser(picture, coarser)


class PassingGround:
    """The ground at one moment after another, with the shadows of moving road users.

    It also has dark edges around vehicles. To copy the static ground would take longer than to put
    back the cells that the last moment changed.
    """

    def __init__(self, static: Ground) -> None:
        self._static = static.levels[:2]
        self._current = [level.copy() for level in static.levels[:2]]
        no_cells = np.zeros(0, dtype=np.int64)
        self._changed = no_cells, no_cells

    def at(self, scene: Scene, light: Light) -> Ground:
        """Return the ground at a moment; it is correct until the next call."""
        levels = zip(self._current, self._static, self._changed, strict=True)
        for current, static, changed in levels:
            current.reshape(-1, 3)[changed] = static.reshape(-1, 3).take(changed, axis=0)
        finest, coarser = self._current
        main_corners = scene.movers.corners[scene.movers.solids.main]
        corners = above_ground(main_corners, scene.setting.terrain)
        cells = [add_shadows(finest, corners, light.to_sun, light.in_shadow)]
        upwards = np.array([0.0, 0.0, 1.0])
        for margin, brightness in _CONTACT_SHADOWS:
            cells.append(add_shadows(finest, _slabs(scene, margin), upwards, brightness))
        finest_cells = np.concatenate(cells)
        self._changed = finest_cells, _update_coarser(coarser, finest, finest_cells)
        return _with_coarser(finest, coarser)


def _with_coarser(*levels: ByteArray) -> Ground:
    """Return the ground with some pictures, fine to coarse, and with coarser ones of the last."""
    while len(levels) < LEVELS:
        levels = (*levels, _coarser(levels[-1], len(levels[-1]) // SHRINK))
    return Ground(levels)


def _coarser(picture: ByteArray, width: int) -> ByteArray:
    """Return a coarser picture, with each cell the mean of the cells that it covers.

    Args:
        picture: The picture, shape (R, C, 3).
        width: Number of columns of the coarser picture; its rows are fewer by the same factor.
    """
    import cv2

    size = width, len(picture) * width // picture.shape[1]
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _update_coarser(coarser: ByteArray, finest: ByteArray, cells: IntArray) -> IntArray:
    """Update the second picture where cells of the finest one have changed, in place.

    To make it anew would take most of a moment's time if the images are small.

    Args:
        coarser: The second picture.
        finest: The finest picture.
        cells: Changed cells of the finest picture, shape (K,).

    Returns:
        Cells of the second picture that may have changed, shape (L,).
    """
    row, column = np.divmod(cells, MAP_CELLS)
    changed = np.zeros(coarser.shape[:2], dtype=bool)
    changed[row // SHRINK, column // SHRINK] = True
    coarser_cells = np.flatnonzero(changed)
    rows, columns = np.divmod(coarser_cells, coarser.shape[1])
    squares = finest.reshape(len(coarser), SHRINK, -1, SHRINK, 3)[rows, :, columns]
    if len(squares):
        side_by_side = squares.transpose(1, 0, 2, 3).reshape(SHRINK, -1, 3)
        coarser[rows, columns] = _coarser(side_by_side, len(squares))[0]
    return coarser_cells


def _slabs(scene: Scene, margin: float) -> FloatArray:
    """Return flat bodies (A, 8, 3) that reach `margin` metres beyond the road users' boxes."""
    half_size = scene.actors.size / 2 + (margin, margin, 0.0)
    signs = np.array([[1, 1], [1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1], [-1, -1], [-1, 1]])
    corners = np.zeros((len(half_size), 8, 3))
    corners[:, :, :2] = half_size[:, None, :2] * signs
    placed = moved(corners, scene.frames)
    placed[:, :, 2] = 0.0
    return placed


def _picture(
    ground: GroundMap, brightness: FloatArray, wet: float, rng: np.random.Generator
) -> ByteArray:
    """Paint the map in colour, with grain and patches from a repeated tile.

    Args:
        ground: Map of the roads.
        brightness: Light on level ground, shape (3,), as a share of the ground's colour.
        wet: Brightness of the ground as a share of dry ground's.
        rng: Generator of random numbers.

    Returns:
        RGB picture, shape (3000, 3000, 3).
    """
    import cv2

    palette = np.zeros((256, 3))
    for code, color in _COLOR_BY_CODE.items():
        palette[code] = np.array(color) * brightness * wet
    coarse_patches = rng.normal(0, _PATCH_STD, (25, 25))
    tile_size = (_TILE_CELLS, _TILE_CELLS)
    patches = cv2.resize(coarse_patches, tile_size, interpolation=cv2.INTER_CUBIC)
    noise = rng.normal(0, _GRAIN_STD, tile_size) + np.asarray(patches)
    grain = noise.round().clip(-_MAX_GRAIN, _MAX_GRAIN).astype(np.int16)
    scale = float(brightness.mean()) * wet
    grain_values = np.arange(-_MAX_GRAIN, _MAX_GRAIN + 1)[None, :, None]
    shades = palette[:, None, :] + scale * grain_values
    shades_table = shades.clip(0, 255).astype(np.uint8)
    num_shades = shades_table.shape[1]
    repeated = np.tile(grain + _MAX_GRAIN, MAP_CELLS // _TILE_CELLS)
    picture = np.empty((MAP_CELLS, MAP_CELLS, 3), dtype=np.uint8)
    for top in range(0, MAP_CELLS, _TILE_CELLS):
        codes = ground.codes[top : top + _TILE_CELLS].astype(np.intp)
        shade_rows = codes * num_shades + repeated
        picture[top : top + _TILE_CELLS] = shades_table.reshape(-1, 3).take(shade_rows, axis=0)
    return picture
