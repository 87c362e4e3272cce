"""The moving road users of a scenario file, placed so that the two who are timed do meet; accidents of no design."""

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
    MANNERS,
    PERIOD,
    RoadUser,
    Tracks,
    free_acceleration,
    lane_span,
    lane_way,
    middle_of,
    road_crossing,
    temper_of,
)
from deepaccident_devkit.plugins.synth.traffic.lifelike import AccidentKind, erring, lively
from deepaccident_devkit.support.arrays import FloatArray

# Seconds that are driven at least.
_USUAL_DRIVE = 24.0
# Seconds that are driven at most; the slowest cyclist needs about 210 to the junction.
_LONGEST_DRIVE = 300.0


@dataclass(frozen=True, slots=True, eq=False)
class Approach:
    """A drive over a free road, from standing or from a given speed.

    Attributes:
        user: who drives, as at the start of the drive.
        along: (S,) metres of its box's centre along its path, one value every `driving.PERIOD`.
        speed: (S,) m/s.
    """

    user: RoadUser
    along: FloatArray
    speed: FloatArray

    def time_to(self, place: float) -> float:
        """Seconds until the centre is `place` metres along the path; if it never is, the end of the drive."""
        row = min(int(np.searchsorted(self.along, place)), len(self.along) - 1)
        return row * PERIOD

    def at(self, time: float) -> RoadUser:
        """The road user `time` seconds into the drive; before, one that stands waits, others are farther back."""
        if time < 0 and self.user.start_speed == 0:
            return replace(self.user, delay=-time)
        if time < 0:
            return replace(self.user, start=self.user.start + self.user.start_speed * time)
        row = min(round(time / PERIOD), len(self.along) - 1)
        return replace(
            self.user, start=float(self.along[row]), start_speed=float(self.speed[row]), delay=0.0
        )


def drive_alone(user: RoadUser, to: float = 0.0) -> Approach:
    """The drive of a road user that is alone and stays on its path, at least until its centre is `to` metres along."""
    tracks = Tracks(
        [user.path], np.array([user.manner.lateral]), np.array([user.walks]), [user.pace]
    )
    temper, back = temper_of([user]), user.wheelbase / 2
    along, speed = np.array([user.start - back]), np.array([user.start_speed])
    steps = PERIOD * np.arange(1, DECISION_STEPS + 1)
    places, speeds = [along], [speed]
    usual, longest = (
        round(seconds / (PERIOD * DECISION_STEPS)) for seconds in (_USUAL_DRIVE, _LONGEST_DRIVE)
    )
    for count in range(longest):
        if count >= usual and along[0] + back >= to:
            break
        acceleration = free_acceleration(temper, speed, tracks.allowed_speed(along))
        moving = np.maximum(speed + acceleration * steps, 0.0)
        before = np.append(speed, moving[:-1])
        moved = along + PERIOD * np.cumsum((before + moving) / 2)
        places.append(moved)
        speeds.append(moving)
        along, speed = moved[-1:], moving[-1:]
    return Approach(user, np.concatenate(places) + back, np.concatenate(speeds))


# Seconds that are simulated before the first recorded frame.
WARM_UP = 1.0
# Least and most metres, bumper to bumper, between leader and follower if the file does not give the gap.
_GAPS = (8.0, 16.0)
# Least and most seconds before a contact at which one of the pair notices it; with less than 0 it never does.
_ALERTS = (-0.3, 0.3)
# Least and most metres from the start to the junction's middle if the start is not given.
_STARTS = (35.0, 75.0)
# Metres that a change of lanes takes.
_LANE_CHANGE = 28.0
# Metres, and the share of a follower's first gap, that are between it and its leader when it meets somebody.
_LENGTH, _CLOSED = 4.6, 0.9
# A follower's wanted speed as a multiple of its leader's, so that the gap does not grow.
_KEEPING_UP = 1.3
# Metres from the path's beginning to where the last vehicle of a queue starts.
_FIRST_PLACE = 8.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cast:
    """The named road users of a scenario at its beginning.

    Attributes:
        users: the road users; leaders are before their followers.
        begin: seconds, when the simulation starts; at time 0 the first of the pair is where the paths cross.
        pair: rows of the two who are timed to meet; None if nobody is.
    """

    users: tuple[RoadUser, ...]
    begin: float
    pair: tuple[int, int] | None

    def row_of(self, role: Role) -> int:
        """The row of the first road user of a role."""
        return next(row for row, user in enumerate(self.users) if user.role == role)


