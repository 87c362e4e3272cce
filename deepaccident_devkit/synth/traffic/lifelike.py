"""What makes a designed scenario like those of the real release: who hits whom, and how drivers err before it.

Each kind of accident is a row of `KINDS`. All numbers were chosen so that a release has the shares and spans that
others measured on the real one (docs/synth.md compares them).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.synth.actors import random_body
from deepaccident_devkit.synth.roads import ARMS, RoadSpec, lane_change
from deepaccident_devkit.synth.roads.layout import MAX_GRADE
from deepaccident_devkit.synth.spec import BackgroundSpec, MeetSpec, ScenarioSpec
from deepaccident_devkit.synth.spec.model import Role
from deepaccident_devkit.synth.traffic.background import ParkedVehicle
from deepaccident_devkit.synth.traffic.driving import RoadUser, Stretch
from deepaccident_devkit.synth.traffic.simulate import Simulation, separation


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
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
    """

    weight: float
    pair: tuple[Role, Role] | None = ("ego", "other")
    late: tuple[float, float] = (-0.4, 0.4)
    gap: tuple[float, float] = (8.0, 16.0)
    joins: bool = False
    stops: bool = False
    labelled: bool = True


KINDS: Final[Mapping[str, Kind]] = {
    "crossing": Kind(weight=16),
    "merge": Kind(weight=36, late=(-1.0, 1.0), joins=True),
    "ego is run into": Kind(weight=9, pair=("ego", "ego_behind"), late=(2.0, 3.0), stops=True),
    "other is run into": Kind(weight=9, pair=("other", "other_behind"), late=(2.0, 3.0), stops=True),
    "ego's follower": Kind(weight=18, pair=("ego_behind", "other")),
    "both followers": Kind(weight=8, pair=("ego_behind", "other_behind"), gap=(30.0, 40.0)),
    "stranger": Kind(weight=20, pair=None),
    "unknown": Kind(weight=13, pair=None, labelled=False),
}
MISFILED: Final = {True: 0.04, False: 0.02}
"""Share of the accident and of the normal folders whose scenario is of the other sort."""
_TURNED = {"right": 1, "straight": 2, "left": 3}
_FRAMES = (63.0, 0.34, 36, 90)
"""Of accidents: the median, how much its logarithm spreads, least, most."""
_NORMAL_FRAMES = (93, 100)
_BACKGROUND = {"vehicles": (3, 8), "two_wheelers": (0, 2), "parked": (1, 4), "walking": (2, 6), "crossing": (0, 2)}
_GAP = (8.0, 16.0)
"""Metres from other to its follower."""
_STEEPER = (0.8, 1.6)
"""Times as high as a design's hump."""
_FROM_REST, _FAST = 0.75, 0.2
"""Shares of drivers who start from rest, and who drive as fast as `_FAST_SPEEDS`."""
_FAST_SPEEDS = (15.0, 17.6)
_TO_GO = (8.0, 26.0)
"""Metres from where one who starts from rest stands to where the paths cross."""
_ALERTS = (-0.3, 0.9)
_OVERLAPPING = 0.31
"""Share of scenarios in which two parked vehicles overlap."""
_PITCHES = (3.2, 4.1)
"""Metres between the middles of these two."""
_AFTER = (-0.03, 0.27)
"""Seconds from the contact to the last frame."""
_DEEPEST = 0.7
"""Metres."""
_GIVES_WAY = 0.6
"""The share of their closing speed that two lose in a contact."""


def draw_kind(rng: np.random.Generator, spec: ScenarioSpec) -> Kind:
    """A kind of accident that is possible where ego and other go as in `spec`."""
    possible = [kind for kind in KINDS.values() if not kind.joins or paths_join(spec)]
    weights = np.array([kind.weight for kind in possible])
    return possible[rng.choice(len(possible), p=weights / weights.sum())]


def paths_join(spec: ScenarioSpec) -> bool:
    """Whether ego and other leave the junction by the same arm."""
    ways = [spec.actor(role) for role in ("ego", "other")]
    exits = {(ARMS.index(way.from_arm or "west") + _TURNED[way.turn]) % len(ARMS) for way in ways}
    return len(exits) == 1


def as_kind(rng: np.random.Generator, spec: ScenarioSpec, kind: Kind) -> ScenarioSpec:
    """A designed scenario with this kind of accident, and with fewer road users on steeper roads."""
    counts = {name: int(rng.integers(low, high + 1)) for name, (low, high) in _BACKGROUND.items()}
    meet = MeetSpec(actors=kind.pair or ("ego", "other"), offset=float(rng.uniform(*kind.late)))
    gaps = {"ego_behind": float(rng.uniform(*kind.gap)), "other_behind": float(rng.uniform(*_GAP))}
    actors = [replace(actor, gap=gaps.get(actor.role)) for actor in spec.actors]
    actors.sort(key=lambda actor: actor.role != "other")  # it has the least id
    return replace(
        spec, road=_steeper(rng, spec.road), actors=tuple(actors), meet=meet, background=BackgroundSpec(**counts)
    )


def _steeper(rng: np.random.Generator, road: RoadSpec) -> RoadSpec:
    hump = road.hump
    if hump is None:
        return road
    height = hump.height * min(float(rng.uniform(*_STEEPER)), 0.999 * MAX_GRADE / hump.grade)
    return replace(road, hump=replace(hump, height=height))


