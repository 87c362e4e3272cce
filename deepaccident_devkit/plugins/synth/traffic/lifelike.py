"""Draws that make a designed scenario like one of the real release: colliders and drivers' errors.

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
# Probability that the scenario of an accident folder, and of a normal one, is of the other sort.
MISFILED: Final = {True: 0.03, False: 0.02}
# Share of strangers that are pedestrians.
ON_FOOT: Final = 0.3
NORMAL_FRAMES = (93, 101)
"""Smallest number of frames of a normal scenario, and one more than the largest."""
# Quarter turns from the arm by which a driver comes to the arm by which it leaves.
_QUARTERS_OF_TURN = {"right": 1, "straight": 2, "left": 3}
# Smallest and largest distance from other to its follower, metres.
_FOLLOWER_GAPS = (8.0, 16.0)
# Height of a hump as a multiple of the design's hump.
_HUMP_FACTORS = (0.8, 2.2)
# Seconds before a contact at which a driver of the pair notices it; below 0 it never does.
_ALERTS = (-0.3, 0.9)
# Share of scenarios in which parked vehicles overlap; smallest number of vehicles that are added
# there, and one more than the largest.
_OVERLAPPING_SHARE = 0.29
_OVERLAPPING_COUNTS = (2, 5)
# Smallest and largest distance between the middles of two of these vehicles, metres.
_OVERLAPPING_PITCHES = (3.2, 4.1)
# Distance from the middle of a slot towards the kerb.
_KERB_SHIFT_M = 0.35
# Smallest and largest time from the contact to the last frame, seconds.
_TIMES_AFTER_CONTACT = (0.25, 0.395)
# Range of the draws of the depth to which two are in each other, metres, and the depth's limit.
_DEPTHS = (0.1, 1.5)
_MAX_DEPTH_M = 0.76
# Smallest share of their relative speed that two lose in a contact.
_MIN_SPEED_LOSS = 0.4


@dataclass(frozen=True, slots=True, kw_only=True)
class Traffic:
    """One version of the lifelike traffic; a published benchmark keeps its version, byte for byte.

    Attributes:
        background: Smallest number of each sort of the background, and one more than the largest.
        frames: Median of the lengths of accidents, the spread of their logarithm, the smallest and
            the largest length, frames.
        slow: Share of the drivers of the pair that start slowly, among drivers that are not fast.
        rolling: Speed at which they roll before they set off, as a share of their usual speed; with
            0 they stand.
        to_go: Smallest and largest distance from the point where they set off to the crossing of
            the paths, metres.
        fast: Share of drivers that are fast from the start.
        fast_speeds: Lowest and highest speed of fast drivers, m/s.
        standing: Share of the other drivers that start from rest.
        waits: Shortest and longest time until they set off, from the beginning of the simulation,
            seconds.
        timed: Whether `waits` are from the time of the planned meeting instead.
        grazes: Share of pairs of scenarios in which two others scrape along each other.
        no_touch: Share of accidents that are recorded up to just before the contact.
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
        pair: Roles that touch; None where one of ego and other touches a stranger: a pedestrian, or
            a vehicle of the background.
        late: Shortest and longest time by which the second (or its leader, or the driver that is
            not run into) comes later to the crossing of the paths, seconds.
        gap: Smallest and largest distance from ego to its follower, where it is one of the pair,
            metres.
        joins: Whether it needs paths that end in one road.
        stops: Whether the first of the pair, in front, brakes to a stop.
        labelled: Whether labels name both.
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
    """Draw a kind of accident that is possible where ego and other go as in `spec`."""
    possible = [kind for kind in ACCIDENT_KINDS.values() if not kind.joins or paths_join(spec)]
    weights = np.array([kind.weight for kind in possible])
    kind = possible[rng.choice(len(possible), p=weights / weights.sum())]
    return replace(kind, traffic=traffic)


