"""Background traffic: parked and moving vehicles, two-wheelers and pedestrians that keep clear of everyone else."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.synth.actors import Motion, Uniform
from deepaccident_devkit.synth.bodies import Body, random_body
from deepaccident_devkit.synth.collision import separation
from deepaccident_devkit.synth.design import Encounter, footprint
from deepaccident_devkit.synth.roads import CROSSWALK, LANE_CENTER, LANE_WIDTH, PARKING_CENTER, ROAD_EDGE
from deepaccident_devkit.synth.solids import Block
from deepaccident_devkit.taxonomy import VEHICLE_AGENTS

_CHECK_PERIOD = 0.05
_MARGIN = 0.3
"""Metres that background actors keep from everyone, at least along one direction."""
_TRIES = 10

Placement = Callable[[np.random.Generator, float], Uniform]


@dataclass(frozen=True, slots=True)
class Flow:
    """A kind of background traffic.

    Attributes:
        categories: drawn evenly.
        count: how many are tried.
        place: draws a motion, given the duration of the recording, seconds.
        parked: whether they are static vehicles.
    """

    categories: tuple[str, ...]
    count: int
    place: Placement
    parked: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class BackgroundActor:
    """A body, its motion, and whether it is a parked vehicle."""

    body: Body
    motion: Uniform
    parked: bool


def random_traffic(
    rng: np.random.Generator, encounter: Encounter, walls: Sequence[Block] = ()
) -> list[BackgroundActor]:
    """Background actors that stay clear of each other and of the agents, in the accident and in its twin.

    Args:
        rng: random numbers.
        encounter: the agents.
        walls: what stands on a sidewalk, so that nobody walks or parks there.
    """
    times = np.append(np.arange(0.0, encounter.end_time, _CHECK_PERIOD), encounter.end_time)
    placed = _Placed(times)
    for wall in walls:
        placed.add_block(wall)
    for motions in (encounter.accident, encounter.normal):
        for agent in VEHICLE_AGENTS:
            placed.add(encounter.bodies[agent], motions[agent])
    accepted = []
    for flow in FLOWS:
        for _ in range(flow.count):
            body = random_body(rng, flow.categories[rng.integers(len(flow.categories))])
            motion = _clear_motion(rng, flow, body, placed)
            if motion is not None:
                placed.add(body, motion)
                accepted.append(BackgroundActor(body, motion, flow.parked))
    return accepted


class _Placed:
    """Where everyone accepted so far is, at all times checked."""

    def __init__(self, times: FloatArray) -> None:
        self.times = times
        self._poses: list[FloatArray] = []
        self._sizes: list[FloatArray] = []

    def add_block(self, block: Block) -> None:
        (x0, x1), (y0, y1) = block.x, block.y
        self._poses.append(np.tile([(x0 + x1) / 2, (y0 + y1) / 2, 0.0], (len(self.times), 1)))
        self._sizes.append(np.array([x1 - x0, y1 - y0]))

    def add(self, body: Body, motion: Motion) -> None:
        self._poses.append(motion.poses(self.times))
        self._sizes.append(footprint(body))

    def is_clear(self, body: Body, motion: Motion) -> bool:
        """Whether the body keeps `_MARGIN` from all; only those that come near are looked at closely."""
        own, size = motion.poses(self.times), footprint(body)
        poses, sizes = np.stack(self._poses), np.stack(self._sizes)
        reach = (np.hypot(*sizes.T) + np.hypot(*size)) / 2 + _MARGIN
        near = (np.hypot(*np.moveaxis(poses[..., :2] - own[:, :2], -1, 0)) < reach[:, None]).any(axis=1)
        apart = separation(own, size, poses[near], sizes[near][:, None])
        return bool((apart > _MARGIN).all())


def _clear_motion(rng: np.random.Generator, flow: Flow, body: Body, placed: _Placed) -> Uniform | None:
    for _ in range(_TRIES):
        motion = flow.place(rng, float(placed.times[-1]))
        if placed.is_clear(body, motion):
            return motion
    return None


def _on_arm(rng: np.random.Generator, along: float, offset: float, speed: float) -> Uniform:
    """At `along` metres past the middle and `offset` right of the line of one of the four directions of travel."""
    yaw = np.pi / 2 * float(rng.integers(4))
    cos, sin = np.cos(yaw), np.sin(yaw)
    return Uniform(float(cos * along + sin * offset), float(sin * along - cos * offset), yaw, speed)


def _parked(rng: np.random.Generator, _duration: float) -> Uniform:
    along = rng.uniform(16, 85) * rng.choice([-1, 1])
    return _on_arm(rng, along, PARKING_CENTER, 0.0)


def _driving(rng: np.random.Generator, duration: float) -> Uniform:
    return _passing(rng, duration, LANE_CENTER, (6, 11), 85)


def _riding(rng: np.random.Generator, duration: float) -> Uniform:
    return _passing(rng, duration, LANE_WIDTH - 0.35, (3, 6), 60)


def _walking(rng: np.random.Generator, duration: float) -> Uniform:
    motion = _passing(rng, duration, rng.uniform(ROAD_EDGE + 1.0, ROAD_EDGE + 2.5), (0.7, 1.7), 50)
    return motion if rng.random() < 0.5 else _turned_round(motion, duration)


def _crossing(rng: np.random.Generator, duration: float) -> Uniform:
    """Over one of the crosswalks."""
    beside = rng.uniform(CROSSWALK[0] + 0.4, CROSSWALK[1] - 0.4) * rng.choice([-1, 1])
    return _passing(rng, duration, beside, (0.9, 1.7), 6)


def _passing(
    rng: np.random.Generator, duration: float, offset: float, speeds: tuple[float, float], reach: float
) -> Uniform:
    """Driving so that at some time of the recording it is within `reach` metres of the middle."""
    speed = float(rng.uniform(*speeds))
    along = rng.uniform(-reach, reach) - speed * rng.uniform(0, duration)
    return _on_arm(rng, float(along), offset, speed)


def _turned_round(motion: Uniform, duration: float) -> Uniform:
    """The same way, walked in the other direction."""
    x, y, _ = motion.poses([duration])[0].tolist()
    return Uniform(x, y, motion.yaw - np.pi, motion.speed)


FLOWS: Sequence[Flow] = (
    Flow(("car", "car", "car", "van"), 14, _parked, parked=True),
    Flow(("car", "car", "car", "van", "truck", "truck"), 14, _driving),
    Flow(("motorcycle",), 3, _driving),
    Flow(("cyclist",), 4, _riding),
    Flow(("pedestrian",), 12, _walking),
    Flow(("pedestrian",), 4, _crossing),
)
"""What every scenario tries to have, in the order in which room is given away."""
