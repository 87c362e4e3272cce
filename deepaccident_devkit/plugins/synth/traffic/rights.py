"""Traffic lights, and the right of way between all pairs of road users whose paths cross."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.plugins.synth.roads.layout import OUTWARD, Arm
from deepaccident_devkit.plugins.synth.roads.paths import Path
from deepaccident_devkit.plugins.synth.traffic.driving import RoadUser
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray

RED, AMBER, GREEN = range(3)
_RoadAxis = Literal["west-east", "south-north"]
# Start and end of the part of a path that is near another path, metres along it.
_Zone = tuple[float, float]
AXIS_OF_ARM: dict[Arm, _RoadAxis] = {
    "west": "west-east",
    "east": "west-east",
    "south": "south-north",
    "north": "south-north",
}
AMBER_TIME = 3.0
CLEARANCE_TIME = 1.5
"""Time with red for all between one axis's amber and the other's green, seconds."""
# Distance between the points of a path at which crossings are searched for.
_SPACING_M = 0.5
# Distance between two bodies that pass each other in a zone, at least.
_PASSING_MARGIN_M = 0.5
# Acceleration that a road user expects of others that approach a zone, and its own acceleration to
# leave the zone, m/s².
_ENTERING_ACCELERATION = 1.5
_LEAVING_ACCELERATION = 1.0
# Shortest time between a road user that leaves a zone and the other that enters it after it, and
# between the other that leaves it and the road user that enters after the other.
_GAP_BEFORE_OTHER_S = 1.2
_GAP_AFTER_OTHER_S = 0.6
# A slower road user counts as if it had this speed, m/s.
_CREEPING_SPEED = 0.5
# A road user that would have to brake harder than this to stop before a zone does not stop, m/s².
_HARD_BRAKING = 4.5
# Distance from a waiting road user to the zone, and the smallest one after hard braking.
_WAITING_DISTANCE_M = 1.0
_MIN_WAITING_DISTANCE_M = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalPlan:
    """Traffic lights with two phases that alternate without end, one for each axis.

    Attributes:
        first: Axis that gets green at `start`.
        start: Time at which that axis gets green, seconds since the first recorded frame.
        green: Duration of green for each axis, seconds.
    """

    first: _RoadAxis
    start: float
    green: float

    def state(self, arm: Arm, times: ArrayLike) -> IntArray:
        """Return `RED`, `AMBER` or `GREEN` of an arm at times (…), seconds."""
        half_period = self.green + AMBER_TIME + CLEARANCE_TIME
        shift = 0.0 if AXIS_OF_ARM[arm] == self.first else half_period
        elapsed = np.asarray(times, dtype=np.float64) - self.start - shift
        phase = elapsed % (2 * half_period)
        amber_or_red = np.where(phase < self.green + AMBER_TIME, AMBER, RED)
        colors = np.where(phase < self.green, GREEN, amber_or_red)
        return np.asarray(colors, dtype=np.int64)

    def shifted(self, seconds: float) -> "SignalPlan":
        """Return the same plan, moved later by some seconds."""
        start = self.start + seconds
        return replace(self, start=start)


def plan_with_green(axis: _RoadAxis, time: float, green: float, share: float) -> SignalPlan:
    """Make a plan in which an axis has a green light at a certain time.

    Args:
        axis: The axis.
        time: Time at which the axis has green, seconds.
        green: Duration of green, seconds.
        share: Fraction of the green phase that has passed at that time, 0 to 1.
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
    excluded: BoolArray,
) -> Zones:
    """Find the zones of all pairs of road users.

    Args:
        paths: Path of each road user.
        spans: Start and end of the part of each path that can meet others, metres.
        widths: Widths of the bodies, shape (A,), metres.
        excluded: Pairs to leave out, because they follow each other or do not react to each other,
            shape (A, A), bool.
    """
    count = len(paths)
    enter = np.full((count, count), np.inf)
    leave = np.full((count, count), np.inf)
    zones_by_key: dict[tuple[int, int, float], tuple[_Zone, _Zone] | None] = {}
    points = [_sample_points(path, span) for path, span in zip(paths, spans, strict=True)]
    for i, j in combinations(range(count), 2):
        if excluded[i, j]:
            continue
        half_widths = float(widths[i] + widths[j]) / 2
        max_distance = round(half_widths + _PASSING_MARGIN_M, 1)
        key = (id(paths[i]), id(paths[j]), max_distance)
        if key not in zones_by_key:
            zones_by_key[key] = _find_zone(points[i], points[j], max_distance)
        zone_pair = zones_by_key[key]
        if zone_pair is not None:
            zone, other_zone = zone_pair
            enter[i, j], leave[i, j] = zone
            enter[j, i], leave[j, i] = other_zone
    return Zones(enter, leave)


def _sample_points(path: Path, span: tuple[float, float]) -> FloatArray:
    """Return points x, y, and their distance along the path, shape (K, 3), metres."""
    start = max(span[0], 0.0)
    end = min(span[1], path.length)
    along = np.arange(start, end, _SPACING_M)
    x, y, _, _ = path.at(along)
    return np.stack([x, y, along], axis=-1)


