"""A scenario's road users at its beginning, and what happens when rules are broken and when they are obeyed.

A part of that is recorded: it ends with the impact, or when ego has arrived, or when time is over.
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

# Which road users are near each other is computed once in so many steps.
_LOOK_STEP = 5
# How much nearer two can come between these steps, metres.
_NEAR = 2.0
_ContactSide = Literal["front", "front_side", "rear", "rear_side"]
Relation = Literal["same", "opposite"]
# Cosine of the angle between two headings: below it they drive towards each other.
_TOWARDS = -0.5
# Impact for each m² of the first box and m/s; so the numbers are about as large as in the real release.
_AREA_MASS = 60.0
_HALVINGS = 40
_GREEN_TIMES = (14.0, 20.0)
# Least and largest share of the green that is over when the pair meets.
_GREEN_SHARE = (0.35, 0.75)
# A simulated accident ends so many seconds after the planned meeting, if the pair does not touch before.
_LATEST = 1.5
# The most runs of a simulation; each leaves out those of the background who touched somebody in the run before.
_ROUNDS = 5
# How many seconds before the meeting the background starts to drive; in a longer scenario it stands until then.
_LONGEST_DRIVE = 11.0
# Metres: two that come nearer than this count as touching.
_MARGIN = 0.1
# The least distance between named road users in a normal twin, metres.
_CLEAR = 1.0
# Seconds by which one of the pair comes later if rules alone do not prevent a collision; tried in this order.
_DELAYS = (0.0, 1.5, 3.0, 5.0, 8.0, 1000.0)
# The fewest and the most frames of a recording if no number is given, as in the release.
_LEAST_FRAMES, _MOST_FRAMES = 40, 100
# The fewest frames of a recording with a kind of accident.
_SHORTEST = 36
# The least time from the beginning until the pair meets, and the latest end of a normal scenario, seconds.
_EARLIEST, _LATEST_END = 5.5, 10.0
# Seconds from the beginning of the recording to a contact beside the accident, and from that to the end, at least.
_BEFORE_GRAZE, _AFTER_GRAZE = 1.5, 1.0
# A normal scenario also ends when ego is so many metres past the middle of the junction.
_ARRIVAL = 25.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stage:
    """All road users of a scenario at its beginning.

    Attributes:
        spec: the draw.
        junction: its roads.
        cast: the named road users.
        background: the others that move.
        parked: the parked vehicles.
        signals: the traffic lights, None if there are none.
        kind: the kind of accident where all is as in the real release; None where it is as designed.
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
        """The row of the road user that labels and sensors leave out, None if there is none."""
        return (
            None
            if self.cast.pair is None or self.kind is None or self.kind.labelled
            else self.cast.pair[1]
        )

    @property
    def users(self) -> tuple[RoadUser, ...]:
        """All that move; the named road users are first."""
        return (*self.cast.users, *self.background)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Performance:
    """What happened.

    Attributes:
        simulation: the simulation of those in `present`.
        present: rows of the stage's users who took part: all except those of the background who would have touched
            somebody.
    """

    simulation: Simulation
    present: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Impact:
    """The end of an accident.

    Attributes:
        time: seconds, when the boxes first touch.
        relation: whether the two drive the same way, or towards each other, as the meta file names it.
        side: the side of the first one's box that is hit, as the meta file names it.
        strength: the impact in the meta file.
    """

    time: float
    relation: Relation
    side: _ContactSide
    strength: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recorded:
    """A part of a performance.

    Attributes:
        performance: what happens.
        start: time of the first recorded frame, in the simulation's time, seconds.
        frames: how many are recorded.
        impact: the impact at its end; None if there is none.
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
    """Everyone's place at the beginning; the pair meets `duration` seconds after the first recorded frame."""
    cast = cast_actors(rng, spec, junction, duration, kind)
    signals = _signal_plan(rng, cast) if spec.road.signalized else None
    hold = max(duration - _LONGEST_DRIVE, 0.0)
    background = background_users(rng, spec, junction, cast.users, signals, cast.begin + hold)
    parked = tuple(
        parked_vehicles(rng, spec, junction, [user for user in cast.users if user.walks])
    )
    if kind is not None:
        background = [lively(rng, user, kind.traffic, cast.begin + hold) for user in background]
        parked = crowded(rng, parked)
    return Stage(
        spec=spec,
        junction=junction,
        cast=cast,
        background=tuple(_held(user, hold) for user in background),
        parked=parked,
        signals=signals,
        kind=kind,
    )


