"""A junction: its ground as a raster of codes; for traffic its routes, stop lines, crosswalks and sidewalks."""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.roads.layout import (
    ARMS,
    EXTENT,
    KERB_RADIUS,
    LANE_WIDTH,
    OUTWARD,
    Arm,
    RoadSpec,
    Terrain,
    parking_places,
    slot_edges,
)
from deepaccident_devkit.plugins.synth.roads.paths import (
    Meeting,
    Path,
    bent,
    crossing,
    quarter_turn,
    straight,
    tangent_of_corner,
    tangent_of_radius,
)
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.support.arrays import (
    BoolArray,
    ByteArray,
    FloatArray,
    FrozenArrays,
    ShortRepr,
    readonly,
)

# The raster covers −`MAP_EXTENT` to `MAP_EXTENT` in x and y, metres.
MAP_EXTENT = EXTENT
MAP_RESOLUTION = 0.1
MAP_CELLS = 3000
TERRAIN, ROAD, WHITE, YELLOW, SIDEWALK, GRASS, TREE, POLE = range(8)
FIRST_BUILDING = 16
# The codes of the road's surface, on which vehicles drive.
ROAD_CODES = (ROAD, WHITE, YELLOW)
# CARLA's semantic tags that the reference renderer does not use.
_TAG_BUILDING, _TAG_POLE, _TAG_VEGETATION, _TAG_GROUND, _TAG_TERRAIN = 1, 5, 9, 14, 22
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
_HALF = MAP_CELLS // 2
# Metres: the length of a dash, and the distance from one dash to the next.
_DASH = (3.0, 6.0)
# The same two lengths for the teeth of a yield line.
_TOOTH = (0.5, 0.9)
# Approximate width of a crosswalk's stripes and of the gaps between them, metres.
_STRIPE = 0.5
Turn = Literal["straight", "left", "right"]
TURNS: tuple[Turn, ...] = get_args(Turn)
# Metres from the middle at which routes begin and end.
REACH = 140.0
_WALK_REACH = 110.0
# Metres from the kerb to where pedestrians walk.
_WALK_INSET = 1.6
# The least distance between the path of a right turn and the kerb, metres.
_CLEARANCE = 1.7
_MAX_RIGHT_RADIUS = 9.0
_LEFT_RADIUS = 10.0
_WALK_TANGENT = 3.0
# Turn → how many arms further, counter-clockwise, it leaves the junction.
_QUARTERS: dict[Turn, int] = {"straight": 2, "left": -1, "right": 1}


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


@lru_cache(maxsize=4)
def paint_junction(spec: RoadSpec) -> GroundMap:
    """The ground of a junction; the last few are kept, since scenarios often share one."""
    axis = cell_axis()
    band = np.digitize(np.abs(axis), (spec.road_edge, spec.sidewalk_edge))
    kinds = np.array([ROAD, SIDEWALK, GRASS], dtype=np.uint8)[band]
    codes = np.minimum.outer(
        kinds, kinds
    )  # where two roads cross, the lower code lies nearer to the traffic
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
    rows, columns = (
        np.flatnonzero((axis > low) & (axis < high)),
        np.flatnonzero((along > low) & (along < high)),
    )
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
    _paint(view, np.abs(across - spec.lanes_edge) < 0.06, dashes, WHITE)
    _paint(
        view,
        (across > spec.lanes_edge) & (across < spec.road_edge),
        _slot_lines(along, spec),
        WHITE,
    )
    low, high = spec.crosswalk
    _paint(view, _stripes(beside, spec.road_edge), (along > low) & (along < high), WHITE)
    incoming = (beside > 0.2) & (beside < spec.lanes_edge)
    stop = (along > spec.stop_line[0]) & (along < spec.stop_line[1])
    if spec.signalized or yields:
        _paint(view, incoming & _every(beside, *_TOOTH) if yields else incoming, stop, WHITE)


