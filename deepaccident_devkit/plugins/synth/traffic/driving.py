"""Road users: their paths, their speeds (intelligent driver model), their wheels (bicycle model).

The paths of all road users are in one table, so that one look-up serves all of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from deepaccident_devkit.plugins.synth.actors import Body
from deepaccident_devkit.plugins.synth.roads import Arm, Junction, Route, Turn, straight
from deepaccident_devkit.plugins.synth.roads.layout import OUTWARD, RoadSpec, point_on_arm
from deepaccident_devkit.plugins.synth.roads.paths import Path, ahead_and_left, shift_path
from deepaccident_devkit.plugins.synth.spec.model import Role, Rule, Side
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray

PERIOD = 0.02
"""Length of a simulated step, seconds."""
DECISION_STEPS = 5
"""Steps from one decision of a driver to the next: drivers decide every tenth of a second."""
WHEELBASE = 0.6
"""Distance between the axles as a share of the body's length."""
MAX_STEER = np.deg2rad(38.0)
_MAX_TANGENT = np.tan(MAX_STEER)
MAX_STEER_RATE = 0.6
"""Fastest turn of the front wheels, radians a second."""
HARDEST_BRAKING = 8.0
"""The hardest braking on dry asphalt, m/s²."""
# The steering aims to be on the path again after a distance: a constant part, and a part for each
# m/s of speed.
_LOOK_AHEAD_M = 2.5
_LOOK_AHEAD_S = 0.25
_TABLE_SPACING_M = 0.25
# Length for which the table goes straight on after the end of a path.
_EXTENSION_M = 80.0
# Braking of drivers before a bend, m/s².
_BEND_BRAKING = 1.8
# Braking for each m/s above the allowed speed, 1/s.
_SPEED_STIFFNESS = 2.5
# The hardest braking near standstill, m/s², and its increase for each m/s of speed.
_STANDSTILL_BRAKING = 3.0
_BRAKING_INCREASE = 1.0
# Smaller gaps count as this one.
_MIN_GAP_M = 0.1
# Paths can cross from the first distance before the stop line to the second one past the junction.
_MARGIN_BEFORE_STOP_LINE_M = 4.0
_MARGIN_AFTER_EXIT_M = 10.0
# Distance from the lane's middle to the right, where cyclists ride.
_CYCLIST_OFFSET_M = 1.1
# Distance from the kerb to the point at which a pedestrian waits to step onto the road.
_KERB_DISTANCE_M = 0.7
WALKER = "pedestrian"
Stretch = tuple[float, float, float]
"""Start and end of a stretch of a path, metres along it, and the maximum speed on it, m/s."""


@dataclass(slots=True, eq=False)
class MotionState:
    """The state of all road users between two steps of the simulation, one row for each.

    Attributes:
        x: Positions x of the middle of the rear axle, shape (A,), metres.
        y: Positions y of the same point, shape (A,), metres.
        yaw: Headings, shape (A,), radians.
        speed: Speeds of the rear axle, shape (A,), m/s, at least 0.
        steer: Angles of the front wheels, shape (A,), radians, positive to the left.
        along: Positions of the rear axle along its path, shape (A,), metres.
    """

    x: FloatArray
    y: FloatArray
    yaw: FloatArray
    speed: FloatArray
    steer: FloatArray
    along: FloatArray


def step_motion(
    state: MotionState, acceleration: FloatArray, on_path: FloatArray, wheelbase: FloatArray
) -> None:
    """Move all road users by one period, in place.

    For road users without wheels only `speed` and `along` are valid.

    Args:
        state: State of the road users.
        acceleration: Accelerations, shape (A,), m/s².
        on_path: Rows x, y, yaw, curvature of the paths at `state.along`, shape (4, A).
        wheelbase: Wheelbases, shape (A,), metres, infinite for road users without wheels.
    """
    mean_speed = state.speed + acceleration * (PERIOD / 2)
    distance = np.maximum(mean_speed, 0.0) * PERIOD
    state.speed = np.maximum(state.speed + acceleration * PERIOD, 0.0)
    path_x, path_y, path_yaw, curvature = on_path
    _, lateral = ahead_and_left(state.x - path_x, state.y - path_y, path_yaw)
    angle = (state.yaw - path_yaw + np.pi) % (2 * np.pi) - np.pi
    state.along = state.along + distance * np.cos(angle) / (1.0 - curvature * lateral)
    steer = _compute_steer(state.speed, lateral, angle, curvature, wheelbase)
    max_change = MAX_STEER_RATE * PERIOD
    change = np.minimum(np.maximum(steer - state.steer, -max_change), max_change)
    state.steer = state.steer + change
    turn = distance * np.tan(state.steer) / wheelbase
    mean_yaw = state.yaw + turn / 2
    state.x = state.x + distance * np.cos(mean_yaw)
    state.y = state.y + distance * np.sin(mean_yaw)
    state.yaw = state.yaw + turn