def try_accident(stage: Stage) -> Performance | float:
    """What happens up to the contact of a pair that breaks its rules; if they do not touch, their least distance (m).

    It is infinite if their paths do not cross, or if others touch before.
    """
    pair = stage.cast.pair
    if pair is None:
        return np.inf
    unruly = [replace(user, ignores=("signal", "priority")) for user in stage.cast.users]
    ahead = {
        LEADERS.get(stage.users[row].role) for row in pair
    }  # whose followers could not come if they waited
    pushing = [
        row for row, user in enumerate(stage.cast.users) if row in pair or user.role in ahead
    ]
    users = [unruly[row] if row in pushing else user for row, user in enumerate(stage.users)]
    performance = _perform(stage, users, _LATEST, watched=pair, pushing=pushing)
    if performance is None:
        return np.inf
    if performance.simulation.contact is not None:
        return performance
    return least_gap(performance.simulation.poses, _sizes(stage.cast.users), list(pair), np.inf)


def perform_twin(stage: Stage, end: float) -> Performance | None:
    """What happens up to `end` (seconds) when all obey the rules; None if named road users touch all the same.

    It has the first delay with which the named road users stay `_CLEAR` from each other. If there is none, it has the
    first delay with which nobody touches.
    """
    roles, narrow = _later_roles(stage.cast), None
    for late in _DELAYS:
        users = [
            _later(user.obeying(), late) if user.role in roles else user.obeying()
            for user in stage.users
        ]
        performance = _perform(stage, users, end)
        if performance is None:
            continue
        if _keep_clear(stage, performance):
            return performance
        narrow = narrow or performance
    return narrow


def recorded_accident(
    rng: np.random.Generator, stage: Stage, performance: Performance, frames: int | None
) -> Recorded:
    """The recording that ends with the impact, or, with a kind of accident, about then.

    None records all frames that there are, within limits.
    """
    pair = stage.cast.pair or (0, 0)
    size = _sizes([stage.users[row] for row in pair])
    impact = impact_of(performance.simulation, pair, size)
    end = impact.time
    if stage.kind is not None:
        simulation, after = beyond_contact(
            rng, performance.simulation, pair, size, stage.kind.traffic
        )
        performance, end = replace(performance, simulation=simulation), end + after
    count = frames or _natural_frames(stage, end)
    return Recorded(
        performance=performance, start=end - FRAME_PERIOD * (count - 1), frames=count, impact=impact
    )


def recorded_normal(
    rng: np.random.Generator, stage: Stage, performance: Performance, frames: int | None
) -> Recorded:
    """The recording that ends when ego has arrived, or when time is over; arguments as in `recorded_accident`."""
    begin = stage.cast.begin + WARM_UP
    if stage.kind is None:
        natural = _natural_frames(
            stage, min(_arrival_time(stage, performance), begin + _LATEST_END)
        )
    else:
        natural = int(rng.integers(*NORMAL_FRAMES))
    if frames is None:
        return Recorded(performance=performance, start=begin, frames=natural, impact=None)
    end = begin + FRAME_PERIOD * (max(natural, frames) - 1)
    return Recorded(
        performance=performance, start=end - FRAME_PERIOD * (frames - 1), frames=frames, impact=None
    )


def with_graze(stage: Stage, recorded: Recorded) -> Recorded:
    """Return a recording in which a driver scrapes along another, none of them in the accident, if any pass closely."""
    performance, pair = recorded.performance, stage.cast.pair or ()
    users = [stage.users[row] for row in performance.present]
    drivers = [
        place
        for place, row in enumerate(performance.present)
        if row not in pair and not users[place].walks
    ]
    window = (
        recorded.start + _BEFORE_GRAZE,
        recorded.start + FRAME_PERIOD * recorded.frames - _AFTER_GRAZE,
    )
    touching = _touching(stage, users, performance.simulation)
    for two, simulation in swerves(performance.simulation, _sizes(users), drivers, window):
        if sorted(_touching(stage, users, simulation)) == sorted([*touching, two]):
            return replace(recorded, performance=replace(performance, simulation=simulation))
    return recorded


def usual_duration(
    rng: np.random.Generator, frames: int | None, kind: AccidentKind | None = None
) -> float:
    """Seconds from the beginning until the pair meets: drawn, or as many as the wanted number of frames needs."""
    usual = (
        accident_duration(rng, kind.traffic) if kind else rng.uniform(_EARLIEST, _LATEST_END + 0.3)
    )
    natural = float(usual)
    return natural if frames is None else max(natural, frames * FRAME_PERIOD + 1.5)


