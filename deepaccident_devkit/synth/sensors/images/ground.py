"""The ground with its shadows, as pictures of lower and lower resolution, and its colours at points."""

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import ByteArray, Float32Array, FloatArray, IntArray
from deepaccident_devkit.synth import roads
from deepaccident_devkit.synth.roads import MAP_CELLS, MAP_EXTENT, GroundMap
from deepaccident_devkit.synth.sensors.images.light import Light
from deepaccident_devkit.synth.sensors.images.shadows import above_ground, add_shadows
from deepaccident_devkit.synth.sensors.scene import Scene
from deepaccident_devkit.synth.sensors.setting import Setting, moved

_COLORS = {
    roads.TERRAIN: (126, 134, 100),
    roads.ROAD: (92, 93, 96),
    roads.WHITE: (226, 226, 222),
    roads.YELLOW: (222, 184, 72),
    roads.SIDEWALK: (168, 164, 156),
    roads.GRASS: (112, 132, 84),
}
_GRAIN = 5.0
"""Standard deviation of the ground's brightness from cell to cell."""
_PATCHES = 5.0
"""Standard deviation of the ground's brightness over some metres."""
_TILE = 500
LEVELS, SHRINK = 3, 4
"""How many pictures there are, and how much coarser each is than the one before."""
_CLOSE_BY = ((0.35, 0.8), (0.1, 0.65))
"""Shadows of the sky's light below and around a vehicle: metres beyond its box, and the remaining brightness."""


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
        outside = picture[0, 0].astype(float).tolist()
        found = cv2.remap(
            picture,
            x * scale + shift,
            y * scale + shift,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=outside,
        )
        return np.asarray(found)


def still_ground(setting: Setting, light: Light, rng: np.random.Generator) -> Ground:
    """The ground with the shadows of all that stands still; `rng` draws its grain."""
    lit = light.sky + light.sun * light.to_sun[2]
    plain = _picture(setting.world.ground, lit, light.wet_ground, rng)
    corners = above_ground(setting.still.corners, setting.terrain)
    add_shadows(plain, corners, light.to_sun, light.in_shadow)
    return _with_coarser(plain, _coarser(plain, len(plain) // SHRINK))


def ground_of(still: Ground, scene: Scene, light: Light) -> Ground:
    """The ground at a moment: with the shadows of moving road users, and a dark edge around every vehicle."""
    finest, coarser = still.levels[0].copy(), still.levels[1].copy()
    corners = above_ground(scene.movers.corners[scene.movers.solids.main], scene.setting.terrain)
    cells = [add_shadows(finest, corners, light.to_sun, light.in_shadow)]
    upwards = np.array([0.0, 0.0, 1.0])
    for beyond, brightness in _CLOSE_BY:
        cells.append(add_shadows(finest, _slabs(scene, beyond), upwards, brightness))
    _follow(coarser, finest, np.concatenate(cells))
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


def _follow(coarser: ByteArray, finest: ByteArray, cells: IntArray) -> None:
    """Make the second picture agree with the finest one, in place, where cells of that (K,) have changed.

    To make all of it again would take most of a moment's time if the images are small.
    """
    row, column = np.divmod(cells, MAP_CELLS)
    changed = np.zeros(coarser.shape[:2], dtype=bool)
    changed[row // SHRINK, column // SHRINK] = True
    rows, columns = np.nonzero(changed)
    squares = finest.reshape(len(coarser), SHRINK, -1, SHRINK, 3)[rows, :, columns]
    if len(squares):
        side_by_side = squares.transpose(1, 0, 2, 3).reshape(SHRINK, -1, 3)
        coarser[rows, columns] = _coarser(side_by_side, len(squares))[0]


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
    patches = cv2.resize(rng.normal(0, _PATCHES, (25, 25)), (_TILE, _TILE), interpolation=cv2.INTER_CUBIC)
    grain = (rng.normal(0, _GRAIN, (_TILE, _TILE)) + np.asarray(patches)).round().clip(-32, 32).astype(np.int16)
    scale = float(lit.mean()) * wet
    shades = (palette[:, None, :] + scale * np.arange(-32, 33)[None, :, None]).clip(0, 255).astype(np.uint8)
    repeated = np.tile(grain + 32, (MAP_CELLS // _TILE, MAP_CELLS // _TILE))
    return np.asarray(shades[ground.codes, repeated])
