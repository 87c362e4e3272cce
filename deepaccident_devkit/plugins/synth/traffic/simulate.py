"""The simulation of all road users together, step by step, and what each of them notices."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.plugins.synth.roads import Arm
from deepaccident_devkit.plugins.synth.roads.paths import ahead_and_left
from deepaccident_devkit.plugins.synth.traffic.driving import (
    DECISION_STEPS,
    HARDEST_BRAKING,
    PERIOD,
    IdmParameters,
    MotionState,
    RoadUser,
    Tracks,
    can_stop,
    following_acceleration,
    free_acceleration,
    hardest_braking,
    idm_parameters,
    step_motion,
    stopping_acceleration,
)
from deepaccident_devkit.plugins.synth.traffic.rights import (
    AMBER,
    GREEN,
    Rights,
    SignalPlan,
    waiting_gap,
)
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, FrozenArrays, IntArray

_POINT_SPACING_M = 2.0
# Positions ahead along a road user's own path, metres.
_LOOK_AHEAD_POSITIONS = np.arange(0.0, 44.0, _POINT_SPACING_M)
# Lateral clearance that drivers keep on each side.
_SIDE_MARGIN_M = 0.25
# A road user farther behind than this does not count as ahead.
_MAX_DISTANCE_BEHIND_M = 2.0
# Time from one future moment that is checked for a contact to the next.
_ALARM_STEP_S = 0.05
# Half of a driver's field of view: the angle to each side of straight ahead, radians.
_HALF_FIELD_OF_VIEW = np.deg2rad(80.0)
# Drivers whose front is farther past a stop line than this do not stop for it.
_STOP_LINE_TOLERANCE_M = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """Positions and sizes of all road users at one moment.

    Attributes:
        poses: x, y (metres), yaw (radians) of the boxes' centres, shape (A, 3).
        speed: Speeds, shape (A,), m/s.
        length: Lengths, shape (A,), metres.
        width: Widths, shape (A,), metres.
    """

    poses: FloatArray
    speed: FloatArray
    length: FloatArray
    width: FloatArray


def find_leaders(
    bodies: Bodies, tracks: Tracks, centers: FloatArray, sees: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Find the nearest road user ahead on each path.

    Args:
        bodies: Positions and sizes of the road users.
        tracks: Table of their paths.
        centers: Positions of the centres along each path, shape (A,), metres.
        sees: Whether the row's road user reacts to the column's, shape (A, A), bool.

    Returns:
        Gaps (A,), metres, infinite if there is no road user ahead; and the leaders' speeds (A,)
        along the path, m/s.
    """
    rows, others = _find_candidates(bodies, sees)
    gaps = np.full(len(centers), np.inf)
    speeds = np.zeros(len(centers))
    if not len(rows):
        return gaps, speeds
    ahead, lateral, angle = _locate_on_paths(bodies, tracks, centers, rows, others)
    cos = np.abs(np.cos(angle))
    sin = np.abs(np.sin(angle))
    other_length = bodies.length[others]
    other_width = bodies.width[others]
    half_length_along = (cos * other_length + sin * other_width) / 2
    half_width_across = (sin * other_length + cos * other_width) / 2
    free_width = bodies.width[rows] / 2 + half_width_across + _SIDE_MARGIN_M
    blocking = (np.abs(lateral) < free_width) & (ahead > 0)
    rows = rows[blocking]
    others = others[blocking]
    gap = (ahead - half_length_along)[blocking] - bodies.length[rows] / 2
    speed_along = bodies.speed[others] * np.cos(angle[blocking])
    order = np.argsort(-gap, kind="stable")  # the nearest is written last
    ordered_rows = rows[order]
    gaps[ordered_rows] = gap[order]
    speeds[ordered_rows] = np.maximum(speed_along, 0.0)[order]
    return gaps, speeds