def paths_join(spec: ScenarioSpec) -> bool:
    """Return whether ego and other leave the junction by the same arm."""
    exits = set()
    for actor in (spec.actor("ego"), spec.actor("other")):
        arm = ARMS.index(actor.from_arm or "west")
        exits.add((arm + _QUARTERS_OF_TURN[actor.turn]) % len(ARMS))
    return len(exits) == 1


def as_kind(rng: np.random.Generator, spec: ScenarioSpec, kind: AccidentKind) -> ScenarioSpec:
    """Turn a designed scenario into one with this kind of accident.

    It has fewer road users on steeper roads.
    """
    counts = {name: int(rng.integers(*span)) for name, span in kind.traffic.background.items()}
    meet = MeetSpec(actors=kind.pair or ("ego", "other"), offset=rng.uniform(*kind.late))
    other_gaps = kind.gap if kind.stops else _FOLLOWER_GAPS
    gaps = {"ego_behind": rng.uniform(*kind.gap), "other_behind": rng.uniform(*other_gaps)}
    # In the order of the ids.
    ordered = sorted(
        spec.actors, key=lambda actor: (actor.role != "other", actor.role == "other_behind")
    )
    return replace(
        spec,
        road=_steeper(rng, spec.road),
        actors=tuple(replace(actor, gap=gaps.get(actor.role)) for actor in ordered),
        meet=meet,
        background=BackgroundSpec(**counts),
    )


def _steeper(rng: np.random.Generator, road: RoadSpec) -> RoadSpec:
    """Return a road with another height of its hump, within the steepest grade."""
    hump = road.hump
    if hump is None:
        return road
    factor = min(rng.uniform(*_HUMP_FACTORS), 0.999 * MAX_GRADE / hump.grade)
    return replace(road, hump=replace(hump, height=factor * hump.height))


def accident_duration(rng: np.random.Generator, traffic: Traffic) -> float:
    """Draw the planned duration of an accident, seconds."""
    median, spread, min_frames, max_frames = traffic.frames
    frames = median * np.exp(spread * rng.standard_normal())
    return int(np.clip(frames, min_frames, max_frames)) * FRAME_PERIOD


def erring(
    rng: np.random.Generator, user: RoadUser, crossing: float, traffic: Traffic, *, stops: bool
) -> RoadUser:
    """Return a driver of the pair, who brakes, hesitates or swerves shortly before the crossing.

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
        pace = (_stop(rng, crossing - rng.uniform(25, 60), speed),)
    if distance_to_go and start_speed:
        pace = ((0.0, start, start_speed),)
    end = crossing + 60.0
    if stops:
        pace += ((crossing - rng.uniform(4, 12), end, speed * rng.uniform(0.0, 0.85)),)
    elif error < 0.35:
        pace += ((crossing - rng.uniform(1, 8), end, speed * rng.uniform(0.2, 0.6)),)
    elif error < 0.6:
        pace += (
            (crossing - rng.uniform(12, 30), crossing - rng.uniform(2, 9), rng.uniform(2.0, 5.0)),
        )
    if rng.random() < 0.3:
        begin = crossing - rng.uniform(8, 14)
        length = rng.uniform(7, 10)
        offset = float(rng.choice([-1, 1]) * rng.uniform(0.5, 1.4))
        path = lane_change(path, begin, length, offset)
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


def lively(rng: np.random.Generator, user: RoadUser, traffic: Traffic, begin: float) -> RoadUser:
    """Return a driver who may start from rest, be fast or slow down on the way.

    Other road users stay as they are.

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
        pace = tuple(_stop(rng, float(begin), speed) for begin in begins)
    return replace(
        user, start_speed=start_speed, max_speed=speed, delay=delay, pace=pace, brisk=True
    )