def lasts(stage: Stage, accident: Performance, frames: int | None) -> bool:
    """Whether an accident has begun early enough for its recording; as designed it always has."""
    needed = FRAME_PERIOD * (frames or _SHORTEST)
    return stage.kind is None or accident.simulation.time[-1] - stage.cast.begin > needed


def latest_end(stage: Stage, frames: int | None) -> float:
    """The time until which a normal scenario is simulated, seconds."""
    return stage.cast.begin + WARM_UP + max(_LATEST_END, (frames or 0) * FRAME_PERIOD)


def _held(user: RoadUser, seconds: float) -> RoadUser:
    """The same road user, which first stands for some seconds."""
    return user if seconds == 0 else replace(user, start_speed=0.0, delay=user.delay + seconds)


def _later_roles(cast: Cast) -> tuple[Role, ...]:
    """The roles that come later in a delay: those of the pair except ego and other; if none, other and its follower."""
    strangers = [
        cast.users[row].role
        for row in cast.pair or ()
        if cast.users[row].role not in ("ego", "other")
    ]
    return tuple(strangers) or ("other", "other_behind")


def _later(user: RoadUser, seconds: float) -> RoadUser:
    """The same road user, some seconds later."""
    if seconds == 0:
        return user
    back = user.start - user.start_speed * seconds
    if user.start_speed == 0 or back < user.body.size[0]:
        return replace(user, start_speed=0.0, delay=user.delay + seconds)
    return replace(user, start=back)


def _keep_clear(stage: Stage, performance: Performance) -> bool:
    rows = list(range(len(stage.cast.users)))
    return least_gap(performance.simulation.poses, _sizes(stage.cast.users), rows, _CLEAR) >= _CLEAR


def _perform(
    stage: Stage,
    users: Sequence[RoadUser],
    end: float,
    watched: tuple[int, int] | None = None,
    pushing: Sequence[int] = (),
) -> Performance | None:
    """Simulate until nobody touches, each time without those of the background who did; None if named ones touch."""
    present = list(range(len(users)))
    for _ in range(_ROUNDS):
        there = [users[row] for row in present]
        rights = find_rights(
            there, minor=stage.spec.road.yielding_arms, blind=watched, pushing=pushing
        )
        simulation = simulate(
            there,
            begin=stage.cast.begin,
            end=end,
            rights=rights,
            signals=stage.signals,
            watched=watched,
        )
        pairs = set(_touching(stage, there, simulation)) - {tuple(sorted(watched or ()))}
        if not pairs:
            return Performance(simulation=simulation, present=tuple(present))
        leaving = {max(i, j) if max(i, j) < len(there) else min(i, j) for i, j in pairs}
        if min(leaving) < len(stage.cast.users):
            return None
        present = [row for place, row in enumerate(present) if place not in leaving]
    return None


def _touching(
    stage: Stage, users: Sequence[RoadUser], simulation: Simulation
) -> list[tuple[int, int]]:
    """Pairs of rows that touch; parked vehicles come after the users."""
    standing = np.array([vehicle.pose for vehicle in stage.parked]).reshape(-1, 3)
    poses = np.concatenate(
        [simulation.poses, np.broadcast_to(standing, (len(simulation.time), *standing.shape))],
        axis=1,
    )
    size = _sizes([*users, *stage.parked])
    return [(i, j) for i, j in touching_pairs(poses, size, _MARGIN) if i < len(users)]


def _sizes(users: Sequence[RoadUser | ParkedVehicle]) -> FloatArray:
    return np.array([user.body.size[:2] for user in users])


def _signal_plan(rng: np.random.Generator, cast: Cast) -> SignalPlan:
    """Lights that are green at the meeting for the one of the pair that obeys them; without a pair, for ego."""
    rows = [*(cast.pair or ()), cast.row_of("ego")]
    lawful = [cast.users[row] for row in rows if "signal" not in cast.users[row].ignores]
    arms = [user.route.from_arm for user in lawful if user.route is not None]
    axis = AXIS_OF_ARM[arms[0]] if arms else "west-east"
    return plan_with_green(axis, 0.0, rng.uniform(*_GREEN_TIMES), rng.uniform(*_GREEN_SHARE))


def _natural_frames(stage: Stage, end: float) -> int:
    frames = int((end - (stage.cast.begin + WARM_UP)) / FRAME_PERIOD + 1e-6) + 1
    return int(np.clip(frames, _LEAST_FRAMES if stage.kind is None else _SHORTEST, _MOST_FRAMES))