def _compute_steer(
    speed: FloatArray,
    lateral: FloatArray,
    angle: FloatArray,
    curvature: FloatArray,
    wheelbase: FloatArray,
) -> FloatArray:
    """Return the steering angles (A,), radians, that follow the path and return to it.

    The return is critically damped over the distance ahead.

    Args:
        speed: Speeds, shape (A,), m/s.
        lateral: Distances to the left of the path, shape (A,), metres.
        angle: Angles from the path's direction, shape (A,), radians, positive to the left.
        curvature: Curvatures of the paths, shape (A,), 1/m.
        wheelbase: Wheelbases, shape (A,), metres, infinite for road users without wheels.
    """
    look_ahead = _LOOK_AHEAD_M + _LOOK_AHEAD_S * speed
    target = curvature - lateral / look_ahead**2 - 2 * angle / look_ahead
    max_curvature = _MAX_TANGENT / wheelbase
    bounded = np.minimum(np.maximum(target, -max_curvature), max_curvature)
    finite_wheelbase = np.where(wheelbase < np.inf, wheelbase, 0.0)
    return np.asarray(np.arctan(finite_wheelbase * bounded))


class Tracks:
    """A table of points along each path, and of the speeds that the bends of the path allow.

    It has one row for each road user.

    Args:
        paths: Path of each road user; it goes straight on after its end.
        lateral: Highest sideways accelerations in bends, shape (A,), m/s².
        stops: Whether each road user stops at the end of its path, shape (A,), bool.
        paces: Slow stretches of each road user; drivers do not brake in advance for them.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        lateral: FloatArray,
        stops: BoolArray,
        paces: Sequence[Sequence[Stretch]] = (),
    ) -> None:
        lengths = [path.length for path in paths]
        along = np.arange(0.0, max(lengths) + _EXTENSION_M, _TABLE_SPACING_M)
        distinct_paths = {id(path): path for path in paths}
        row_by_path = {key: row for row, key in enumerate(distinct_paths)}
        tables = [np.stack(path.at(along), axis=-1) for path in distinct_paths.values()]
        points = np.stack(tables)
        rows = np.array([row_by_path[id(path)] for path in paths])
        self._points = points  # (P, K, 4)
        self._path_rows = rows  # (A,)
        ends = np.where(stops, lengths, np.inf)
        self._allowed = _compute_allowed_speed(along, points[rows, :, 3], lateral, ends)
        for row, pace in enumerate(paces):
            for begin, end, max_speed in pace:
                cells = slice(*np.searchsorted(along, (begin, end)))
                self._allowed[row, cells] = np.minimum(self._allowed[row, cells], max_speed)
        self._flat_points = np.ascontiguousarray(points.reshape(-1, 4).T)
        self._flat_offsets = rows * len(along)
        self._rows = np.arange(len(paths))
        self._last_cell = len(along) - 2

    def at(self, along: FloatArray) -> FloatArray:
        """Return rows x, y, yaw, curvature (4, A) of the paths at `along` (A,), metres."""
        cell, share = self._locate_cell(along)
        flat_cell = self._flat_offsets + cell
        before = self._flat_points[:, flat_cell]
        after = self._flat_points[:, flat_cell + 1]
        points: FloatArray = before + share * (after - before)
        return points

    def points_near(self, rows: IntArray, along: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the points of the table that are nearest to positions on some paths.

        Args:
            rows: Rows of the road users with the paths, shape (P,).
            along: Positions along each path, shape (P, K), metres.

        Returns:
            x, y, yaw, curvature (P, K, 4) of the points, and their positions (P, K) along the
            paths, metres.
        """
        nearest = np.rint(along / _TABLE_SPACING_M).astype(np.int64)
        cells = nearest.clip(0, self._last_cell)
        path_rows = self._path_rows[rows, None]
        return self._points[path_rows, cells], cells * _TABLE_SPACING_M

    def allowed_speed(self, along: FloatArray) -> FloatArray:
        """Return the highest speeds (A,), m/s, from which drivers can brake gently for bends."""
        cell, _ = self._locate_cell(along)
        return np.asarray(self._allowed[self._rows, cell])

    def _locate_cell(self, along: FloatArray) -> tuple[IntArray, FloatArray]:
        """Return the cells (A,) of the table at positions (A,), and the shares of them passed."""
        position = along / _TABLE_SPACING_M
        cell = np.minimum(np.maximum(position, 0.0), self._last_cell).astype(np.int64)
        return cell, position - cell


