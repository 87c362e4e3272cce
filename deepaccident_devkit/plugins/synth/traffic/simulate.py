"""The simulation: all road users together, step by step, with what each of them notices."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.plugins.synth.traffic.driving import (
    DECISION_STEPS,
    HARDEST_BRAKING,
    PERIOD,
    RoadUser,
    Temper,
    Tracks,
    Wheels,
    can_stop,
    free_acceleration,
    hardest_braking,
    interaction,
    step,
    stopping,
    temper_of,
)
from deepaccident_devkit.plugins.synth.traffic.rights import (
    AMBER,
    GREEN,
    Rights,
    SignalPlan,
    waiting_gap,
)
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, FrozenArrays, IntArray

_SPACING = 2.0
# Metres ahead along a road user's own path.
_POINTS = np.arange(0.0, 44.0, _SPACING)
# The free space at each side that drivers want, metres.
_MARGIN = 0.25
# Metres: a road user that is farther back than this does not count as ahead.
_BEHIND = 2.0
# Seconds between the future moments that are checked for a contact.
_STEP = 0.05
# How far to each side of straight ahead a driver looks, radians.
_FIELD_OF_VIEW = np.deg2rad(80.0)


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """Where all road users are at one moment.

    Attributes:
        poses: (A, 3) x, y (metres), yaw (radians) of the boxes' centres.
        speed: (A,) m/s.
        length: (A,) metres.
        width: (A,) metres.
    """

    poses: FloatArray
    speed: FloatArray
    length: FloatArray
    width: FloatArray


def leaders(
    bodies: Bodies, tracks: Tracks, centers: FloatArray, sees: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Gap (A,) in metres to the nearest one ahead on each path, infinite if there is none, and that one's speed (A,).

    Centres are (A,) metres along each path; `sees` (A, A) tells whether the row's road user reacts to the column's.
    """
    rows, others = _candidates(bodies, sees)
    gaps, speeds = np.full(len(centers), np.inf), np.zeros(len(centers))
    if not len(rows):
        return gaps, speeds
    ahead, lateral, turn = _in_path_frame(bodies, tracks, centers, rows, others)
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    half_along = (cos * bodies.length[others] + sin * bodies.width[others]) / 2
    half_across = (sin * bodies.length[others] + cos * bodies.width[others]) / 2
    blocking = (np.abs(lateral) < bodies.width[rows] / 2 + half_across + _MARGIN) & (ahead > 0)
    rows, others = rows[blocking], others[blocking]
    gap = (ahead - half_along)[blocking] - bodies.length[rows] / 2
    order = np.argsort(-gap, kind="stable")  # the nearest is written last
    gaps[rows[order]] = gap[order]
    along_path = np.maximum(bodies.speed[others] * np.cos(turn[blocking]), 0.0)
    speeds[rows[order]] = along_path[order]
    return gaps, speeds


def _candidates(bodies: Bodies, sees: BoolArray) -> tuple[IntArray, IntArray]:
    """Pairs of rows: one that looks, and another that is near and not behind it."""
    delta = bodies.poses[None, :, :2] - bodies.poses[:, None, :2]
    heading = bodies.poses[:, 2]
    forward = np.cos(heading)[:, None] * delta[..., 0] + np.sin(heading)[:, None] * delta[..., 1]
    reach = (_POINTS[-1] + bodies.length)[:, None] / 2 + 2.0 * bodies.speed[:, None]
    near = (delta[..., 0] ** 2 + delta[..., 1] ** 2 < reach**2) & (forward > -_BEHIND) & sees
    rows, others = np.nonzero(near)
    return rows, others


