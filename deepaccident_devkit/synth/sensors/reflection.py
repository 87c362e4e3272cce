"""How much of a LiDAR's light surfaces send back."""

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.synth import roads
from deepaccident_devkit.synth.roads import GroundMap
from deepaccident_devkit.synth.solids import GLASS

_OF_GLASS = 0.03
_OF_CODE = {roads.ROAD: 0.25, roads.WHITE: 0.85, roads.YELLOW: 0.7, roads.SIDEWALK: 0.4, roads.GRASS: 0.45}
_OF_OTHER_GROUND = 0.4


def color_reflectivity(colors: FloatArray) -> FloatArray:
    """Of faces with colours (F, 3), 0 to 255, from 0 to 1: light colours reflect more, glass little."""
    bright = 0.1 + 0.8 * colors.mean(axis=1) / 255
    return np.where((colors == GLASS).all(axis=1), _OF_GLASS, bright)


def ground_reflectivity(ground: GroundMap, points: FloatArray) -> FloatArray:
    """Of the ground at points (N, 2 or 3), metres, ground frame."""
    table = np.full(256, _OF_OTHER_GROUND)
    for code, value in _OF_CODE.items():
        table[code] = value
    return np.asarray(table[ground.at(points[:, :2])])
