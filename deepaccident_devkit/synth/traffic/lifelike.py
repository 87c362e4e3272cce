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
    "ego is run into": Kind(weight=9, pair=("ego", "ego_behind"), late=(2.0, 3.0), gap=(3.0, 9.0), stops=True),
    "other is run into": Kind(weight=9, pair=("other", "other_behind"), late=(2.0, 3.0), gap=(3.0, 9.0), stops=True),
    "ego's follower": Kind(weight=18, pair=("ego_behind", "other")),
    "both followers": Kind(weight=8, pair=("ego_behind", "other_behind"), gap=(30.0, 40.0)),
    "stranger": Kind(weight=14, pair=None),
    "unknown": Kind(weight=6, pair=None, labelled=False),
}
MISFILED: Final = {True: 0.03, False: 0.02}
"""Share of the accident and of the normal folders whose scenario is of the other sort."""
ON_FOOT: Final = 0.3
"""Share of strangers who are pedestrians."""
_TURNED = {"right": 1, "straight": 2, "left": 3}
_FRAMES = (63.0, 0.34, 36, 90)
"""Of accidents: the median, how much its logarithm spreads, least, most."""
NORMAL_FRAMES = (93, 101)
"""The fewest frames of a normal scenario, and one more than the most."""
_BACKGROUND = {"vehicles": (4, 10), "two_wheelers": (0, 3), "parked": (1, 3), "walking": (0, 4), "crossing": (0, 3)}
"""The fewest of the background, and one more than the most."""
_GAP = (8.0, 16.0)
"""Metres from other to its follower."""
_STEEPER = (0.8, 2.2)
"""Times as high as a design's hump."""
_FROM_REST, _FAST = 0.8, 0.2
"""Shares of drivers who start from rest, and who drive as fast as `_FAST_SPEEDS`."""
_FAST_SPEEDS = (15.0, 18.4)
_TO_GO = (8.0, 26.0)
"""Metres from where one who starts from rest stands to where the paths cross."""
_ALERTS = (-0.3, 0.9)
_OVERLAPPING, _CROWD = 0.29, (2, 5)
"""Share of scenarios in which parked vehicles overlap; how many are added there, less one."""
_PITCHES, _TO_KERB = (3.2, 4.1), 0.35
"""Metres between the middles of two of these; metres from the middle of a slot towards the kerb."""
_NO_TOUCH, _AFTER = 0.07, (0.25, 0.395)
"""Share of accidents that are recorded up to just before the contact; of others, seconds from it to the last frame."""
_DEEP, _DEEPEST = (0.1, 1.5), 0.76
"""Metres into each other: between which numbers they are drawn, and the most."""
_GIVES_WAY = 0.4
"""The least share of their relative speed that two lose in a contact."""


def draw_kind(rng: np.random.Generator, spec: ScenarioSpec) -> Kind:
    """A kind of accident that is possible where ego and other go as in `spec`."""
    possible = [kind for kind in KINDS.values() if not kind.joins or paths_join(spec)]
    weights = np.array([kind.weight for kind in possible])
    return possible[rng.choice(len(possible), p=weights / weights.sum())]


def paths_join(spec: ScenarioSpec) -> bool:
    """Whether ego and other leave the junction by the same arm."""
    exits = {
        (ARMS.index(way.from_arm or "west") + _TURNED[way.turn]) % len(ARMS)
        for way in (spec.actor("ego"), spec.actor("other"))
    }
    return len(exits) == 1


def as_kind(rng: np.random.Generator, spec: ScenarioSpec, kind: Kind) -> ScenarioSpec:
    """A designed scenario with this kind of accident, and with fewer road users on steeper roads."""
    background = BackgroundSpec(**{name: int(rng.integers(*span)) for name, span in _BACKGROUND.items()})
    meet = MeetSpec(actors=kind.pair or ("ego", "other"), offset=float(rng.uniform(*kind.late)))
    spans = {"ego_behind": kind.gap, "other_behind": kind.gap if kind.stops else _GAP}
    gaps = {role: float(rng.uniform(*span)) for role, span in spans.items()}
    ordered = sorted(spec.actors, key=lambda actor: (actor.role != "other", actor.role == "other_behind"))  # as ids
    actors = tuple(replace(actor, gap=gaps.get(actor.role)) for actor in ordered)
    return replace(spec, road=_steeper(rng, spec.road), actors=actors, meet=meet, background=background)


def _steeper(rng: np.random.Generator, road: RoadSpec) -> RoadSpec:
    hump = road.hump
    if hump is None:
        return road
    times = min(float(rng.uniform(*_STEEPER)), 0.999 * MAX_GRADE / hump.grade)
    return replace(road, hump=replace(hump, height=times * hump.height))