def _find_candidates(bodies: Bodies, sees: BoolArray) -> tuple[IntArray, IntArray]:
    """Find the pairs of a road user that looks, and another one near it and not behind it.

    Returns:
        Rows of the first and of the second of each pair, shape (P,) each.
    """
    offsets = bodies.poses[None, :, :2] - bodies.poses[:, None, :2]
    dx = offsets[..., 0]
    dy = offsets[..., 1]
    ahead, _ = ahead_and_left(dx, dy, bodies.poses[:, 2:])
    half_reach = (_LOOK_AHEAD_POSITIONS[-1] + bodies.length)[:, None] / 2
    reach = half_reach + 2.0 * bodies.speed[:, None]
    is_near = dx**2 + dy**2 < reach**2
    is_ahead = ahead > -_MAX_DISTANCE_BEHIND_M
    rows, other_rows = np.nonzero(is_near & is_ahead & sees)
    return rows, other_rows


def _locate_on_paths(
    bodies: Bodies, tracks: Tracks, centers: FloatArray, rows: IntArray, others: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Locate other road users along the paths of the road users that look, for P pairs.

    Args:
        bodies: Positions and sizes of the road users.
        tracks: Table of their paths.
        centers: Positions of the centres along each path, shape (A,), metres.
        rows: Rows of the road users that look, shape (P,).
        others: Rows of the other road users, shape (P,).

    Returns:
        Distances ahead (P,), distances to the left (P,), metres, and angles from the direction of
        the path (P,), radians.
    """
    points, along = tracks.points_near(rows, centers[rows, None] + _LOOK_AHEAD_POSITIONS)
    offsets = bodies.poses[others, None, :2] - points[..., :2]
    nearest_points = (offsets**2).sum(axis=-1).argmin(axis=1)
    pairs = np.arange(len(rows))
    dx, dy = offsets[pairs, nearest_points].T
    yaw = points[pairs, nearest_points, 2]
    cos = np.cos(yaw)
    sin = np.sin(yaw)
    point_ahead = along[pairs, nearest_points] - centers[rows]
    ahead = point_ahead + cos * dx + sin * dy
    lateral = cos * dy - sin * dx
    return ahead, lateral, bodies.poses[others, 2] - yaw


class ContactAlarm:
    """The alarm of a pair before its contact; a driver that noticed it brakes until the end.

    Args:
        rows: Rows of the pair, shape (2,).
        size: Lengths and widths, shape (2, 2), metres.
        alert: Seconds before the contact at which each notices it, shape (2,); 0 for never.
    """

    def __init__(self, rows: IntArray, size: FloatArray, alert: FloatArray) -> None:
        self._rows = rows
        self._size = size
        self._alert = alert
        end = alert.max() + _ALARM_STEP_S / 2
        self._times_ahead = np.arange(0.0, end, _ALARM_STEP_S)
        self._noticed = np.zeros(2, dtype=bool)

    def rows(self, poses: FloatArray, velocities: FloatArray) -> IntArray:
        """Return the rows of the drivers that brake (0 to 2); call it for successive moments.

        Args:
            poses: x, y (metres), yaw (radians) of the centres, shape (A, 3).
            velocities: Velocities, shape (A, 2), m/s, which are assumed to stay.
        """
        pair_poses = poses[self._rows]
        pair_velocities = velocities[self._rows]
        expected_poses = np.repeat(pair_poses[:, None], len(self._times_ahead), axis=1)
        expected_poses[..., :2] += self._times_ahead[:, None] * pair_velocities[:, None]
        pose, other_pose = expected_poses
        touching = separation(pose, self._size[0], other_pose, self._size[1]) <= 0
        if touching.any():
            time_to_contact = self._times_ahead[touching.argmax()]
            is_due = time_to_contact < self._alert
            self._noticed |= is_due & _see_each_other(pair_poses)
        return self._rows[self._noticed]


def _see_each_other(poses: FloatArray) -> BoolArray:
    """Return whether each of a pair sees the other, for poses (2, 3: x, y, yaw)."""
    positions = poses[:, :2]
    dx, dy = (positions[::-1] - positions).T
    bearing = np.arctan2(dy, dx) - poses[:, 2]
    min_cosine = np.cos(_HALF_FIELD_OF_VIEW)
    return np.asarray(np.cos(bearing) > min_cosine)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Simulation(FrozenArrays):
    """The motion of all road users over time; arrays are read-only.

    Attributes:
        time: Times, shape (S,), seconds, in steps of `driving.PERIOD`.
        states: x, y (metres), yaw (radians), speed (m/s) and steering angle (radians), shape
            (S, A, 5); x and y are of the box's centre, speed and yaw of the rear axle, which does
            not slide.
        velocities: Velocities of the box's centre, shape (S, A, 2), m/s.
        contact: Row of the first step at which the watched pair touches; None if it never touches.
    """

    time: FloatArray
    states: FloatArray
    velocities: FloatArray
    contact: int | None

    @property
    def poses(self) -> FloatArray:
        """x, y (metres), yaw (radians) of the boxes' centres, shape (S, A, 3)."""
        return self.states[..., :3]

    @property
    def speeds(self) -> FloatArray:
        """Speeds of the rear axles, shape (S, A), m/s."""
        return self.states[..., 3]


def simulate(
    users: Sequence[RoadUser],
    *,
    begin: float,
    end: float,
    rights: Rights | None = None,
    signals: SignalPlan | None = None,
    watched: tuple[int, int] | None = None,
) -> Simulation:
    """Simulate road users until the end, or until the watched pair touches.

    Args:
        users: The road users.
        begin: Time of the first step, seconds.
        end: Time of the last step, seconds.
        rights: Rules between all pairs; if None, road users do not react to each other.
        signals: Traffic lights; None if there are none.
        watched: Rows of the watched pair; each of the two brakes for the other only at the last
            moment, or never.
    """
    run = _SimulationRun(users, rights, signals, watched)
    num_steps = round((end - begin) / PERIOD) + 1
    times = begin + PERIOD * np.arange(num_steps, dtype=np.float64)
    states = np.empty((num_steps, len(users), 5))
    velocities = np.empty((num_steps, len(users), 2))
    contact = None
    for row in range(num_steps):
        run.write_state(states[row], velocities[row])
        if row % DECISION_STEPS == 0:
            run.decide(states[row], velocities[row], float(times[row]) - begin, float(times[row]))
            if watched is not None:
                start = max(row - DECISION_STEPS, 0)
                contact = _find_contact(states, run.size, watched, start, row + 1)
                if contact is not None:
                    num_steps = contact + 1
                    break
        run.advance()
    return Simulation(
        time=times[:num_steps],
        states=states[:num_steps],
        velocities=velocities[:num_steps],
        contact=contact,
    )


class _SimulationRun:
    """The state of a simulation between its steps."""

    def __init__(
        self,
        users: Sequence[RoadUser],
        rights: Rights | None,
        signals: SignalPlan | None,
        watched: tuple[int, int] | None,
    ) -> None:
        self.size = np.array([user.body.size[:2] for user in users])
        wheelbase = np.array([user.wheelbase for user in users])
        self._walks = np.array([user.walks for user in users])
        self._axle_to_center = wheelbase / 2
        self._wheelbase = np.where(self._walks, np.inf, wheelbase)
        self._walkers = np.flatnonzero(self._walks)
        self._parameters = idm_parameters(users)
        paths = [user.path for user in users]
        lateral = np.array([user.style.lateral for user in users])
        self._tracks = Tracks(paths, lateral, self._walks, [user.pace for user in users])
        self._delay = np.array([user.delay for user in users])
        self._rights = rights
        self._lights = _Lights(users, signals)
        self._alarm: ContactAlarm | None = None
        if watched is not None:
            alert = np.array([users[row].alert for row in watched])
            self._alarm = ContactAlarm(np.array(watched), self.size[[*watched]], alert)
        along = np.array([user.start for user in users]) - self._axle_to_center
        self._on_path = self._tracks.at(along)
        x, y, yaw, _ = self._on_path
        speed = np.array([user.start_speed for user in users], dtype=np.float64)
        self._state = MotionState(x, y, yaw, speed, np.zeros(len(users)), along)
        self._acceleration = np.zeros(len(users))

    def write_state(self, states: FloatArray, velocities: FloatArray) -> None:
        """Fill in states (A, 5) and velocities (A, 2), as in `Simulation`."""
        state = self._state
        cos = np.cos(state.yaw)
        sin = np.sin(state.yaw)
        across = state.speed * np.tan(state.steer) / 2
        states[:, 0] = state.x + self._axle_to_center * cos
        states[:, 1] = state.y + self._axle_to_center * sin
        states[:, 2] = state.yaw
        states[:, 3] = state.speed
        states[:, 4] = state.steer
        velocities[:, 0] = state.speed * cos - across * sin
        velocities[:, 1] = state.speed * sin + across * cos

    def decide(
        self, states: FloatArray, velocities: FloatArray, elapsed: float, time: float
    ) -> None:
        """Choose the acceleration of each road user.

        Args:
            states: States at the moment, shape (A, 5), as in `Simulation`.
            velocities: Velocities, shape (A, 2), m/s.
            elapsed: Time since the first step, seconds.
            time: Time, seconds.
        """
        state = self._state
        allowed = self._tracks.allowed_speed(state.along)
        acceleration = free_acceleration(self._parameters, state.speed, allowed)
        if self._rights is not None:
            acceleration = acceleration + self._compute_reaction(self._rights, states, time)
        acceleration[elapsed < self._delay] = -HARDEST_BRAKING
        if self._alarm is not None:
            braking_rows = self._alarm.rows(states[:, :3], velocities)
            acceleration[braking_rows] = -HARDEST_BRAKING
        self._acceleration = np.maximum(acceleration, -hardest_braking(state.speed))

    def advance(self) -> None:
        """Move all road users by one step."""
        step_motion(self._state, self._acceleration, self._on_path, self._wheelbase)
        self._on_path = self._tracks.at(self._state.along)
        state = self._state
        walkers = self._walkers
        state.x[walkers], state.y[walkers], state.yaw[walkers] = self._on_path[:3, walkers]

    def _compute_reaction(self, rights: Rights, states: FloatArray, time: float) -> FloatArray:
        """Return the accelerations (A,), m/s², 0 or less, that others and red lights cause."""
        parameters = self._parameters
        length = self.size[:, 0]
        speed = self._state.speed
        centers = self._state.along + self._axle_to_center
        front = centers + length / 2
        rear = centers - length / 2
        bodies = Bodies(states[:, :3], speed, length, self.size[:, 1])
        gap, leader_speed = find_leaders(bodies, self._tracks, centers, rights.sees)
        red_gap = self._lights.gap(time, front, speed, parameters)
        faces_red = red_gap < np.inf
        crossing_gap = waiting_gap(rights, front, rear, speed, parameters.max_speed, faces_red)
        stop_gap = np.minimum(red_gap, crossing_gap)
        following = following_acceleration(parameters, speed, gap, leader_speed)
        following = np.where(self._walks, 0.0, following)
        stopping = stopping_acceleration(parameters, speed, stop_gap)
        return np.asarray(np.minimum(following, stopping))


class _Lights:
    """The stop lines of all road users and the colours of their lights."""

    def __init__(self, users: Sequence[RoadUser], signals: SignalPlan | None) -> None:
        self._signals = signals
        self._arms: list[Arm | None] = []
        stop_lines = []
        for user in users:
            arm = None
            stop_line = -np.inf
            if user.route is not None:
                arm = user.route.from_arm
                if "signal" not in user.ignores:
                    stop_line = user.route.stop_s
            self._arms.append(arm)
            stop_lines.append(stop_line)
        self._stop_lines = np.array(stop_lines)

    def gap(
        self, time: float, front: FloatArray, speed: FloatArray, parameters: IdmParameters
    ) -> FloatArray:
        """Return the distances (A,) to the stop lines, metres; infinite for drivers that may go.

        Args:
            time: Time, seconds.
            front: Positions of the fronts along each path, shape (A,), metres.
            speed: Speeds, shape (A,), m/s.
            parameters: Parameters of the road users.
        """
        if self._signals is None:
            return np.full(len(front), np.inf)
        arms = {arm for arm in self._arms if arm is not None}
        color_by_arm = {arm: int(self._signals.state(arm, time)) for arm in arms}
        color = np.array([color_by_arm[arm] if arm else GREEN for arm in self._arms])
        gap = self._stop_lines - front
        has_to_stop = (color != GREEN) & (gap > -_STOP_LINE_TOLERANCE_M)
        has_to_stop &= (color != AMBER) | can_stop(parameters, speed, gap)
        return np.where(has_to_stop, np.maximum(gap, 0.0), np.inf)


def _find_contact(
    states: FloatArray, size: FloatArray, pair: tuple[int, int], start: int, stop: int
) -> int | None:
    """Return the first step at which the boxes of a pair touch.

    Args:
        states: States as in `Simulation`, shape (S, A, 5).
        size: Lengths and widths, shape (A, 2), metres.
        pair: Rows of the pair.
        start: First step to look at.
        stop: Step after the last one to look at.

    Returns:
        None if they do not touch.
    """
    row, other_row = pair
    poses = states[start:stop, row, :3]
    other_poses = states[start:stop, other_row, :3]
    touching: BoolArray = separation(poses, size[row], other_poses, size[other_row]) <= 0
    if not touching.any():
        return None
    return start + int(touching.argmax())


def separation(
    poses_a: FloatArray, size_a: FloatArray, poses_b: FloatArray, size_b: FloatArray
) -> FloatArray:
    """Return the widest gaps between rectangles along any side's normal.

    All arguments broadcast.

    Args:
        poses_a: x, y, yaw of the centres, shape (…, 3).
        size_a: Full lengths and widths, shape (…, 2), metres.
        poses_b: Poses of the other rectangles.
        size_b: Sizes of the other rectangles.

    Returns:
        Gaps (…), metres: 0 where rectangles just touch, negative if they overlap.
    """
    angle = poses_b[..., 2] - poses_a[..., 2]
    cos = np.abs(np.cos(angle))
    sin = np.abs(np.sin(angle))
    offset_a = np.abs(to_pose_frame(poses_a, poses_b[..., :2]))
    offset_b = np.abs(to_pose_frame(poses_b, poses_a[..., :2]))
    half_length_a = size_a[..., 0] / 2
    half_width_a = size_a[..., 1] / 2
    half_length_b = size_b[..., 0] / 2
    half_width_b = size_b[..., 1] / 2
    gaps = [
        offset_a[..., 0] - half_length_a - half_length_b * cos - half_width_b * sin,
        offset_a[..., 1] - half_width_a - half_length_b * sin - half_width_b * cos,
        offset_b[..., 0] - half_length_b - half_length_a * cos - half_width_a * sin,
        offset_b[..., 1] - half_width_b - half_length_a * sin - half_width_a * cos,
    ]
    stacked_gaps = np.stack(np.broadcast_arrays(*gaps))
    return np.asarray(np.max(stacked_gaps, axis=0))


def gap(
    poses_a: FloatArray, size_a: FloatArray, poses_b: FloatArray, size_b: FloatArray
) -> FloatArray:
    """Return the distances between rectangles (…), metres, 0 where they overlap.

    The arguments are as in `separation`. Two disjoint rectangles are nearest at a corner of one of
    them.
    """
    return gaps_of_pairs(_stack_footprints(poses_a, size_a), _stack_footprints(poses_b, size_b))


def to_pose_frame(poses: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (…, 2) in the frames of poses (…, 3)."""
    offsets = points - poses[..., :2]
    dx = offsets[..., 0]
    dy = offsets[..., 1]
    ahead, lateral = ahead_and_left(dx, dy, poses[..., 2])
    return np.stack([ahead, lateral], axis=-1)


def _stack_footprints(poses: FloatArray, size: FloatArray) -> FloatArray:
    """Return rectangles (…, 5) as for `geometry.box_arrays`: x, y, length, width, yaw."""
    leading_shape = poses.shape[:-1]
    sizes = np.broadcast_to(size, (*leading_shape, 2))
    xy = poses[..., :2]
    yaw = poses[..., 2:]
    return np.concatenate([xy, sizes, yaw], axis=-1)