def _in_path_frame(
    bodies: Bodies, tracks: Tracks, centers: FloatArray, rows: IntArray, others: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How far ahead, how far to the left (metres) and how much turned (radians) others are, along the rows' paths."""
    points, along = tracks.near(rows, centers[rows, None] + _POINTS)
    delta = bodies.poses[others, None, :2] - points[..., :2]
    nearest = (delta**2).sum(axis=-1).argmin(axis=1)
    pick = np.arange(len(rows))
    offset, yaw = delta[pick, nearest], points[pick, nearest, 2]
    cos, sin = np.cos(yaw), np.sin(yaw)
    ahead = along[pick, nearest] - centers[rows] + cos * offset[:, 0] + sin * offset[:, 1]
    return ahead, cos * offset[:, 1] - sin * offset[:, 0], bodies.poses[others, 2] - yaw


class ContactAlarm:
    """Which of a pair (rows, sizes (2, 2) metres) has noticed its coming contact; from then on it brakes until the end.

    Each notices it `alert` (2,) seconds before; 0 for never.
    """

    def __init__(self, rows: IntArray, size: FloatArray, alert: FloatArray) -> None:
        self._rows, self._size, self._alert = rows, size, alert
        self._ahead = np.arange(0.0, alert.max() + _STEP / 2, _STEP)
        self._noticed = np.zeros(2, dtype=bool)

    def rows(self, poses: FloatArray, velocities: FloatArray) -> IntArray:
        """Rows of those who brake, 0 to 2 of them; call it with one moment after the other.

        Poses are (A, 3) x, y (metres), yaw (radians) of the centres; velocities (A, 2) m/s are assumed to stay.
        """
        two, moving = poses[self._rows], velocities[self._rows]
        expected = np.repeat(two[:, None], len(self._ahead), axis=1)
        expected[..., :2] += self._ahead[:, None] * moving[:, None]
        touching = separation(expected[0], self._size[0], expected[1], self._size[1]) <= 0
        if touching.any():
            self._noticed |= (self._ahead[touching.argmax()] < self._alert) & _looks_at(two)
        return self._rows[self._noticed]


def _looks_at(poses: FloatArray) -> BoolArray:
    """(2,) bool, whether each of two (2, 3) has the other in its field of view."""
    delta = poses[::-1, :2] - poses[:, :2]
    bearing = np.arctan2(delta[:, 1], delta[:, 0]) - poses[:, 2]
    return np.asarray(np.cos(bearing) > np.cos(_FIELD_OF_VIEW))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Simulation(FrozenArrays):
    """Where everyone was; arrays are read-only.

    Attributes:
        time: (S,) seconds, in steps of `driving.PERIOD`.
        states: (S, A, 5) x, y (metres), yaw (radians), speed (m/s) and steering angle (radians); x and y are of the
            box's centre, speed and yaw of the rear axle, which does not slide.
        velocities: (S, A, 2) velocities of the box's centre, m/s.
        contact: row of the first step at which the watched pair touches; None if it never touches.
    """

    time: FloatArray
    states: FloatArray
    velocities: FloatArray
    contact: int | None

    @property
    def poses(self) -> FloatArray:
        """(S, A, 3) x, y (metres), yaw (radians) of the boxes' centres."""
        return self.states[..., :3]


def simulate(
    users: Sequence[RoadUser],
    *,
    begin: float,
    end: float,
    rights: Rights | None = None,
    signals: SignalPlan | None = None,
    watched: tuple[int, int] | None = None,
) -> Simulation:
    """Let road users drive and walk from `begin` to `end` (seconds), or until the watched pair (rows) touches.

    The watched pair brakes for each other at the last moment, or not. Without rights nobody reacts to anybody.
    """
    run = _Run(users, rights, signals, watched)
    count = round((end - begin) / PERIOD) + 1
    time = begin + PERIOD * np.arange(count, dtype=np.float64)
    states, velocities = np.empty((count, len(users), 5)), np.empty((count, len(users), 2))
    contact = None
    for row in range(count):
        run.write_state(states[row], velocities[row])
        if row % DECISION_STEPS == 0:
            run.decide(states[row], velocities[row], float(time[row]) - begin, float(time[row]))
            if watched is not None:
                contact = _first_contact(
                    states, run.size, watched, max(row - DECISION_STEPS, 0), row + 1
                )
                if contact is not None:
                    count = contact + 1
                    break
        run.advance()
    return Simulation(
        time=time[:count], states=states[:count], velocities=velocities[:count], contact=contact
    )


class _Run:
    """The state of a simulation between its steps."""

    def __init__(
        self,
        users: Sequence[RoadUser],
        rights: Rights | None,
        signals: SignalPlan | None,
        watched: tuple[int, int] | None,
    ) -> None:
        self.size = np.array([user.body.size[:2] for user in users])
        wheelbase, self._walks = (
            np.array([user.wheelbase for user in users]),
            np.array([user.walks for user in users]),
        )
        self._ahead, self._wheelbase = wheelbase / 2, np.where(self._walks, np.inf, wheelbase)
        self._walkers = np.flatnonzero(self._walks)
        self._temper = temper_of(users)
        lateral = np.array([user.manner.lateral for user in users])
        self._tracks = Tracks(
            [user.path for user in users], lateral, self._walks, [user.pace for user in users]
        )
        self._delay = np.array([user.delay for user in users])
        self._rights = rights
        self._lights = _Lights(users, signals)
        self._alarm = (
            None
            if watched is None
            else ContactAlarm(
                np.array(watched),
                self.size[[*watched]],
                np.array([users[row].alert for row in watched]),
            )
        )
        along = np.array([user.start for user in users]) - self._ahead
        self._on_path = self._tracks.at(along)
        x, y, yaw, _ = self._on_path
        speed = np.array([user.start_speed for user in users], dtype=np.float64)
        self._wheels = Wheels(x, y, yaw, speed, np.zeros(len(users)), along)
        self._acceleration = np.zeros(len(users))

    def write_state(self, states: FloatArray, velocities: FloatArray) -> None:
        """Fill in states (A, 5) and velocities (A, 2), as in `Simulation`."""
        wheels = self._wheels
        cos, sin = np.cos(wheels.yaw), np.sin(wheels.yaw)
        across = wheels.speed * np.tan(wheels.steer) / 2
        states[:, 0], states[:, 1] = wheels.x + self._ahead * cos, wheels.y + self._ahead * sin
        states[:, 2], states[:, 3], states[:, 4] = wheels.yaw, wheels.speed, wheels.steer
        velocities[:, 0], velocities[:, 1] = (
            wheels.speed * cos - across * sin,
            wheels.speed * sin + across * cos,
        )

    def decide(self, states: FloatArray, velocities: FloatArray, since: float, time: float) -> None:
        """Choose everyone's acceleration, `since` seconds after the start."""
        wheels, temper = self._wheels, self._temper
        acceleration = free_acceleration(
            temper, wheels.speed, self._tracks.allowed_speed(wheels.along)
        )
        if self._rights is not None:
            acceleration = acceleration + self._for_others(self._rights, states, time)
        hardest = -hardest_braking(wheels.speed)
        acceleration[since < self._delay] = -HARDEST_BRAKING
        if self._alarm is not None:
            acceleration[self._alarm.rows(states[:, :3], velocities)] = -HARDEST_BRAKING
        self._acceleration = np.maximum(acceleration, hardest)

    def advance(self) -> None:
        """One step."""
        step(self._wheels, self._acceleration, self._on_path, self._wheelbase)
        self._on_path = self._tracks.at(self._wheels.along)
        wheels, walkers = self._wheels, self._walkers
        wheels.x[walkers], wheels.y[walkers], wheels.yaw[walkers] = self._on_path[:3, walkers]

    def _for_others(self, rights: Rights, states: FloatArray, time: float) -> FloatArray:
        """(A,) m/s², 0 or less: braking for those ahead, for red lights and for those who go first."""
        wheels, temper = self._wheels, self._temper
        speed, centers = wheels.speed, wheels.along + self._ahead
        front, rear = centers + self.size[:, 0] / 2, centers - self.size[:, 0] / 2
        bodies = Bodies(states[:, :3], speed, self.size[:, 0], self.size[:, 1])
        gap, leader_speed = leaders(bodies, self._tracks, centers, rights.sees)
        red = self._lights.gap(time, front, speed, temper)
        stop = np.minimum(
            red, waiting_gap(rights, front, rear, speed, temper.max_speed, red < np.inf)
        )
        following = np.where(self._walks, 0.0, interaction(temper, speed, gap, leader_speed))
        return np.asarray(np.minimum(following, stopping(temper, speed, stop)))


class _Lights:
    """The stop lines of all road users and the colours of their lights."""

    def __init__(self, users: Sequence[RoadUser], signals: SignalPlan | None) -> None:
        self._signals = signals
        self._arms = [user.route.from_arm if user.route else None for user in users]
        self._stop = np.array(
            [
                user.route.stop_s if user.route and "signal" not in user.ignores else -np.inf
                for user in users
            ]
        )

    def gap(self, time: float, front: FloatArray, speed: FloatArray, temper: Temper) -> FloatArray:
        """(A,) metres to the stop line; infinite for those who need not stop there."""
        if self._signals is None:
            return np.full(len(front), np.inf)
        colors = {
            arm: int(self._signals.state(arm, time)) for arm in set(self._arms) - {None} if arm
        }
        color = np.array([colors[arm] if arm else GREEN for arm in self._arms])
        gap = self._stop - front
        stops = (color != GREEN) & (gap > -0.5)
        stops &= (color != AMBER) | can_stop(temper, speed, gap)
        return np.where(stops, np.maximum(gap, 0.0), np.inf)


def _first_contact(
    states: FloatArray, size: FloatArray, pair: tuple[int, int], low: int, high: int
) -> int | None:
    """The first row at which the boxes of a pair touch, `low` included and `high` excluded; None if there is none."""
    first, second = pair
    apart = separation(
        states[low:high, first, :3], size[first], states[low:high, second, :3], size[second]
    )
    touching: BoolArray = apart <= 0
    return low + int(touching.argmax()) if touching.any() else None


def separation(
    poses_a: FloatArray, size_a: FloatArray, poses_b: FloatArray, size_b: FloatArray
) -> FloatArray:
    """The widest gap (…) along any side's normal, metres: 0 where rectangles just touch, negative if they overlap.

    Poses are (…, 3) x, y, yaw of the centres, sizes (…, 2) full length and width, metres; all broadcast.
    """
    turn = poses_b[..., 2] - poses_a[..., 2]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    along_a = np.abs(relative(poses_a, poses_b[..., :2]))
    along_b = np.abs(relative(poses_b, poses_a[..., :2]))
    half_a, half_b = size_a / 2, size_b / 2
    gaps = [
        along_a[..., 0] - half_a[..., 0] - half_b[..., 0] * cos - half_b[..., 1] * sin,
        along_a[..., 1] - half_a[..., 1] - half_b[..., 0] * sin - half_b[..., 1] * cos,
        along_b[..., 0] - half_b[..., 0] - half_a[..., 0] * cos - half_a[..., 1] * sin,
        along_b[..., 1] - half_b[..., 1] - half_a[..., 0] * sin - half_a[..., 1] * cos,
    ]
    return np.asarray(np.max(np.stack(np.broadcast_arrays(*gaps)), axis=0))


def gap(
    poses_a: FloatArray, size_a: FloatArray, poses_b: FloatArray, size_b: FloatArray
) -> FloatArray:
    """The distance between rectangles (…), metres, 0 where they overlap; arguments as in `separation`.

    Two disjoint rectangles are nearest at a corner of one of them.
    """
    return gaps_of_pairs(_footprints(poses_a, size_a), _footprints(poses_b, size_b))


def relative(poses: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (…, 2) in the frames of poses (…, 3)."""
    delta = points - poses[..., :2]
    cos, sin = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    return np.stack(
        [cos * delta[..., 0] + sin * delta[..., 1], cos * delta[..., 1] - sin * delta[..., 0]],
        axis=-1,
    )


def _footprints(poses: FloatArray, size: FloatArray) -> FloatArray:
    """Rectangles (…, 5) as `geometry.box_arrays` has them: x, y, length, width, yaw."""
    sizes = np.broadcast_to(size, (*poses.shape[:-1], 2))
    return np.concatenate([poses[..., :2], sizes, poses[..., 2:]], axis=-1)
