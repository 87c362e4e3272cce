"""The road users at the start of a scenario, and how it unfolds with and without broken rules.

Part of the simulation is recorded. The recording ends at the impact, when the ego has passed the
junction, or when time is up.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from deepaccident_devkit.plugins.synth.roads import Junction
from deepaccident_devkit.plugins.synth.spec import ScenarioSpec
from deepaccident_devkit.plugins.synth.spec.checks import LEADERS
from deepaccident_devkit.plugins.synth.spec.model import Role
from deepaccident_devkit.plugins.synth.traffic.background import (
    ParkedVehicle,
    background_users,
    parked_vehicles,
)
from deepaccident_devkit.plugins.synth.traffic.driving import RoadUser, distance_to_middle
from deepaccident_devkit.plugins.synth.traffic.grazes import find_swerves
from deepaccident_devkit.plugins.synth.traffic.lifelike import (
    NORMAL_FRAMES,
    AccidentKind,
    continue_past_contact,
    crowd_kerb,
    draw_accident_duration,
    vary_driving,
)
from deepaccident_devkit.plugins.synth.traffic.placement import WARM_UP, Cast, cast_actors
from deepaccident_devkit.plugins.synth.traffic.rights import (
    AXIS_OF_ARM,
    SignalPlan,
    find_rights,
    plan_with_green,
)
from deepaccident_devkit.plugins.synth.traffic.simulate import Simulation, gap, separation, simulate
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.taxonomy import FRAME_PERIOD

_ContactSide = Literal["front", "front_side", "rear", "rear_side"]
Relation = Literal["same", "opposite"]
# Steps from one search for road users near each other to the next, and the distance by which two
# can come nearer in between.
_SEARCH_STEPS = 5
_NEAR_MARGIN_M = 2.0
# Two drive towards each other if the cosine of the angle between their headings is smaller.
_MAX_OPPOSITE_COSINE = -0.5
# Impact for each m² of the first box and each m/s, so that the numbers are about as large as in the
# real release.
_IMPACT_PER_AREA = 60.0
_NUM_HALVINGS = 40
_GREEN_TIMES = (14.0, 20.0)
# Smallest and largest fraction of the green phase that has passed when the pair meets.
_GREEN_SHARES = (0.35, 0.75)
# Time from the planned meeting to the end of a simulated accident, if the pair does not touch
# before.
_MAX_LATENESS_S = 1.5
# Maximum number of runs of a simulation; each run leaves out the background road users that
# touched another road user in the previous run.
_MAX_ROUNDS = 5
# Time before the meeting at which the background starts to drive; in a longer scenario it stands
# until then.
_MAX_BACKGROUND_DRIVE_S = 11.0
# Two road users that come nearer to each other than this count as touching.
_TOUCHING_MARGIN_M = 0.1
# Smallest distance between named road users in a normal twin.
_CLEARANCE_M = 1.0
# Delays in seconds of one of the pair where obeying the rules does not prevent a collision;
# tried in this order.
_DELAYS = (0.0, 1.5, 3.0, 5.0, 8.0, 1000.0)
# Smallest and largest number of frames of a recording if no number is given, as in the release.
_MIN_FRAMES = 40
_MAX_FRAMES = 100
# Smallest number of frames of a recording with a kind of accident.
_MIN_LIFELIKE_FRAMES = 36
# Shortest time from the beginning until the pair meets, and latest end of a normal scenario.
_MIN_DURATION_S = 5.5
_MAX_END_S = 10.0
# Shortest time from the start of the recording to a contact other than the accident, and from
# that contact to the end.
_TIME_BEFORE_GRAZE_S = 1.5
_TIME_AFTER_GRAZE_S = 1.0
# A normal scenario also ends when the ego is this far past the middle of the junction,
# which is checked after every few steps.
_ARRIVAL_DISTANCE_M = 25.0
_ARRIVAL_STEPS = 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stage:
    """All road users of a scenario at its beginning.

    Attributes:
        spec: Draw of the scenario.
        junction: Roads of the scenario.
        cast: Named road users.
        background: All other road users that move.
        parked: Parked vehicles.
        signals: Traffic lights, None if there are none.
        kind: Kind of accident in a lifelike release; None in a designed one.
    """

    spec: ScenarioSpec
    junction: Junction
    cast: Cast
    background: tuple[RoadUser, ...]
    parked: tuple[ParkedVehicle, ...]
    signals: SignalPlan | None
    kind: AccidentKind | None = None

    @property
    def unlabelled(self) -> int | None:
        """Row of the road user that labels and sensors leave out; None if there is none."""
        if self.cast.pair is None or self.kind is None or self.kind.labelled:
            return None
        return self.cast.pair[1]

    @property
    def users(self) -> tuple[RoadUser, ...]:
        """All road users that move; the named ones are first."""
        return (*self.cast.users, *self.background)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Performance:
    """The simulation of a stage.

    Attributes:
        simulation: Simulation of the road users in `present`.
        present: Rows of the stage's users that took part: all except background road users that
            would have touched another road user.
    """

    simulation: Simulation
    present: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Impact:
    """The end of an accident.

    Attributes:
        time: Time at which the boxes first touch, seconds.
        relation: Whether the two actors drive the same way or towards each other, in the meta
            file's words.
        side: Side of the first actor's box that is hit, in the meta file's words.
        strength: Impact in the meta file.
    """

    time: float
    relation: Relation
    side: _ContactSide
    strength: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """A recorded part of a performance.

    Attributes:
        performance: The performance.
        start: Time of the first recorded frame, in the simulation's time, seconds.
        frames: Number of recorded frames.
        impact: Impact at the end; None if there is none.
    """

    performance: Performance
    start: float
    frames: int
    impact: Impact | None


def set_stage(
    rng: np.random.Generator,
    spec: ScenarioSpec,
    junction: Junction,
    duration: float,
    kind: AccidentKind | None = None,
) -> Stage:
    """Place all road users at the start of a scenario.

    Args:
        rng: Generator of random numbers.
        spec: The scenario.
        junction: Junction of the scenario.
        duration: Time from the first recorded frame to the meeting of the pair, seconds.
        kind: Kind of accident; None in a designed release.
    """
    cast = cast_actors(rng, spec, junction, duration, kind)
    signals = _draw_signals(rng, cast) if spec.road.signalized else None
    standing_time = max(duration - _MAX_BACKGROUND_DRIVE_S, 0.0)
    drive_begin = cast.begin + standing_time
    background = background_users(rng, spec, junction, cast.users, signals, drive_begin)
    walking = [user for user in cast.users if user.walks]
    parked = tuple(parked_vehicles(rng, spec, junction, walking))
    if kind is not None:
        background = [vary_driving(rng, user, kind.traffic, drive_begin) for user in background]
        parked = crowd_kerb(rng, parked)
    background = [_add_delay(user, standing_time) for user in background]
    return Stage(
        spec=spec,
        junction=junction,
        cast=cast,
        background=tuple(background),
        parked=parked,
        signals=signals,
        kind=kind,
    )


def try_accident(stage: Stage) -> Performance | float:
    """Simulate a stage in which the pair breaks its rules, up to the pair's contact.

    Returns:
        The performance; if the pair does not touch, the smallest distance between the two in
        metres, or infinity if their paths do not cross or if others touch first.
    """
    pair = stage.cast.pair
    if pair is None:
        return np.inf
    # Followers could not proceed if their leaders waited.
    leader_roles = {LEADERS.get(stage.users[row].role) for row in pair}
    users = list(stage.users)
    pushing = []
    for row, user in enumerate(stage.cast.users):
        if row in pair or user.role in leader_roles:
            pushing.append(row)
            users[row] = replace(user, ignores=("signal", "priority"))
    performance = _perform(stage, users, _MAX_LATENESS_S, watched=pair, pushing=pushing)
    if performance is None:
        return np.inf
    simulation = performance.simulation
    if simulation.contact is not None:
        return performance
    return min_gap(simulation.poses, _gather_sizes(stage.cast.users), list(pair), np.inf)


def perform_twin(stage: Stage, end: float) -> Performance | None:
    """Simulate a stage up to `end` (seconds) with road users that all obey the rules.

    Returns:
        The performance with the first delay at which the named road users keep clear of each other.
        If there is none, the one with the first delay at which no road users touch; None if named
        road users touch at every delay.
    """
    delayed_roles = _choose_delayed_roles(stage.cast)
    close_performance = None
    for delay in _DELAYS:
        users = []
        for user in stage.users:
            seconds = delay if user.role in delayed_roles else 0.0
            users.append(_delay_user(user.obeying(), seconds))
        performance = _perform(stage, users, end)
        if performance is None:
            continue
        rows = list(range(len(stage.cast.users)))
        sizes = _gather_sizes(stage.cast.users)
        if min_gap(performance.simulation.poses, sizes, rows, _CLEARANCE_M) >= _CLEARANCE_M:
            return performance
        if close_performance is None:
            close_performance = performance
    return close_performance


def record_accident(
    rng: np.random.Generator, stage: Stage, performance: Performance, frames: int | None
) -> Recording:
    """Cut the recording of an accident out of its performance.

    It ends with the impact or, for a stage with a kind of accident, shortly before or after it.

    Args:
        rng: Generator of random numbers.
        stage: The stage.
        performance: Performance of the stage.
        frames: Number of frames; None records all frames, within limits.
    """
    pair = stage.cast.pair or (0, 0)
    size = _gather_sizes([stage.users[row] for row in pair])
    impact = measure_impact(performance.simulation, pair, size)
    end = impact.time
    if stage.kind is not None:
        simulation, time_after = continue_past_contact(
            rng, performance.simulation, pair, size, stage.kind.traffic
        )
        performance = replace(performance, simulation=simulation)
        end = end + time_after
    num_frames = frames or _count_frames(stage, end)
    start = end - FRAME_PERIOD * (num_frames - 1)
    return Recording(performance=performance, start=start, frames=num_frames, impact=impact)


def record_normal(
    rng: np.random.Generator, stage: Stage, performance: Performance, frames: int | None
) -> Recording:
    """Cut the recording of a normal scenario out of its performance.

    In a designed release, the recording ends when the ego has passed the junction or when time is
    up; otherwise, its length is drawn. If `frames` is smaller, the recording starts later; if it is
    larger, the recording ends later.

    The arguments are as in `record_accident`.
    """
    earliest_start = stage.cast.begin + WARM_UP
    if stage.kind is None:
        end = min(_find_arrival_time(stage, performance), earliest_start + _MAX_END_S)
        default_frames = _count_frames(stage, end)
    else:
        default_frames = int(rng.integers(*NORMAL_FRAMES))
    if frames is None:
        return Recording(
            performance=performance, start=earliest_start, frames=default_frames, impact=None
        )
    end = earliest_start + FRAME_PERIOD * (max(default_frames, frames) - 1)
    start = end - FRAME_PERIOD * (frames - 1)
    return Recording(performance=performance, start=start, frames=frames, impact=None)


def add_graze(stage: Stage, recording: Recording) -> Recording:
    """Return a recording in which one vehicle sideswipes another that it passes closely.

    Neither of the two is in the accident. If no vehicles pass closely, the recording is returned
    unchanged.
    """
    performance = recording.performance
    pair = stage.cast.pair or ()
    users = [stage.users[row] for row in performance.present]
    drivers = []
    for position, row in enumerate(performance.present):
        if row not in pair and not users[position].walks:
            drivers.append(position)
    end = recording.start + FRAME_PERIOD * recording.frames
    window = (recording.start + _TIME_BEFORE_GRAZE_S, end - _TIME_AFTER_GRAZE_S)
    previous_pairs = _find_touching(stage, users, performance.simulation)
    sizes = _gather_sizes(users)
    for new_pair, simulation in find_swerves(performance.simulation, sizes, drivers, window):
        pairs = _find_touching(stage, users, simulation)
        if sorted(pairs) == sorted([*previous_pairs, new_pair]):
            grazing = replace(performance, simulation=simulation)
            return replace(recording, performance=grazing)
    return recording


def draw_duration(
    rng: np.random.Generator, frames: int | None, kind: AccidentKind | None = None
) -> float:
    """Draw the time from the first recorded frame until the pair meets, seconds.

    It is at least as long as the number of frames needs.
    """
    if kind:
        duration = draw_accident_duration(rng, kind.traffic)
    else:
        duration = rng.uniform(_MIN_DURATION_S, _MAX_END_S + 0.3)
    if frames is None:
        return duration
    return max(duration, frames * FRAME_PERIOD + 1.5)


def is_long_enough(stage: Stage, accident: Performance, frames: int | None) -> bool:
    """Return whether an accident has begun early enough for its recording.

    This is always true of a designed accident.
    """
    if stage.kind is None:
        return True
    min_duration = FRAME_PERIOD * (frames or _MIN_LIFELIKE_FRAMES)
    duration = accident.simulation.time[-1] - stage.cast.begin
    return bool(duration > min_duration)


def latest_end(stage: Stage, frames: int | None) -> float:
    """Return the time until which a normal scenario is simulated, seconds."""
    min_duration = (frames or 0) * FRAME_PERIOD
    return stage.cast.begin + WARM_UP + max(_MAX_END_S, min_duration)


def _add_delay(user: RoadUser, seconds: float) -> RoadUser:
    """Return the same road user, which stands still for some seconds first."""
    if seconds == 0:
        return user
    return replace(user, start_speed=0.0, delay=user.delay + seconds)


def _choose_delayed_roles(cast: Cast) -> tuple[Role, ...]:
    """Return the roles that come later if there is a delay.

    They are the roles of the pair except ego and other; if there are none, other and its follower.
    """
    strangers = []
    for row in cast.pair or ():
        role = cast.users[row].role
        if role not in ("ego", "other"):
            strangers.append(role)
    return tuple(strangers) or ("other", "other_behind")


def _delay_user(user: RoadUser, seconds: float) -> RoadUser:
    """Return the same road user, some seconds later."""
    if seconds == 0:
        return user
    start = user.start - user.start_speed * seconds
    if user.start_speed == 0 or start < user.body.size[0]:
        return _add_delay(user, seconds)
    return replace(user, start=start)


def _perform(
    stage: Stage,
    users: Sequence[RoadUser],
    end: float,
    watched: tuple[int, int] | None = None,
    pushing: Sequence[int] = (),
) -> Performance | None:
    """Simulate road users repeatedly, until no two of them touch.

    Each run leaves out the background road users that touched another road user.

    Args:
        stage: The stage.
        users: Road users of the stage, the named ones first.
        end: Time of the last step, seconds.
        watched: Rows of the pair that may touch; the simulation ends when they touch.
        pushing: Rows of road users that do not give way.

    Returns:
        None if named road users touch.
    """
    present_rows = list(range(len(users)))
    allowed_pair = tuple(sorted(watched or ()))
    for _ in range(_MAX_ROUNDS):
        present_users = [users[row] for row in present_rows]
        rights = find_rights(
            present_users, minor=stage.spec.road.yielding_arms, blind=watched, pushing=pushing
        )
        simulation = simulate(
            present_users,
            begin=stage.cast.begin,
            end=end,
            rights=rights,
            signals=stage.signals,
            watched=watched,
        )
        touching = _find_touching(stage, present_users, simulation)
        forbidden_pairs = [pair for pair in touching if pair != allowed_pair]
        if not forbidden_pairs:
            return Performance(simulation=simulation, present=tuple(present_rows))
        leaving = set()
        for row, other_row in forbidden_pairs:
            # Rows after the users are parked vehicles, which cannot leave.
            leaving.add(other_row if other_row < len(present_users) else row)
        if min(leaving) < len(stage.cast.users):
            return None
        present_rows = [row for position, row in enumerate(present_rows) if position not in leaving]
    return None


def _find_touching(
    stage: Stage, users: Sequence[RoadUser], simulation: Simulation
) -> list[tuple[int, int]]:
    """Return the pairs of rows that touch, the lower row first.

    Parked vehicles have the rows after the users.
    """
    num_steps = len(simulation.time)
    parked_poses = np.array([vehicle.pose for vehicle in stage.parked]).reshape(-1, 3)
    standing_poses = np.broadcast_to(parked_poses, (num_steps, *parked_poses.shape))
    poses = np.concatenate([simulation.poses, standing_poses], axis=1)
    sizes = _gather_sizes([*users, *stage.parked])
    pairs = []
    for row, other_row in touching_pairs(poses, sizes, _TOUCHING_MARGIN_M):
        if row < len(users):
            pairs.append((row, other_row))
    return pairs


def _gather_sizes(users: Sequence[RoadUser | ParkedVehicle]) -> FloatArray:
    """Return the lengths and widths of bodies, shape (A, 2), metres."""
    sizes = [user.body.size for user in users]
    return np.array(sizes)[:, :2]


def _draw_signals(rng: np.random.Generator, cast: Cast) -> SignalPlan:
    """Draw a signal plan that is green at time 0 for the first of the pair who obeys signals.

    At time 0 the pair meets. If there is no pair, or neither of the two obeys, it is green for the
    ego.
    """
    axis = AXIS_OF_ARM["west"]
    for row in (*(cast.pair or ()), cast.row_of("ego")):
        user = cast.users[row]
        if user.route is not None and "signal" not in user.ignores:
            axis = AXIS_OF_ARM[user.route.from_arm]
            break
    green = rng.uniform(*_GREEN_TIMES)
    share = rng.uniform(*_GREEN_SHARES)
    meeting_time = 0.0
    return plan_with_green(axis, meeting_time, green, share)


def _count_frames(stage: Stage, end: float) -> int:
    """Return the number of frames up to a time (seconds), within limits."""
    duration = end - (stage.cast.begin + WARM_UP)
    frames = int(duration / FRAME_PERIOD + 1e-6) + 1
    min_frames = _MIN_FRAMES if stage.kind is None else _MIN_LIFELIKE_FRAMES
    return int(np.clip(frames, min_frames, _MAX_FRAMES))


def _find_arrival_time(stage: Stage, performance: Performance) -> float:
    """Return the time at which the ego is far enough past the junction, seconds.

    The result is infinite if ego never gets that far.
    """
    row = stage.cast.row_of("ego")
    ego = stage.users[row]
    simulation = performance.simulation
    if ego.route is None:
        return np.inf
    column = performance.present.index(row)
    positions = simulation.poses[::_ARRIVAL_STEPS, column, :2]
    along, _ = ego.path.project(positions)
    has_arrived = along > distance_to_middle(ego.route) + _ARRIVAL_DISTANCE_M
    if not has_arrived.any():
        return np.inf
    step = _ARRIVAL_STEPS * has_arrived.argmax()
    return float(simulation.time[step])


def measure_impact(simulation: Simulation, pair: tuple[int, int], size: FloatArray) -> Impact:
    """Return the impact at the contact that ends a simulation.

    Args:
        simulation: The simulation.
        pair: Rows of the pair.
        size: Lengths and widths of the pair, shape (2, 2), metres.
    """
    rows = list(pair)
    end_poses = simulation.poses[-1][rows]
    previous_poses = end_poses
    end_time = float(simulation.time[-1])
    period = 0.0
    if len(simulation.time) > 1:
        previous_poses = simulation.poses[-2][rows]
        period = end_time - float(simulation.time[-2])
    share = _find_contact_share(previous_poses, end_poses, size)
    poses = previous_poses + share * (end_poses - previous_poses)
    is_opposite = np.cos(poses[0, 2] - poses[1, 2]) < _MAX_OPPOSITE_COSINE
    velocity, other_velocity = simulation.velocities[-1][rows]
    relative_speed = np.hypot(*(velocity - other_velocity))
    return Impact(
        time=end_time - (1.0 - share) * period,
        relation="opposite" if is_opposite else "same",
        side=contact_side(poses, size),
        strength=float(_IMPACT_PER_AREA * size[0].prod() * relative_speed),
    )


def _find_contact_share(before: FloatArray, after: FloatArray, size: FloatArray) -> float:
    """Find by bisection the fraction of a step that has passed when a pair's boxes touch.

    The boxes touch at the returned fraction.

    Args:
        before: Poses of the pair before the step, shape (2, 3).
        after: Poses after the step, shape (2, 3).
        size: Lengths and widths, shape (2, 2), metres.
    """
    apart_share = 0.0
    touching_share = 1.0
    for _ in range(_NUM_HALVINGS):
        share = (apart_share + touching_share) / 2
        pose, other_pose = before + share * (after - before)
        if separation(pose, size[0], other_pose, size[1]) > 0:
            apart_share = share
        else:
            touching_share = share
    return touching_share


def contact_side(poses: FloatArray, size: FloatArray) -> _ContactSide:
    """Return the side of the first of two boxes that faces the second.

    The side faces it across the widest gap along any side's normal. For flanks, the result depends
    on the half, before or behind the first box's middle, in which the middle of the second is.

    Args:
        poses: x, y (metres), yaw (radians) of the centres, shape (2, 3).
        size: Lengths and widths, shape (2, 2), metres.
    """
    cos = np.cos(poses[:, 2])
    sin = np.sin(poses[:, 2])
    forward = np.stack([cos, sin], axis=1)
    left = np.stack([-sin, cos], axis=1)
    axes = np.stack([forward, left], axis=1)  # box, axis, xy
    normals = axes.reshape(4, 2)
    half_extents = np.einsum("na,bka->nbk", normals, axes) * size / 2
    min_offsets = np.abs(half_extents).sum(axis=(1, 2))
    to_second = poses[1, :2] - poses[0, :2]
    offsets = normals @ to_second
    widest = np.argmax(np.abs(offsets) - min_offsets)
    direction = normals[widest] * np.sign(offsets[widest])
    ahead, left_part = axes[0] @ direction
    if abs(ahead) >= abs(left_part):
        return "front" if ahead > 0 else "rear"
    return "front_side" if forward[0] @ to_second >= 0 else "rear_side"


def touching_pairs(poses: FloatArray, size: FloatArray, margin: float) -> list[tuple[int, int]]:
    """Return pairs of rows that come nearer to each other than `margin`, along any side's normal.

    Args:
        poses: x, y (metres), yaw (radians) of the boxes' centres, shape (S, A, 3).
        size: Lengths and widths, shape (A, 2), metres.
        margin: Distance, metres.

    Returns:
        Pairs with the lower row first.
    """
    pairs = []
    for i, j in _find_near_pairs(poses, size, margin):
        gaps = separation(poses[:, i], size[i], poses[:, j], size[j])
        if gaps.min() < margin:
            pairs.append((i, j))
    return pairs


def min_gap(poses: FloatArray, size: FloatArray, rows: list[int], max_gap: float) -> float:
    """Return the smallest distance between any two of some road users, metres.

    Args:
        poses: x, y (metres), yaw (radians) of the boxes' centres, shape (S, A, 3).
        size: Lengths and widths, shape (A, 2), metres.
        rows: Rows of the road users.
        max_gap: Result if all distances are larger, metres.
    """
    poses = poses[:, rows]
    size = size[rows]
    gaps = [max_gap]
    for i, j in _find_near_pairs(poses, size, max_gap):
        distances = gap(poses[:, i], size[i], poses[:, j], size[j])
        gaps.append(float(distances.min()))
    return min(gaps)


def _find_near_pairs(poses: FloatArray, size: FloatArray, margin: float) -> list[tuple[int, int]]:
    """Return the pairs of rows that may come nearer to each other than `margin`, metres."""
    sampled_poses = np.concatenate([poses[::_SEARCH_STEPS], poses[-1:]])
    positions = sampled_poses[..., :2]
    offsets = positions[:, :, None] - positions[:, None]
    square_distances = (offsets**2).sum(axis=-1)
    radius = np.hypot(size[:, 0], size[:, 1]) / 2
    max_distance = radius[:, None] + radius + margin + _NEAR_MARGIN_M
    is_near = (square_distances < max_distance**2).any(axis=0)
    rows, columns = np.nonzero(np.triu(is_near, 1))
    return list(zip(rows.tolist(), columns.tolist(), strict=True))
