"""Road users: their paths, how fast they drive (intelligent driver model), and how wheels move them (bicycle model).

The paths of all road users are in one table, so that one look-up serves all of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from deepaccident_devkit.plugins.synth.actors import Body
from deepaccident_devkit.plugins.synth.roads import Arm, Junction, Route, Turn, straight
from deepaccident_devkit.plugins.synth.roads.layout import OUTWARD, RoadSpec
from deepaccident_devkit.plugins.synth.roads.paths import Path, through
from deepaccident_devkit.plugins.synth.spec.model import Role, Rule, Side
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray

# Length of a simulated step, seconds.
PERIOD = 0.02
# Drivers look and decide once in so many steps: every tenth of a second.
DECISION_STEPS = 5
# Distance of the axles as a share of the body's length.
WHEELBASE = 0.6
MAX_STEER = np.deg2rad(38.0)
_MAX_TANGENT = np.tan(MAX_STEER)
# How fast the front wheels can turn, radians a second.
MAX_STEER_RATE = 0.6
# The hardest braking on dry asphalt, m/s².
HARDEST_BRAKING = 8.0
# How far ahead the steering aims to be on the path again: metres, and seconds of driving that are added to them.
_LOOK_AHEAD = (2.5, 0.25)
# Metres between the table's points.
_TABLE_SPACING = 0.25
# Metres that the table goes straight on after a path's end.
_BEYOND = 80.0
# m/s² with which drivers brake before a bend.
_BEND_BRAKING = 1.8
# 1/s: the braking for each m/s above the allowed speed.
_STIFFNESS = 2.5
# The hardest braking near standstill, m/s², and how much harder it can be for each m/s of speed.
_GENTLE_STOP = (3.0, 1.0)
# Metres: a smaller gap counts as this.
_NO_GAP = 0.1
# Metres before the stop line, and metres past the junction, between which paths can cross.
_SPAN = (4.0, 10.0)
# Metres from the lane's middle to the right, where cyclists ride.
_CYCLIST_OFFSET = 1.1
# Metres from the kerb to where a pedestrian waits to step onto the road.
_KERB_ROOM = 0.7
WALKER = "pedestrian"
# Where a part of a path begins and ends, metres along it, and the most speed there, m/s.
Stretch = tuple[float, float, float]


@dataclass(slots=True, eq=False)
class Wheels:
    """Where the road users are, one row each; the state that the simulation steps.

    Attributes:
        x: (A,) x of the middle of the rear axle, metres.
        y: (A,) y of the same point, metres.
        yaw: (A,) radians.
        speed: (A,) speed of the rear axle, m/s, at least 0.
        steer: (A,) angle of the front wheels, radians, positive to the left.
        along: (A,) how far the rear axle is along its path, metres.
    """

    x: FloatArray
    y: FloatArray
    yaw: FloatArray
    speed: FloatArray
    steer: FloatArray
    along: FloatArray


def step(
    wheels: Wheels, acceleration: FloatArray, on_path: FloatArray, wheelbase: FloatArray
) -> None:
    """Move all road users by one period, in place; for those without wheels only `speed` and `along` are valid.

    The acceleration is (A,) m/s², `on_path` (4, A) x, y, yaw, curvature of the paths at `wheels.along`, the wheelbase
    (A,) metres, infinite for those without wheels.
    """
    distance = np.maximum(wheels.speed + acceleration * (PERIOD / 2), 0.0) * PERIOD
    wheels.speed = np.maximum(wheels.speed + acceleration * PERIOD, 0.0)
    lateral, turned = _off_path(wheels, on_path)
    wheels.along = wheels.along + distance * np.cos(turned) / (1.0 - on_path[3] * lateral)
    change = _wanted_steer(wheels.speed, lateral, turned, on_path[3], wheelbase) - wheels.steer
    room = MAX_STEER_RATE * PERIOD
    wheels.steer = wheels.steer + np.minimum(np.maximum(change, -room), room)
    turn = distance * np.tan(wheels.steer) / wheelbase
    middle = wheels.yaw + turn / 2
    wheels.x = wheels.x + distance * np.cos(middle)
    wheels.y = wheels.y + distance * np.sin(middle)
    wheels.yaw = wheels.yaw + turn


def _off_path(wheels: Wheels, on_path: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far each is to the left of its path, metres, and by how much it is turned to the left of it, radians."""
    x, y, yaw, _ = on_path
    lateral = np.cos(yaw) * (wheels.y - y) - np.sin(yaw) * (wheels.x - x)
    turned = (wheels.yaw - yaw + np.pi) % (2 * np.pi) - np.pi
    return lateral, turned