def _arrival_time(stage: Stage, performance: Performance) -> float:
    """The time when ego is far enough past the junction; infinite if it never is."""
    row = stage.cast.row_of("ego")
    ego, simulation = stage.users[row], performance.simulation
    if ego.route is None:
        return np.inf
    coarse = slice(None, None, 5)
    along, _ = ego.path.project(simulation.poses[coarse, performance.present.index(row), :2])
    arrived = along > middle_of(ego.route) + _ARRIVAL
    return float(simulation.time[coarse][arrived.argmax()]) if arrived.any() else np.inf


def impact_of(simulation: Simulation, pair: tuple[int, int], size: FloatArray) -> Impact:
    """The impact that ends a simulation with a contact of a pair of rows; sizes are (2, 2) length and width, metres."""
    rows = list(pair)
    last = simulation.poses[-1][rows]
    before = simulation.poses[-2][rows] if len(simulation.time) > 1 else last
    share = _touching_share(before, last, size)
    poses = before + share * (last - before)
    period = float(simulation.time[-1] - simulation.time[-2]) if len(simulation.time) > 1 else 0.0
    velocity = simulation.velocities[-1][rows]
    return Impact(
        time=float(simulation.time[-1]) - (1.0 - share) * period,
        relation="opposite" if np.cos(poses[0, 2] - poses[1, 2]) < _TOWARDS else "same",
        side=contact_side(poses, size),
        strength=float(_AREA_MASS * size[0].prod() * np.hypot(*(velocity[0] - velocity[1]))),
    )


def _touching_share(before: FloatArray, after: FloatArray, size: FloatArray) -> float:
    """The share of a step (2, 3) → (2, 3) that is over when the boxes touch, by halving; at the result they touch."""
    apart, touching = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = (apart + touching) / 2
        first, second = before + middle * (after - before)
        if separation(first, size[0], second, size[1]) > 0:
            apart = middle
        else:
            touching = middle
    return touching


def contact_side(poses: FloatArray, size: FloatArray) -> _ContactSide:
    """The side of the first of two boxes that faces the second across the widest gap along any side's normal.

    Flanks are told by the half, before or behind the first one's middle, in which the middle of the second is.

    Poses are (2, 3) x, y (metres), yaw (radians) of the centres, sizes (2, 2) length and width, metres.
    """
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    axes = np.stack(
        [np.stack([cos, sin], axis=1), np.stack([-sin, cos], axis=1)], axis=1
    )  # box, axis, xy
    normals = axes.reshape(4, 2)
    reach = np.abs(np.einsum("na,bka->nbk", normals, axes) * size / 2).sum(axis=(1, 2))
    apart = normals @ (poses[1, :2] - poses[0, :2])
    best = int(np.argmax(np.abs(apart) - reach))
    along, across = axes[0] @ (normals[best] * np.sign(apart[best]))
    if abs(along) >= abs(across):
        return "front" if along > 0 else "rear"
    return "front_side" if axes[0, 0] @ (poses[1, :2] - poses[0, :2]) >= 0 else "rear_side"


def touching_pairs(poses: FloatArray, size: FloatArray, margin: float) -> list[tuple[int, int]]:
    """Pairs of rows, the lower one first, that come nearer to each other than `margin`, along any side's normal.

    Poses are (S, A, 3) x, y (metres), yaw (radians) of the boxes' centres, sizes (A, 2) length and width, metres.
    """
    near = _near_pairs(poses, size, margin)
    return [
        (i, j)
        for i, j in near
        if separation(poses[:, i], size[i], poses[:, j], size[j]).min() < margin
    ]


def least_gap(poses: FloatArray, size: FloatArray, rows: list[int], enough: float) -> float:
    """The least distance in metres between any two of `rows`, or `enough`; arguments as in `touching_pairs`."""
    pairs = _near_pairs(poses[:, rows], size[rows], enough)
    gaps = [
        float(gap(poses[:, rows[i]], size[rows[i]], poses[:, rows[j]], size[rows[j]]).min())
        for i, j in pairs
    ]
    return min([*gaps, enough])


def _near_pairs(poses: FloatArray, size: FloatArray, margin: float) -> list[tuple[int, int]]:
    """Pairs of rows that may come nearer than `margin`."""
    moments = np.concatenate([poses[::_LOOK_STEP], poses[-1:]])
    delta = moments[:, :, None, :2] - moments[:, None, :, :2]
    square = (delta**2).sum(axis=-1)
    radius = np.hypot(size[:, 0], size[:, 1]) / 2
    near = (square < (radius[:, None] + radius + margin + _NEAR) ** 2).any(axis=0)
    rows, columns = np.nonzero(np.triu(near, 1))
    return list(zip(rows.tolist(), columns.tolist(), strict=True))
