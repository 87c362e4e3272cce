"""The crossing of two straight roads as a raster of the ground: what lies where, in the ground frame."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.arrays import ByteArray, FloatArray, readonly
from deepaccident_devkit.release.bev_camera import TAGS

LANE_WIDTH = 3.5
LANE_CENTER = LANE_WIDTH / 2
"""Metres from the road's middle line to where its right lane is driven; traffic keeps right."""
PARKING_CENTER = 4.75
"""Likewise to the middle of the parking strip."""
ROAD_EDGE = 5.9
SIDEWALK_EDGE = 8.9
CROSSWALK = (6.9, 9.9)
"""From, to: metres from the junction's middle along each arm."""
_STOP_LINE = (10.6, 11.0)

MAP_EXTENT = 150.0
"""The raster covers ±this, metres, in x and y."""
MAP_RESOLUTION = 0.1
MAP_CELLS = 3000

TERRAIN, ROAD, WHITE, YELLOW, SIDEWALK, GRASS, TREE, POLE = range(8)
FIRST_BUILDING = 16
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
class GroundMap:
    """What lies on the ground, as codes of this module; arrays are read-only.

    Attributes:
        codes: (3000, 3000) uint8, row = y index, column = x index: cell (i, j) has its middle at
            x = (j + 0.5) · 0.1 − 150, y = (i + 0.5) · 0.1 − 150.
    """

    codes: ByteArray

    def __post_init__(self) -> None:
        """Freeze the array."""
        object.__setattr__(self, "codes", readonly(self.codes))

    def with_rectangles(self, rectangles: FloatArray, codes: NDArray[np.uint8]) -> "GroundMap":
        """A new map with axis-parallel rectangles (R, 4) x from, x to, y from, y to, painted in order."""
        painted = self.codes.copy()
        edges = np.rint((rectangles + MAP_EXTENT) / MAP_RESOLUTION).astype(int).clip(0, MAP_CELLS)
        for (x0, x1, y0, y1), code in zip(edges.tolist(), codes.tolist(), strict=True):
            painted[y0:y1, x0:x1] = code
        return GroundMap(painted)


def crossing() -> GroundMap:
    """Two roads with one lane and a parking strip each way, crossing at the origin."""
    axis = (np.arange(MAP_CELLS, dtype=np.float64) + 0.5) * MAP_RESOLUTION - MAP_EXTENT
    distance = np.abs(axis)
    band = np.digitize(distance, (ROAD_EDGE, SIDEWALK_EDGE)).astype(np.uint8)  # 0 road, 1 sidewalk, 2 beyond
    kinds = np.array([ROAD, SIDEWALK, GRASS], dtype=np.uint8)
    codes = kinds[np.minimum(band[:, None], band[None, :])]
    _paint_lines(codes, axis, right=-1)  # along x, a road's right lies at lower y
    _paint_lines(codes.T, axis, right=1)  # along y, at higher x; the transpose is a view
    return GroundMap(codes)


def tag_of_code() -> ByteArray:
    """CARLA's semantic tag of every code, (256,); codes from `FIRST_BUILDING` on are buildings."""
    tags = np.full(256, _TAG_BUILDING, dtype=np.uint8)
    for code, tag in _CODE_TAGS.items():
        tags[code] = tag
    return tags


def _paint_lines(codes: ByteArray, axis: FloatArray, *, right: int) -> None:
    """Paint the lines of the road along the columns, in place; `right` is the sign of the row's axis to its right."""
    along, across = np.abs(axis), np.abs(axis)
    outside = along > _STOP_LINE[1]
    dashes = outside & (along % 6.0 < 3.0)
    middle = (across > 0.05) & (across < 0.2)
    edge = np.abs(across - LANE_WIDTH) < 0.06
    stripes = (across < ROAD_EDGE - 0.4) & (axis % 1.0 < 0.5)
    crosswalk = (along > CROSSWALK[0]) & (along < CROSSWALK[1])
    stop = (along > _STOP_LINE[0]) & (along < _STOP_LINE[1])
    codes[np.ix_(middle, outside)] = YELLOW
    codes[np.ix_(edge, dashes)] = WHITE
    codes[np.ix_(stripes, crosswalk)] = WHITE
    for driving in (1, -1):
        lane = (right * driving * axis > 0.2) & (right * driving * axis < LANE_WIDTH)
        codes[np.ix_(lane, stop & (driving * axis < 0))] = WHITE
