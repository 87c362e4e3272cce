"""Traffic lights, and the rules between all pairs of road users: where their paths meet, and who has to wait."""

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
# Seconds of red for all between one axis' amber and the other's green.
CLEARANCE_TIME = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalPlan:
    """Two phases that alternate without end: one axis has green, then the other.

    Attributes:
        first: the axis that gets green at `start`.
        start: when it gets green, seconds since the first recorded frame.
        green: how long each axis has green, seconds.
    """

    first: _RoadAxis
    start: float
    green: float

    def state(self, arm: Arm, times: ArrayLike) -> IntArray:
        """`RED`, `AMBER` or `GREEN` of an arm at times (…), seconds."""
        half = self.green + AMBER_TIME + CLEARANCE_TIME
        shift = 0.0 if AXIS_OF_ARM[arm] == self.first else half
        phase = (np.asarray(times, dtype=np.float64) - self.start - shift) % (2 * half)
        colors = np.where(
            phase < self.green, GREEN, np.where(phase < self.green + AMBER_TIME, AMBER, RED)
        )
        return np.asarray(colors, dtype=np.int64)

    def shifted(self, seconds: float) -> "SignalPlan":
        """The same plan, some seconds later."""
        return replace(self, start=self.start + seconds)


def plan_with_green(axis: _RoadAxis, time: float, green: float, share: float) -> SignalPlan:
    """A plan in which an axis has green at a time (seconds), when a share, 0 to 1, of its green (seconds) is over."""
    return SignalPlan(first=axis, start=time - share * green, green=green)


_SPACING = 0.5
# Metres between two bodies that pass each other in a zone.
_MARGIN = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Zones:
    """For each ordered pair of road users, the part of the first one's path on which it meets the second's path.

    Attributes:
        enter: (A, A) metres along the path of the row's road user where its front comes too near to the path of the
            column's road user; infinite if the paths never meet.
        leave: (A, A) metres along the same path where its rear is far enough from the other path again.
    """

    enter: FloatArray
    leave: FloatArray


def find_zones(
    paths: Sequence[Path],
    spans: Sequence[tuple[float, float]],
    widths: FloatArray,
    together: BoolArray,
) -> Zones:
    """The zones of all pairs but those `together` (A, A), which follow each other or do not react to each other.

    Spans (metres) are the part of each path that can meet others; widths (A,) those of the bodies, metres.
    """
    count = len(paths)
    enter, leave = np.full((count, count), np.inf), np.full((count, count), np.inf)
    known: dict[tuple[int, int, float], tuple[tuple[float, float], tuple[float, float]] | None] = {}
    points = [_points(path, span) for path, span in zip(paths, spans, strict=True)]
    for i in range(count):
        for j in range(i + 1, count):
            if together[i, j]:
                continue
            reach = round(float(widths[i] + widths[j]) / 2 + _MARGIN, 1)
            key = (id(paths[i]), id(paths[j]), reach)
            if key not in known:
                known[key] = _meeting(points[i], points[j], reach)
            zone = known[key]
            if zone is not None:
                (enter[i, j], leave[i, j]), (enter[j, i], leave[j, i]) = zone
    return Zones(enter, leave)


def _points(path: Path, span: tuple[float, float]) -> FloatArray:
    """(K, 3) x, y and distance along the path, metres."""
    along = np.arange(max(span[0], 0.0), min(span[1], path.length), _SPACING)
    x, y, _, _ = path.at(along)
    return np.stack([x, y, along], axis=-1)


