"""The ways of road users: lanes over the junction, beside them for cyclists, and over the road for who walks."""

from functools import lru_cache

import numpy as np

from deepaccident_devkit.synth.roads import Arm, Junction, Path, Route, Turn, straight
from deepaccident_devkit.synth.roads.layout import RoadSpec
from deepaccident_devkit.synth.roads.paths import through
from deepaccident_devkit.synth.roads.terrain import OUTWARD
from deepaccident_devkit.synth.spec.model import Side

_SPAN = (4.0, 10.0)
"""Metres before the stop line, and past the junction, between which ways can cross."""
_CYCLIST_OFFSET = 1.1
"""Metres to the right of the lane's middle."""
_KERB_ROOM = 0.7
"""Metres from the kerb to where a pedestrian waits to step onto the road."""


def lane_way(junction: Junction, route: Route, category: str) -> Path:
    """The path of a driver or rider on a route."""
    if category != "cyclist":
        return route.path
    return _cyclist_path(junction.spec, route.from_arm, route.turn, route.lane)


def lane_span(route: Route) -> tuple[float, float]:
    """From, to: metres along a route where its way may cross others'."""
    return route.stop_s - _SPAN[0], route.exit_s + _SPAN[1]


def middle_of(route: Route) -> float:
    """Metres along a route to the middle of the junction."""
    return (route.enter_s + route.exit_s) / 2


def road_crossing(spec: RoadSpec, arm: Arm, along: float, side: Side) -> Path:
    """Straight over an arm's road, from kerb to kerb.

    Args:
        spec: of the junction.
        arm: which.
        along: metres from the junction's middle.
        side: from where, seen by those who drive towards the junction.
    """
    out_x, out_y = OUTWARD[arm]
    beside = spec.road_edge + _KERB_ROOM
    sign = 1.0 if side == "right" else -1.0  # who drives inward has his right on the outward direction's left
    left = np.array([-out_y, out_x], dtype=np.float64)
    start = along * np.array([out_x, out_y]) + sign * beside * left
    yaw = float(np.arctan2(-sign * left[1], -sign * left[0]))
    return straight((float(start[0]), float(start[1])), yaw, 2 * beside)


def shifted(path: Path, offset: float) -> Path:
    """The same way, `offset` metres to the left."""
    left = np.stack([-np.sin(path.yaw), np.cos(path.yaw)], axis=1)
    return through(path.xy + offset * left)


@lru_cache(maxsize=64)
def _cyclist_path(spec: RoadSpec, from_arm: Arm, turn: Turn, lane: int) -> Path:
    return shifted(Junction(spec).route(from_arm, turn, lane).path, -_CYCLIST_OFFSET)
