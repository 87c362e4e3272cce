"""A junction: its ground as a raster of codes, and its routes, stop lines and sidewalks."""

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

MAP_EXTENT = EXTENT
"""The raster covers −`MAP_EXTENT` to `MAP_EXTENT` in x and y, metres."""
MAP_RESOLUTION = 0.1
MAP_CELLS = 3000
TERRAIN, ROAD, WHITE, YELLOW, SIDEWALK, GRASS, TREE, POLE = range(8)
FIRST_BUILDING = 16
ROAD_CODES = (ROAD, WHITE, YELLOW)
"""The codes of the road's surface, on which vehicles drive."""
# CARLA's semantic tags that the reference renderer does not use.
_TAG_BUILDING, _TAG_POLE, _TAG_VEGETATION, _TAG_GROUND, _TAG_TERRAIN = 1, 5, 9, 14, 22
_TAG_BY_CODE = {
    TERRAIN: _TAG_TERRAIN,
    ROAD: TAGS["road"],
    WHITE: TAGS["road_line"],
    YELLOW: TAGS["road_line"],
    SIDEWALK: TAGS["sidewalk"],
    GRASS: _TAG_GROUND,
    TREE: _TAG_VEGETATION,
    POLE: _TAG_POLE,
}
_HALF_CELLS = MAP_CELLS // 2
# Length of a dash, and distance from one dash to the next, metres.
_DASH_LENGTHS = (3.0, 6.0)
# The same two lengths for the teeth of a yield line.
_TOOTH_LENGTHS = (0.5, 0.9)
# Approximate width of a crosswalk's stripes and of the gaps between them.
_STRIPE_WIDTH_M = 0.5
Turn = Literal["straight", "left", "right"]
TURNS: tuple[Turn, ...] = get_args(Turn)
ROUTE_REACH = 140.0
"""Distance from the middle at which routes begin and end, metres."""
_WALK_REACH_M = 110.0
# Distance from the kerb to the line on which pedestrians walk.
_WALK_INSET_M = 1.6
# The smallest distance between the path of a right turn and the kerb.
_KERB_CLEARANCE_M = 1.7
_MAX_RIGHT_RADIUS_M = 9.0
_LEFT_RADIUS_M = 10.0
_WALK_TANGENT_M = 3.0
# Number of arms, counter-clockwise, from the arm of the approach to the exit of each turn.
_ARMS_TO_EXIT: dict[Turn, int] = {"straight": 2, "left": -1, "right": 1}


@dataclass(frozen=True, slots=True, eq=False)
class GroundMap(FrozenArrays):
    """The surface of the ground, as codes of this module; arrays are read-only.

    Attributes:
        codes: Codes, shape (3000, 3000), uint8, row = y index, column = x index: cell (i, j) has
            its middle at x = (j + 0.5) · 0.1 − 150, y = (i + 0.5) · 0.1 − 150.
    """

    codes: ByteArray

    def at(self, xy: FloatArray) -> ByteArray:
        """Return codes (N,) at points (N, 2), metres; `TERRAIN` beyond the map."""
        cells = np.floor((xy + MAP_EXTENT) / MAP_RESOLUTION).astype(np.int64)
        on_axis = (cells >= 0) & (cells < MAP_CELLS)
        on_map: BoolArray = np.asarray(on_axis.all(axis=-1))
        column, row = np.where(on_map[..., None], cells, 0).T
        return np.where(on_map, self.codes[row, column], np.uint8(TERRAIN))

    def with_rectangles(self, rectangles: FloatArray, codes: NDArray[np.uint8]) -> "GroundMap":
        """Return a new map with axis-parallel rectangles, painted in order.

        Args:
            rectangles: x from, x to, y from, y to, shape (R, 4), metres.
            codes: Codes of the rectangles, shape (R,).
        """
        painted = self.codes.copy()
        edges = np.rint((rectangles + MAP_EXTENT) / MAP_RESOLUTION).astype(int).clip(0, MAP_CELLS)
        for (x0, x1, y0, y1), code in zip(edges.tolist(), codes.tolist(), strict=True):
            painted[y0:y1, x0:x1] = code
        return GroundMap(painted)


def cell_axis() -> FloatArray:
    """Return the middles of the cells along x or y, shape (3000,), metres."""
    cells = np.arange(MAP_CELLS, dtype=np.float64)
    return (cells + 0.5) * MAP_RESOLUTION - MAP_EXTENT


