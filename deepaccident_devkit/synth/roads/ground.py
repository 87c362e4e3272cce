"""The ground as a raster of codes: what lies where, in the ground frame."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.arrays import BoolArray, ByteArray, FloatArray, FrozenArrays
from deepaccident_devkit.release.bev_camera import TAGS
from deepaccident_devkit.synth.roads.terrain import EXTENT

MAP_EXTENT = EXTENT
"""The raster covers ±this, metres, in x and y."""
MAP_RESOLUTION = 0.1
MAP_CELLS = 3000

TERRAIN, ROAD, WHITE, YELLOW, SIDEWALK, GRASS, TREE, POLE = range(8)
FIRST_BUILDING = 16
ROAD_CODES = (ROAD, WHITE, YELLOW)
"""What is driven on."""
_TAG_BUILDING, _TAG_POLE, _TAG_VEGETATION, _TAG_GROUND, _TAG_TERRAIN = 1, 5, 9, 14, 22
"""CARLA's semantic tags of what the reference renderer does not use."""
_CODE_TAGS = {
    TERRAIN: _TAG_TERRAIN,
    ROAD: TAGS["road"],
    WHITE: TAGS["road_line"],
    YELLOW: TAGS["road_line"],
    SIDEWALK: TAGS["sidewalk"],
    GRASS: _TAG_GROUND,
    TREE: _TAG_VEGETATION,
    POLE: _TAG_POLE,
}


@dataclass(frozen=True, slots=True, eq=False)
class GroundMap(FrozenArrays):
    """What lies on the ground, as codes of this module; arrays are read-only.

    Attributes:
        codes: (3000, 3000) uint8, row = y index, column = x index: cell (i, j) has its middle at
            x = (j + 0.5) · 0.1 − 150, y = (i + 0.5) · 0.1 − 150.
    """

    codes: ByteArray

    def at(self, xy: FloatArray) -> ByteArray:
        """Codes (N,) at points (N, 2), metres; `TERRAIN` beyond the map."""
        cells = np.floor((xy + MAP_EXTENT) / MAP_RESOLUTION).astype(np.int64)
        inside: BoolArray = np.asarray(((cells >= 0) & (cells < MAP_CELLS)).all(axis=-1))
        column, row = np.where(inside[..., None], cells, 0).T
        return np.where(inside, self.codes[row, column], np.uint8(TERRAIN))

    def with_rectangles(self, rectangles: FloatArray, codes: NDArray[np.uint8]) -> "GroundMap":
        """A new map with axis-parallel rectangles (R, 4) x from, x to, y from, y to, painted in order."""
        painted = self.codes.copy()
        edges = np.rint((rectangles + MAP_EXTENT) / MAP_RESOLUTION).astype(int).clip(0, MAP_CELLS)
        for (x0, x1, y0, y1), code in zip(edges.tolist(), codes.tolist(), strict=True):
            painted[y0:y1, x0:x1] = code
        return GroundMap(painted)


def cell_axis() -> FloatArray:
    """The middles of the cells along x or y, (3000,) metres."""
    return (np.arange(MAP_CELLS, dtype=np.float64) + 0.5) * MAP_RESOLUTION - MAP_EXTENT


def tag_of_code() -> ByteArray:
    """CARLA's semantic tag of every code, (256,); codes from `FIRST_BUILDING` on are buildings."""
    tags = np.full(256, _TAG_BUILDING, dtype=np.uint8)
    for code, tag in _CODE_TAGS.items():
        tags[code] = tag
    return tags