def _find_zone(
    points: FloatArray, other_points: FloatArray, max_distance: float
) -> tuple[_Zone, _Zone] | None:
    """Find the zones of two lines of points (K, 3) in which they are near each other.

    Returns:
        Zone on each of the two; None if they never come nearer than `max_distance`, metres.
    """
    if not len(points) or not len(other_points):
        return None
    x_offsets = points[:, None, 0] - other_points[None, :, 0]
    y_offsets = points[:, None, 1] - other_points[None, :, 1]
    is_near = x_offsets**2 + y_offsets**2 < max_distance**2
    if not is_near.any():
        return None
    along = points[is_near.any(axis=1), 2]
    other_along = other_points[is_near.any(axis=0), 2]
    zone = (float(along[0]), float(along[-1]))
    other_zone = (float(other_along[0]), float(other_along[-1]))
    return zone, other_zone


@dataclass(frozen=True, slots=True, eq=False)
class Rights:
    """The rules between all ordered pairs of road users, valid for a complete simulation.

    Attributes:
        zones: Zones in which their paths meet.
        waits: Whether the row's road user has to give way to the column's, shape (A, A), bool.
        sees: Whether the row's road user brakes if the column's is in its way, shape (A, A), bool.
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
        blind: Rows of a pair that sees only road users on its own arm; all others let the pair go
            first, so that it meets.
        pushing: Rows of road users that do not give way, if there is a blind pair.
    """
    count = len(users)
    excluded = np.zeros((count, count), dtype=bool)
    waits = np.zeros((count, count), dtype=bool)
    sees = ~np.eye(count, dtype=bool)
    for i, user in enumerate(users):
        for j, other in enumerate(users):
            excluded[i, j] = _share_arm(user, other) or (user.walks and other.walks)
            waits[i, j] = _has_to_wait(user, other, minor)
    if blind is not None:
        pair = list(blind)
        waits[:, pair] = True
        for row in blind:
            waits[row] = False
            sees[row] = [_share_arm(users[row], other) for other in users]
            sees[row, pair] = False
        waits[list(pushing)] = False
    paths = [user.path for user in users]
    spans = [user.span for user in users]
    widths = np.array([user.body.size[1] for user in users])
    zones = find_zones(paths, spans, widths, excluded)
    return Rights(zones, waits, sees)


def _share_arm(user: RoadUser, other: RoadUser) -> bool:
    """Return whether two drivers come from the same arm, where one follows the other."""
    if user.route is None or other.route is None:
        return False
    return user.route.from_arm == other.route.from_arm


def _has_to_wait(user: RoadUser, other: RoadUser, minor: Sequence[Arm]) -> bool:
    """Return whether a road user has to let another go first."""
    if user.route is None:
        return False
    if other.route is None:
        return True
    if "priority" in user.ignores:
        return False
    own_arm = user.route.from_arm
    other_arm = other.route.from_arm
    is_minor = own_arm in minor
    if is_minor != (other_arm in minor):
        return is_minor
    if user.route.turn != "left" or other.route.turn == "left":
        return False
    other_x, other_y = OUTWARD[other_arm]
    return OUTWARD[own_arm] == (-other_x, -other_y)


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
        top_speed: Speed that each road user does not exceed, shape (A,), m/s.
        faces_red: Whether each road user stands or will stand at a red light, shape (A,), bool.

    Returns:
        Distances (A,), metres; infinite for road users that may go.
    """
    to_enter = rights.zones.enter - front[:, None]
    to_leave = rights.zones.leave - rear[:, None]
    own_speed = speed[:, None]
    own_top_speed = top_speed[:, None]
    steady_speed = np.maximum(own_speed, _CREEPING_SPEED)
    with np.errstate(invalid="ignore"):
        enter_distance = np.maximum(to_enter, 0.0)
        leave_distance = np.maximum(to_leave, 0.0)
        time_to_enter = _compute_min_time(
            enter_distance, own_speed, own_top_speed, _ENTERING_ACCELERATION
        )
        time_to_leave = _compute_min_time(
            leave_distance, own_speed, own_top_speed, _LEAVING_ACCELERATION
        )
        steady_time_to_leave = leave_distance / steady_speed
    is_before_zone = to_enter > 0
    is_in_zone = ~is_before_zone & (to_leave > 0)
    max_stopping_distance = np.maximum(to_enter - _MIN_WAITING_DISTANCE_M, 0.0)
    needs_hard_braking = own_speed**2 > 2 * _HARD_BRAKING * max_stopping_distance
    cannot_stop = is_before_zone & needs_hard_braking
    other_comes = (to_leave.T > 0) & np.isfinite(to_enter.T) & ~faces_red[None, :]
    goes_first = time_to_leave + _GAP_BEFORE_OTHER_S < time_to_enter.T
    steady_time_to_enter = to_enter / steady_speed
    goes_second = steady_time_to_enter > steady_time_to_leave.T + _GAP_AFTER_OTHER_S
    conflicts = other_comes & ~goes_first & ~goes_second
    conflicts = conflicts & is_before_zone & ~cannot_stop & rights.sees
    must_wait = rights.waits | is_in_zone.T | cannot_stop.T
    stop_distance = np.maximum(to_enter - _WAITING_DISTANCE_M, 0.0)
    gap = np.where(conflicts & must_wait, stop_distance, np.inf)
    return np.asarray(gap.min(axis=1))


def _compute_min_time(
    distance: FloatArray, speed: FloatArray, top_speed: FloatArray, acceleration: float
) -> FloatArray:
    """Return the shortest times for distances, seconds.

    Args:
        distance: Distances, metres.
        speed: Speeds at the start, m/s.
        top_speed: Speeds up to which the road users accelerate, m/s.
        acceleration: Acceleration, m/s².
    """
    end_speed = np.sqrt(speed**2 + 2 * acceleration * distance)
    accelerating_time = (end_speed - speed) / acceleration
    return np.maximum(accelerating_time, distance / top_speed)
