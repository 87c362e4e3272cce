"""Random draws that make a designed scenario resemble the real release.

They decide who collides, and which errors drivers make.

Each kind of accident is a row of `ACCIDENT_KINDS`. All numbers were chosen so that a release has
the shares and spans that others measured on the real one (docs/synth.md compares them).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from deepaccident_devkit.plugins.synth.actors import random_body
from deepaccident_devkit.plugins.synth.roads import ARMS, RoadSpec, lane_change
from deepaccident_devkit.plugins.synth.roads.layout import MAX_GRADE
from deepaccident_devkit.plugins.synth.spec import BackgroundSpec, MeetSpec, ScenarioSpec
from deepaccident_devkit.plugins.synth.spec.model import Role
from deepaccident_devkit.plugins.synth.traffic.background import ParkedVehicle
from deepaccident_devkit.plugins.synth.traffic.driving import RoadUser, Stretch
from deepaccident_devkit.plugins.synth.traffic.simulate import Simulation, separation
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.taxonomy import FRAME_PERIOD

_BACKGROUND_RANGES = {
    "vehicles": (4, 10),
    "two_wheelers": (0, 3),
    "parked": (1, 3),
    "walking": (0, 4),
    "crossing": (0, 3),
}
# Probability that the scenario in the folder of an accident is a normal one, and the reverse.
MISFILED: Final = {True: 0.03, False: 0.02}
# Share of strangers that are pedestrians.
ON_FOOT: Final = 0.3
NORMAL_FRAMES = (93, 101)
"""Smallest number of frames of a normal scenario, and one more than the largest."""
# Quarter turns from the arm where a driver comes from to the arm where it leaves.
_QUARTERS_OF_TURN = {"right": 1, "straight": 2, "left": 3}
# Smallest and largest distance from other to its follower, metres.
_FOLLOWER_GAPS = (8.0, 16.0)
# Height of a hump as a multiple of the design's hump.
_HUMP_FACTORS = (0.8, 2.2)
# Range of the times before a contact at which a driver of the pair notices the other, seconds; a
# driver with a time below 0 never does.
_ALERTS = (-0.3, 0.9)
# Fraction of scenarios in which parked vehicles overlap; and the smallest number of vehicles
# that are then added, and one more than the largest.
_OVERLAPPING_SHARE = 0.29
_OVERLAPPING_COUNTS = (2, 5)
# Smallest and largest distance between the middles of two of these vehicles, metres.
_OVERLAPPING_PITCHES = (3.2, 4.1)
# Distance from the middle of a slot towards the kerb.
_KERB_SHIFT_M = 0.35
# Smallest and largest time from the contact to the last frame, seconds.
_TIMES_AFTER_CONTACT = (0.25, 0.395)
# Range from which the depth to which the two overlap is drawn, metres, and the limit of the depth.
_DEPTHS = (0.1, 1.5)
_MAX_DEPTH_M = 0.76
# Smallest fraction of their relative speed that the two lose in a contact.
_MIN_SPEED_LOSS = 0.4


@dataclass(frozen=True, slots=True, kw_only=True)
class Traffic:
    """One version of the lifelike traffic; a published benchmark keeps its version, byte for byte.

    Attributes:
        background: Smallest number of each sort of the background, and one more than the largest.
        frames: Median of the lengths of accidents, the spread of their logarithm, the smallest and
            the largest length, frames.
        slow: Share of the drivers of the pair that start slowly, among drivers that are not fast.
        rolling: Speed at which they roll before they set off, as a fraction of their usual speed; 0
            if they stand still.
        to_go: Smallest and largest distance from the point where they set off to the crossing of
            the paths, metres.
        fast: Share of drivers that are fast from the start.
        fast_speeds: Lowest and highest speed of fast drivers, m/s.
        standing: Share of the other drivers that start from rest.
        waits: Shortest and longest time until they set off, from the beginning of the simulation,
            seconds.
        timed: Whether `waits` are from the time of the planned meeting instead.
        grazes: Fraction of scenario pairs in which two other vehicles sideswipe each other.
        no_touch: Share of accidents whose recording ends just before the contact.
    """

    # road users of the background, and length of the recording
    background: Mapping[str, tuple[int, int]]
    frames: tuple[float, float, int, int]
    # slow drivers of the pair
    slow: float
    rolling: float
    to_go: tuple[float, float]
    # fast drivers
    fast: float
    fast_speeds: tuple[float, float]
    # drivers that start from rest
    standing: float
    waits: tuple[float, float]
    timed: bool
    # contacts
    grazes: float
    no_touch: float


TRAFFICS: Final[Mapping[str, Traffic]] = {
    "v1": Traffic(
        background=_BACKGROUND_RANGES,
        frames=(63.0, 0.34, 36, 90),
        slow=0.8,
        rolling=0.0,
        to_go=(8.0, 26.0),
        fast=0.2,
        fast_speeds=(15.0, 18.4),
        standing=0.55,
        waits=(0.0, 4.0),
        timed=False,
        grazes=0.0,
        no_touch=0.07,
    ),
    "v2": Traffic(
        background=_BACKGROUND_RANGES
        | {"vehicles": (5, 11), "two_wheelers": (0, 2), "parked": (1, 2), "walking": (2, 7)},
        frames=(61.5, 0.29, 36, 78),
        slow=0.95,
        rolling=0.35,
        to_go=(12.0, 34.0),
        fast=0.18,
        fast_speeds=(16.5, 18.6),
        standing=0.96,
        waits=(-4.5, -4.0),
        timed=True,
        grazes=0.45,
        no_touch=0.17,
    ),
}
"""Versions of the traffic by name; the last one is the default."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentKind:
    """A kind of accident.

    Attributes:
        weight: Relative frequency of the kind.
        pair: Roles that touch; None if `ego` or `other` touches another road user: a pedestrian or
            a vehicle of the background.
        late: Shortest and longest time by which the second (or its leader, or the driver that is
            not run into) reaches the crossing of the paths later, seconds.
        gap: Smallest and largest distance from ego to its follower, where it is one of the pair,
            metres.
        joins: Whether it needs paths that lead into the same road.
        stops: Whether the first of the pair, in front, brakes to a stop.
        labelled: Whether both are labelled.
        traffic: Version of the traffic around it.
    """

    weight: float
    pair: tuple[Role, Role] | None = ("ego", "other")
    late: tuple[float, float] = (-0.4, 0.4)
    gap: tuple[float, float] = (8.0, 16.0)
    joins: bool = False
    stops: bool = False
    labelled: bool = True
    traffic: Traffic = TRAFFICS["v2"]


