"""Shadows on the ground and on façades, and the ground as pictures of several resolutions."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.geometry.boxes import CORNER_SIGNS
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
from deepaccident_devkit.plugins.synth.sensors.paint import Colors, FacadePixels, Facades
from deepaccident_devkit.plugins.synth.sensors.scene import Scene, Setting, move_points
from deepaccident_devkit.support.arrays import (
    NO_INDICES,
    ByteArray,
    Float32Array,
    FloatArray,
    IntArray,
)

# Distance between two rays from a façade to the sun.
_CELL_SIZE_M = 0.4
# Distance from the wall to the points where these rays begin.
_WALL_CLEARANCE_M = 0.05
# Largest number of points to look up in one call; OpenCV accepts no wider picture.
_MAX_LOOKUP_POINTS = 32000
# Smallest cosine of the angle between the normal of a façade and the sun for casting rays.
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
# Dark edges around a vehicle, which hides the light of the sky: distance beyond its box (metres),
# and the remaining brightness as a share.
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
        Flat indices of the cells in shadow, shape (K,), of 3000 · 3000; a cell in two shadows
        occurs twice.
    """
    outlines = _project_shadows(corners, to_sun)
    cells = _fill_outlines(outlines)
    dimmed_values = (np.arange(256) * brightness).astype(np.uint8)
    flat_picture = picture.reshape(-1, 3)
    # All cells are read before one is written, so that two shadows together are no darker than one.
    flat_picture[cells] = dimmed_values[flat_picture.take(cells, axis=0)]
    return cells


def _fill_outlines(outlines: IntArray) -> IntArray:
    """Return the cells (K,) inside convex outlines, one outline after the other.

    Args:
        outlines: Column and row of each corner, shape (P, 8, 2).
    """
    import cv2

    cells = [NO_INDICES]
    lows = np.maximum(outlines.min(axis=1), 0)
    highs = np.minimum(outlines.max(axis=1) + 1, MAP_CELLS)
    is_on_map = (lows < highs).all(axis=1)
    for outline, low, high in zip(
        outlines[is_on_map], lows[is_on_map], highs[is_on_map], strict=True
    ):
        mask = np.zeros((high - low)[::-1], dtype=np.uint8)
        hull = cv2.convexHull((outline - low).astype(np.int32))
        cv2.fillConvexPoly(mask, hull, 1)
        rows, columns = np.nonzero(mask)
        cells.append((rows + low[1]) * MAP_CELLS + columns + low[0])
    return np.concatenate(cells)


def measure_from_ground(corners: FloatArray, terrain: Terrain) -> FloatArray:
    """Return corners (P, 8, 3) with z above the ground below each solid's middle."""
    if terrain.is_flat:
        return corners
    lowered = corners.copy()
    middle = corners[..., :2].mean(axis=1)
    ground_height = terrain.height(middle)
    lowered[..., 2] -= ground_height[:, None]
    return lowered


def _project_shadows(corners: FloatArray, to_sun: FloatArray) -> IntArray:
    """Return the map cells (column, row) that the corners' shadows fall on, shape (P, 8, 2)."""
    height = np.maximum(corners[..., 2:], 0.0)
    shadow_direction = to_sun[:2] / to_sun[2]
    shadows = corners[..., :2] - height * shadow_direction
    cells = np.floor((shadows + MAP_EXTENT) / MAP_RESOLUTION)
    return np.asarray(cells.astype(np.int64))


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


def cast_wall_shadows(setting: Setting, facades: Facades, light: Light) -> WallShadows:
    """Compute the shadows on the façades of the static world."""
    normals, _ = setting.static.planes
    faces_sun = normals @ light.to_sun > _MIN_SUN_COSINE
    sunny_faces = np.flatnonzero((facades.length > 0) & faces_sun)
    column, density = np.zeros((2, len(normals)), dtype=np.float32)
    sunny_column = np.full((1, 1), 255, dtype=np.uint8)
    if not len(sunny_faces):
        return WallShadows(sunny_column, column, density)
    lengths = facades.length[sunny_faces]
    counts = np.ceil(lengths / _CELL_SIZE_M).astype(np.int64)
    density[sunny_faces] = counts / lengths
    num_columns = counts + 2
    first_columns = 1 + num_columns.cumsum() - num_columns
    column[sunny_faces] = first_columns + 0.5
    lit = _cast_sunlight(setting, light, sunny_faces, counts)
    sunny_column = np.repeat(sunny_column, len(lit), axis=0)
    return WallShadows(np.concatenate([sunny_column, lit], axis=1), column, density)