def accident_frames(rng: np.random.Generator) -> int:
    """How many frames an accident is meant to have."""
    median, spread, least, most = _FRAMES
    return int(np.clip(median * np.exp(spread * rng.standard_normal()), least, most))


def normal_frames(rng: np.random.Generator) -> int:
    """How many frames a normal scenario has."""
    return int(rng.integers(_NORMAL_FRAMES[0], _NORMAL_FRAMES[1] + 1))


def erring(rng: np.random.Generator, user: RoadUser, place: float, *, stops: bool) -> RoadUser:
    """A driver of the pair, who brakes, hesitates or swerves shortly before `place` (metres along its path)."""
    if user.route is None:
        return user
    speed, start_speed = user.max_speed, float(rng.uniform(0.1, 0.8)) * user.max_speed
    if rng.random() < _FAST:
        speed = float(rng.uniform(*_FAST_SPEEDS))
        start_speed = 0.95 * speed
    elif rng.random() < _FROM_REST:
        start_speed = 0.0
    start = place - (30.0 + 2.0 * start_speed if start_speed else float(rng.uniform(*_TO_GO)))
    path, error = user.path, rng.random()
    pace: tuple[Stretch, ...] = ()
    if stops:
        pace = ((place - float(rng.uniform(4, 12)), place + 60.0, float(rng.uniform(0.0, 5.0))),)
    elif error < 0.35:
        pace = ((place - float(rng.uniform(1, 8)), place + 60.0, speed * float(rng.uniform(0.2, 0.6))),)
    elif error < 0.7:
        pace = ((place - float(rng.uniform(12, 30)), place - float(rng.uniform(2, 9)), float(rng.uniform(2.0, 5.0))),)
    if rng.random() < 0.3:
        begin, length = place - float(rng.uniform(8, 14)), float(rng.uniform(7, 10))
        path = lane_change(path, begin, length, float(rng.choice([-1, 1]) * rng.uniform(0.5, 1.4)))
    return replace(
        user,
        path=path,
        start=start,
        start_speed=start_speed,
        max_speed=speed,
        pace=pace,
        brisk=True,
        alert=max(float(rng.uniform(*_ALERTS)), 0.0),
    )


def lively(rng: np.random.Generator, user: RoadUser) -> RoadUser:
    """A driver of whom some start from rest, some are fast and some slow down on the way; others are as they are."""
    if user.route is None or user.body.category == "cyclist":
        return user
    start, chance, speed = user.start, rng.random(2), user.max_speed
    start_speed, delay = user.start_speed * float(rng.uniform(0.1, 0.7)), user.delay
    pace: tuple[Stretch, ...] = ()
    if chance[0] < 0.45:
        start_speed, delay = 0.0, delay + float(rng.uniform(0, 4))
    elif chance[0] < 0.6:
        speed = float(rng.uniform(*_FAST_SPEEDS))
    if chance[1] < 0.4:
        begin = start + float(rng.uniform(8, 45))
        pace = ((begin, begin + float(rng.uniform(4, 12)), float(rng.uniform(0.6, 2.5))),)
    return replace(user, start_speed=start_speed, max_speed=speed, delay=delay, pace=pace, brisk=True)


def crowded(rng: np.random.Generator, parked: Sequence[ParkedVehicle]) -> tuple[ParkedVehicle, ...]:
    """Parked vehicles, of which two overlap in some scenarios: one more stands half on the place of another."""
    if not parked or rng.random() >= _OVERLAPPING:
        return tuple(parked)
    x, y, yaw = parked[int(rng.integers(len(parked)))].pose
    shift = float(rng.uniform(*_PITCHES)) * (1 if x * np.cos(yaw) + y * np.sin(yaw) > 0 else -1)  # away from the middle
    added = ParkedVehicle(random_body(rng, "car"), (x + shift * np.cos(yaw), y + shift * np.sin(yaw), yaw))
    return (*parked, added)


def beyond_contact(
    rng: np.random.Generator, simulation: Simulation, pair: tuple[int, int], size: FloatArray
) -> tuple[Simulation, float]:
    """A simulation that goes on after its last step, and how many seconds later (or earlier) its recording ends.

    Everybody goes straight on, the pair with less closing speed, until it is `_DEEPEST` metres into each other. Sizes
    are (2, 2) length and width, metres.
    """
    after = float(rng.uniform(*_AFTER))
    period, rows = float(simulation.time[-1] - simulation.time[-2]), list(pair)
    steps = np.arange(1, int(max(after, 0.0) / period) + 2)
    velocity = simulation.velocities[-1].copy()
    velocity[rows] += _GIVES_WAY * (velocity[rows].mean(axis=0) - velocity[rows])
    states = np.repeat(simulation.states[-1:], len(steps), axis=0)
    states[..., :2] += steps[:, None, None] * period * velocity
    depth = -separation(states[:, pair[0], :3], size[0], states[:, pair[1], :3], size[1])
    count = max(int((depth < _DEEPEST).cumprod().sum()), 1)
    added = replace(
        simulation,
        time=np.concatenate([simulation.time, simulation.time[-1] + period * steps[:count]]),
        states=np.concatenate([simulation.states, states[:count]]),
        velocities=np.concatenate([simulation.velocities, np.repeat(velocity[None], count, axis=0)]),
    )
    return added, min(after, (count - 1) * period)