ACCIDENT_KINDS: Final[Mapping[str, AccidentKind]] = {
    "crossing": AccidentKind(weight=16),
    "merge": AccidentKind(weight=36, late=(-1.0, 1.0), joins=True),
    "ego is run into": AccidentKind(
        weight=9, pair=("ego", "ego_behind"), late=(2.0, 3.0), gap=(3.0, 9.0), stops=True
    ),
    "other is run into": AccidentKind(
        weight=9, pair=("other", "other_behind"), late=(2.0, 3.0), gap=(3.0, 9.0), stops=True
    ),
    "ego's follower": AccidentKind(weight=18, pair=("ego_behind", "other")),
    "both followers": AccidentKind(weight=8, pair=("ego_behind", "other_behind"), gap=(30.0, 40.0)),
    "stranger": AccidentKind(weight=14, pair=None),
    "unknown": AccidentKind(weight=6, pair=None, labelled=False),
}


def draw_kind(rng: np.random.Generator, spec: ScenarioSpec, traffic: Traffic) -> AccidentKind:
    """Draw a kind of accident that is possible on the routes of `ego` and `other` in `spec`."""
    has_joining_paths = paths_join(spec)
    kinds = [kind for kind in ACCIDENT_KINDS.values() if has_joining_paths or not kind.joins]
    weights = np.array([kind.weight for kind in kinds])
    probabilities = weights / weights.sum()
    kind = kinds[rng.choice(len(kinds), p=probabilities)]
    return replace(kind, traffic=traffic)


def paths_join(spec: ScenarioSpec) -> bool:
    """Return whether ego and other leave the junction by the same arm."""
    exits = set()
    for role in ("ego", "other"):
        actor = spec.actor(role)
        arm = ARMS.index(actor.from_arm or "west")
        exit_arm = (arm + _QUARTERS_OF_TURN[actor.turn]) % len(ARMS)
        exits.add(exit_arm)
    return len(exits) == 1


def apply_kind(rng: np.random.Generator, spec: ScenarioSpec, kind: AccidentKind) -> ScenarioSpec:
    """Turn a designed scenario into one with this kind of accident.

    On steeper roads, the scenario has fewer road users.
    """
    counts = {}
    for name, span in kind.traffic.background.items():
        counts[name] = int(rng.integers(*span))
    meet = MeetSpec(actors=kind.pair or ("ego", "other"), offset=rng.uniform(*kind.late))
    other_gaps = kind.gap if kind.stops else _FOLLOWER_GAPS
    gap_by_role = {"ego_behind": rng.uniform(*kind.gap), "other_behind": rng.uniform(*other_gaps)}
    # Other gets the lowest id, and its follower the highest.
    ordered = sorted(
        spec.actors, key=lambda actor: (actor.role != "other", actor.role == "other_behind")
    )
    actors = [replace(actor, gap=gap_by_role.get(actor.role)) for actor in ordered]
    return replace(
        spec,
        road=_draw_steepness(rng, spec.road),
        actors=tuple(actors),
        meet=meet,
        background=BackgroundSpec(**counts),
    )


