"""The ground as a raster of codes, in the ground frame: roads, sidewalks and buildings, and a junction's markings."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.support.arrays import BoolArray, ByteArray, FloatArray, FrozenArrays
from deepaccident_devkit.synth.roads.layout import EXTENT, KERB_RADIUS, LANE_WIDTH, OUTWARD, Arm, RoadSpec, slot_edges

MAP_EXTENT = EXTENT
"""The raster covers −`MAP_EXTENT` to `MAP_EXTENT` in x and y, metres."""
MAP_RESOLUTION = 0.1
MAP_CELLS = 3000

TERRAIN, ROAD, WHITE, YELLOW, SIDEWALK, GRASS, TREE, POLE = range(8)
FIRST_BUILDING = 16
ROAD_CODES = (ROAD, WHITE, YELLOW)
"""The codes of the road's surface, on which vehicles drive."""
_TAG_BUILDING, _TAG_POLE, _TAG_VEGETATION, _TAG_GROUND, _TAG_TERRAIN = 1, 5, 9, 14, 22
"""CARLA's semantic tags that the reference renderer does not use."""
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
    """What the ground is covered with, as codes of this module; arrays are read-only.

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


_HALF = MAP_CELLS // 2
_DASH = (3.0, 6.0)
"""Metres: the length of a dash, and the distance from one dash to the next."""
_TOOTH = (0.5, 0.9)
"""The same two lengths for the teeth of a yield line."""
_STRIPE = 0.5
"""Approximate width of a crosswalk's stripes and of the gaps between them, metres."""


@lru_cache(maxsize=4)
def paint_junction(spec: RoadSpec) -> GroundMap:
    """The ground of a junction; the last few are kept, since scenarios often share one."""
    axis = cell_axis()
    band = np.digitize(np.abs(axis), (spec.road_edge, spec.sidewalk_edge))
    kinds = np.array([ROAD, SIDEWALK, GRASS], dtype=np.uint8)[band]
    codes = np.minimum.outer(kinds, kinds)  # where two roads cross, the lower code lies nearer to the traffic
    if spec.kind == "three-way":
        beyond = axis > spec.road_edge
        codes[beyond] = kinds[beyond, None]
    views = {arm: _outward_view(codes, arm) for arm in spec.arms}
    for arm, view in views.items():
        if _has_left_neighbour(arm, spec):
            _round_left_corner(view, axis, spec)
    for arm, view in views.items():
        _paint_arm(view, axis, spec, yields=arm in spec.yielding_arms)
    return GroundMap(codes)


def _outward_view(codes: ByteArray, arm: Arm) -> ByteArray:
    """A view of the map along an arm: columns outward from the middle, rows from the arm's right to its left."""
    x, y = OUTWARD[arm]
    whole = codes if x else codes.T
    whole = whole if (x or -y) > 0 else whole[::-1]
    return whole[:, _HALF:] if (x or y) > 0 else whole[:, _HALF - 1 :: -1]


def _has_left_neighbour(arm: Arm, spec: RoadSpec) -> bool:
    """Whether there is an arm to the left, looking outward."""
    x, y = OUTWARD[arm]
    return any(OUTWARD[other] == (-y, x) for other in spec.arms)


def _round_left_corner(view: ByteArray, axis: FloatArray, spec: RoadSpec) -> None:
    """Make the corner between an arm and the one to its left round, in place."""
    along = axis[_HALF:]
    low, high = spec.road_edge, spec.road_edge + KERB_RADIUS
    rows, columns = np.flatnonzero((axis > low) & (axis < high)), np.flatnonzero((along > low) & (along < high))
    off = np.hypot(axis[rows, None] - high, along[None, columns] - high)
    patch = view[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    patch[off > KERB_RADIUS] = ROAD


def _paint_arm(view: ByteArray, beside: FloatArray, spec: RoadSpec, *, yields: bool) -> None:
    """Paint the lines of one arm, in place; seen outward, traffic towards the junction drives on the left side."""
    along = beside[_HALF:]
    before = along > spec.stop_line[1]
    across = np.abs(beside)
    dashes = before & _every(along, *_DASH)
    _paint(view, (across > 0.05) & (across < 0.2), before, YELLOW)
    for divider in range(1, spec.lanes):
        _paint(view, np.abs(across - divider * LANE_WIDTH) < 0.06, dashes, WHITE)
    edge = np.abs(across - spec.lanes_edge) < 0.06
    _paint(view, edge, dashes, WHITE)
    _paint(view, (across > spec.lanes_edge) & (across < spec.road_edge), _slot_lines(along, spec), WHITE)
    low, high = spec.crosswalk
    _paint(view, _stripes(beside, spec.road_edge), (along > low) & (along < high), WHITE)
    incoming = (beside > 0.2) & (beside < spec.lanes_edge)
    stop = (along > spec.stop_line[0]) & (along < spec.stop_line[1])
    if spec.signalized or yields:
        _paint(view, incoming & _every(beside, *_TOOTH) if yields else incoming, stop, WHITE)


def _slot_lines(along: FloatArray, spec: RoadSpec) -> BoolArray:
    edges = slot_edges(spec)
    return np.asarray(np.abs(along[:, None] - edges).min(axis=1) < 0.06)


def _stripes(beside: FloatArray, kerb: float) -> BoolArray:
    """Where the stripes of a crosswalk are: a stripe in the middle, and a gap at each kerb."""
    more = round((2 * kerb / _STRIPE - 3) / 4)
    width = 2 * kerb / (4 * more + 3)
    return _every(beside, width, 2 * width) & (np.abs(beside) < kerb)


def _every(values: FloatArray, length: float, period: float) -> BoolArray:
    """Which values lie on stretches of a length, one in each period; the middle of one stretch is at 0."""
    return np.asarray((np.abs(values) + length / 2) % period < length)


def _paint(view: ByteArray, rows: BoolArray, columns: BoolArray, code: int) -> None:
    """Paint the cells of chosen rows and columns in place, if they are road."""
    window = np.ix_(rows, columns)
    block = view[window]
    view[window] = np.where(block == ROAD, np.uint8(code), block)