def _compute_allowed_speed(
    along: FloatArray, curvature: FloatArray, lateral: FloatArray, ends: FloatArray
) -> FloatArray:
    """Return the speeds (A, K), m/s, from which drivers reach the bends ahead slowly enough.

    Args:
        along: Positions along the paths, shape (K,), metres.
        curvature: Curvatures of the paths there, shape (A, K), 1/m.
        lateral: Highest sideways accelerations in bends, shape (A,), m/s².
        ends: Positions at which road users stop, shape (A,), metres; infinite for those that drive
            on.
    """
    square_speed = lateral[:, None] / np.maximum(np.abs(curvature), 1e-4)
    square_speed[along >= ends[:, None]] = 0.0
    braking_term = 2 * _BEND_BRAKING * along
    reversed_sums = (square_speed + braking_term)[:, ::-1]
    lowest_ahead = np.minimum.accumulate(reversed_sums, axis=1)[:, ::-1]
    return np.sqrt(np.maximum(lowest_ahead - braking_term, 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class IdmParameters:
    """Parameters of the intelligent driver model, one row for each road user.

    Treiber, Hennecke and Helbing 2000 name the parameters.

    Attributes:
        max_speed: Speeds on a free straight road, shape (A,), m/s.
        acceleration: Accelerations from standstill, shape (A,), m/s².
        braking: Comfortable braking, shape (A,), m/s².
        slowing: The hardest braking to the speed that a bend allows, shape (A,), m/s².
        time_gap: Time gaps to the road user ahead, shape (A,), seconds.
        min_gap: Gaps when standing, bumper to bumper, shape (A,), metres.
    """

    max_speed: FloatArray
    acceleration: FloatArray
    braking: FloatArray
    slowing: FloatArray
    time_gap: FloatArray
    min_gap: FloatArray


def free_acceleration(
    parameters: IdmParameters, speed: FloatArray, allowed: FloatArray
) -> FloatArray:
    """Return the accelerations (A,), m/s², if no road user is in the way.

    Args:
        parameters: Parameters of the road users.
        speed: Speeds, shape (A,), m/s.
        allowed: Speeds that the bends ahead allow, shape (A,), m/s.
    """
    speed_ratio = speed / parameters.max_speed
    on_straight = parameters.acceleration * (1.0 - speed_ratio**4)
    in_bend = np.maximum(_SPEED_STIFFNESS * (allowed - speed), -parameters.slowing)
    acceleration = np.minimum(on_straight, in_bend)
    return np.clip(acceleration, -HARDEST_BRAKING, None)


def hardest_braking(speed: FloatArray) -> FloatArray:
    """Return the hardest braking (A,), m/s², at speeds (A,), m/s.

    At low speeds, the hardest braking is gentler.
    """
    braking = _STANDSTILL_BRAKING + _BRAKING_INCREASE * speed
    return np.minimum(braking, HARDEST_BRAKING)


def following_acceleration(
    parameters: IdmParameters, speed: FloatArray, gap: FloatArray, leader_speed: FloatArray
) -> FloatArray:
    """Return the accelerations (A,), m/s², 0 or less, that the road users ahead cause.

    Args:
        parameters: Parameters of the road users.
        speed: Speeds, shape (A,), m/s.
        gap: Gaps to the road users ahead, shape (A,), metres; infinite without one.
        leader_speed: Speeds of the road users ahead along the same path, shape (A,), m/s.
    """
    return _compute_interaction(
        parameters, speed, gap, leader_speed, parameters.min_gap, parameters.time_gap
    )


def stopping_acceleration(
    parameters: IdmParameters, speed: FloatArray, gap: FloatArray
) -> FloatArray:
    """Return the accelerations (A,), m/s², that stop road users before a line.

    Args:
        parameters: Parameters of the road users.
        speed: Speeds, shape (A,), m/s.
        gap: Distances to the line ahead, shape (A,), metres; infinite without a line.
    """
    line_speed = np.zeros_like(speed)
    min_gap = np.full_like(speed, 0.5)
    return _compute_interaction(
        parameters, speed, gap, line_speed, min_gap, 0.3 * parameters.time_gap
    )


def can_stop(parameters: IdmParameters, speed: FloatArray, gap: FloatArray) -> BoolArray:
    """Return which road users (A,) can stop by braking a little harder than comfortably.

    Args:
        parameters: Parameters of the road users.
        speed: Speeds, shape (A,), m/s.
        gap: Distances to the line ahead, shape (A,), metres.
    """
    max_square_speed = 2 * 1.5 * parameters.braking * gap
    return np.asarray(speed**2 <= max_square_speed)


def _compute_interaction(
    parameters: IdmParameters,
    speed: FloatArray,
    gap: FloatArray,
    leader_speed: FloatArray,
    min_gap: FloatArray,
    time_gap: FloatArray,
) -> FloatArray:
    """Return the interaction term (A,), m/s², of the intelligent driver model."""
    acceleration = parameters.acceleration
    gentle_braking = 2 * np.sqrt(acceleration * parameters.braking)
    closing = speed * (speed - leader_speed) / gentle_braking
    target_gap = min_gap + np.maximum(speed * time_gap + closing, 0.0)
    gap_ratio = target_gap / np.maximum(gap, _MIN_GAP_M)
    return np.asarray(-acceleration * gap_ratio**2)


def lane_path(junction: Junction, route: Route, category: str) -> Path:
    """Return the path of a driver or rider on a route."""
    if category != "cyclist":
        return route.path
    return _make_cyclist_path(junction.spec, route.from_arm, route.turn, route.lane)


def lane_span(route: Route) -> tuple[float, float]:
    """Return start and end of the part of a route that may cross others, metres along it."""
    start = route.stop_s - _MARGIN_BEFORE_STOP_LINE_M
    end = route.exit_s + _MARGIN_AFTER_EXIT_M
    return start, end


def distance_to_middle(route: Route) -> float:
    """Return the distance along a route to the middle of the junction, metres."""
    return (route.enter_s + route.exit_s) / 2


def road_crossing(spec: RoadSpec, arm: Arm, along: float, side: Side) -> Path:
    """Return the straight path over an arm's road, from kerb to kerb.

    Args:
        spec: The road.
        arm: The arm.
        along: Distance from the junction's middle, metres.
        side: Side on which the path begins, as a driver towards the junction sees it.
    """
    half_length = spec.road_edge + _KERB_DISTANCE_M
    # The right of a driver inward is the left, seen outward.
    if side == "right":
        sign = 1.0
    else:
        sign = -1.0
    start = point_on_arm(arm, along, sign * half_length)
    outward_x, outward_y = OUTWARD[arm]
    yaw = float(np.arctan2(-sign * outward_x, sign * outward_y))
    return straight(start, yaw, 2 * half_length)


@lru_cache(maxsize=64)
def _make_cyclist_path(spec: RoadSpec, from_arm: Arm, turn: Turn, lane: int) -> Path:
    """Return the path of a cyclist, to the right of the lane's middle."""
    route = Junction(spec).route(from_arm, turn, lane)
    return shift_path(route.path, -_CYCLIST_OFFSET_M)


@dataclass(frozen=True, slots=True)
class DrivingStyle:
    """The driving style of a category.

    Attributes:
        acceleration: Acceleration from standstill, m/s².
        braking: Comfortable braking, m/s².
        time_gap: Time gap to the road user ahead, seconds.
        min_gap: Gap when standing, bumper to bumper, metres.
        lateral: Highest sideways acceleration in a bend, m/s².
        max_speed: Lowest and highest speed on a free straight road, m/s.
        slowing: The hardest braking to the speed that a bend allows, m/s².
    """

    acceleration: float
    braking: float
    time_gap: float
    min_gap: float
    lateral: float
    max_speed: tuple[float, float]
    slowing: float = 4.0


DRIVING_STYLES = {
    "car": DrivingStyle(2.2, 2.5, 0.9, 2.0, 2.8, (8.0, 12.5)),
    "van": DrivingStyle(2.0, 2.4, 0.9, 2.0, 2.5, (7.5, 11.5)),
    "truck": DrivingStyle(1.6, 2.0, 1.2, 2.5, 1.8, (7.0, 10.0)),
    "motorcycle": DrivingStyle(2.8, 2.8, 1.0, 1.8, 3.0, (8.0, 12.5)),
    "cyclist": DrivingStyle(1.0, 1.8, 1.0, 1.2, 2.0, (3.5, 6.0)),
    "pedestrian": DrivingStyle(1.5, 2.0, 0.4, 0.5, 9.0, (0.9, 1.7)),
}
"""Driving styles by category."""
BRISK_STYLES = {
    category: style
    if category == WALKER
    else replace(
        style,
        acceleration=2.0 * style.acceleration,
        braking=2.1 * style.braking,
        time_gap=0.6 * style.time_gap,
        lateral=1.4 * style.lateral,
        slowing=7.0,
    )
    for category, style in DRIVING_STYLES.items()
}
"""Driving styles of late drivers: they speed up and brake harder, and follow more closely."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RoadUser:
    """A road user that moves.

    Attributes:
        role: Role in the scenario.
        body: Size and shape.
        path: Path of its middle axis.
        start: Position of its box's centre along its path at the start, metres.
        start_speed: Speed at the start, m/s.
        max_speed: Speed that it reaches on a free straight road, m/s.
        delay: Time that it stands before it starts to move, seconds.
        route: Route over the junction; None for a pedestrian.
        span: Start and end of the part of its path that may cross others, metres; empty for a
            pedestrian who stays on the sidewalk.
        ignores: Rules that it breaks.
        alert: Seconds before a contact at which it notices the other of the pair; 0 if it never
            does.
        pace: Stretches of its path where it is slow although the path is free.
        brisk: Whether it drives with a style of `BRISK_STYLES`.
    """

    # identity
    role: Role
    body: Body
    # path and start
    path: Path
    start: float
    start_speed: float
    max_speed: float
    delay: float = 0.0
    route: Route | None = None
    span: tuple[float, float] = (0.0, 0.0)
    # behaviour
    ignores: tuple[Rule, ...] = ()
    alert: float = 0.0
    pace: tuple[Stretch, ...] = ()
    brisk: bool = False

    @property
    def walks(self) -> bool:
        """Whether it has no wheels."""
        return self.body.category == WALKER

    @property
    def style(self) -> DrivingStyle:
        """Its driving style."""
        if self.brisk:
            styles = BRISK_STYLES
        else:
            styles = DRIVING_STYLES
        return styles[self.body.category]

    @property
    def wheelbase(self) -> float:
        """Its wheelbase, metres; 0 without wheels."""
        if self.walks:
            return 0.0
        return WHEELBASE * self.body.size[0]

    def obeying(self) -> "RoadUser":
        """Return the same road user, which obeys all rules."""
        return replace(self, ignores=())


def idm_parameters(users: Sequence[RoadUser]) -> IdmParameters:
    """Return the parameters of road users as arrays."""
    return IdmParameters(
        max_speed=_gather_numbers(users, lambda user: user.max_speed),
        acceleration=_gather_numbers(users, lambda user: user.style.acceleration),
        braking=_gather_numbers(users, lambda user: user.style.braking),
        slowing=_gather_numbers(users, lambda user: user.style.slowing),
        time_gap=_gather_numbers(users, lambda user: user.style.time_gap),
        min_gap=_gather_numbers(users, lambda user: user.style.min_gap),
    )


def _gather_numbers(
    users: Sequence[RoadUser], read_number: Callable[[RoadUser], float]
) -> FloatArray:
    """Return a number of each road user as an array (A,)."""
    numbers = [read_number(user) for user in users]
    return np.array(numbers, dtype=np.float64)