def tag_of_code() -> ByteArray:
    """Return CARLA's semantic tag of every code, shape (256,).

    Codes from `FIRST_BUILDING` on are buildings.
    """
    tags = np.full(256, _TAG_BUILDING, dtype=np.uint8)
    for code, tag in _TAG_BY_CODE.items():
        tags[code] = tag
    return tags


@lru_cache(maxsize=4)
def paint_junction(spec: RoadSpec) -> GroundMap:
    """Paint the ground of a junction.

    The latest few maps are cached, because scenarios often share one.
    """
    axis = cell_axis()
    band = np.digitize(np.abs(axis), (spec.road_edge, spec.sidewalk_edge))
    band_codes = np.array([ROAD, SIDEWALK, GRASS], dtype=np.uint8)[band]
    # Where two roads cross, the lower code is nearer to the traffic.
    codes = np.minimum.outer(band_codes, band_codes)
    if spec.kind == "three-way":
        beyond = axis > spec.road_edge
        codes[beyond] = band_codes[beyond, None]
    views = {arm: _outward_view(codes, arm) for arm in spec.arms}
    for arm, view in views.items():
        if _has_left_neighbour(arm, spec):
            _round_left_corner(view, axis, spec)
    for arm, view in views.items():
        _paint_arm(view, axis, spec, yields=arm in spec.yielding_arms)
    return GroundMap(codes)


def _outward_view(codes: ByteArray, arm: Arm) -> ByteArray:
    """Return a view of the map along an arm.

    Its columns go outward from the middle, its rows from the arm's right to its left.
    """
    x, y = OUTWARD[arm]
    view = codes if x else codes.T
    if (x or -y) <= 0:
        view = view[::-1]
    if (x or y) > 0:
        return view[:, _HALF_CELLS:]
    return view[:, _HALF_CELLS - 1 :: -1]


def _has_left_neighbour(arm: Arm, spec: RoadSpec) -> bool:
    """Return whether there is an arm to the left, looking outward."""
    x, y = OUTWARD[arm]
    left = (-y, x)
    return any(OUTWARD[other] == left for other in spec.arms)