def accident_frames(rng: np.random.Generator) -> int:
    """How many frames an accident is meant to have."""
    median, spread, least, most = _FRAMES
    return int(np.clip(median * np.exp(spread * rng.standard_normal()), least, most))


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
    pace: tuple[Stretch, ...] = (_stop(rng, place - float(rng.uniform(25, 60)), speed),) if rng.random() < 0.25 else ()
    if stops:
        pace += ((place - float(rng.uniform(4, 12)), place + 60.0, speed * float(rng.uniform(0.0, 0.85))),)
    elif error < 0.35:
        pace += ((place - float(rng.uniform(1, 8)), place + 60.0, speed * float(rng.uniform(0.2, 0.6))),)
    elif error < 0.6:
        pace += ((place - float(rng.uniform(12, 30)), place - float(rng.uniform(2, 9)), float(rng.uniform(2.0, 5.0))),)
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
    chance, speed = rng.random(2), user.max_speed * float(rng.uniform(1.0, 1.45))
    start_speed, delay, pace = user.start_speed * float(rng.uniform(0.1, 0.9)), user.delay, user.pace
    if chance[0] < 0.55:
        start_speed, delay = 0.0, delay + float(rng.uniform(0, 4))
    elif chance[0] < 0.75:
        speed = float(rng.uniform(*_FAST_SPEEDS))
    if chance[1] < 0.85:
        begins = user.start + rng.uniform(3, 40) + np.cumsum(rng.uniform(5, 30, size=2)) + np.arange(2) * speed**2 / 4
        pace = tuple(_stop(rng, float(begin), speed) for begin in begins)
    return replace(user, start_speed=start_speed, max_speed=speed, delay=delay, pace=pace, brisk=True)


def _stop(rng: np.random.Generator, begin: float, speed: float) -> Stretch:
    """A stretch that is long enough to brake to walking speed, or nearly to a standstill, and drive a little."""
    return (begin, begin + speed**2 / 14 + float(rng.uniform(0.5, 2.5)), float(rng.uniform(0.3, 1.5)))


def crowded(rng: np.random.Generator, parked: Sequence[ParkedVehicle]) -> tuple[ParkedVehicle, ...]:
    """Parked vehicles, nearer to the kerb; to some scenarios a row is added in which each overlaps the one before."""
    at_kerb = [replace(each, pose=_beside(each.pose, 0.0, _TO_KERB)) for each in parked]
    if not parked or rng.random() >= _OVERLAPPING:
        return tuple(at_kerb)
    first = at_kerb[int(rng.integers(len(parked)))].pose
    shifts = np.cumsum(rng.uniform(*_PITCHES, size=int(rng.integers(*_CROWD))))
    shifts *= np.sign(first[0] * np.cos(first[2]) + first[1] * np.sin(first[2]))  # away from the junction's middle
    row = [ParkedVehicle(random_body(rng, "car"), _beside(first, shift, 0.0)) for shift in shifts.tolist()]
    return (*at_kerb, *row)


def _beside(pose: tuple[float, float, float], ahead: float, right: float) -> tuple[float, float, float]:
    x, y, yaw = pose
    cos, sin = float(np.cos(yaw)), float(np.sin(yaw))
    return x + ahead * cos + right * sin, y + ahead * sin - right * cos, yaw


def beyond_contact(
    rng: np.random.Generator, simulation: Simulation, pair: tuple[int, int], size: FloatArray
) -> tuple[Simulation, float]:
    """A simulation that goes on after its last step, and how many seconds later (or earlier) its recording ends.

    Everybody goes straight on, the pair with less relative speed, until they are as deep in each other as is drawn.
    Sizes are (2, 2) length and width, metres.
    """
    after = -0.02 if rng.random() < _NO_TOUCH else float(rng.uniform(*_AFTER))
    deepest = min(float(rng.uniform(*_DEEP)), _DEEPEST)
    period, rows = float(simulation.time[-1] - simulation.time[-2]), list(pair)
    steps = np.arange(1, int(max(after, 0.0) / period) + 2)
    velocity = simulation.velocities[-1].copy()
    mean = velocity[rows].mean(axis=0)
    way = 2.0 * np.hypot(*(velocity[pair[0]] - mean)) * after
    velocity[rows] = mean + min(1.0 - _GIVES_WAY, 1.3 * deepest / max(way, 1e-6)) * (velocity[rows] - mean)
    states = np.repeat(simulation.states[-1:], len(steps), axis=0)
    states[..., :2] += steps[:, None, None] * period * velocity
    depth = -separation(states[:, pair[0], :3], size[0], states[:, pair[1], :3], size[1])
    count = max(int((depth < deepest + 0.01).cumprod().sum()), 1)
    added = replace(
        simulation,
        time=np.concatenate([simulation.time, simulation.time[-1] + period * steps[:count]]),
        states=np.concatenate([simulation.states, states[:count]]),
        velocities=np.concatenate([simulation.velocities, np.repeat(velocity[None], count, axis=0)]),
    )
    return added, min(after, (count - 1) * period)