def _wanted_steer(
    speed: FloatArray,
    lateral: FloatArray,
    turned: FloatArray,
    curvature: FloatArray,
    wheelbase: FloatArray,
) -> FloatArray:
    """The steering angle that follows the path and returns to it, critically damped over the distance ahead."""
    ahead = _LOOK_AHEAD[0] + _LOOK_AHEAD[1] * speed
    wanted = curvature - lateral / ahead**2 - 2 * turned / ahead
    most = _MAX_TANGENT / wheelbase
    return np.asarray(
        np.arctan(
            np.where(wheelbase < np.inf, wheelbase, 0.0)
            * np.minimum(np.maximum(wanted, -most), most)
        )
    )


class Tracks:
    """Points along each path, and the speed that its bends allow; one row for each road user.

    `lateral` is (A,) m/s², the most sideways acceleration that each accepts in a bend. Those with `stops` (A,) stop at
    the path's end; others go straight on. `paces` has each one's own stretches, before which nobody brakes in advance.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        lateral: FloatArray,
        stops: BoolArray,
        paces: Sequence[Sequence[Stretch]] = (),
    ) -> None:
        along = np.arange(0.0, max(path.length for path in paths) + _BEYOND, _TABLE_SPACING)
        distinct = {id(path): path for path in paths}
        order = {key: row for row, key in enumerate(distinct)}
        points = np.stack([np.stack(path.at(along), axis=-1) for path in distinct.values()])
        rows = np.array([order[id(path)] for path in paths])
        self._points, self._distinct = points, rows  # (P, K, 4), (A,)
        ends = np.where(stops, [path.length for path in paths], np.inf)
        self._allowed = _allowed_speed(along, points[rows, :, 3], lateral, ends)
        for row, pace in enumerate(paces):
            for begin, end, most in pace:
                cells = slice(*np.searchsorted(along, (begin, end)))
                self._allowed[row, cells] = np.minimum(self._allowed[row, cells], most)
        self._flat = np.ascontiguousarray(points.reshape(-1, 4).T)
        self._first = rows * len(along)
        self._row = np.arange(len(paths))
        self._last = len(along) - 2

    def at(self, along: FloatArray) -> FloatArray:
        """(4, A) x, y, yaw, curvature of the paths at `along` (A,) metres from their starts."""
        low, share = self._cell(along)
        flat = self._first + low
        before = self._flat[:, flat]
        return np.asarray(before + share * (self._flat[:, flat + 1] - before))

    def near(self, rows: IntArray, along: FloatArray) -> tuple[FloatArray, FloatArray]:
        """x, y, yaw, curvature (P, K, 4) of the table's points nearest to `along` (P, K) on the paths of `rows` (P,).

        Second, how far along they are (P, K), metres.
        """
        cells = np.rint(along / _TABLE_SPACING).astype(np.int64).clip(0, self._last)
        return np.asarray(self._points[self._distinct[rows, None], cells]), cells * _TABLE_SPACING

    def allowed_speed(self, along: FloatArray) -> FloatArray:
        """The highest speed (A,) m/s from which drivers can brake comfortably for the bends ahead."""
        low, _ = self._cell(along)
        return np.asarray(self._allowed[self._row, low])

    def _cell(self, along: FloatArray) -> tuple[IntArray, FloatArray]:
        place = along / _TABLE_SPACING
        low = np.minimum(np.maximum(place, 0.0), self._last).astype(np.int64)
        return low, place - low


def _allowed_speed(
    along: FloatArray, curvature: FloatArray, lateral: FloatArray, ends: FloatArray
) -> FloatArray:
    """(A, K) m/s: so slow that each enters the bends ahead slowly enough, and stops at its path's end if it must."""
    bend = lateral[:, None] / np.maximum(np.abs(curvature), 1e-4)
    bend[along >= ends[:, None]] = 0.0
    lead = bend + 2 * _BEND_BRAKING * along
    least = np.minimum.accumulate(lead[:, ::-1], axis=1)[:, ::-1]
    return np.sqrt(np.maximum(least - 2 * _BEND_BRAKING * along, 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class Temper:
    """How road users drive, one row each (Treiber, Hennecke and Helbing 2000 name the parameters).

    Attributes:
        max_speed: (A,) speed on a free straight road, m/s.
        acceleration: (A,) acceleration from standstill, m/s².
        braking: (A,) comfortable braking, m/s².
        slowing: (A,) the hardest braking to the speed that a bend allows, m/s².
        time_gap: (A,) seconds to the road user ahead.
        min_gap: (A,) metres, bumper to bumper, when standing.
    """

    max_speed: FloatArray
    acceleration: FloatArray
    braking: FloatArray
    slowing: FloatArray
    time_gap: FloatArray
    min_gap: FloatArray


def free_acceleration(temper: Temper, speed: FloatArray, allowed: FloatArray) -> FloatArray:
    """The acceleration (A,) m/s² at a speed if nobody is in the way and the bends ahead allow so much, (A,) m/s."""
    own = temper.acceleration * (1.0 - (speed / temper.max_speed) ** 4)
    bend = np.maximum(_STIFFNESS * (allowed - speed), -temper.slowing)
    return np.asarray(np.clip(np.minimum(own, bend), -HARDEST_BRAKING, None))


def hardest_braking(speed: FloatArray) -> FloatArray:
    """The hardest braking (A,) m/s² at a speed (A,) m/s: at low speed nobody brakes hard."""
    return np.minimum(_GENTLE_STOP[0] + _GENTLE_STOP[1] * speed, HARDEST_BRAKING)


def interaction(
    temper: Temper, speed: FloatArray, gap: FloatArray, leader_speed: FloatArray
) -> FloatArray:
    """The acceleration (A,) m/s², 0 or less, that each adds because of the road user ahead.

    The gap is (A,) metres, infinite without one; its speed is that along the same path, (A,) m/s.
    """
    return _interaction(temper, speed, gap, leader_speed, temper.min_gap, temper.time_gap)


def stopping(temper: Temper, speed: FloatArray, gap: FloatArray) -> FloatArray:
    """The acceleration (A,) m/s² to stop before a line `gap` (A,) metres ahead; `gap` is infinite if there is none."""
    return _interaction(
        temper, speed, gap, np.zeros_like(speed), np.full_like(speed, 0.5), 0.3 * temper.time_gap
    )


def can_stop(temper: Temper, speed: FloatArray, gap: FloatArray) -> FloatArray:
    """(A,) bool, whether braking a little harder than comfortably stops it before a line `gap` (A,) metres ahead."""
    return np.asarray(speed**2 <= 2 * 1.5 * temper.braking * gap)


def _interaction(
    temper: Temper,
    speed: FloatArray,
    gap: FloatArray,
    leader_speed: FloatArray,
    min_gap: FloatArray,
    time_gap: FloatArray,
) -> FloatArray:
    closing = speed * (speed - leader_speed) / (2 * np.sqrt(temper.acceleration * temper.braking))
    wanted = min_gap + np.maximum(speed * time_gap + closing, 0.0)
    return np.asarray(-temper.acceleration * (wanted / np.maximum(gap, _NO_GAP)) ** 2)


def lane_way(junction: Junction, route: Route, category: str) -> Path:
    """The path of a driver or rider on a route."""
    return (
        route.path
        if category != "cyclist"
        else _cyclist_path(junction.spec, route.from_arm, route.turn, route.lane)
    )


def lane_span(route: Route) -> tuple[float, float]:
    """Where the part of a route that may cross others begins and ends, metres along it."""
    return route.stop_s - _SPAN[0], route.exit_s + _SPAN[1]


def middle_of(route: Route) -> float:
    """Metres along a route to the middle of the junction."""
    return (route.enter_s + route.exit_s) / 2


def road_crossing(spec: RoadSpec, arm: Arm, along: float, side: Side) -> Path:
    """The straight path over an arm's road, from kerb to kerb, `along` metres from the junction's middle.

    It begins on a side as a driver towards the junction sees it.
    """
    out_x, out_y = OUTWARD[arm]
    beside = spec.road_edge + _KERB_ROOM
    sign = (
        1.0 if side == "right" else -1.0
    )  # the right of a driver inward is the left, seen outward
    left = np.array([-out_y, out_x], dtype=np.float64)
    start = along * np.array([out_x, out_y]) + sign * beside * left
    yaw = float(np.arctan2(-sign * left[1], -sign * left[0]))
    return straight((float(start[0]), float(start[1])), yaw, 2 * beside)


def shifted_path(path: Path, offset: float) -> Path:
    """The same path, `offset` metres further to the left."""
    left = np.stack([-np.sin(path.yaw), np.cos(path.yaw)], axis=1)
    return through(path.xy + offset * left)


@lru_cache(maxsize=64)
def _cyclist_path(spec: RoadSpec, from_arm: Arm, turn: Turn, lane: int) -> Path:
    return shifted_path(Junction(spec).route(from_arm, turn, lane).path, -_CYCLIST_OFFSET)


@dataclass(frozen=True, slots=True)
class Manner:
    """How the drivers of a category drive.

    Attributes:
        acceleration: acceleration from standstill, m/s².
        braking: comfortable braking, m/s².
        time_gap: seconds to the road user ahead.
        min_gap: metres, bumper to bumper, when standing.
        lateral: the most sideways acceleration in a bend, m/s².
        max_speed: least and most speed on a free straight road, m/s.
        slowing: the hardest braking to the speed that a bend allows, m/s².
    """

    acceleration: float
    braking: float
    time_gap: float
    min_gap: float
    lateral: float
    max_speed: tuple[float, float]
    slowing: float = 4.0


# By category.
MANNERS = {
    "car": Manner(2.2, 2.5, 0.9, 2.0, 2.8, (8.0, 12.5)),
    "van": Manner(2.0, 2.4, 0.9, 2.0, 2.5, (7.5, 11.5)),
    "truck": Manner(1.6, 2.0, 1.2, 2.5, 1.8, (7.0, 10.0)),
    "motorcycle": Manner(2.8, 2.8, 1.0, 1.8, 3.0, (8.0, 12.5)),
    "cyclist": Manner(1.0, 1.8, 1.0, 1.2, 2.0, (3.5, 6.0)),
    "pedestrian": Manner(1.5, 2.0, 0.4, 0.5, 9.0, (0.9, 1.7)),
}
# Of drivers who are late: they speed up and brake harder, and follow more closely.
BRISK_MANNERS = {
    category: manner
    if category == WALKER
    else replace(
        manner,
        acceleration=2.0 * manner.acceleration,
        braking=2.1 * manner.braking,
        time_gap=0.6 * manner.time_gap,
        lateral=1.4 * manner.lateral,
        slowing=7.0,
    )
    for category, manner in MANNERS.items()
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RoadUser:
    """A road user that moves.

    Attributes:
        role: its role in the scenario.
        body: its size and shape.
        path: the path of its middle axis.
        start: how far along its path its box's centre starts, metres.
        start_speed: its speed at the start, m/s.
        max_speed: the speed that it reaches on a free straight road, m/s.
        delay: seconds that it stands before it starts to move.
        route: its route over the junction; None for a pedestrian.
        span: where the part of its path that may cross others begins and ends, metres; empty for a pedestrian who
            stays on the sidewalk.
        ignores: the rules that it breaks.
        alert: seconds before a contact at which it notices the other one of the pair; 0 for never.
        pace: stretches of its path where it is slow for reasons of its own.
        brisk: whether it drives as `BRISK_MANNERS` say.
    """

    role: Role
    body: Body
    path: Path
    start: float
    start_speed: float
    max_speed: float
    delay: float = 0.0
    route: Route | None = None
    span: tuple[float, float] = (0.0, 0.0)
    ignores: tuple[Rule, ...] = ()
    alert: float = 0.0
    pace: tuple[Stretch, ...] = ()
    brisk: bool = False

    @property
    def walks(self) -> bool:
        """Whether it has no wheels."""
        return self.body.category == WALKER

    @property
    def manner(self) -> Manner:
        """How it drives."""
        return (BRISK_MANNERS if self.brisk else MANNERS)[self.body.category]

    @property
    def wheelbase(self) -> float:
        """Metres; 0 without wheels."""
        return 0.0 if self.walks else WHEELBASE * self.body.size[0]

    def obeying(self) -> "RoadUser":
        """The same road user, which obeys all rules."""
        return replace(self, ignores=())


def temper_of(users: Sequence[RoadUser]) -> Temper:
    """How they drive, as arrays."""
    return Temper(
        max_speed=_gather(users, lambda user: user.max_speed),
        acceleration=_gather(users, lambda user: user.manner.acceleration),
        braking=_gather(users, lambda user: user.manner.braking),
        slowing=_gather(users, lambda user: user.manner.slowing),
        time_gap=_gather(users, lambda user: user.manner.time_gap),
        min_gap=_gather(users, lambda user: user.manner.min_gap),
    )


def _gather(users: Sequence[RoadUser], value: Callable[[RoadUser], float]) -> FloatArray:
    return np.array([value(user) for user in users], dtype=np.float64)