def _slot_lines(along: FloatArray, spec: RoadSpec) -> BoolArray:
    return np.asarray(np.abs(along[:, None] - slot_edges(spec)).min(axis=1) < 0.06)


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Route(ShortRepr):
    """A way over the junction.

    Attributes:
        path: along the middle of the lane, from one end of the ground to the other.
        stop_s: metres along the path where the stop line begins; a vehicle that has to wait stops before it.
        enter_s: metres along the path where the junction begins.
        exit_s: metres along the path where the junction ends.
        from_arm: the arm that it comes from.
        to_arm: the arm by which it leaves.
        turn: what it does between them.
        lane: its number on both arms, 0 is the rightmost.
    """

    path: Path
    stop_s: float
    enter_s: float
    exit_s: float
    from_arm: Arm
    to_arm: Arm
    turn: Turn
    lane: int


@dataclass(frozen=True, slots=True)
class Junction:
    """Straight roads that meet at the origin of the ground frame; traffic keeps right.

    Attributes:
        spec: its arms, lanes and edges.
    """

    spec: RoadSpec = field(default_factory=RoadSpec)

    @property
    def arms(self) -> tuple[Arm, ...]:
        """The arms that it has."""
        return self.spec.arms

    @property
    def terrain(self) -> Terrain:
        """How high its ground lies."""
        return Terrain(self.spec.hump)

    def turns(self, from_arm: Arm) -> tuple[Turn, ...]:
        """The possible turns of those who come from an arm."""
        return tuple(turn for turn in TURNS if _leaves_by(from_arm, turn) in self.arms)

    def route(self, from_arm: Arm, turn: Turn, lane: int | None = None) -> Route:
        """The way from an arm over the junction; raises ConfigError: the junction has no such arm, turn or lane.

        Lane 0 is the rightmost; by default it is the leftmost for a left turn, if not, the rightmost.
        """
        self._check_arm(from_arm)
        if turn not in self.turns(from_arm):
            raise ConfigError(
                f"turn: nobody can go {turn!r} from the {from_arm} arm of a {self.spec.kind} junction; choose one of "
                f"{', '.join(self.turns(from_arm))}"
            )
        if lane is None:
            lane = self.spec.lanes - 1 if turn == "left" else 0
        if not 0 <= lane < self.spec.lanes:
            raise ConfigError(f"lane: expected 0 to {self.spec.lanes - 1}, found {lane}")
        return _route(self.spec, from_arm, turn, lane)

    def routes(self) -> tuple[Route, ...]:
        """All ways over the junction, by arm, turn and lane."""
        return tuple(
            self.route(arm, turn, lane)
            for arm in self.arms
            for turn in self.turns(arm)
            for lane in range(self.spec.lanes)
        )

    def conflicts(self, route_a: Route, route_b: Route) -> Meeting | None:
        """Where two routes first meet, as distances along each; None if they never meet, or come by the same lane."""
        if route_a.from_arm == route_b.from_arm and route_a.lane == route_b.lane:
            return None
        return _meeting(route_a, route_b)

    def stop_line(self, arm: Arm) -> FloatArray:
        """The line where those who come by this arm stop, (2, 2) metres: from the middle line to the lanes' edge."""
        self._check_arm(arm)
        return readonly(
            _on_arm(arm, np.full(2, self.spec.stop_line[1]), np.array([0.0, self.spec.lanes_edge]))
        )

    def crosswalk(self, arm: Arm) -> Path:
        """The path across an arm's road, between the sidewalks: seen outward, from right to left; marked or not."""
        self._check_arm(arm)
        along, beside = float(np.mean(self.spec.crosswalk)), self.spec.road_edge + _WALK_INSET
        start, end = _on_arm(arm, np.full(2, along), np.array([-beside, beside]))
        x, y = (end - start).tolist()
        return straight((float(start[0]), float(start[1])), float(np.arctan2(y, x)), 2 * beside)

    def sidewalk_paths(self) -> tuple[Path, ...]:
        """The sidewalks' paths: one round each corner, and one along the side where a three-way junction has no arm."""
        beside = self.spec.road_edge + _WALK_INSET
        corners = [
            _way(arm, beside, "right", _WALK_TANGENT, _WALK_REACH)
            for arm in self.arms
            if _leaves_by(arm, "right") in self.arms
        ]
        if self.spec.kind == "three-way":
            corners.append(straight((-_WALK_REACH, beside), 0.0, 2 * _WALK_REACH))
        return tuple(corners)

    def parking_places(self) -> FloatArray:
        """x, y (metres), yaw (radians) of the middles of all parking slots, (N, 3)."""
        return readonly(parking_places(self.spec))

    def ground_map(self) -> GroundMap:
        """What lies on the ground."""
        return paint_junction(self.spec)

    def _check_arm(self, arm: Arm) -> None:
        if arm not in self.arms:
            raise ConfigError(
                f"arm: a {self.spec.kind} junction has no {arm!r} arm; choose one of {', '.join(self.arms)}"
            )


