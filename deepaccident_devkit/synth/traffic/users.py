"""A road user before the simulation: what it is, its path over the junction, and how it drives."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.synth.actors import Body
from deepaccident_devkit.synth.roads import Arm, Junction, Path, Route, Turn, straight
from deepaccident_devkit.synth.roads.layout import OUTWARD, RoadSpec
from deepaccident_devkit.synth.roads.paths import through
from deepaccident_devkit.synth.spec.model import Role, Rule, Side
from deepaccident_devkit.synth.traffic.driving import WHEELBASE, Temper

_SPAN = (4.0, 10.0)
"""Metres before the stop line, and metres past the junction, between which paths can cross."""
_CYCLIST_OFFSET = 1.1
"""Metres from the lane's middle to the right, where cyclists ride."""
_KERB_ROOM = 0.7
"""Metres from the kerb to where a pedestrian waits to step onto the road."""


def lane_way(junction: Junction, route: Route, category: str) -> Path:
    """The path of a driver or rider on a route."""
    if category != "cyclist":
        return route.path
    return _cyclist_path(junction.spec, route.from_arm, route.turn, route.lane)


def lane_span(route: Route) -> tuple[float, float]:
    """Where the part of a route that may cross others begins and ends, metres along it."""
    return route.stop_s - _SPAN[0], route.exit_s + _SPAN[1]


def middle_of(route: Route) -> float:
    """Metres along a route to the middle of the junction."""
    return (route.enter_s + route.exit_s) / 2


def road_crossing(spec: RoadSpec, arm: Arm, along: float, side: Side) -> Path:
    """The straight path over an arm's road, from kerb to kerb.

    Args:
        spec: the junction's layout.
        arm: which arm.
        along: metres from the junction's middle.
        side: where it begins, as a driver towards the junction sees it.
    """
    out_x, out_y = OUTWARD[arm]
    beside = spec.road_edge + _KERB_ROOM
    sign = 1.0 if side == "right" else -1.0  # the right of a driver inward is the left, seen outward
    left = np.array([-out_y, out_x], dtype=np.float64)
    start = along * np.array([out_x, out_y]) + sign * beside * left
    yaw = float(np.arctan2(-sign * left[1], -sign * left[0]))
    return straight((float(start[0]), float(start[1])), yaw, 2 * beside)


def shifted(path: Path, offset: float) -> Path:
    """The same path, `offset` metres further to the left."""
    left = np.stack([-np.sin(path.yaw), np.cos(path.yaw)], axis=1)
    return through(path.xy + offset * left)


@lru_cache(maxsize=64)
def _cyclist_path(spec: RoadSpec, from_arm: Arm, turn: Turn, lane: int) -> Path:
    return shifted(Junction(spec).route(from_arm, turn, lane).path, -_CYCLIST_OFFSET)


WALKER = "pedestrian"


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
    """

    acceleration: float
    braking: float
    time_gap: float
    min_gap: float
    lateral: float
    max_speed: tuple[float, float]


MANNERS = {
    "car": Manner(2.2, 2.5, 0.9, 2.0, 2.8, (8.0, 12.5)),
    "van": Manner(2.0, 2.4, 0.9, 2.0, 2.5, (7.5, 11.5)),
    "truck": Manner(1.6, 2.0, 1.2, 2.5, 1.8, (7.0, 10.0)),
    "motorcycle": Manner(2.8, 2.8, 1.0, 1.8, 3.0, (8.0, 12.5)),
    "cyclist": Manner(1.0, 1.8, 1.0, 1.2, 2.0, (3.5, 6.0)),
    "pedestrian": Manner(1.5, 2.0, 0.4, 0.5, 9.0, (0.9, 1.7)),
}
"""By category."""


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

    @property
    def walks(self) -> bool:
        """Whether it has no wheels."""
        return self.body.category == WALKER

    @property
    def manner(self) -> Manner:
        """How it drives."""
        return MANNERS[self.body.category]

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
        time_gap=_gather(users, lambda user: user.manner.time_gap),
        min_gap=_gather(users, lambda user: user.manner.min_gap),
    )


def _gather(users: Sequence[RoadUser], value: Callable[[RoadUser], float]) -> FloatArray:
    return np.array([value(user) for user in users], dtype=np.float64)
