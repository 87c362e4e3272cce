"""What makes a designed scenario like those of the real release: who hits whom, and how drivers err before it.

Each kind of accident is a row of `ACCIDENT_KINDS`. All numbers were chosen so that a release has the shares and
spans that others measured on the real one (docs/synth.md compares them).
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

_BACKGROUND = {
    "vehicles": (4, 10),
    "two_wheelers": (0, 3),
    "parked": (1, 3),
    "walking": (0, 4),
    "crossing": (0, 3),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Traffic:
    """One version of the lifelike traffic; a published benchmark keeps its version, byte for byte.

    Attributes:
        background: The fewest of each sort of the background, and one more than the most.
        frames: Of the lengths of accidents the median, the spread of the logarithm, the least and the most.
        slow: Share of the drivers of the pair who start slowly, of those who are not fast.
        rolling: Speed at which these roll before they set off, as a share of their usual one; with 0 they stand.
        to_go: Least and most metres from where these set off to where the paths cross.
        fast: Share of drivers who are fast from the start.
        fast_speeds: Least and most speed of these, m/s.
        standing: Share of the other drivers who start from rest.
        waits: Least and most seconds until these set off, from the beginning of the simulation.
        timed: Whether `waits` are from the time of the planned meeting instead.
        grazes: Share of pairs of scenarios in which two others scrape along each other.
        no_touch: Share of accidents that are recorded up to just before the contact.
    """

    background: Mapping[str, tuple[int, int]]
    frames: tuple[float, float, int, int]
    slow: float
    rolling: float
    to_go: tuple[float, float]
    fast: float
    fast_speeds: tuple[float, float]
    standing: float
    waits: tuple[float, float]
    timed: bool
    grazes: float
    no_touch: float


# Versions of the traffic by name; the last one is the default.
TRAFFICS: Final[Mapping[str, Traffic]] = {
    "v1": Traffic(
        background=_BACKGROUND,
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
        background=_BACKGROUND
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


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentKind:
    """A kind of accident.

    Attributes:
        weight: how often it is drawn, relative to the others.
        pair: the two who touch; None where one of ego and other touches a stranger: a pedestrian, or a vehicle of the
            background.
        late: least and most seconds by which the second (or its leader, or the one whom nobody runs into) comes later
            to the crossing of the paths.
        gap: least and most metres from ego to its follower, where it is one of the pair.
        joins: whether it needs paths that end in one road.
        stops: whether the first of the pair, in front, brakes to a stop.
        labelled: whether labels name both.
        traffic: The version of the traffic around it.
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
# Share of the accident and of the normal folders whose scenario is of the other sort.
MISFILED: Final = {True: 0.03, False: 0.02}
# Share of strangers who are pedestrians.
ON_FOOT: Final = 0.3
_TURNED = {"right": 1, "straight": 2, "left": 3}
# The fewest frames of a normal scenario, and one more than the most.
NORMAL_FRAMES = (93, 101)
# Metres from other to its follower.
_GAP = (8.0, 16.0)
# Times as high as a design's hump.
_STEEPER = (0.8, 2.2)
_ALERTS = (-0.3, 0.9)
# Share of scenarios in which parked vehicles overlap; how many are added there, less one.
_OVERLAPPING, _CROWD = 0.29, (2, 5)
# Metres between the middles of two of these; metres from the middle of a slot towards the kerb.
_PITCHES, _TO_KERB = (3.2, 4.1), 0.35
# Seconds from the contact to the last frame.
_AFTER = (0.25, 0.395)
# Metres into each other: between which numbers they are drawn, and the most.
_DEEP, _DEEPEST = (0.1, 1.5), 0.76
# The least share of their relative speed that two lose in a contact.
_GIVES_WAY = 0.4


def draw_kind(rng: np.random.Generator, spec: ScenarioSpec, traffic: Traffic) -> AccidentKind:
    """Draw a kind of accident that is possible where ego and other go as in `spec`."""
    possible = [kind for kind in ACCIDENT_KINDS.values() if not kind.joins or paths_join(spec)]
    weights = np.array([kind.weight for kind in possible])
    return replace(possible[rng.choice(len(possible), p=weights / weights.sum())], traffic=traffic)


