"""The ground with its shadows, as pictures of lower and lower resolution, and its colours at points."""

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import ByteArray, Float32Array, FloatArray
from deepaccident_devkit.synth import roads
from deepaccident_devkit.synth.roads import MAP_CELLS, MAP_EXTENT, GroundMap
from deepaccident_devkit.synth.sensors.images.light import Light
from deepaccident_devkit.synth.sensors.images.shadows import above_ground, with_shadows
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


def still_ground(setting: Setting, light: Light, rng: np.random.Generator) -> ByteArray:
    """The ground with the shadows of all that stands still, (3000, 3000, 3) uint8; `rng` draws its grain."""
    lit = light.sky + light.sun * light.to_sun[2]
    plain = _picture(setting.world.ground, lit, light.wet_ground, rng)
    corners = above_ground(setting.still.corners, setting.terrain)
    return with_shadows(plain, corners, light.to_sun, light.in_shadow)


def ground_of(still: ByteArray, scene: Scene, light: Light) -> Ground:
    """The ground at a moment: with the shadows of moving road users, and a dark edge around every vehicle."""
    import cv2

    corners = above_ground(scene.movers.corners[scene.movers.solids.main], scene.setting.terrain)
    finest = with_shadows(still, corners, light.to_sun, light.in_shadow)
    upwards = np.array([0.0, 0.0, 1.0])
    for beyond, brightness in _CLOSE_BY:
        finest = with_shadows(finest, _slabs(scene, beyond), upwards, brightness)
    levels = [finest]
    for _ in range(LEVELS - 1):
        side = len(levels[-1]) // SHRINK
        levels.append(np.asarray(cv2.resize(levels[-1], (side, side), interpolation=cv2.INTER_AREA), dtype=np.uint8))
    return Ground(tuple(levels))


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
