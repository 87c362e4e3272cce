"""Traffic lights, and the rights of way between all pairs of road users with paths that meet."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.plugins.synth.roads.layout import OUTWARD, Arm
from deepaccident_devkit.plugins.synth.roads.paths import Path
from deepaccident_devkit.plugins.synth.traffic.driving import RoadUser
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray

RED, AMBER, GREEN = range(3)
_RoadAxis = Literal["west-east", "south-north"]
AXIS_OF_ARM: dict[Arm, _RoadAxis] = {
    "west": "west-east",
    "east": "west-east",
    "south": "south-north",
    "north": "south-north",
}
AMBER_TIME = 3.0
CLEARANCE_TIME = 1.5
"""Seconds of red for all between one axis' amber and the other's green."""
# Distance between the points of a path at which meetings are looked for.
_SPACING_M = 0.5
# Distance between two bodies that pass each other in a zone.
_PASSING_MARGIN_M = 0.5
# Acceleration that a road user expects of others towards a zone, and its own to leave it, m/s².
_ENTERING_ACCELERATION = 1.5
_LEAVING_ACCELERATION = 1.0
# Shortest time from leaving a zone until the other comes, and from the other's leaving until the
# road user comes itself.
_GAP_BEFORE_OTHER_S = 1.2
_GAP_AFTER_OTHER_S = 0.6
# A slower road user counts as this fast, m/s.
_CREEPING_SPEED = 0.5
# A road user that would have to brake harder than this before a zone does not stop, m/s².
_HARD_BRAKING = 4.5
# Distance from a waiting road user to the zone.
_WAITING_DISTANCE_M = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalPlan:
    """Two phases that alternate without end: one axis has green, then the other.

    Attributes:
        first: Axis that gets green at `start`.
        start: Time at which it gets green, seconds since the first recorded frame.
        green: Duration of green for each axis, seconds.
    """

    first: _RoadAxis
    start: float
    green: float

    def state(self, arm: Arm, times: ArrayLike) -> IntArray:
        """Return `RED`, `AMBER` or `GREEN` of an arm at times (…), seconds."""
        half = self.green + AMBER_TIME + CLEARANCE_TIME
        shift = 0.0 if AXIS_OF_ARM[arm] == self.first else half
        phase = (np.asarray(times, dtype=np.float64) - self.start - shift) % (2 * half)
        amber_or_red = np.where(phase < self.green + AMBER_TIME, AMBER, RED)
        colors = np.where(phase < self.green, GREEN, amber_or_red)
        return np.asarray(colors, dtype=np.int64)

    def shifted(self, seconds: float) -> "SignalPlan":
        """Return the same plan, some seconds later."""
        return replace(self, start=self.start + seconds)


def plan_with_green(axis: _RoadAxis, time: float, green: float, share: float) -> SignalPlan:
    """Make a plan in which an axis has green at a time.

    Args:
        axis: The axis.
        time: Time at which it has green, seconds.
        green: Duration of green, seconds.
        share: Share of the green, 0 to 1, that is over at that time.
    """
    start = time - share * green
    return SignalPlan(first=axis, start=start, green=green)


@dataclass(frozen=True, slots=True, eq=False)
class Zones:
    """The parts of paths on which they meet other paths, for each ordered pair of road users.

    Attributes:
        enter: Metres along the path of the row's road user where its front comes too near to the
            path of the column's road user, shape (A, A); infinite if the paths never meet.
        leave: Metres along the same path where its rear is far enough from the other path again,
            shape (A, A).
    """

    enter: FloatArray
    leave: FloatArray


def find_zones(
    paths: Sequence[Path],
    spans: Sequence[tuple[float, float]],
    widths: FloatArray,
    together: BoolArray,
) -> Zones:
    """Find the zones of all pairs of road users.

    Args:
        paths: Path of each road user.
        spans: Start and end of the part of each path that can meet others, metres.
        widths: Widths of the bodies, shape (A,), metres.
        together: Truth values, shape (A, A): pairs to leave out, which follow each other or do not
            react to each other.
    """
    count = len(paths)
    enter = np.full((count, count), np.inf)
    leave = np.full((count, count), np.inf)
    known: dict[tuple[int, int, float], tuple[tuple[float, float], tuple[float, float]] | None] = {}
    points = [_points(path, span) for path, span in zip(paths, spans, strict=True)]
    for i in range(count):
        for j in range(i + 1, count):
            if together[i, j]:
                continue
            reach = round(float(widths[i] + widths[j]) / 2 + _PASSING_MARGIN_M, 1)
            key = (id(paths[i]), id(paths[j]), reach)
            if key not in known:
                known[key] = _meeting(points[i], points[j], reach)
            zone = known[key]
            if zone is not None:
                (enter[i, j], leave[i, j]), (enter[j, i], leave[j, i]) = zone
    return Zones(enter, leave)


def _points(path: Path, span: tuple[float, float]) -> FloatArray:
    """Return points x, y and distance along the path, shape (K, 3), metres."""
    start = max(span[0], 0.0)
    end = min(span[1], path.length)
    along = np.arange(start, end, _SPACING_M)
    x, y, _, _ = path.at(along)
    return np.stack([x, y, along], axis=-1)


def _meeting(
    points: FloatArray, other_points: FloatArray, reach: float
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Find where two lines of points (K, 3) are within `reach` of each other.

    Returns:
        Start and end on each line, metres; None if they never are.
    """
    if not len(points) or not len(other_points):
        return None
    x_offsets = points[:, None, 0] - other_points[None, :, 0]
    y_offsets = points[:, None, 1] - other_points[None, :, 1]
    near = x_offsets**2 + y_offsets**2 < reach**2
    rows = near.any(axis=1)
    columns = near.any(axis=0)
    if not rows.any():
        return None
    along = points[rows, 2]
    other_along = other_points[columns, 2]
    span = (float(along[0]), float(along[-1]))
    other_span = (float(other_along[0]), float(other_along[-1]))
    return span, other_span