def paths_join(spec: ScenarioSpec) -> bool:
    """Whether ego and other leave the junction by the same arm."""
    exits = {
        (ARMS.index(way.from_arm or "west") + _TURNED[way.turn]) % len(ARMS)
        for way in (spec.actor("ego"), spec.actor("other"))
    }
    return len(exits) == 1


def as_kind(rng: np.random.Generator, spec: ScenarioSpec, kind: AccidentKind) -> ScenarioSpec:
    """A designed scenario with this kind of accident, and with fewer road users on steeper roads."""
    background = BackgroundSpec(
        **{name: int(rng.integers(*span)) for name, span in kind.traffic.background.items()}
    )
    meet = MeetSpec(actors=kind.pair or ("ego", "other"), offset=rng.uniform(*kind.late))
    gaps = {
        "ego_behind": rng.uniform(*kind.gap),
        "other_behind": rng.uniform(*(kind.gap if kind.stops else _GAP)),
    }
    ordered = sorted(
        spec.actors, key=lambda actor: (actor.role != "other", actor.role == "other_behind")
    )  # as ids
    actors = tuple(replace(actor, gap=gaps.get(actor.role)) for actor in ordered)
    return replace(
        spec, road=_steeper(rng, spec.road), actors=actors, meet=meet, background=background
    )


def _steeper(rng: np.random.Generator, road: RoadSpec) -> RoadSpec:
    hump = road.hump
    if hump is None:
        return road
    times = min(rng.uniform(*_STEEPER), 0.999 * MAX_GRADE / hump.grade)
    return replace(road, hump=replace(hump, height=times * hump.height))


def accident_duration(rng: np.random.Generator, traffic: Traffic) -> float:
    """Draw how many seconds an accident is meant to have."""
    median, spread, least, most = traffic.frames
    return int(np.clip(median * np.exp(spread * rng.standard_normal()), least, most)) * FRAME_PERIOD


def erring(
    rng: np.random.Generator, user: RoadUser, place: float, traffic: Traffic, *, stops: bool
) -> RoadUser:
    """Return a driver of the pair, who brakes, hesitates or swerves shortly before `place` (metres along its path)."""
    if user.route is None:
        return user
    speed, start_speed = user.max_speed, rng.uniform(0.1, 0.8) * user.max_speed
    to_go = 0.0
    if rng.random() < traffic.fast:
        speed = rng.uniform(*traffic.fast_speeds)
        start_speed = 0.95 * speed
    elif rng.random() < traffic.slow:
        start_speed, to_go = traffic.rolling * speed, rng.uniform(*traffic.to_go)
    start = place - (to_go or 30.0 + 2.0 * start_speed)
    path, error = user.path, rng.random()
    pace: tuple[Stretch, ...] = (
        (_stop(rng, place - rng.uniform(25, 60), speed),) if rng.random() < 0.25 else ()
    )
    if to_go and start_speed:
        pace = ((0.0, start, start_speed),)
    if stops:
        pace += ((place - rng.uniform(4, 12), place + 60.0, speed * rng.uniform(0.0, 0.85)),)
    elif error < 0.35:
        pace += ((place - rng.uniform(1, 8), place + 60.0, speed * rng.uniform(0.2, 0.6)),)
    elif error < 0.6:
        pace += ((place - rng.uniform(12, 30), place - rng.uniform(2, 9), rng.uniform(2.0, 5.0)),)
    if rng.random() < 0.3:
        begin, length = place - rng.uniform(8, 14), rng.uniform(7, 10)
        path = lane_change(path, begin, length, float(rng.choice([-1, 1]) * rng.uniform(0.5, 1.4)))
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
    """Return a driver who may start from rest, be fast or slow down on the way; others stay as they are.

    Drivers act from `begin` on, seconds; the meeting is planned for time 0.
    """
    cycles = user.body.category == "cyclist"
    if user.route is None or (cycles and not traffic.timed):
        return user
    chance, speed = rng.random(2), user.max_speed * rng.uniform(1.0, 1.45)
    start_speed, delay, pace = user.start_speed * rng.uniform(0.1, 0.9), user.delay, user.pace
    if chance[0] < traffic.standing:
        start_speed, delay = 0.0, delay + rng.uniform(*traffic.waits) - begin * traffic.timed
    elif not cycles and chance[0] < traffic.standing + traffic.fast:
        speed = rng.uniform(*traffic.fast_speeds)
    if chance[1] < 0.85:
        begins = (
            user.start
            + rng.uniform(3, 40)
            + np.cumsum(rng.uniform(5, 30, size=2))
            + np.arange(2) * speed**2 / 4
        )
        pace = tuple(_stop(rng, float(begin), speed) for begin in begins)
    return replace(
        user, start_speed=start_speed, max_speed=speed, delay=delay, pace=pace, brisk=True
    )


