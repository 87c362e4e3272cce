"""A junction as traffic sees it: routes over it, where they meet, stop lines, crosswalks and sidewalks."""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal, get_args

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.support.arrays import FloatArray, ShortRepr, readonly
from deepaccident_devkit.synth.roads.ground import GroundMap, paint_junction
from deepaccident_devkit.synth.roads.layout import ARMS, KERB_RADIUS, OUTWARD, Arm, RoadSpec, Terrain, parking_places
from deepaccident_devkit.synth.roads.paths import (
    Meeting,
    Path,
    bent,
    crossing,
    quarter_turn,
    straight,
    tangent_of_corner,
    tangent_of_radius,
)

Turn = Literal["straight", "left", "right"]
TURNS: tuple[Turn, ...] = get_args(Turn)

REACH = 140.0
"""Metres from the middle at which routes begin and end."""
_WALK_REACH = 110.0
_WALK_INSET = 1.6
"""Metres from the kerb to where pedestrians walk."""
_CLEARANCE = 1.7
"""The least distance between the path of a right turn and the kerb, metres."""
_MAX_RIGHT_RADIUS = 9.0
_LEFT_RADIUS = 10.0
_WALK_TANGENT = 3.0
_QUARTERS: dict[Turn, int] = {"straight": 2, "left": -1, "right": 1}
"""Turn → how many arms further, counter-clockwise, it leaves the junction."""


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
        """A way over the junction.

        Args:
            from_arm: where it comes from.
            turn: what it does at the junction.
            lane: 0 is the rightmost; by default the leftmost lane for a left turn, if not, the rightmost.

        Raises:
            ConfigError: the junction has no such arm, turn or lane.
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
        """Where two routes first meet, as distances along each; None if they never meet.

        Routes that come by the same lane do not count as meeting: there one vehicle follows the other.
        """
        if route_a.from_arm == route_b.from_arm and route_a.lane == route_b.lane:
            return None
        return _meeting(route_a, route_b)

    def stop_line(self, arm: Arm) -> FloatArray:
        """The line where those who come by this arm stop, (2, 2) metres: from the middle line to the lanes' edge."""
        self._check_arm(arm)
        beside = np.array([0.0, self.spec.lanes_edge])
        return readonly(_on_arm(arm, np.full(2, self.spec.stop_line[1]), beside))

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
    return bent(place, yaw, [(run, 0.0, 0.0), *quarter_turn(tangent, left=turn == "left"), (run, 0.0, 0.0)])


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