def _cast_sunlight(setting: Setting, light: Light, faces: IntArray, counts: IntArray) -> ByteArray:
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
    along = quads[..., :2].sum(axis=2)
    height = quads[..., 2]
    foot = height.min(axis=1)
    max_height = (height.max(axis=1) - foot).max()
    face_rows = np.arange(len(faces))
    starts = quads[face_rows, along.argmin(axis=1)]
    ends = quads[face_rows, along.argmax(axis=1)]
    num_columns = counts + 2
    face_of_column = np.repeat(face_rows, num_columns)
    count_of_column = counts[face_of_column]
    first_columns = np.repeat(num_columns.cumsum() - num_columns, num_columns)
    cell = np.arange(len(face_of_column)) - first_columns - 1
    cell = cell.clip(0, count_of_column - 1)
    share = (cell + 0.5) / count_of_column
    columns = starts[face_of_column] + (ends - starts)[face_of_column] * share[:, None]
    columns = columns + normals[faces][face_of_column] * _WALL_CLEARANCE_M
    num_rows = int(np.ceil(max_height / _CELL_SIZE_M))
    points = np.broadcast_to(columns, (num_rows, *columns.shape)).copy()
    row_heights = (np.arange(num_rows)[:, None] + 0.5) * _CELL_SIZE_M
    points[..., 2] = foot[face_of_column] + row_heights
    rays = np.broadcast_to(light.to_sun.astype(np.float32), (points.size // 3, 3))
    _, face = setting.caster.cast(points.reshape(-1, 3), rays)
    lit = np.where(face == NO_HIT, np.uint8(255), np.uint8(0))
    return lit.reshape(num_rows, -1)


def darken_facades(
    painted: NDArray[np.uint32], pixels: FacadePixels, shadows: WallShadows, colors: Colors
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
    from_start = pixels.across.take(has_shadows) * shadows.density.take(face)
    column = from_start + first_column.take(has_shadows)
    from_foot = pixels.up.take(has_shadows) * np.float32(1 / _CELL_SIZE_M)
    row = from_foot - np.float32(0.5)
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
    flat_painted = painted.reshape(-1)
    dark = np.flatnonzero(sunlight == 0)
    flat_painted[pixel.take(dark)] = colors.shaded.take(face.take(dark))
    edge = np.flatnonzero((sunlight > 0) & (sunlight < 255))
    edge_pixel = pixel[edge]
    weight = sunlight[edge, None] / np.float32(255)
    lit_bytes = flat_painted[edge_pixel].view(np.uint8).reshape(-1, 4)
    shaded_bytes = colors.shaded[face[edge]].view(np.uint8).reshape(-1, 4)
    mixed = lit_bytes * weight + shaded_bytes * (1 - weight)
    flat_painted[edge_pixel] = mixed.astype(np.uint8).view(np.uint32)[:, 0]


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Pictures of the complete map, fine to coarse.

    Attributes:
        levels: RGB pictures, shapes (3000, 3000, 3), (750, 750, 3), …, uint8, with cells as in
            `GroundMap`.
    """

    levels: tuple[ByteArray, ...]

    def at(self, x: Float32Array, y: Float32Array, level: int) -> ByteArray:
        """Return the colours (R, C, 3) at points.

        Beyond the map the ground has the colour of the map's corner.

        Args:
            x: Coordinates x of the points, shape (R, C), metres.
            y: Coordinates y of the points, shape (R, C), metres.
            level: Index of the picture to read.
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


def paint_static_ground(setting: Setting, light: Light, rng: np.random.Generator) -> Ground:
    """Paint the ground with the shadows of the static world; `rng` draws its grain."""
    brightness = light.sky + light.sun * light.to_sun[2]
    picture = _paint_map(setting.world.ground, brightness, light.wet_ground, rng)
    corners = measure_from_ground(setting.static.corners, setting.terrain)
    add_shadows(picture, corners, light.to_sun, light.in_shadow)
    return _make_levels(picture, _coarsen(picture, len(picture) // SHRINK))


class PassingGround:
    """The ground at one moment after another, with the shadows of moving road users.

    It also has dark edges around vehicles. Only the cells that the last moment changed are
    restored, because copying the static ground would take longer.
    """

    def __init__(self, static: Ground) -> None:
        self._static = static.levels[:2]
        self._current = [level.copy() for level in self._static]
        no_cells = np.zeros(0, dtype=np.int64)
        self._changed = no_cells, no_cells

    def at(self, scene: Scene, light: Light) -> Ground:
        """Return the ground at a moment; the result is valid until the next call."""
        levels = zip(self._current, self._static, self._changed, strict=True)
        for current, static, changed in levels:
            current.reshape(-1, 3)[changed] = static.reshape(-1, 3).take(changed, axis=0)
        finest, coarser = self._current
        main_corners = scene.movers.corners[scene.movers.solids.main]
        corners = measure_from_ground(main_corners, scene.setting.terrain)
        cells = [add_shadows(finest, corners, light.to_sun, light.in_shadow)]
        upwards = np.array([0.0, 0.0, 1.0])
        for margin, brightness in _CONTACT_SHADOWS:
            slabs = _make_slabs(scene, margin)
            cells.append(add_shadows(finest, slabs, upwards, brightness))
        finest_cells = np.concatenate(cells)
        coarser_cells = _update_coarser(coarser, finest, finest_cells)
        self._changed = finest_cells, coarser_cells
        return _make_levels(finest, coarser)


def _make_levels(*levels: ByteArray) -> Ground:
    """Return the ground with some pictures, fine to coarse, and the missing coarser ones."""
    while len(levels) < LEVELS:
        coarsest = levels[-1]
        width = len(coarsest) // SHRINK
        levels = (*levels, _coarsen(coarsest, width))
    return Ground(levels)


def _coarsen(picture: ByteArray, width: int) -> ByteArray:
    """Return a coarser picture, with each cell the mean of the cells that it covers.

    Args:
        picture: The picture, shape (R, C, 3).
        width: Number of columns of the coarser picture; its rows are fewer by the same factor.
    """
    import cv2

    rows, columns, _ = picture.shape
    size = (width, rows * width // columns)
    small_picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small_picture, dtype=np.uint8)


def _update_coarser(coarser: ByteArray, finest: ByteArray, cells: IntArray) -> IntArray:
    """Update the second picture where cells of the finest one have changed, in place.

    Recomputing it would take most of a moment's time if the images are small.

    Args:
        coarser: The second picture.
        finest: The finest picture.
        cells: Changed cells of the finest picture, shape (K,).

    Returns:
        Cells of the second picture that may have changed, shape (L,).
    """
    row, column = np.divmod(cells, MAP_CELLS)
    has_changed = np.zeros(coarser.shape[:2], dtype=bool)
    has_changed[row // SHRINK, column // SHRINK] = True
    coarser_cells = np.flatnonzero(has_changed)
    rows, columns = np.divmod(coarser_cells, coarser.shape[1])
    squares = finest.reshape(len(coarser), SHRINK, -1, SHRINK, 3)[rows, :, columns]
    if len(squares):
        side_by_side = squares.transpose(1, 0, 2, 3).reshape(SHRINK, -1, 3)
        coarser[rows, columns] = _coarsen(side_by_side, len(squares))[0]
    return coarser_cells


def _make_slabs(scene: Scene, margin: float) -> FloatArray:
    """Return flat bodies (A, 8, 3) that reach `margin` metres beyond the road users' boxes."""
    half_size = scene.actors.size / 2 + (margin, margin, 0.0)
    corner_signs = CORNER_SIGNS * (1, 1, 0)
    slabs = move_points(half_size[:, None] * corner_signs, scene.frames)
    slabs[:, :, 2] = 0.0
    return slabs


def _paint_map(
    ground: GroundMap, brightness: FloatArray, wetness: float, rng: np.random.Generator
) -> ByteArray:
    """Paint the map in colour, with grain and patches from a repeated tile.

    Args:
        ground: Map of the roads.
        brightness: Light on level ground, shape (3,), as a share of the ground's colour.
        wetness: Brightness of the ground as a share of dry ground's.
        rng: Generator of random numbers.

    Returns:
        RGB picture, shape (3000, 3000, 3).
    """
    import cv2

    palette = np.zeros((256, 3))
    for code, color in _COLOR_BY_CODE.items():
        palette[code] = np.array(color) * brightness * wetness
    coarse_patches = rng.normal(0, _PATCH_STD, (25, 25))
    tile_size = (_TILE_CELLS, _TILE_CELLS)
    patches = cv2.resize(coarse_patches, tile_size, interpolation=cv2.INTER_CUBIC)
    noise = rng.normal(0, _GRAIN_STD, tile_size) + np.asarray(patches)
    grain = noise.round().clip(-_MAX_GRAIN, _MAX_GRAIN).astype(np.int16)
    scale = float(brightness.mean()) * wetness
    grain_values = np.arange(-_MAX_GRAIN, _MAX_GRAIN + 1)
    shades = palette[:, None, :] + scale * grain_values[None, :, None]
    shades_table = shades.clip(0, 255).astype(np.uint8).reshape(-1, 3)
    shade_columns = np.tile(grain + _MAX_GRAIN, MAP_CELLS // _TILE_CELLS)
    picture = np.empty((MAP_CELLS, MAP_CELLS, 3), dtype=np.uint8)
    for start in range(0, MAP_CELLS, _TILE_CELLS):
        tile_rows = slice(start, start + _TILE_CELLS)
        codes = ground.codes[tile_rows].astype(np.intp)
        shade_rows = codes * len(grain_values) + shade_columns
        picture[tile_rows] = shades_table.take(shade_rows, axis=0)
    return picture
