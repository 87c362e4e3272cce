"""A scenario's road users at its beginning, and its course with and without broken rules.

A part of that course is recorded: it ends with the impact, or when ego has arrived, or when time is
over.
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
from deepaccident_devkit.plugins.synth.traffic.driving import RoadUser, middle_of
from deepaccident_devkit.plugins.synth.traffic.grazes import swerves
from deepaccident_devkit.plugins.synth.traffic.lifelike import (
    NORMAL_FRAMES,
    AccidentKind,
    accident_duration,
    beyond_contact,
    crowded,
    lively,
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
# Steps between two searches for road users near each other, and the distance by which two can come
# nearer in between.
_LOOK_STEPS = 5
_NEAR_MARGIN_M = 2.0
# Cosine of the angle between two headings below which they drive towards each other.
_MAX_OPPOSITE_COSINE = -0.5
# Impact for each m² of the first box and m/s; so the numbers are about as large as in the real
# release.
_IMPACT_PER_AREA = 60.0
_NUM_HALVINGS = 40
_GREEN_TIMES = (14.0, 20.0)
# Smallest and largest share of the green that is over when the pair meets.
_GREEN_SHARES = (0.35, 0.75)
# A simulated accident ends this long after the planned meeting, if the pair does not touch before.
_MAX_LATENESS_S = 1.5
# Largest number of runs of a simulation; each leaves out the road users of the background that
# touched somebody in the run before.
_MAX_ROUNDS = 5
# The background starts to drive this long before the meeting; in a longer scenario it stands until
# then.
_MAX_BACKGROUND_DRIVE_S = 11.0
# Two that come nearer than this count as touching.
_TOUCHING_MARGIN_M = 0.1
# Smallest distance between named road users in a normal twin.
_CLEARANCE_M = 1.0
# Seconds by which one of the pair comes later if the rules do not prevent a collision; tried in
# this order.
_DELAYS = (0.0, 1.5, 3.0, 5.0, 8.0, 1000.0)
# Smallest and largest number of frames of a recording if no number is given, as in the release.
_MIN_FRAMES = 40
_MAX_FRAMES = 100
# Smallest number of frames of a recording with a kind of accident.
_MIN_LIFELIKE_FRAMES = 36
# Shortest time from the beginning until the pair meets, and latest end of a normal scenario.
_MIN_DURATION_S = 5.5
_MAX_END_S = 10.0
# Shortest time from the beginning of the recording to a contact beside the accident, and from that
# contact to the end.
_TIME_BEFORE_GRAZE_S = 1.5
_TIME_AFTER_GRAZE_S = 1.0
# A normal scenario also ends when ego is this far past the middle of the junction.
_ARRIVAL_DISTANCE_M = 25.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stage:
    """All road users of a scenario at its beginning.

    Attributes:
        spec: Draw of the scenario.
        junction: Its roads.
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
    """The course of a stage.

    Attributes:
        simulation: Simulation of the road users in `present`.
        present: Rows of the stage's users that took part: all except users of the background that
            would have touched somebody.
    """

    simulation: Simulation
    present: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Impact:
    """The end of an accident.

    Attributes:
        time: Time at which the boxes first touch, seconds.
        relation: Whether the two drive the same way, or towards each other, in the meta file's
            words.
        side: Side of the first one's box that is hit, in the meta file's words.
        strength: Impact in the meta file.
    """

    time: float
    relation: Relation
    side: _ContactSide
    strength: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recorded:
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
    """Place everyone at the beginning of a scenario.

    Args:
        rng: Generator of random numbers.
        spec: The scenario.
        junction: Its junction.
        duration: Time from the first recorded frame to the meeting of the pair, seconds.
        kind: Kind of accident; None in a designed release.
    """
    cast = cast_actors(rng, spec, junction, duration, kind)
    signals = _signal_plan(rng, cast) if spec.road.signalized else None
    standing_time = max(duration - _MAX_BACKGROUND_DRIVE_S, 0.0)
    drive_begin = cast.begin + standing_time
    background = background_users(rng, spec, junction, cast.users, signals, drive_begin)
    walking = [user for user in cast.users if user.walks]
    parked = tuple(parked_vehicles(rng, spec, junction, walking))
    if kind is not None:
        background = [lively(rng, user, kind.traffic, drive_begin) for user in background]
        parked = crowded(rng, parked)
    return Stage(
        spec=spec,
        junction=junction,
        cast=cast,
        background=tuple(_standing_first(user, standing_time) for user in background),
        parked=parked,
        signals=signals,
        kind=kind,
    )