@dataclass(frozen=True, slots=True, eq=False)
class Rights:
    """The rules between all ordered pairs of road users, valid for a complete simulation.

    Attributes:
        zones: Zones in which their paths meet.
        waits: Truth values, shape (A, A): whether the road user of the row has to let the one of
            the column go first.
        sees: Truth values, shape (A, A): whether the road user of the row brakes if the one of the
            column is in its way.
    """

    zones: Zones
    waits: BoolArray
    sees: BoolArray


def find_rights(
    users: Sequence[RoadUser],
    *,
    minor: Sequence[Arm] = (),
    blind: tuple[int, int] | None = None,
    pushing: Sequence[int] = (),
) -> Rights:
    """Find the rights of all pairs of road users.

    Args:
        users: The road users.
        minor: Arms that give way to the others (none at a junction with lights).
        blind: Rows of a pair that sees only the others on their own arm; all others let them go
            first, so that they meet.
        pushing: Rows of road users that wait for nobody, if there is a blind pair.
    """
    count = len(users)
    together = np.zeros((count, count), dtype=bool)
    waits = np.zeros((count, count), dtype=bool)
    sees = ~np.eye(count, dtype=bool)
    for i, user in enumerate(users):
        for j, other in enumerate(users):
            together[i, j] = _go_together(user, other)
            waits[i, j] = _waits(user, other, minor)
    if blind is not None:
        pair = list(blind)
        waits[:, pair] = True
        for row in blind:
            waits[row] = False
            sees[row] = [_same_arm(users[row], other) for other in users]
            sees[row, pair] = False
        waits[list(pushing)] = False
    paths = [user.path for user in users]
    spans = [user.span for user in users]
    widths = np.array([user.body.size[1] for user in users])
    zones = find_zones(paths, spans, widths, together)
    return Rights(zones, waits, sees)