def _stop(rng: np.random.Generator, begin: float, speed: float) -> Stretch:
    """A stretch that is long enough to brake to walking speed, or nearly to a standstill, and drive a little."""
    return (begin, begin + speed**2 / 14 + rng.uniform(0.5, 2.5), rng.uniform(0.3, 1.5))


def crowded(rng: np.random.Generator, parked: Sequence[ParkedVehicle]) -> tuple[ParkedVehicle, ...]:
    """Parked vehicles, nearer to the kerb; to some scenarios a row is added in which each overlaps the one before."""
    at_kerb = [replace(each, pose=_beside(each.pose, 0.0, _TO_KERB)) for each in parked]
    if not parked or rng.random() >= _OVERLAPPING:
        return tuple(at_kerb)
    first = at_kerb[int(rng.integers(len(parked)))].pose
    shifts = np.cumsum(rng.uniform(*_PITCHES, size=int(rng.integers(*_CROWD))))
    shifts *= np.sign(
        first[0] * np.cos(first[2]) + first[1] * np.sin(first[2])
    )  # away from the junction's middle
    row = [
        ParkedVehicle(random_body(rng, "car"), _beside(first, shift, 0.0))
        for shift in shifts.tolist()
    ]
    return (*at_kerb, *row)


def _beside(
    pose: tuple[float, float, float], ahead: float, right: float
) -> tuple[float, float, float]:
    x, y, yaw = pose
    cos, sin = float(np.cos(yaw)), float(np.sin(yaw))
    return x + ahead * cos + right * sin, y + ahead * sin - right * cos, yaw


def beyond_contact(
    rng: np.random.Generator,
    simulation: Simulation,
    pair: tuple[int, int],
    size: FloatArray,
    traffic: Traffic,
) -> tuple[Simulation, float]:
    """A simulation that goes on after its last step, and how many seconds later (or earlier) its recording ends.

    Everybody goes straight on, the pair with less relative speed, until they are as deep in each other as is drawn.
    Sizes are (2, 2) length and width, metres.
    """
    after = -0.02 if rng.random() < traffic.no_touch else rng.uniform(*_AFTER)
    deepest = min(rng.uniform(*_DEEP), _DEEPEST)
    period, rows = float(simulation.time[-1] - simulation.time[-2]), list(pair)
    steps = np.arange(1, int(max(after, 0.0) / period) + 2)
    velocity = simulation.velocities[-1].copy()
    mean = velocity[rows].mean(axis=0)
    way = 2.0 * np.hypot(*(velocity[pair[0]] - mean)) * after
    velocity[rows] = mean + min(1.0 - _GIVES_WAY, 1.3 * deepest / max(way, 1e-6)) * (
        velocity[rows] - mean
    )
    states = np.repeat(simulation.states[-1:], len(steps), axis=0)
    states[..., :2] += steps[:, None, None] * period * velocity
    depth = -separation(states[:, pair[0], :3], size[0], states[:, pair[1], :3], size[1])
    count = max(int((depth < deepest + 0.01).cumprod().sum()), 1)
    added = replace(
        simulation,
        time=np.concatenate([simulation.time, simulation.time[-1] + period * steps[:count]]),
        states=np.concatenate([simulation.states, states[:count]]),
        velocities=np.concatenate(
            [simulation.velocities, np.repeat(velocity[None], count, axis=0)]
        ),
    )
    return added, min(after, (count - 1) * period)