def try_accident(stage: Stage) -> Performance | float:
    """Simulate a stage up to the contact of a pair that breaks its rules.

    Returns:
        The performance; if the pair does not touch, its smallest distance in metres. It is infinite
        if the paths do not cross, or if others touch before.
    """
    pair = stage.cast.pair
    if pair is None:
        return np.inf
    # Followers could not come if their leaders waited.
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
    if performance.simulation.contact is not None:
        return performance
    return min_gap(performance.simulation.poses, _sizes(stage.cast.users), list(pair), np.inf)


def perform_twin(stage: Stage, end: float) -> Performance | None:
    """Simulate a stage up to `end` (seconds) with road users that all obey the rules.

    Returns:
        The performance with the first delay with which the named road users keep clear of each
        other, or if there is none, with the first delay with which nobody touches; None if named
        road users touch with every delay.
    """
    later_roles = _later_roles(stage.cast)
    narrow_performance = None
    for delay in _DELAYS:
        users = []
        for user in stage.users:
            seconds = delay if user.role in later_roles else 0.0
            users.append(_later(user.obeying(), seconds))
        performance = _perform(stage, users, end)
        if performance is None:
            continue
        if _keep_clear(stage, performance):
            return performance
        narrow_performance = narrow_performance or performance
    return narrow_performance


def recorded_accident(
    rng: np.random.Generator, stage: Stage, performance: Performance, frames: int | None
) -> Recorded:
    """Cut the recording that ends with the impact, or, with a kind of accident, about then.

    Args:
        rng: Generator of random numbers.
        stage: The stage.
        performance: Its performance.
        frames: Number of frames; None records all frames, within limits.
    """
    pair = stage.cast.pair or (0, 0)
    size = _sizes([stage.users[row] for row in pair])
    impact = impact_of(performance.simulation, pair, size)
    end = impact.time
    if stage.kind is not None:
        simulation, time_after = beyond_contact(
            rng, performance.simulation, pair, size, stage.kind.traffic
        )
        performance = replace(performance, simulation=simulation)
        end = end + time_after
    count = frames or _natural_frames(stage, end)
    start = end - FRAME_PERIOD * (count - 1)
    return Recorded(performance=performance, start=start, frames=count, impact=impact)


def recorded_normal(
    rng: np.random.Generator, stage: Stage, performance: Performance, frames: int | None
) -> Recorded:
    """Cut the recording that ends when ego has arrived, or when time is over.

    The arguments are as in `recorded_accident`.
    """
    begin = stage.cast.begin + WARM_UP
    if stage.kind is None:
        arrival_time = _arrival_time(stage, performance)
        natural_frames = _natural_frames(stage, min(arrival_time, begin + _MAX_END_S))
    else:
        natural_frames = int(rng.integers(*NORMAL_FRAMES))
    if frames is None:
        return Recorded(performance=performance, start=begin, frames=natural_frames, impact=None)
    end = begin + FRAME_PERIOD * (max(natural_frames, frames) - 1)
    start = end - FRAME_PERIOD * (frames - 1)
    return Recorded(performance=performance, start=start, frames=frames, impact=None)


def with_graze(stage: Stage, recorded: Recorded) -> Recorded:
    """Return a recording in which a driver scrapes along another one that it passes closely.

    None of the two is in the accident. If nobody passes closely, the recording stays as it is.
    """
    performance = recorded.performance
    pair = stage.cast.pair or ()
    users = [stage.users[row] for row in performance.present]
    drivers = []
    for position, row in enumerate(performance.present):
        if row not in pair and not users[position].walks:
            drivers.append(position)
    end = recorded.start + FRAME_PERIOD * recorded.frames
    window = (recorded.start + _TIME_BEFORE_GRAZE_S, end - _TIME_AFTER_GRAZE_S)
    previous_pairs = _touching(stage, users, performance.simulation)
    for new_pair, simulation in swerves(performance.simulation, _sizes(users), drivers, window):
        pairs = _touching(stage, users, simulation)
        if sorted(pairs) == sorted([*previous_pairs, new_pair]):
            return replace(recorded, performance=replace(performance, simulation=simulation))
    return recorded


def usual_duration(
    rng: np.random.Generator, frames: int | None, kind: AccidentKind | None = None
) -> float:
    """Draw the time from the beginning until the pair meets, seconds.

    It is at least as long as the number of frames needs.
    """
    if kind:
        duration = float(accident_duration(rng, kind.traffic))
    else:
        duration = float(rng.uniform(_MIN_DURATION_S, _MAX_END_S + 0.3))
    if frames is None:
        return duration
    return max(duration, frames * FRAME_PERIOD + 1.5)