@lru_cache(maxsize=64)
def _meeting(route_a: Route, route_b: Route) -> Meeting | None:
    return crossing(route_a.path, route_b.path)


@lru_cache(maxsize=64)
def _route(spec: RoadSpec, from_arm: Arm, turn: Turn, lane: int) -> Route:
    offset = spec.lane_center(lane)
    path = _way(from_arm, offset, turn, _tangent(spec, offset, turn), REACH)
    to_arm = _leaves_by(from_arm, turn)
    come, go = (path.xy @ np.array(OUTWARD[arm], dtype=np.float64) for arm in (from_arm, to_arm))
    return Route(
        path=path,
        stop_s=float(np.interp(-spec.stop_line[1], -come, path.s)),
        enter_s=float(np.interp(-spec.mouth, -come, path.s)),
        exit_s=float(np.interp(spec.mouth, go, path.s)),
        from_arm=from_arm,
        to_arm=to_arm,
        turn=turn,
        lane=lane,
    )


def _way(arm: Arm, offset: float, turn: Turn, tangent: float, reach: float) -> Path:
    """The path from an arm over the junction, `offset` metres right of the middle lines, `reach` metres on each arm."""
    start = _on_arm(arm, np.array([reach]), np.array([offset]))[0]
    x, y = OUTWARD[arm]
    place, yaw = (float(start[0]), float(start[1])), float(np.arctan2(-y, -x))
    if turn == "straight":
        return straight(place, yaw, 2 * reach)
    side = 1 if turn == "left" else -1
    run = reach + side * offset - tangent
    return bent(
        place, yaw, [(run, 0.0, 0.0), *quarter_turn(tangent, left=turn == "left"), (run, 0.0, 0.0)]
    )


def _tangent(spec: RoadSpec, offset: float, turn: Turn) -> float:
    """Metres before the crossing of the lanes where a turn begins: as wide as kerb and usual driving allow."""
    if turn == "left":
        return tangent_of_radius(_LEFT_RADIUS)
    kerb = np.sqrt(2) * (spec.road_edge - offset) + (np.sqrt(2) - 1) * KERB_RADIUS
    return min(tangent_of_corner(float(kerb) - _CLEARANCE), tangent_of_radius(_MAX_RIGHT_RADIUS))


def _leaves_by(arm: Arm, turn: Turn) -> Arm:
    return ARMS[(ARMS.index(arm) + _QUARTERS[turn]) % len(ARMS)]


def _on_arm(arm: Arm, along: FloatArray, beside: FloatArray) -> FloatArray:
    """Points (N, 2) at metres outward and to the left of an arm's middle line, seen outward."""
    x, y = OUTWARD[arm]
    return np.column_stack([along * x - beside * y, along * y + beside * x])