def _round_left_corner(view: ByteArray, axis: FloatArray, spec: RoadSpec) -> None:
    """Make the corner between an arm and the one to its left round, in place."""
    along = axis[_HALF_CELLS:]
    low = spec.road_edge
    high = spec.road_edge + KERB_RADIUS
    rows = np.flatnonzero((axis > low) & (axis < high))
    columns = np.flatnonzero((along > low) & (along < high))
    distances = np.hypot(axis[rows, None] - high, along[None, columns] - high)
    patch = view[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    patch[distances > KERB_RADIUS] = ROAD


def _paint_arm(view: ByteArray, beside: FloatArray, spec: RoadSpec, *, yields: bool) -> None:
    """Paint the lines of one arm, in place.

    Seen outward, traffic towards the junction drives on the left side.

    Args:
        view: View of the map along the arm.
        beside: Distances of its rows to the left of the middle line, metres.
        spec: The road.
        yields: Whether the arm has a yield line.
    """
    along = beside[_HALF_CELLS:]
    before_line = along > spec.stop_line[1]
    across = np.abs(beside)
    dashes = before_line & _on_stretches(along, *_DASH_LENGTHS)
    _paint(view, (across > 0.05) & (across < 0.2), before_line, YELLOW)
    for divider in range(1, spec.lanes):
        _paint(view, np.abs(across - divider * LANE_WIDTH) < 0.06, dashes, WHITE)
    _paint(view, np.abs(across - spec.lanes_edge) < 0.06, dashes, WHITE)
    parking_rows = (across > spec.lanes_edge) & (across < spec.road_edge)
    _paint(view, parking_rows, _slot_lines(along, spec), WHITE)
    low, high = spec.crosswalk
    _paint(view, _stripes(beside, spec.road_edge), (along > low) & (along < high), WHITE)
    if spec.signalized or yields:
        line_rows = (beside > 0.2) & (beside < spec.lanes_edge)
        if yields:
            line_rows = line_rows & _on_stretches(beside, *_TOOTH_LENGTHS)
        line_columns = (along > spec.stop_line[0]) & (along < spec.stop_line[1])
        _paint(view, line_rows, line_columns, WHITE)


def _slot_lines(along: FloatArray, spec: RoadSpec) -> BoolArray:
    """Mark the columns of the lines between parking slots."""
    distances = np.abs(along[:, None] - slot_edges(spec))
    return np.asarray(distances.min(axis=1) < 0.06)


def _stripes(beside: FloatArray, kerb: float) -> BoolArray:
    """Mark the rows of a crosswalk's stripes: one stripe in the middle, and a gap at each kerb."""
    num_pairs = round((2 * kerb / _STRIPE_WIDTH_M - 3) / 4)
    width = 2 * kerb / (4 * num_pairs + 3)
    on_road = np.abs(beside) < kerb
    return _on_stretches(beside, width, 2 * width) & on_road


def _on_stretches(values: FloatArray, length: float, period: float) -> BoolArray:
    """Mark values on stretches of a length, one in each period; one is centred at 0."""
    position = (np.abs(values) + length / 2) % period
    return np.asarray(position < length)


def _paint(view: ByteArray, rows: BoolArray, columns: BoolArray, code: int) -> None:
    """Paint the cells of marked rows and columns in place, if they are road."""
    window = np.ix_(rows, columns)
    cells = view[window]
    view[window] = np.where(cells == ROAD, np.uint8(code), cells)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Route(ShortRepr):
    """A route over the junction.

    Attributes:
        path: Path along the middle of the lane, from one end of the ground to the other.
        stop_s: Start of the stop line along the path, metres; a vehicle that has to wait stops
            before it.
        enter_s: Start of the junction along the path, metres.
        exit_s: End of the junction along the path, metres.
        from_arm: Arm that it comes from.
        to_arm: Arm by which it leaves.
        turn: Turn between them.
        lane: Number of its lane on both arms, 0 is the rightmost.
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
        spec: Arms, lanes and edges of the junction.
    """

    spec: RoadSpec = field(default_factory=RoadSpec)

    @property
    def arms(self) -> tuple[Arm, ...]:
        """The arms of the junction."""
        return self.spec.arms

    @property
    def terrain(self) -> Terrain:
        """The height of its ground."""
        return Terrain(self.spec.hump)

    def turns(self, from_arm: Arm) -> tuple[Turn, ...]:
        """Return the possible turns of traffic from an arm."""
        return tuple(turn for turn in TURNS if _exit_arm(from_arm, turn) in self.arms)

    def route(self, from_arm: Arm, turn: Turn, lane: int | None = None) -> Route:
        """Return the route from an arm over the junction.

        Args:
            from_arm: The arm.
            turn: The turn.
            lane: Number of the lane, 0 is the rightmost; by default the leftmost for a left turn,
                otherwise the rightmost.

        Raises:
            ConfigError: The junction has no such arm, turn or lane.
        """
        self._check_arm(from_arm)
        if turn not in self.turns(from_arm):
            raise ConfigError(
                f"turn: nobody can go {turn!r} from the {from_arm} arm of a {self.spec.kind} "
                f"junction; choose one of {', '.join(self.turns(from_arm))}"
            )
        if lane is None:
            lane = self.spec.lanes - 1 if turn == "left" else 0
        if not 0 <= lane < self.spec.lanes:
            raise ConfigError(f"lane: expected 0 to {self.spec.lanes - 1}, found {lane}")
        return _route(self.spec, from_arm, turn, lane)

    def routes(self) -> tuple[Route, ...]:
        """Return all routes over the junction, by arm, turn and lane."""
        routes = []
        for arm in self.arms:
            for turn in self.turns(arm):
                for lane in range(self.spec.lanes):
                    routes.append(self.route(arm, turn, lane))
        return tuple(routes)

    def conflicts(self, route_a: Route, route_b: Route) -> Meeting | None:
        """Return the point where two routes first meet, as distances along each.

        Returns:
            None if they never meet, or come by the same lane.
        """
        if route_a.from_arm == route_b.from_arm and route_a.lane == route_b.lane:
            return None
        return _meeting(route_a, route_b)

    def stop_line(self, arm: Arm) -> FloatArray:
        """Return the line where traffic from an arm stops, shape (2, 2), metres.

        It reaches from the middle line to the lanes' edge.
        """
        self._check_arm(arm)
        along = np.full(2, self.spec.stop_line[1])
        beside = np.array([0.0, self.spec.lanes_edge])
        return readonly(_on_arm(arm, along, beside))

    def crosswalk(self, arm: Arm) -> Path:
        """Return the path across an arm's road, between the sidewalks; marked or not.

        Seen outward, it goes from right to left.
        """
        self._check_arm(arm)
        along = float(np.mean(self.spec.crosswalk))
        beside = self.spec.road_edge + _WALK_INSET_M
        start, end = _on_arm(arm, np.full(2, along), np.array([-beside, beside]))
        x, y = (end - start).tolist()
        return straight((float(start[0]), float(start[1])), float(np.arctan2(y, x)), 2 * beside)

    def sidewalk_paths(self) -> tuple[Path, ...]:
        """Return the sidewalks' paths: one round each corner.

        A three-way junction has one more, along the side where it has no arm.
        """
        beside = self.spec.road_edge + _WALK_INSET_M
        paths = []
        for arm in self.arms:
            if _exit_arm(arm, "right") in self.arms:
                paths.append(_turning_path(arm, beside, "right", _WALK_TANGENT_M, _WALK_REACH_M))
        if self.spec.kind == "three-way":
            paths.append(straight((-_WALK_REACH_M, beside), 0.0, 2 * _WALK_REACH_M))
        return tuple(paths)

    def parking_places(self) -> FloatArray:
        """Return x, y (metres), yaw (radians) of the middles of all parking slots, shape (N, 3)."""
        return readonly(parking_places(self.spec))

    def ground_map(self) -> GroundMap:
        """Return the map of the ground's surface."""
        return paint_junction(self.spec)

    def _check_arm(self, arm: Arm) -> None:
        """Check that the junction has an arm; raises ConfigError."""
        if arm not in self.arms:
            raise ConfigError(
                f"arm: a {self.spec.kind} junction has no {arm!r} arm; "
                f"choose one of {', '.join(self.arms)}"
            )


@lru_cache(maxsize=64)
def _meeting(route_a: Route, route_b: Route) -> Meeting | None:
    """Return the point where two routes first meet; None if they never meet."""
    return crossing(route_a.path, route_b.path)


@lru_cache(maxsize=64)
def _route(spec: RoadSpec, from_arm: Arm, turn: Turn, lane: int) -> Route:
    """Return a route over the junction."""
    offset = spec.lane_center(lane)
    path = _turning_path(from_arm, offset, turn, _tangent(spec, offset, turn), ROUTE_REACH)
    to_arm = _exit_arm(from_arm, turn)
    from_distance = path.xy @ np.array(OUTWARD[from_arm], dtype=np.float64)
    to_distance = path.xy @ np.array(OUTWARD[to_arm], dtype=np.float64)
    return Route(
        path=path,
        stop_s=float(np.interp(-spec.stop_line[1], -from_distance, path.s)),
        enter_s=float(np.interp(-spec.mouth, -from_distance, path.s)),
        exit_s=float(np.interp(spec.mouth, to_distance, path.s)),
        from_arm=from_arm,
        to_arm=to_arm,
        turn=turn,
        lane=lane,
    )


def _turning_path(arm: Arm, offset: float, turn: Turn, tangent: float, reach: float) -> Path:
    """Return the path from an arm over the junction.

    Args:
        arm: The arm.
        offset: Distance to the right of the middle lines, metres.
        turn: The turn.
        tangent: Distance before the crossing of the lanes where the turn begins, metres.
        reach: Length of the path on each arm, metres.
    """
    [start] = _on_arm(arm, np.array([reach]), np.array([offset]))
    x, y = OUTWARD[arm]
    position = (float(start[0]), float(start[1]))
    yaw = float(np.arctan2(-y, -x))
    if turn == "straight":
        return straight(position, yaw, 2 * reach)
    side = 1 if turn == "left" else -1
    run = reach + side * offset - tangent
    line = (run, 0.0, 0.0)
    return bent(position, yaw, [line, *quarter_turn(tangent, left=turn == "left"), line])


def _tangent(spec: RoadSpec, offset: float, turn: Turn) -> float:
    """Return the distance before the crossing of the lanes where a turn begins, metres.

    A turn is as wide as kerb and usual driving allow.
    """
    if turn == "left":
        return tangent_of_radius(_LEFT_RADIUS_M)
    kerb = np.sqrt(2) * (spec.road_edge - offset) + (np.sqrt(2) - 1) * KERB_RADIUS
    corner_tangent = tangent_of_corner(float(kerb) - _KERB_CLEARANCE_M)
    return min(corner_tangent, tangent_of_radius(_MAX_RIGHT_RADIUS_M))


def _exit_arm(arm: Arm, turn: Turn) -> Arm:
    """Return the arm by which traffic from an arm leaves after a turn."""
    index = ARMS.index(arm) + _ARMS_TO_EXIT[turn]
    return ARMS[index % len(ARMS)]


def _on_arm(arm: Arm, along: FloatArray, beside: FloatArray) -> FloatArray:
    """Return points (N, 2) at distances outward and to the left of an arm's middle line, metres.

    Left is as seen outward.
    """
    x, y = OUTWARD[arm]
    ground_x = along * x - beside * y
    ground_y = along * y + beside * x
    return np.column_stack([ground_x, ground_y])