def lasts(stage: Stage, accident: Performance, frames: int | None) -> bool:
    """Return whether an accident has begun early enough for its recording.

    A designed accident always has.
    """
    min_duration = FRAME_PERIOD * (frames or _MIN_LIFELIKE_FRAMES)
    if stage.kind is None:
        return True
    return bool(accident.simulation.time[-1] - stage.cast.begin > min_duration)


def latest_end(stage: Stage, frames: int | None) -> float:
    """Return the time until which a normal scenario is simulated, seconds."""
    duration = max(_MAX_END_S, (frames or 0) * FRAME_PERIOD)
    return stage.cast.begin + WARM_UP + duration


def _standing_first(user: RoadUser, seconds: float) -> RoadUser:
    """Return the same road user, which first stands for some seconds."""
    if seconds == 0:
        return user
    return replace(user, start_speed=0.0, delay=user.delay + seconds)


def _later_roles(cast: Cast) -> tuple[Role, ...]:
    """Return the roles that come later in a delay.

    They are the roles of the pair except ego and other; if there are none, other and its follower.
    """
    pair_roles = [cast.users[row].role for row in cast.pair or ()]
    strangers = [role for role in pair_roles if role not in ("ego", "other")]
    return tuple(strangers) or ("other", "other_behind")


def _later(user: RoadUser, seconds: float) -> RoadUser:
    """Return the same road user, some seconds later."""
    if seconds == 0:
        return user
    start = user.start - user.start_speed * seconds
    if user.start_speed == 0 or start < user.body.size[0]:
        return _standing_first(user, seconds)
    return replace(user, start=start)


def _keep_clear(stage: Stage, performance: Performance) -> bool:
    """Return whether the named road users keep clear of each other."""
    sizes = _sizes(stage.cast.users)
    rows = list(range(len(stage.cast.users)))
    return min_gap(performance.simulation.poses, sizes, rows, _CLEARANCE_M) >= _CLEARANCE_M


def _perform(
    stage: Stage,
    users: Sequence[RoadUser],
    end: float,
    watched: tuple[int, int] | None = None,
    pushing: Sequence[int] = (),
) -> Performance | None:
    """Simulate road users until nobody touches.

    Each round leaves out the road users of the background that touched somebody.

    Args:
        stage: The stage.
        users: Its road users, the named ones first.
        end: Time of the last step, seconds.
        watched: Rows of the pair that may touch, with which the simulation ends.
        pushing: Rows of road users that wait for nobody.

    Returns:
        None if named road users touch.
    """
    present = list(range(len(users)))
    allowed_pair = tuple(sorted(watched or ()))
    for _ in range(_MAX_ROUNDS):
        present_users = [users[row] for row in present]
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
        pairs = set(_touching(stage, present_users, simulation)) - {allowed_pair}
        if not pairs:
            return Performance(simulation=simulation, present=tuple(present))
        leaving = set()
        for pair in pairs:
            # Rows after the users are parked vehicles, which cannot leave.
            leaving.add(max(pair) if max(pair) < len(present_users) else min(pair))
        if min(leaving) < len(stage.cast.users):
            return None
        present = [row for position, row in enumerate(present) if position not in leaving]
    return None


def _touching(
    stage: Stage, users: Sequence[RoadUser], simulation: Simulation
) -> list[tuple[int, int]]:
    """Return pairs of rows that touch; parked vehicles come after the users."""
    parked_poses = np.array([vehicle.pose for vehicle in stage.parked]).reshape(-1, 3)
    standing_poses = np.broadcast_to(parked_poses, (len(simulation.time), *parked_poses.shape))
    poses = np.concatenate([simulation.poses, standing_poses], axis=1)
    sizes = _sizes([*users, *stage.parked])
    pairs = touching_pairs(poses, sizes, _TOUCHING_MARGIN_M)
    return [pair for pair in pairs if pair[0] < len(users)]


def _sizes(users: Sequence[RoadUser | ParkedVehicle]) -> FloatArray:
    """Return lengths and widths (A, 2), metres."""
    return np.array([user.body.size[:2] for user in users])


def _signal_plan(rng: np.random.Generator, cast: Cast) -> SignalPlan:
    """Draw lights that are green at the meeting for the driver of the pair that obeys them.

    Without a pair, they are green for ego.
    """
    rows = [*(cast.pair or ()), cast.row_of("ego")]
    lawful = [cast.users[row] for row in rows if "signal" not in cast.users[row].ignores]
    arms = [user.route.from_arm for user in lawful if user.route is not None]
    axis = AXIS_OF_ARM[arms[0]] if arms else "west-east"
    return plan_with_green(axis, 0.0, rng.uniform(*_GREEN_TIMES), rng.uniform(*_GREEN_SHARES))