def cast_actors(
    rng: np.random.Generator,
    spec: ScenarioSpec,
    junction: Junction,
    duration: float,
    kind: AccidentKind | None = None,
) -> Cast:
    """The moving road users that a file names; the pair meets `duration` seconds after the first recorded frame.

    If a follower is one of the pair, its leader is timed. With a kind of accident drivers err.
    """
    begin = -(duration + WARM_UP)
    named = [actor for actor in spec.actors if actor.role != "parked"]
    leading = [actor for actor in named if actor.role not in LEADERS]
    pair = _pair_rows(spec, leading)
    users = [
        _drawn(rng, actor, junction, timed=row in (pair or ())) for row, actor in enumerate(leading)
    ]
    if pair is not None and spec.meet is not None:
        meeting = crossing(users[pair[0]].path, users[pair[1]].path)
        if meeting is None:
            pair = None
        else:
            if kind is not None:
                for row, user in enumerate(users):
                    users[row] = user if row in pair else lively(rng, user, kind.traffic, begin)
                for row, place in zip(pair, meeting, strict=True):
                    stops = kind.stops and spec.meet.actors[0] == users[row].role
                    users[row] = erring(rng, users[row], place, kind.traffic, stops=stops)
            places = [
                place + _ahead(spec, role)
                for place, role in zip(meeting, spec.meet.actors, strict=True)
            ]
            approaches = [
                drive_alone(users[row], to=place) for row, place in zip(pair, places, strict=True)
            ]
            for row, place, late, approach in zip(
                pair, places, (0.0, spec.meet.offset), approaches, strict=True
            ):
                users[row] = approach.at(approach.time_to(place) + begin - late)
    for actor in named:
        if actor.role in LEADERS:
            leader = next(user for user in users if user.role == LEADERS[actor.role])
            # a follower does not change lanes with its leader, or it would collide with a vehicle beside it
            way = (
                leader
                if kind is None and spec.actor(leader.role).lane_change is None
                else leader.route or leader
            )
            users.append(_follower(rng, actor, leader, way.path))
    if pair is not None and spec.meet is not None:
        roles = [user.role for user in users]
        pair = (roles.index(spec.meet.actors[0]), roles.index(spec.meet.actors[1]))
    return Cast(users=tuple(users), begin=begin, pair=pair)


def _pair_rows(spec: ScenarioSpec, actors: Sequence[ActorSpec]) -> tuple[int, int] | None:
    """Rows of the two who are timed to meet; None if there are none."""
    if spec.meet is None:
        return None
    roles = [actor.role for actor in actors]
    first, second = _timed_roles(spec.meet)
    return (roles.index(first), roles.index(second)) if first in roles and second in roles else None


def _timed_roles(meet: MeetSpec) -> tuple[Role, Role]:
    """The roles that are timed: leaders in place of their followers; of one behind the other, ego and other."""
    first, second = (LEADERS.get(role, role) for role in meet.actors)
    return (first, "ego" if first == "other" else "other") if first == second else (first, second)


def _ahead(spec: ScenarioSpec, role: Role) -> float:
    """About how many metres its leader is ahead of a follower that meets a stranger; 0 for others."""
    if role not in LEADERS or spec.meet is None or LEADERS[role] in spec.meet.actors:
        return 0.0
    return _LENGTH + max(_CLOSED * (spec.actor(role).gap or 0.0), _GAPS[0])


def _drawn(
    rng: np.random.Generator, actor: ActorSpec, junction: Junction, *, timed: bool
) -> RoadUser:
    """A road user that follows nobody; if `timed`, it starts far away and standing, if the file gives no start."""
    body, manner = random_body(rng, actor.category), MANNERS[actor.category]
    max_speed = actor.max_speed if actor.max_speed is not None else rng.uniform(*manner.max_speed)
    arm = actor.from_arm or "west"
    if actor.role == "pedestrian":
        distance = actor.start_distance if actor.start_distance is not None else rng.uniform(22, 50)
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
    start, speed = _FIRST_PLACE + 2 * _GAPS[1] + body.size[0], 0.0
    if actor.start_distance is not None:
        start, speed = middle_of(route) - actor.start_distance, max_speed
    elif not timed:
        start, speed = middle_of(route) - rng.uniform(*_STARTS), 0.8 * max_speed
    return RoadUser(
        role=actor.role,
        body=body,
        path=_way(junction, route, actor),
        start=start,
        start_speed=speed,
        max_speed=max_speed,
        route=route,
        span=lane_span(route),
        ignores=actor.ignores,
        alert=max(rng.uniform(*_ALERTS), 0.0) if timed else 0.0,
    )


def _way(junction: Junction, route: Route, actor: ActorSpec) -> Path:
    """The actor's path, with its change of lanes if it makes one."""
    path = lane_way(junction, route, actor.category)
    if actor.lane_change is None:
        return path
    offset = LANE_WIDTH if actor.lane == 0 else -LANE_WIDTH
    return lane_change(path, middle_of(route) - actor.lane_change, _LANE_CHANGE, offset)


