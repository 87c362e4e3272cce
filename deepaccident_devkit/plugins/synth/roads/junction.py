"""A junction, its ground as a raster of codes, and its routes, stop lines and sidewalks."""

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
    point_on_arm,
    slot_edges,
)
from deepaccident_devkit.plugins.synth.roads.paths import (
    Meeting,
    Path,
    crossing,
    join_pieces,
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
# Semantic tags of CARLA that the reference renderer does not use.
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
# Length of a tooth of a yield line, and distance from one tooth to the next, metres.
_TOOTH_LENGTHS = (0.5, 0.9)
_HALF_LINE_WIDTH_M = 0.06
# Distances from the middle of the road to the edges of each of the two middle lines, metres.
_MIDDLE_LINE_EDGES = (0.05, 0.2)
# Approximate width of the stripes of a crosswalk, and of the gaps between them.
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
        """Return the codes (N,) at points (N, 2), metres; `TERRAIN` beyond the map."""
        cells = np.floor((xy + MAP_EXTENT) / MAP_RESOLUTION).astype(np.int64)
        is_on_axis = (cells >= 0) & (cells < MAP_CELLS)
        is_on_map: BoolArray = np.asarray(is_on_axis.all(axis=-1))
        column, row = np.where(is_on_map[..., None], cells, 0).T
        codes = self.codes[row, column]
        return np.where(is_on_map, codes, np.uint8(TERRAIN))

    def with_rectangles(self, rectangles: FloatArray, codes: NDArray[np.uint8]) -> "GroundMap":
        """Return a new map with axis-parallel rectangles, painted in order.

        Args:
            rectangles: x from, x to, y from, y to, shape (R, 4), metres.
            codes: Codes of the rectangles, shape (R,).
        """
        painted = self.codes.copy()
        edges = np.rint((rectangles + MAP_EXTENT) / MAP_RESOLUTION)
        cells = edges.astype(int).clip(0, MAP_CELLS).tolist()
        for (left, right, bottom, top), code in zip(cells, codes.tolist(), strict=True):
            painted[bottom:top, left:right] = code
        return GroundMap(painted)


def cell_axis() -> FloatArray:
    """Return the coordinate of the middle of each cell along x or y, shape (3000,), metres."""
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
    zones = np.digitize(np.abs(axis), (spec.road_edge, spec.sidewalk_edge))
    zone_codes = np.array([ROAD, SIDEWALK, GRASS], dtype=np.uint8)[zones]
    # Where two roads cross, the lower code is nearer to the traffic.
    codes = np.minimum.outer(zone_codes, zone_codes)
    if spec.kind == "three-way":
        is_north = axis > spec.road_edge
        codes[is_north] = zone_codes[is_north, None]
    views = {arm: _view_outward(codes, arm) for arm in spec.arms}
    for arm, view in views.items():
        if _has_left_neighbour(arm, spec):
            _round_left_corner(view, axis, spec)
    for arm, view in views.items():
        _paint_arm(view, axis, spec, yields=arm in spec.yielding_arms)
    return GroundMap(codes)


def _view_outward(codes: ByteArray, arm: Arm) -> ByteArray:
    """Return a view of the map along an arm.

    Its columns go outward from the middle, its rows from the arm's right to its left.
    """
    if arm in ("west", "east"):
        view = codes
    else:
        view = codes.T
    if arm in ("west", "north"):
        view = view[::-1]
    if arm in ("east", "north"):
        return view[:, _HALF_CELLS:]
    return view[:, _HALF_CELLS - 1 :: -1]


def _has_left_neighbour(arm: Arm, spec: RoadSpec) -> bool:
    """Return whether there is an arm to the left of an arm, seen outward."""
    x, y = OUTWARD[arm]
    directions = [OUTWARD[other] for other in spec.arms]
    return (-y, x) in directions


def _round_left_corner(view: ByteArray, axis: FloatArray, spec: RoadSpec) -> None:
    """Round the corner between an arm and the arm to its left, in place.

    Args:
        view: View of the map along the arm.
        axis: Coordinates of the cells, as from `cell_axis`.
        spec: The road.
    """
    along = axis[_HALF_CELLS:]
    low = spec.road_edge
    high = spec.road_edge + KERB_RADIUS
    rows = np.flatnonzero((axis > low) & (axis < high))
    columns = np.flatnonzero((along > low) & (along < high))
    row_offsets = axis[rows, None] - high
    column_offsets = along[None, columns] - high
    distances = np.hypot(row_offsets, column_offsets)
    corner = view[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    corner[distances > KERB_RADIUS] = ROAD


def _paint_arm(view: ByteArray, to_left: FloatArray, spec: RoadSpec, *, yields: bool) -> None:
    """Paint the lines of one arm, in place.

    Seen outward, traffic towards the junction drives on the left side.

    Args:
        view: View of the map along the arm.
        to_left: Distances of its rows to the left of the middle line, metres.
        spec: The road.
        yields: Whether the arm has a yield line.
    """
    along = to_left[_HALF_CELLS:]
    line_start, line_end = spec.stop_line
    before_line = along > line_end
    from_middle = np.abs(to_left)
    dashes = before_line & _mark_stretches(along, *_DASH_LENGTHS)
    line_inner, line_outer = _MIDDLE_LINE_EDGES
    middle_rows = (from_middle > line_inner) & (from_middle < line_outer)
    _paint_lines(view, middle_rows, before_line, YELLOW)
    for number in range(1, spec.lanes + 1):
        lane_edge_rows = np.abs(from_middle - number * LANE_WIDTH) < _HALF_LINE_WIDTH_M
        _paint_lines(view, lane_edge_rows, dashes, WHITE)
    parking_rows = (from_middle > spec.lanes_edge) & (from_middle < spec.road_edge)
    to_slot_edges = np.abs(along[:, None] - slot_edges(spec)).min(axis=1)
    _paint_lines(view, parking_rows, to_slot_edges < _HALF_LINE_WIDTH_M, WHITE)
    low, high = spec.crosswalk
    crosswalk_columns = (along > low) & (along < high)
    _paint_lines(view, _mark_stripes(to_left, spec.road_edge), crosswalk_columns, WHITE)
    if spec.signalized or yields:
        line_rows = (to_left > line_outer) & (to_left < spec.lanes_edge)
        if yields:
            line_rows = line_rows & _mark_stretches(to_left, *_TOOTH_LENGTHS)
        line_columns = (along > line_start) & (along < line_end)
        _paint_lines(view, line_rows, line_columns, WHITE)


def _mark_stripes(to_left: FloatArray, kerb: float) -> BoolArray:
    """Mark the rows of a crosswalk's stripes: one stripe in the middle, and a gap at each kerb.

    Args:
        to_left: Distances of the rows to the left of the middle line, metres.
        kerb: Distance from the middle line to the kerb, metres.
    """
    num_pairs = round((2 * kerb / _STRIPE_WIDTH_M - 3) / 4)
    width = 2 * kerb / (4 * num_pairs + 3)
    is_on_road = np.abs(to_left) < kerb
    return _mark_stretches(to_left, width, 2 * width) & is_on_road


def _mark_stretches(values: FloatArray, length: float, period: float) -> BoolArray:
    """Mark the values on stretches of a length, one in each period; one is centred at 0."""
    position = (np.abs(values) + length / 2) % period
    return np.asarray(position < length)


def _paint_lines(view: ByteArray, rows: BoolArray, columns: BoolArray, code: int) -> None:
    """Paint the cells of marked rows and columns, in place, where they are road."""
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
        from_arm: Arm that the route comes from.
        to_arm: Arm where the route leaves the junction.
        turn: Turn between the two arms.
        lane: Number of its lane on both arms; 0 is the rightmost lane.
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
        possible_turns = [turn for turn in TURNS if _find_exit_arm(from_arm, turn) in self.arms]
        return tuple(possible_turns)

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
        possible_turns = self.turns(from_arm)
        if turn not in possible_turns:
            raise ConfigError(
                f"turn: {turn!r} is impossible from the {from_arm} arm of a {self.spec.kind} "
                f"junction; choose one of {', '.join(possible_turns)}"
            )
        last_lane = self.spec.lanes - 1
        if lane is None:
            lane = last_lane if turn == "left" else 0
        if not 0 <= lane <= last_lane:
            raise ConfigError(f"lane: expected 0 to {last_lane}, found {lane}")
        return _make_route(self.spec, from_arm, turn, lane)

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
            None if they never meet, or come from the same lane.
        """
        if route_a.from_arm == route_b.from_arm and route_a.lane == route_b.lane:
            return None
        return _find_meeting(route_a, route_b)

    def stop_line(self, arm: Arm) -> FloatArray:
        """Return the ends (2, 2) of the line where traffic from an arm stops, metres.

        The line reaches from the middle line to the lanes' edge.
        """
        self._check_arm(arm)
        along = np.full(2, self.spec.stop_line[1])
        to_left = np.array([0.0, self.spec.lanes_edge])
        x, y = point_on_arm(arm, along, to_left)
        return readonly(np.column_stack([x, y]))

    def crosswalk(self, arm: Arm) -> Path:
        """Return the path across an arm's road, between the sidewalks, whether marked or not.

        Seen outward, it goes from right to left.
        """
        self._check_arm(arm)
        along = float(np.mean(self.spec.crosswalk))
        half_length = self.spec.road_edge + _WALK_INSET_M
        start_x, start_y = point_on_arm(arm, along, -half_length)
        end_x, end_y = point_on_arm(arm, along, half_length)
        yaw = float(np.arctan2(end_y - start_y, end_x - start_x))
        return straight((start_x, start_y), yaw, 2 * half_length)

    def sidewalk_paths(self) -> tuple[Path, ...]:
        """Return the paths of the sidewalks, one around each corner.

        A three-way junction has one more, along the side where it has no arm.
        """
        offset = self.spec.road_edge + _WALK_INSET_M
        paths = []
        for arm in self.arms:
            if _find_exit_arm(arm, "right") in self.arms:
                paths.append(
                    _make_turning_path(arm, offset, "right", _WALK_TANGENT_M, _WALK_REACH_M)
                )
        if self.spec.kind == "three-way":
            paths.append(straight((-_WALK_REACH_M, offset), 0.0, 2 * _WALK_REACH_M))
        return tuple(paths)

    def parking_places(self) -> FloatArray:
        """Return x, y (metres), yaw (radians) of the middles of all parking slots, shape (N, 3)."""
        return readonly(parking_places(self.spec))

    def ground_map(self) -> GroundMap:
        """Return the map of the ground's surface."""
        return paint_junction(self.spec)

    def _check_arm(self, arm: Arm) -> None:
        """Raise ConfigError unless the junction has an arm."""
        if arm not in self.arms:
            raise ConfigError(
                f"arm: a {self.spec.kind} junction has no {arm!r} arm; "
                f"choose one of {', '.join(self.arms)}"
            )


@lru_cache(maxsize=64)
def _find_meeting(route_a: Route, route_b: Route) -> Meeting | None:
    """Return the point where two routes first meet; None if they never meet."""
    return crossing(route_a.path, route_b.path)


@lru_cache(maxsize=64)
def _make_route(spec: RoadSpec, from_arm: Arm, turn: Turn, lane: int) -> Route:
    """Make a route over the junction."""
    offset = spec.lane_center(lane)
    tangent = _choose_tangent(spec, offset, turn)
    path = _make_turning_path(from_arm, offset, turn, tangent, ROUTE_REACH)
    to_arm = _find_exit_arm(from_arm, turn)
    along_from_arm = path.xy @ np.array(OUTWARD[from_arm], dtype=np.float64)
    along_to_arm = path.xy @ np.array(OUTWARD[to_arm], dtype=np.float64)
    return Route(
        path=path,
        stop_s=float(np.interp(-spec.stop_line[1], -along_from_arm, path.s)),
        enter_s=float(np.interp(-spec.mouth, -along_from_arm, path.s)),
        exit_s=float(np.interp(spec.mouth, along_to_arm, path.s)),
        from_arm=from_arm,
        to_arm=to_arm,
        turn=turn,
        lane=lane,
    )


def _make_turning_path(arm: Arm, offset: float, turn: Turn, tangent: float, reach: float) -> Path:
    """Return the path from an arm over the junction.

    Args:
        arm: The arm.
        offset: Distance to the right of the middle lines, metres.
        turn: The turn.
        tangent: Distance before the crossing of the lanes where the turn begins, metres.
        reach: Length of the path on each arm, metres.
    """
    start = point_on_arm(arm, reach, offset)
    outward_x, outward_y = OUTWARD[arm]
    yaw = float(np.arctan2(-outward_y, -outward_x))
    if turn == "straight":
        return straight(start, yaw, 2 * reach)
    is_left = turn == "left"
    side = 1 if is_left else -1
    line = (reach + side * offset - tangent, 0.0, 0.0)
    return join_pieces(start, yaw, [line, *quarter_turn(tangent, left=is_left), line])


def _choose_tangent(spec: RoadSpec, offset: float, turn: Turn) -> float:
    """Return the distance before the crossing of the lanes where a turn begins, metres.

    A turn is as wide as the kerb and usual driving allow.

    Args:
        spec: The road.
        offset: Distance of the lane to the right of the middle line, metres.
        turn: The turn.
    """
    if turn == "left":
        return tangent_of_radius(_LEFT_RADIUS_M)
    diagonal = np.sqrt(2)
    kerb_distance = diagonal * (spec.road_edge - offset) + (diagonal - 1) * KERB_RADIUS
    corner_tangent = tangent_of_corner(float(kerb_distance) - _KERB_CLEARANCE_M)
    return min(corner_tangent, tangent_of_radius(_MAX_RIGHT_RADIUS_M))


def _find_exit_arm(arm: Arm, turn: Turn) -> Arm:
    """Return the arm where traffic from an arm leaves the junction after a turn."""
    index = ARMS.index(arm) + _ARMS_TO_EXIT[turn]
    return ARMS[index % len(ARMS)]