def _natural_frames(stage: Stage, end: float) -> int:
    """Return the number of frames up to a time (seconds), within limits."""
    duration = end - (stage.cast.begin + WARM_UP)
    frames = int(duration / FRAME_PERIOD + 1e-6) + 1
    min_frames = _MIN_FRAMES if stage.kind is None else _MIN_LIFELIKE_FRAMES
    return int(np.clip(frames, min_frames, _MAX_FRAMES))


def _arrival_time(stage: Stage, performance: Performance) -> float:
    """Return the time when ego is far enough past the junction; infinite if it never is."""
    row = stage.cast.row_of("ego")
    ego = stage.users[row]
    simulation = performance.simulation
    if ego.route is None:
        return np.inf
    coarse = slice(None, None, 5)
    positions = simulation.poses[coarse, performance.present.index(row), :2]
    along, _ = ego.path.project(positions)
    arrived = along > middle_of(ego.route) + _ARRIVAL_DISTANCE_M
    if not arrived.any():
        return np.inf
    return float(simulation.time[coarse][arrived.argmax()])


def impact_of(simulation: Simulation, pair: tuple[int, int], size: FloatArray) -> Impact:
    """Return the impact that ends a simulation with a contact.

    Args:
        simulation: The simulation.
        pair: Rows of the pair.
        size: Lengths and widths of the pair, shape (2, 2), metres.
    """
    rows = list(pair)
    end_poses = simulation.poses[-1][rows]
    previous_poses = end_poses
    period = 0.0
    if len(simulation.time) > 1:
        previous_poses = simulation.poses[-2][rows]
        period = float(simulation.time[-1] - simulation.time[-2])
    share = _touching_share(previous_poses, end_poses, size)
    poses = previous_poses + share * (end_poses - previous_poses)
    opposite = np.cos(poses[0, 2] - poses[1, 2]) < _MAX_OPPOSITE_COSINE
    velocity = simulation.velocities[-1][rows]
    relative_speed = np.hypot(*(velocity[0] - velocity[1]))
    return Impact(
        time=float(simulation.time[-1]) - (1.0 - share) * period,
        relation="opposite" if opposite else "same",
        side=contact_side(poses, size),
        strength=float(_IMPACT_PER_AREA * size[0].prod() * relative_speed),
    )


def _touching_share(before: FloatArray, after: FloatArray, size: FloatArray) -> float:
    """Find by halving the share of a step that is over when the boxes of a pair touch.

    At the returned share they touch.

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
    reach = np.abs(half_extents).sum(axis=(1, 2))
    to_second = poses[1, :2] - poses[0, :2]
    offsets = normals @ to_second
    widest = int(np.argmax(np.abs(offsets) - reach))
    along, across = axes[0] @ (normals[widest] * np.sign(offsets[widest]))
    if abs(along) >= abs(across):
        return "front" if along > 0 else "rear"
    return "front_side" if axes[0, 0] @ to_second >= 0 else "rear_side"


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
    for i, j in _near_pairs(poses, size, margin):
        gaps = separation(poses[:, i], size[i], poses[:, j], size[j])
        if gaps.min() < margin:
            pairs.append((i, j))
    return pairs


def min_gap(poses: FloatArray, size: FloatArray, rows: list[int], enough: float) -> float:
    """Return the smallest distance between any two of `rows`, at most `enough`, in metres.

    The other arguments are as in `touching_pairs`.
    """
    poses = poses[:, rows]
    size = size[rows]
    gaps = [enough]
    for i, j in _near_pairs(poses, size, enough):
        gaps.append(float(gap(poses[:, i], size[i], poses[:, j], size[j]).min()))
    return min(gaps)


def _near_pairs(poses: FloatArray, size: FloatArray, margin: float) -> list[tuple[int, int]]:
    """Return pairs of rows that may come nearer than `margin`."""
    moments = np.concatenate([poses[::_LOOK_STEPS], poses[-1:]])
    delta = moments[:, :, None, :2] - moments[:, None, :, :2]
    square_distances = (delta**2).sum(axis=-1)
    radius = np.hypot(size[:, 0], size[:, 1]) / 2
    reach = radius[:, None] + radius + margin + _NEAR_MARGIN_M
    near = (square_distances < reach**2).any(axis=0)
    rows, columns = np.nonzero(np.triu(near, 1))
    return list(zip(rows.tolist(), columns.tolist(), strict=True))