def _stop(rng: np.random.Generator, begin: float, speed: float) -> Stretch:
    """Draw a stretch on which a driver nearly stops.

    It is long enough to brake to walking speed, or nearly to a standstill, and drive a little.
    """
    braking_distance = speed**2 / 14
    end = begin + braking_distance + rng.uniform(0.5, 2.5)
    return (begin, end, rng.uniform(0.3, 1.5))


def crowded(rng: np.random.Generator, parked: Sequence[ParkedVehicle]) -> tuple[ParkedVehicle, ...]:
    """Move parked vehicles nearer to the kerb, and add a row of overlapping ones to some scenarios.

    In such a row each vehicle overlaps the one before.
    """
    at_kerb = []
    for vehicle in parked:
        pose = _shifted_pose(vehicle.pose, 0.0, _KERB_SHIFT_M)
        at_kerb.append(replace(vehicle, pose=pose))
    if not parked or rng.random() >= _OVERLAPPING_SHARE:
        return tuple(at_kerb)
    row_pose = at_kerb[int(rng.integers(len(parked)))].pose
    count = int(rng.integers(*_OVERLAPPING_COUNTS))
    shifts = np.cumsum(rng.uniform(*_OVERLAPPING_PITCHES, size=count))
    x, y, yaw = row_pose
    # The row grows away from the junction's middle.
    shifts *= np.sign(x * np.cos(yaw) + y * np.sin(yaw))
    row = []
    for shift in shifts.tolist():
        row.append(ParkedVehicle(random_body(rng, "car"), _shifted_pose(row_pose, shift, 0.0)))
    return (*at_kerb, *row)


def _shifted_pose(
    pose: tuple[float, float, float], ahead: float, right: float
) -> tuple[float, float, float]:
    """Return a pose x, y, yaw that is shifted ahead and to the right, metres."""
    x, y, yaw = pose
    cos = float(np.cos(yaw))
    sin = float(np.sin(yaw))
    shifted_x = x + ahead * cos + right * sin
    shifted_y = y + ahead * sin - right * cos
    return shifted_x, shifted_y, yaw


def beyond_contact(
    rng: np.random.Generator,
    simulation: Simulation,
    pair: tuple[int, int],
    size: FloatArray,
    traffic: Traffic,
) -> tuple[Simulation, float]:
    """Continue a simulation after its last step.

    Everybody goes straight on, the pair with less relative speed, until the two are as deep in each
    other as is drawn.

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
    after = -0.02
    if rng.random() >= traffic.no_touch:
        after = rng.uniform(*_TIMES_AFTER_CONTACT)
    max_depth = min(rng.uniform(*_DEPTHS), _MAX_DEPTH_M)
    period = float(simulation.time[-1] - simulation.time[-2])
    steps = np.arange(1, int(max(after, 0.0) / period) + 2)
    rows = list(pair)
    velocity = simulation.velocities[-1].copy()
    mean = velocity[rows].mean(axis=0)
    closing_distance = 2.0 * np.hypot(*(velocity[pair[0]] - mean)) * after
    depth_factor = 1.3 * max_depth / max(closing_distance, 1e-6)
    speed_factor = min(1.0 - _MIN_SPEED_LOSS, depth_factor)
    velocity[rows] = mean + speed_factor * (velocity[rows] - mean)
    states = np.repeat(simulation.states[-1:], len(steps), axis=0)
    states[..., :2] += steps[:, None, None] * period * velocity
    depth = -separation(states[:, pair[0], :3], size[0], states[:, pair[1], :3], size[1])
    num_shallow = int((depth < max_depth + 0.01).cumprod().sum())
    count = max(num_shallow, 1)
    times = simulation.time[-1] + period * steps[:count]
    velocities = np.repeat(velocity[None], count, axis=0)
    longer = replace(
        simulation,
        time=np.concatenate([simulation.time, times]),
        states=np.concatenate([simulation.states, states[:count]]),
        velocities=np.concatenate([simulation.velocities, velocities]),
    )
    return longer, min(after, (count - 1) * period)