def _draw_steepness(rng: np.random.Generator, road: RoadSpec) -> RoadSpec:
    """Return a road with another height of its hump, within the steepest grade."""
    hump = road.hump
    if hump is None:
        return road
    max_factor = 0.999 * MAX_GRADE / hump.grade
    factor = min(rng.uniform(*_HUMP_FACTORS), max_factor)
    new_hump = replace(hump, height=factor * hump.height)
    return replace(road, hump=new_hump)


def draw_accident_duration(rng: np.random.Generator, traffic: Traffic) -> float:
    """Draw the planned duration of an accident, seconds."""
    median, spread, min_frames, max_frames = traffic.frames
    frames = median * np.exp(spread * rng.standard_normal())
    num_frames = int(np.clip(frames, min_frames, max_frames))
    return num_frames * FRAME_PERIOD


def add_driver_errors(
    rng: np.random.Generator, user: RoadUser, crossing: float, traffic: Traffic, *, stops: bool
) -> RoadUser:
    """Let a driver of the pair brake, hesitate or swerve shortly before the crossing of the paths.

    Args:
        rng: Generator of random numbers.
        user: The driver.
        crossing: Position of the crossing of the paths along its path, metres.
        traffic: Version of the traffic.
        stops: Whether the driver brakes to a stop.
    """
    if user.route is None:
        return user
    speed = user.max_speed
    start_speed = rng.uniform(0.1, 0.8) * user.max_speed
    distance_to_go = 0.0
    if rng.random() < traffic.fast:
        speed = rng.uniform(*traffic.fast_speeds)
        start_speed = 0.95 * speed
    elif rng.random() < traffic.slow:
        start_speed = traffic.rolling * speed
        distance_to_go = rng.uniform(*traffic.to_go)
    start = crossing - (distance_to_go or 30.0 + 2.0 * start_speed)
    path = user.path
    error = rng.random()
    pace: tuple[Stretch, ...] = ()
    if rng.random() < 0.25:
        stop_begin = crossing - rng.uniform(25, 60)
        pace = (_draw_stop(rng, stop_begin, speed),)
    if distance_to_go and start_speed:
        pace = ((0.0, start, start_speed),)
    past_crossing = crossing + 60.0
    if stops:
        begin = crossing - rng.uniform(4, 12)
        pace += ((begin, past_crossing, speed * rng.uniform(0.0, 0.85)),)
    elif error < 0.35:
        begin = crossing - rng.uniform(1, 8)
        pace += ((begin, past_crossing, speed * rng.uniform(0.2, 0.6)),)
    elif error < 0.6:
        begin = crossing - rng.uniform(12, 30)
        end = crossing - rng.uniform(2, 9)
        pace += ((begin, end, rng.uniform(2.0, 5.0)),)
    if rng.random() < 0.3:
        swerve_begin = crossing - rng.uniform(8, 14)
        swerve_length = rng.uniform(7, 10)
        offset = float(rng.choice([-1, 1]) * rng.uniform(0.5, 1.4))
        path = lane_change(path, swerve_begin, swerve_length, offset)
    return replace(
        user,
        path=path,
        start=start,
        start_speed=start_speed,
        max_speed=speed,
        pace=pace,
        brisk=True,
        alert=max(rng.uniform(*_ALERTS), 0.0),
    )


def vary_driving(
    rng: np.random.Generator, user: RoadUser, traffic: Traffic, begin: float
) -> RoadUser:
    """Let a driver start from rest, drive fast or slow down on the way, chosen at random.

    Road users that are not drivers are returned unchanged.

    Args:
        rng: Generator of random numbers.
        user: The road user.
        traffic: Version of the traffic.
        begin: Time from which drivers act, seconds; the meeting is planned for time 0.
    """
    cycles = user.body.category == "cyclist"
    if user.route is None or (cycles and not traffic.timed):
        return user
    start_chance, pace_chance = rng.random(2)
    speed = user.max_speed * rng.uniform(1.0, 1.45)
    start_speed = user.start_speed * rng.uniform(0.1, 0.9)
    delay = user.delay
    pace = user.pace
    if start_chance < traffic.standing:
        start_speed = 0.0
        delay = delay + rng.uniform(*traffic.waits) - begin * traffic.timed
    elif not cycles and start_chance < traffic.standing + traffic.fast:
        speed = rng.uniform(*traffic.fast_speeds)
    if pace_chance < 0.85:
        first_distance = user.start + rng.uniform(3, 40)
        distances = np.cumsum(rng.uniform(5, 30, size=2))
        begins = first_distance + distances + np.arange(2) * speed**2 / 4
        pace = tuple(_draw_stop(rng, stop_begin, speed) for stop_begin in begins.tolist())
    return replace(
        user, start_speed=start_speed, max_speed=speed, delay=delay, pace=pace, brisk=True
    )