def _meeting(
    first: FloatArray, second: FloatArray, reach: float
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Where two lines of points (K, 3) are within `reach`: begin and end on each line; None if they never are."""
    if not len(first) or not len(second):
        return None
    square = (first[:, None, 0] - second[None, :, 0]) ** 2 + (
        first[:, None, 1] - second[None, :, 1]
    ) ** 2
    near = square < reach**2
    rows, columns = near.any(axis=1), near.any(axis=0)
    if not rows.any():
        return None
    on_first, on_second = first[rows, 2], second[columns, 2]
    return (float(on_first[0]), float(on_first[-1])), (float(on_second[0]), float(on_second[-1]))


@dataclass(frozen=True, slots=True, eq=False)
class Rights:
    """The rules between all ordered pairs of road users, valid for a whole simulation.

    Attributes:
        zones: where their paths meet.
        waits: (A, A) bool, whether the road user of the row has to let that of the column go first.
        sees: (A, A) bool, whether the road user of the row brakes if that of the column is in its way.
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
    """The rights of all pairs; `minor` arms give way to the others (none at a junction with lights).

    A `blind` pair (rows) sees only the others on their own arm; all others let them go first, so that they meet. Who is
    `pushing` (rows) waits for nobody.
    """
    count = len(users)
    together, waits = np.zeros((count, count), dtype=bool), np.zeros((count, count), dtype=bool)
    sees = ~np.eye(count, dtype=bool)
    for i, one in enumerate(users):
        for j, other in enumerate(users):
            together[i, j] = _go_together(one, other)
            waits[i, j] = _waits(one, other, minor)
    if blind is not None:
        waits[:, list(blind)] = True
        for row in blind:
            waits[row], sees[row] = False, [_same_arm(users[row], other) for other in users]
            sees[row, list(blind)] = False
        waits[list(pushing)] = False
    widths = np.array([user.body.size[1] for user in users])
    zones = find_zones(
        [user.path for user in users], [user.span for user in users], widths, together
    )
    return Rights(zones, waits, sees)


def _go_together(one: RoadUser, other: RoadUser) -> bool:
    """Whether they come from the same arm, where one follows the other, or both walk."""
    return _same_arm(one, other) or (one.walks and other.walks)


def _same_arm(one: RoadUser, other: RoadUser) -> bool:
    return (
        one.route is not None
        and other.route is not None
        and one.route.from_arm == other.route.from_arm
    )


def _waits(one: RoadUser, other: RoadUser, minor: Sequence[Arm]) -> bool:
    if one.route is None:
        return False
    if other.route is None:
        return True
    if "priority" in one.ignores:
        return False
    if (one.route.from_arm in minor) != (other.route.from_arm in minor):
        return one.route.from_arm in minor
    opposite = OUTWARD[one.route.from_arm] == tuple(
        -value for value in OUTWARD[other.route.from_arm]
    )
    return opposite and one.route.turn == "left" and other.route.turn != "left"


# m/s²: the acceleration that a road user expects of others towards a zone, and its own to leave the zone.
_ACCELERATION = (1.5, 1.0)
# Least seconds from leaving a zone until the other comes, and from the other's leaving until it comes itself.
_GAP_BEFORE, _GAP_AFTER = 1.2, 0.6
# m/s: a road user that is slower counts as so fast.
_CREEPING = 0.5
# m/s²: who would have to brake harder than this before a zone does not stop.
_HARD_BRAKING = 4.5
# Metres from a waiting road user to the zone.
_BEFORE_ZONE = 1.0


def waiting_gap(
    rights: Rights,
    front: FloatArray,
    rear: FloatArray,
    speed: FloatArray,
    top_speed: FloatArray,
    held: BoolArray,
) -> FloatArray:
    """Distance (A,) in metres to where each has to stop for others; infinite for those who may go.

    Front and rear are (A,) metres along each path, speeds (A,) m/s; nobody becomes faster than the top speed. Those
    `held` (A,) stand or will stand before a red light.
    """
    to_enter = rights.zones.enter - front[:, None]
    to_leave = rights.zones.leave - rear[:, None]
    with np.errstate(invalid="ignore"):
        comes = _earliest(
            np.maximum(to_enter, 0.0), speed[:, None], top_speed[:, None], _ACCELERATION[0]
        )
        goes = _earliest(
            np.maximum(to_leave, 0.0), speed[:, None], top_speed[:, None], _ACCELERATION[1]
        )
        gone = np.maximum(to_leave, 0.0) / np.maximum(speed[:, None], _CREEPING)
    inside = (to_enter <= 0) & (to_leave > 0)
    cannot_stop = (to_enter > 0) & (
        speed[:, None] ** 2 > 2 * _HARD_BRAKING * np.maximum(to_enter - 0.3, 0.0)
    )
    coming = (to_leave.T > 0) & (np.isfinite(to_enter.T)) & ~held[None, :]
    first = goes + _GAP_BEFORE < comes.T
    reaching = to_enter / np.maximum(speed[:, None], _CREEPING)
    second = reaching > gone.T + _GAP_AFTER
    matters = coming & ~first & ~second & (to_enter > 0) & ~cannot_stop & rights.sees
    must = rights.waits | inside.T | (cannot_stop & ~inside).T
    gap = np.where(matters & must, np.maximum(to_enter - _BEFORE_ZONE, 0.0), np.inf)
    return np.asarray(gap.min(axis=1))


def _earliest(
    distance: FloatArray, speed: FloatArray, top_speed: FloatArray, acceleration: float
) -> FloatArray:
    """The least seconds that somebody needs for a distance (metres) with this acceleration, up to a top speed."""
    speeding_up = (np.sqrt(speed**2 + 2 * acceleration * distance) - speed) / acceleration
    return np.asarray(np.maximum(speeding_up, distance / top_speed))