def _go_together(user: RoadUser, other: RoadUser) -> bool:
    """Return whether two come from the same arm, where one follows the other, or both walk."""
    return _same_arm(user, other) or (user.walks and other.walks)


def _same_arm(user: RoadUser, other: RoadUser) -> bool:
    """Return whether two drivers come from the same arm."""
    return (
        user.route is not None
        and other.route is not None
        and user.route.from_arm == other.route.from_arm
    )


def _waits(user: RoadUser, other: RoadUser, minor: Sequence[Arm]) -> bool:
    """Return whether a road user has to let another go first."""
    if user.route is None:
        return False
    if other.route is None:
        return True
    if "priority" in user.ignores:
        return False
    own_arm = user.route.from_arm
    other_arm = other.route.from_arm
    if (own_arm in minor) != (other_arm in minor):
        return own_arm in minor
    opposite = OUTWARD[own_arm] == tuple(-value for value in OUTWARD[other_arm])
    return opposite and user.route.turn == "left" and other.route.turn != "left"


def waiting_gap(
    rights: Rights,
    front: FloatArray,
    rear: FloatArray,
    speed: FloatArray,
    top_speed: FloatArray,
    faces_red: BoolArray,
) -> FloatArray:
    """Return the distances to where road users have to stop for others.

    Args:
        rights: Rights of all pairs.
        front: Positions of the fronts along each path, shape (A,), metres.
        rear: Positions of the rears along each path, shape (A,), metres.
        speed: Speeds, shape (A,), m/s.
        top_speed: Speeds that nobody exceeds, shape (A,), m/s.
        faces_red: Truth values, shape (A,): whether a road user stands or will stand before a red
            light.

    Returns:
        Distances (A,), metres; infinite for road users that may go.
    """
    to_enter = rights.zones.enter - front[:, None]
    to_leave = rights.zones.leave - rear[:, None]
    own_speed = speed[:, None]
    own_top_speed = top_speed[:, None]
    crawl_speed = np.maximum(own_speed, _CREEPING_SPEED)
    with np.errstate(invalid="ignore"):
        enter_distance = np.maximum(to_enter, 0.0)
        leave_distance = np.maximum(to_leave, 0.0)
        time_to_enter = _min_time(enter_distance, own_speed, own_top_speed, _ENTERING_ACCELERATION)
        time_to_leave = _min_time(leave_distance, own_speed, own_top_speed, _LEAVING_ACCELERATION)
        steady_time_to_leave = leave_distance / crawl_speed
    in_zone = (to_enter <= 0) & (to_leave > 0)
    stopping_distance = np.maximum(to_enter - 0.3, 0.0)
    cannot_stop = (to_enter > 0) & (own_speed**2 > 2 * _HARD_BRAKING * stopping_distance)
    other_comes = (to_leave.T > 0) & (np.isfinite(to_enter.T)) & ~faces_red[None, :]
    goes_first = time_to_leave + _GAP_BEFORE_OTHER_S < time_to_enter.T
    steady_time_to_enter = to_enter / crawl_speed
    goes_second = steady_time_to_enter > steady_time_to_leave.T + _GAP_AFTER_OTHER_S
    conflict = other_comes & ~goes_first & ~goes_second
    conflict = conflict & (to_enter > 0) & ~cannot_stop & rights.sees
    must_wait = rights.waits | in_zone.T | (cannot_stop & ~in_zone).T
    stop_distance = np.maximum(to_enter - _WAITING_DISTANCE_M, 0.0)
    gap = np.where(conflict & must_wait, stop_distance, np.inf)
    return np.asarray(gap.min(axis=1))


def _min_time(
    distance: FloatArray, speed: FloatArray, top_speed: FloatArray, acceleration: float
) -> FloatArray:
    """Return the shortest times, seconds, for distances, metres.

    The road users accelerate up to a top speed.
    """
    speeding_up = (np.sqrt(speed**2 + 2 * acceleration * distance) - speed) / acceleration
    return np.asarray(np.maximum(speeding_up, distance / top_speed))