def _follower(rng: np.random.Generator, actor: ActorSpec, leader: RoadUser, path: Path) -> RoadUser:
    """A road user behind its leader, as fast as the leader, on a path that begins like the leader's."""
    body, manner = random_body(rng, actor.category), MANNERS[actor.category]
    gap = actor.gap if actor.gap is not None else rng.uniform(*_GAPS)
    own_speed = actor.max_speed if actor.max_speed is not None else rng.uniform(*manner.max_speed)
    start = leader.start - (leader.body.size[0] + body.size[0]) / 2 - gap
    return RoadUser(
        role=actor.role,
        body=body,
        path=path,
        start=start,
        start_speed=leader.start_speed,
        max_speed=max(
            own_speed, leader.max_speed if leader.brisk else _KEEPING_UP * leader.max_speed
        ),
        delay=leader.delay,
        route=leader.route,
        span=leader.span,
        ignores=leader.ignores,
        pace=tuple(
            (begin, end - leader.start + start, speed)
            for begin, end, speed in leader.pace
            if begin == 0.0
        ),
        brisk=leader.brisk,
    )


# Share of accidents with a pedestrian; the others are with a third vehicle.
_PEDESTRIANS = 0.6
_STEP_OUT_SPEEDS = (1.2, 2.2)
# Least and most metres from the junction's middle to where a pedestrian steps onto the road.
_STEP_OUT = (24.0, 45.0)
# Metres from a hump's crest to a pedestrian behind it; the hump hides it until the victim is about 40 m away.
_BEHIND_CREST = (15.0, 22.0)
# Share of third vehicles that come by the victim's arm and change into its lane, if the arm has two lanes.
_CUTTING_IN = 0.5
# Least and most metres from the junction's middle to where that change of lanes begins.
_CUT_IN = (45.0, 75.0)
_THIRD_SPEEDS = (8.0, 12.0)
_OFFSETS = (-0.2, 0.2)


def unplanned(
    rng: np.random.Generator, spec: ScenarioSpec, junction: Junction, *, on_foot: bool | None = None
) -> ScenarioSpec:
    """A designed scenario with another accident: ego and other obey, and one meets a pedestrian or a third vehicle.

    Which of the two is drawn if `on_foot` is None.
    """
    victims: tuple[Role, ...] = ("ego", "other")
    victim = spec.actor(victims[int(rng.integers(2))])
    used = {spec.actor(role).from_arm for role in victims}
    free = [arm for arm in junction.arms if arm not in used]
    on_foot = (rng.random() < _PEDESTRIANS if on_foot is None else on_foot) or not free
    goes_on = "straight" in junction.turns(victim.from_arm or "west")
    cuts_in = junction.spec.lanes == 2 and goes_on and rng.random() < _CUTTING_IN
    if on_foot:
        stranger = _pedestrian(rng, victim, spec)
    elif cuts_in:
        stranger = _cutting_in(rng, victim)
    else:
        stranger = _third_vehicle(rng, junction, free)
    return replace(
        spec,
        design=None,
        actors=(*(replace(actor, ignores=()) for actor in spec.actors), stranger),
        meet=MeetSpec(actors=(victim.role, stranger.role), offset=rng.uniform(*_OFFSETS)),
    )


def _pedestrian(rng: np.random.Generator, victim: ActorSpec, spec: ScenarioSpec) -> ActorSpec:
    """A pedestrian who steps onto the road in front of the victim, behind the hump if there is one on its arm."""
    arm, hump = victim.from_arm or "west", spec.road.hump
    distance = rng.uniform(*_STEP_OUT)
    if hump is not None and hump.arm == arm:
        distance = hump.distance - rng.uniform(*_BEHIND_CREST)
    side: Side = "right" if rng.random() < 0.7 else "left"
    return ActorSpec(
        role="pedestrian",
        category="pedestrian",
        from_arm=arm,
        side=side,
        start_distance=distance,
        max_speed=rng.uniform(*_STEP_OUT_SPEEDS),
    )


def _third_vehicle(rng: np.random.Generator, junction: Junction, free: list[Arm]) -> ActorSpec:
    """A vehicle that comes by an arm by which neither ego nor other comes, and reacts to nobody."""
    arm = free[int(rng.integers(len(free)))]
    turn: Turn = "straight" if "straight" in junction.turns(arm) else "left"
    return ActorSpec(
        role="background",
        category=rng.choice(["car", "car", "van", "motorcycle"]).item(),
        from_arm=arm,
        turn=turn,
        lane=junction.spec.lanes - 1,
        max_speed=rng.uniform(*_THIRD_SPEEDS),
        ignores=("signal", "priority"),
    )


def _cutting_in(rng: np.random.Generator, victim: ActorSpec) -> ActorSpec:
    """A vehicle in the lane beside the victim's that changes into the victim's lane without looking."""
    return ActorSpec(
        role="background",
        category=rng.choice(["car", "car", "van"]).item(),
        from_arm=victim.from_arm,
        lane=1 - victim.lane,
        max_speed=rng.uniform(*_THIRD_SPEEDS),
        lane_change=rng.uniform(*_CUT_IN),
        ignores=("signal", "priority"),
    )