def _draw_stop(rng: np.random.Generator, begin: float, speed: float) -> Stretch:
    """Draw a stretch on which a driver nearly stops.

    It is long enough to brake to walking speed, or nearly to a standstill, and drive a little.

    Args:
        rng: Generator of random numbers.
        begin: Start of the stretch along the path, metres.
        speed: Usual speed of the driver, m/s.
    """
    braking_distance = speed**2 / 14
    end = begin + braking_distance + rng.uniform(0.5, 2.5)
    max_speed = rng.uniform(0.3, 1.5)
    return begin, end, max_speed


def crowd_kerb(
    rng: np.random.Generator, parked: Sequence[ParkedVehicle]
) -> tuple[ParkedVehicle, ...]:
    """Move parked vehicles nearer to the kerb, and in some scenarios add a row of vehicles.

    In such a row each vehicle overlaps the one before.

    Args:
        rng: Generator of random numbers.
        parked: The parked vehicles.
    """
    vehicles = []
    for vehicle in parked:
        pose = _shift_pose(vehicle.pose, 0.0, _KERB_SHIFT_M)
        vehicles.append(replace(vehicle, pose=pose))
    if not parked or rng.random() >= _OVERLAPPING_SHARE:
        return tuple(vehicles)
    first_pose = vehicles[rng.integers(len(parked))].pose
    count = rng.integers(*_OVERLAPPING_COUNTS)
    shifts = np.cumsum(rng.uniform(*_OVERLAPPING_PITCHES, size=count))
    x, y, yaw = first_pose
    # The row grows away from the junction's middle.
    shifts *= np.sign(x * np.cos(yaw) + y * np.sin(yaw))
    for shift in shifts.tolist():
        body = random_body(rng, "car")
        vehicles.append(ParkedVehicle(body, _shift_pose(first_pose, shift, 0.0)))
    return tuple(vehicles)


def _shift_pose(
    pose: tuple[float, float, float], ahead: float, right: float
) -> tuple[float, float, float]:
    """Return a pose x, y, yaw that is shifted ahead and to the right, metres."""
    x, y, yaw = pose
    cos = float(np.cos(yaw))
    sin = float(np.sin(yaw))
    shifted_x = x + ahead * cos + right * sin
    shifted_y = y + ahead * sin - right * cos
    return shifted_x, shifted_y, yaw


def continue_past_contact(
    rng: np.random.Generator,
    simulation: Simulation,
    pair: tuple[int, int],
    size: FloatArray,
    traffic: Traffic,
) -> tuple[Simulation, float]:
    """Continue a simulation after its last step.

    All road users go straight on, the pair with less relative speed, until the two overlap by a
    drawn depth.

    Args:
        rng: Generator of random numbers.
        simulation: The simulation, which ends with the contact.
        pair: Rows of the pair.
        size: Lengths and widths of the pair, shape (2, 2), metres.
        traffic: Version of the traffic.

    Returns:
        The longer simulation, and the time by which its recording ends later (or earlier) than the
        contact, seconds.
    """
    time_after = -0.02
    if rng.random() >= traffic.no_touch:
        time_after = rng.uniform(*_TIMES_AFTER_CONTACT)
    max_depth = min(rng.uniform(*_DEPTHS), _MAX_DEPTH_M)
    last_time = simulation.time[-1]
    period = float(last_time - simulation.time[-2])
    num_steps = int(max(time_after, 0.0) / period) + 1
    steps = np.arange(1, num_steps + 1)
    rows = list(pair)
    velocity = simulation.velocities[-1].copy()
    mean = velocity[rows].mean(axis=0)
    closing_distance = 2.0 * np.hypot(*(velocity[pair[0]] - mean)) * time_after
    depth_factor = 1.3 * max_depth / max(closing_distance, 1e-6)
    speed_factor = min(1.0 - _MIN_SPEED_LOSS, depth_factor)
    velocity[rows] = mean + speed_factor * (velocity[rows] - mean)
    states = np.repeat(simulation.states[-1:], len(steps), axis=0)
    states[..., :2] += steps[:, None, None] * period * velocity
    poses = states[:, pair[0], :3]
    other_poses = states[:, pair[1], :3]
    depth = -separation(poses, size[0], other_poses, size[1])
    num_shallow = int((depth < max_depth + 0.01).cumprod().sum())
    count = max(num_shallow, 1)
    new_times = last_time + period * steps[:count]
    new_velocities = np.repeat(velocity[None], count, axis=0)
    longer_simulation = replace(
        simulation,
        time=np.concatenate([simulation.time, new_times]),
        states=np.concatenate([simulation.states, states[:count]]),
        velocities=np.concatenate([simulation.velocities, new_velocities]),
    )
    return longer_simulation, min(time_after, (count - 1) * period)
