"""The moving road users of a scenario file, placed so that the pair that should collide meets.

`replan_accident` draws accidents that differ from the designs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from deepaccident_devkit.plugins.synth.actors import random_body
from deepaccident_devkit.plugins.synth.roads import (
    LANE_WIDTH,
    Arm,
    Junction,
    Path,
    Route,
    Turn,
    crossing,
    lane_change,
)
from deepaccident_devkit.plugins.synth.spec import ActorSpec, MeetSpec, ScenarioSpec
from deepaccident_devkit.plugins.synth.spec.checks import LEADERS
from deepaccident_devkit.plugins.synth.spec.model import Role, Side
from deepaccident_devkit.plugins.synth.traffic.driving import (
    DECISION_STEPS,
    DRIVING_STYLES,
    PERIOD,
    RoadUser,
    Tracks,
    distance_to_middle,
    free_acceleration,
    idm_parameters,
    lane_path,
    lane_span,
    road_crossing,
)
from deepaccident_devkit.plugins.synth.traffic.lifelike import (
    AccidentKind,
    add_driver_errors,
    vary_driving,
)
from deepaccident_devkit.support.arrays import FloatArray

# Shortest and longest drive on a free road; the slowest cyclist reaches the junction after about
# 210 s.
_MIN_DRIVE_S = 24.0
_MAX_DRIVE_S = 300.0
WARM_UP = 1.0
"""Seconds that are simulated before the first recorded frame."""
# Smallest and largest gap between leader and follower, bumper to bumper, where the file does not
# give the gap, metres.
_FOLLOWER_GAPS = (8.0, 16.0)
# Range of the times before a contact at which one of the pair notices the other, seconds; below 0
# it never does.
_ALERTS = (-0.3, 0.3)
# Smallest and largest distance from the start to the junction's middle, if the file does not give
# it, metres.
_START_DISTANCES = (35.0, 75.0)
_LANE_CHANGE_LENGTH_M = 28.0
# Distance between a leader and its follower that collides with another road user: the length of
# a vehicle, and a share of the gap at the start.
_VEHICLE_LENGTH_M = 4.6
_GAP_SHARE = 0.9
# Target speed of a follower as a multiple of its leader's, so that the gap does not grow.
_FOLLOWER_SPEED_FACTOR = 1.3
# Distance from the path's beginning to the start of the last vehicle of a queue.
_QUEUE_START_M = 8.0
# Share of unplanned accidents with a pedestrian; the others are with a third vehicle.
_PEDESTRIAN_SHARE = 0.6
_STEP_OUT_SPEEDS = (1.2, 2.2)
# Smallest and largest distance from the junction's middle to the point where a pedestrian steps
# onto the road, metres.
_STEP_OUT_DISTANCES = (24.0, 45.0)
# Distance from a hump's crest to a pedestrian behind it, metres; the hump hides the pedestrian
# until the victim is about 40 m away.
_CREST_DISTANCES = (15.0, 22.0)
# Share of third vehicles that come from the victim's arm and change into its lane, if the arm
# has two lanes.
_CUT_IN_SHARE = 0.5
# Smallest and largest distance from the junction's middle at which this change of lanes begins,
# metres.
_CUT_IN_DISTANCES = (45.0, 75.0)
_STRANGER_SPEEDS = (8.0, 12.0)
_STRANGER_OFFSETS = (-0.2, 0.2)


@dataclass(frozen=True, slots=True, eq=False)
class Approach:
    """A drive on a free road, from rest or from a certain speed.

    Attributes:
        user: The road user at the start of the drive.
        along: Positions of its box's centre along its path, shape (S,), metres, one every
            `driving.PERIOD`.
        speed: Speeds, shape (S,), m/s.
    """

    user: RoadUser
    along: FloatArray
    speed: FloatArray

    def time_to(self, position: float) -> float:
        """Return the time until the centre is at a position along the path, seconds.

        If the centre never gets there, the time is the duration of the drive.

        Args:
            position: Position along the path, metres.
        """
        last_row = len(self.along) - 1
        row = min(int(np.searchsorted(self.along, position)), last_row)
        return row * PERIOD

    def at(self, time: float) -> RoadUser:
        """Return the road user `time` seconds after the start of the drive.

        Before the drive, a road user that starts from rest waits; any other one is farther back.
        """
        user = self.user
        if time < 0 and user.start_speed == 0:
            return replace(user, delay=-time)
        if time < 0:
            return replace(user, start=user.start + user.start_speed * time)
        row = min(round(time / PERIOD), len(self.along) - 1)
        start = float(self.along[row])
        speed = float(self.speed[row])
        return replace(user, start=start, start_speed=speed, delay=0.0)


def drive_alone(user: RoadUser, min_end: float = 0.0) -> Approach:
    """Simulate a road user's drive along its path on an otherwise empty road.

    Args:
        user: The road user.
        min_end: Position along the path that the drive reaches at least, metres.
    """
    lateral = np.array([user.style.lateral])
    tracks = Tracks([user.path], lateral, np.array([user.walks]), [user.pace])
    parameters = idm_parameters([user])
    axle_to_center = user.wheelbase / 2
    along = np.array([user.start - axle_to_center])
    speed = np.array([user.start_speed])
    times = PERIOD * np.arange(1, DECISION_STEPS + 1)
    all_positions = [along]
    all_speeds = [speed]
    decision_period = PERIOD * DECISION_STEPS
    min_decisions = round(_MIN_DRIVE_S / decision_period)
    max_decisions = round(_MAX_DRIVE_S / decision_period)
    for count in range(max_decisions):
        if count >= min_decisions and along[0] + axle_to_center >= min_end:
            break
        acceleration = free_acceleration(parameters, speed, tracks.allowed_speed(along))
        speeds = np.maximum(speed + acceleration * times, 0.0)
        previous_speeds = np.append(speed, speeds[:-1])
        mean_speeds = (previous_speeds + speeds) / 2
        positions = along + PERIOD * np.cumsum(mean_speeds)
        all_positions.append(positions)
        all_speeds.append(speeds)
        along = positions[-1:]
        speed = speeds[-1:]
    centers = np.concatenate(all_positions) + axle_to_center
    return Approach(user, centers, np.concatenate(all_speeds))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cast:
    """The named road users of a scenario at its beginning.

    Attributes:
        users: Road users; leaders are before their followers.
        begin: Start time of the simulation, seconds. At time 0, the first road user of the pair is
            where the paths cross.
        pair: Rows of the two road users that are timed to meet; None if there is no such pair.
    """

    users: tuple[RoadUser, ...]
    begin: float
    pair: tuple[int, int] | None

    def row_of(self, role: Role) -> int:
        """Return the row of the first road user with a role."""
        roles = [user.role for user in self.users]
        return roles.index(role)


def cast_actors(
    rng: np.random.Generator,
    spec: ScenarioSpec,
    junction: Junction,
    duration: float,
    kind: AccidentKind | None = None,
) -> Cast:
    """Place the moving road users that a scenario file names.

    The two road users of the planned meeting are timed so that they meet at time 0. If one of them
    follows a leader, the leader is timed instead.

    Args:
        rng: Generator of random numbers.
        spec: The scenario.
        junction: Junction of the scenario.
        duration: Time from the first recorded frame to the meeting, seconds.
        kind: Kind of accident, which sets the driving errors; None for drivers without errors.
    """
    begin = -(duration + WARM_UP)
    moving_actors = [actor for actor in spec.actors if actor.role != "parked"]
    leading_actors = [actor for actor in moving_actors if actor.role not in LEADERS]
    pair = _find_timed_rows(spec, leading_actors)
    timed_rows = pair or ()
    users = []
    for row, actor in enumerate(leading_actors):
        users.append(_draw_leader(rng, actor, junction, timed=row in timed_rows))
    meet = spec.meet
    if pair is not None and meet is not None:
        row, other_row = pair
        meeting = crossing(users[row].path, users[other_row].path)
        if meeting is None:
            pair = None
        else:
            if kind is not None:
                _make_drivers_err(rng, users, pair, meeting, meet, kind, begin)
            _time_pair(users, pair, meeting, spec, begin)
    for actor in moving_actors:
        if actor.role in LEADERS:
            leader = next(user for user in users if user.role == LEADERS[actor.role])
            keeps_path = kind is None and spec.actor(leader.role).lane_change is None
            users.append(_draw_follower(rng, actor, leader, keeps_path=keeps_path))
    if pair is not None and meet is not None:
        roles = [user.role for user in users]
        role, other_role = meet.actors
        pair = (roles.index(role), roles.index(other_role))
    return Cast(users=tuple(users), begin=begin, pair=pair)


def _make_drivers_err(
    rng: np.random.Generator,
    users: list[RoadUser],
    pair: tuple[int, int],
    meeting: tuple[float, float],
    meet: MeetSpec,
    kind: AccidentKind,
    begin: float,
) -> None:
    """Add driving errors to the pair, and vary the driving of all others, in place.

    Args:
        rng: Generator of random numbers.
        users: The road users.
        pair: Rows of the pair.
        meeting: Position of the crossing of the two paths along each path, metres.
        meet: The planned meeting.
        kind: Kind of accident.
        begin: Start time of the simulation, seconds.
    """
    for row, user in enumerate(users):
        if row not in pair:
            users[row] = vary_driving(rng, user, kind.traffic, begin)
    for row, position in zip(pair, meeting, strict=True):
        user = users[row]
        stops = kind.stops and meet.actors[0] == user.role
        users[row] = add_driver_errors(rng, user, position, kind.traffic, stops=stops)


def _time_pair(
    users: list[RoadUser],
    pair: tuple[int, int],
    meeting: tuple[float, float],
    spec: ScenarioSpec,
    begin: float,
) -> None:
    """Place the pair in `users` so that the first road user is at the meeting point at time 0.

    The second road user gets there later by the offset of the planned meeting.

    Args:
        users: The road users.
        pair: Rows of the pair.
        meeting: Position of the crossing of the two paths along each path, metres.
        spec: The scenario, with a planned meeting.
        begin: Start time of the simulation, seconds.
    """
    meet = spec.meet
    if meet is None:
        return
    delays = (0.0, meet.offset)
    for row, position, role, delay in zip(pair, meeting, meet.actors, delays, strict=True):
        target = position + _estimate_leader_distance(spec, role)
        approach = drive_alone(users[row], target)
        users[row] = approach.at(approach.time_to(target) + begin - delay)


def _find_timed_rows(spec: ScenarioSpec, actors: Sequence[ActorSpec]) -> tuple[int, int] | None:
    """Return the rows of the two road users that are timed to meet; None if there are none.

    A leader is timed instead of its follower. If one of the two follows the other, `ego` and
    `other` are timed.
    """
    if spec.meet is None:
        return None
    role, other_role = (LEADERS.get(actor, actor) for actor in spec.meet.actors)
    if role == other_role:
        other_role = "ego" if role == "other" else "other"
    roles = [actor.role for actor in actors]
    if role not in roles or other_role not in roles:
        return None
    return roles.index(role), roles.index(other_role)


def _estimate_leader_distance(spec: ScenarioSpec, role: Role) -> float:
    """Estimate how far the leader is ahead of a follower that meets another road user, metres.

    The result is 0 for road users that do not follow a leader.
    """
    if role not in LEADERS or spec.meet is None or LEADERS[role] in spec.meet.actors:
        return 0.0
    gap = _GAP_SHARE * (spec.actor(role).gap or 0.0)
    return _VEHICLE_LENGTH_M + max(gap, _FOLLOWER_GAPS[0])


def _draw_leader(
    rng: np.random.Generator, actor: ActorSpec, junction: Junction, *, timed: bool
) -> RoadUser:
    """Draw a road user that does not follow another one.

    Args:
        rng: Generator of random numbers.
        actor: The road user in the file.
        junction: The junction.
        timed: Whether it is timed to meet another one; then it starts far away and from rest,
            unless the file gives its start.
    """
    body = random_body(rng, actor.category)
    max_speed = actor.max_speed
    if max_speed is None:
        max_speed = rng.uniform(*DRIVING_STYLES[actor.category].max_speed)
    arm = actor.from_arm or "west"
    if actor.role == "pedestrian":
        distance = actor.start_distance
        if distance is None:
            distance = rng.uniform(22, 50)
        path = road_crossing(junction.spec, arm, distance, actor.side)
        return RoadUser(
            role=actor.role,
            body=body,
            path=path,
            start=0.0,
            start_speed=0.0,
            max_speed=max_speed,
            span=(0.0, path.length),
            ignores=actor.ignores,
        )
    route = junction.route(arm, actor.turn, actor.lane)
    start = _QUEUE_START_M + 2 * _FOLLOWER_GAPS[1] + body.size[0]
    speed = 0.0
    if actor.start_distance is not None:
        start = distance_to_middle(route) - actor.start_distance
        speed = max_speed
    elif not timed:
        start = distance_to_middle(route) - rng.uniform(*_START_DISTANCES)
        speed = 0.8 * max_speed
    alert = 0.0
    if timed:
        alert = max(rng.uniform(*_ALERTS), 0.0)
    return RoadUser(
        role=actor.role,
        body=body,
        path=_plan_path(junction, route, actor),
        start=start,
        start_speed=speed,
        max_speed=max_speed,
        route=route,
        span=lane_span(route),
        ignores=actor.ignores,
        alert=alert,
    )


def _plan_path(junction: Junction, route: Route, actor: ActorSpec) -> Path:
    """Return the path of a driver on a route, with its change of lanes if it makes one."""
    path = lane_path(junction, route, actor.category)
    if actor.lane_change is None:
        return path
    start = distance_to_middle(route) - actor.lane_change
    if actor.lane == 0:
        offset = LANE_WIDTH
    else:
        offset = -LANE_WIDTH
    return lane_change(path, start, _LANE_CHANGE_LENGTH_M, offset)


def _draw_follower(
    rng: np.random.Generator, actor: ActorSpec, leader: RoadUser, *, keeps_path: bool
) -> RoadUser:
    """Draw a road user behind its leader, with the leader's speed.

    Args:
        rng: Generator of random numbers.
        actor: The follower in the file.
        leader: The leader.
        keeps_path: Whether the follower drives along the leader's path even where that path leaves
            the leader's route.
    """
    path = leader.path
    # A follower does not change lanes with its leader, or it would collide with a vehicle next to
    # it.
    if leader.route is not None and not keeps_path:
        path = leader.route.path
    body = random_body(rng, actor.category)
    gap = actor.gap
    if gap is None:
        gap = rng.uniform(*_FOLLOWER_GAPS)
    own_speed = actor.max_speed
    if own_speed is None:
        own_speed = rng.uniform(*DRIVING_STYLES[actor.category].max_speed)
    min_speed = leader.max_speed
    if not leader.brisk:
        min_speed = _FOLLOWER_SPEED_FACTOR * leader.max_speed
    start = leader.start - (leader.body.size[0] + body.size[0]) / 2 - gap
    pace = []
    for begin, end, speed in leader.pace:
        if begin == 0.0:
            pace.append((begin, end - leader.start + start, speed))
    return RoadUser(
        role=actor.role,
        body=body,
        path=path,
        start=start,
        start_speed=leader.start_speed,
        max_speed=max(own_speed, min_speed),
        delay=leader.delay,
        route=leader.route,
        span=leader.span,
        ignores=leader.ignores,
        pace=tuple(pace),
        brisk=leader.brisk,
    )


def replan_accident(
    rng: np.random.Generator, spec: ScenarioSpec, junction: Junction, *, on_foot: bool | None = None
) -> ScenarioSpec:
    """Turn a designed scenario into one with another accident.

    `ego` and `other` obey the rules, and one of them collides with a pedestrian or a third vehicle.

    Args:
        rng: Generator of random numbers.
        spec: The designed scenario.
        junction: Junction of the scenario.
        on_foot: Whether that road user is a pedestrian; drawn if None.
    """
    victims: tuple[Role, ...] = ("ego", "other")
    victim = spec.actor(victims[rng.integers(2)])
    used_arms = {spec.actor(role).from_arm for role in victims}
    free_arms = [arm for arm in junction.arms if arm not in used_arms]
    if on_foot is None:
        on_foot = rng.random() < _PEDESTRIAN_SHARE
    on_foot = on_foot or not free_arms
    can_go_straight = "straight" in junction.turns(victim.from_arm or "west")
    cuts_in = junction.spec.lanes == 2 and can_go_straight and rng.random() < _CUT_IN_SHARE
    if on_foot:
        stranger = _draw_pedestrian(rng, victim, spec)
    elif cuts_in:
        stranger = _draw_lane_changer(rng, victim)
    else:
        stranger = _draw_third_vehicle(rng, junction, free_arms)
    lawful_actors = [replace(actor, ignores=()) for actor in spec.actors]
    offset = rng.uniform(*_STRANGER_OFFSETS)
    return replace(
        spec,
        design=None,
        actors=(*lawful_actors, stranger),
        meet=MeetSpec(actors=(victim.role, stranger.role), offset=offset),
    )


def _draw_pedestrian(rng: np.random.Generator, victim: ActorSpec, spec: ScenarioSpec) -> ActorSpec:
    """Draw a pedestrian who steps onto the road in front of the victim.

    The pedestrian is behind the hump if there is one on the victim's arm.
    """
    arm = victim.from_arm or "west"
    hump = spec.road.hump
    distance = rng.uniform(*_STEP_OUT_DISTANCES)
    if hump is not None and hump.arm == arm:
        distance = hump.distance - rng.uniform(*_CREST_DISTANCES)
    side: Side = "right" if rng.random() < 0.7 else "left"
    return ActorSpec(
        role="pedestrian",
        category="pedestrian",
        from_arm=arm,
        side=side,
        start_distance=distance,
        max_speed=rng.uniform(*_STEP_OUT_SPEEDS),
    )


def _draw_third_vehicle(
    rng: np.random.Generator, junction: Junction, free_arms: list[Arm]
) -> ActorSpec:
    """Draw a vehicle from an arm without ego and other that does not react to others."""
    arm = free_arms[rng.integers(len(free_arms))]
    turn: Turn = "straight" if "straight" in junction.turns(arm) else "left"
    return ActorSpec(
        role="background",
        category=rng.choice(["car", "car", "van", "motorcycle"]).item(),
        from_arm=arm,
        turn=turn,
        lane=junction.spec.lanes - 1,
        max_speed=rng.uniform(*_STRANGER_SPEEDS),
        ignores=("signal", "priority"),
    )


def _draw_lane_changer(rng: np.random.Generator, victim: ActorSpec) -> ActorSpec:
    """Draw a vehicle next to the victim that changes into the victim's lane without looking."""
    return ActorSpec(
        role="background",
        category=rng.choice(["car", "car", "van"]).item(),
        from_arm=victim.from_arm,
        lane=1 - victim.lane,
        max_speed=rng.uniform(*_STRANGER_SPEEDS),
        lane_change=rng.uniform(*_CUT_IN_DISTANCES),
        ignores=("signal", "priority"),
    )
