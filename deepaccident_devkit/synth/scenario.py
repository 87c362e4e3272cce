"""Scenarios: which there are in a release, and all that one of them holds."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from deepaccident_devkit.release import Collision, Meta
from deepaccident_devkit.synth.actors import Actor, Actors, Motion
from deepaccident_devkit.synth.bodies import Body
from deepaccident_devkit.synth.config import SynthConfig
from deepaccident_devkit.synth.design import SPEEDS, Encounter, random_encounter
from deepaccident_devkit.synth.traffic import BackgroundActor, random_traffic
from deepaccident_devkit.synth.world import HidingPlace, World, random_world
from deepaccident_devkit.taxonomy import (
    STATIC_ACTOR_ID,
    TIMES_OF_DAY,
    TOWNS,
    VEHICLE_AGENTS,
    WARM_UP_FRAMES,
    WEATHERS,
    AgentName,
    frame_timestamp,
)

_FIRST_PAIRS = ("train", "val", "test")
_HIDDEN_SPEEDS = (12.0, 14.0)
"""m/s: with a house on the kerb between them, slower cars would see each other earlier."""
_GOLDEN_RATIO = 0.6180339887498949
"""Its multiples fill [0, 1) evenly, whatever their number."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioPlan:
    """One scenario to make.

    Attributes:
        pair: number of its pair, from 0; an accident and its normal twin share scene, name and split.
        accident: whether it is the accident.
        subtype: 1, signalised, or 2.
        name: such as `Town03_type001_subtype0001_scenario00024`.
        split: `train`, `val` or `test`.
    """

    pair: int
    accident: bool
    subtype: int
    name: str
    split: str

    @property
    def scenario_type(self) -> str:
        """Such as `type1_subtype1_accident`."""
        return f"type1_subtype{self.subtype}_{'accident' if self.accident else 'normal'}"

    @property
    def token(self) -> str:
        """The scenario's token."""
        return f"{self.scenario_type}/{self.name}"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scenario:
    """All that is there to be recorded.

    Attributes:
        plan: which scenario it is.
        world: what stands still.
        actors: what moves, and parked vehicles.
        agents: actor ids of the four vehicle agents.
        weather: one of `WEATHERS`.
        time_of_day: one of `taxonomy.TIMES_OF_DAY`.
        meta: as its file says.
    """

    plan: ScenarioPlan
    world: World
    actors: Actors
    agents: dict[AgentName, int]
    weather: str
    time_of_day: str
    meta: Meta


class RandomStreams(NamedTuple):
    """Independent random numbers for each part of a pair's scene, so that a change to one part leaves the others."""

    world: np.random.Generator
    design: np.random.Generator
    traffic: np.random.Generator
    ids: np.random.Generator
    weather: np.random.Generator
    look: np.random.Generator

    @classmethod
    def of(cls, seed: int, pair: int) -> "RandomStreams":
        """The streams of a pair, from their start."""
        return cls(*map(np.random.default_rng, _seed(seed, pair).spawn(len(cls._fields))))


def plan_scenarios(config: SynthConfig) -> list[ScenarioPlan]:
    """The scenarios of a release: accidents and their twins by turns."""
    return [_plan(config.seed, number // 2, accident=number % 2 == 0) for number in range(config.scenarios)]


def build_scenario(config: SynthConfig, plan: ScenarioPlan) -> Scenario:
    """Make up a scenario; the same seed and pair give the same scene, for the accident and for its twin."""
    random = RandomStreams.of(config.seed, plan.pair)
    hidden, end_time = config.view == "hidden", frame_timestamp(config.frames)
    encounter = random_encounter(random.design, end_time, _HIDDEN_SPEEDS if hidden else SPEEDS)
    hiding = _between(encounter) if hidden else None
    world = random_world(random.world, signalized=plan.subtype == 1, hiding=hiding)
    traffic = random_traffic(random.traffic, encounter, [hiding.block] if hiding else [])
    actors, agents = _numbered(random.ids, encounter, traffic, accident=plan.accident)
    weather, time_of_day = str(random.weather.choice(WEATHERS)), str(random.weather.choice(TIMES_OF_DAY))
    meta = Meta(
        weather=weather,
        time_of_day=time_of_day,
        collision=_collision(encounter, agents) if plan.accident else None,
        simulated_frames=config.frames + WARM_UP_FRAMES,
        agent_ids=(agents[VEHICLE_AGENTS[0]], agents[VEHICLE_AGENTS[1]], *_last_two(agents)),
        road_type="four-way junction",
        spawn_side=encounter.spawn_side,
        ego_direction="straight",
        other_direction="straight",
    )
    return Scenario(
        plan=plan,
        world=world,
        actors=Actors.of(actors),
        agents=agents,
        weather=weather,
        time_of_day=time_of_day,
        meta=meta,
    )


def _between(encounter: Encounter) -> HidingPlace:
    """A house between the two who meet, ego coming along x from below 0; the pole looks along the other's lane."""
    if encounter.spawn_side == "left":
        return HidingPlace(house=(-1, 1), pole=(-1, -1))
    return HidingPlace(house=(-1, -1), pole=(1, 1))


def _seed(seed: int, pair: int) -> np.random.SeedSequence:
    return np.random.SeedSequence([seed, pair])


def _plan(seed: int, pair: int, *, accident: bool) -> ScenarioPlan:
    town = TOWNS[_seed(seed, pair).generate_state(1)[0] % len(TOWNS)]
    subtype = 1 + pair % 2
    return ScenarioPlan(
        pair=pair,
        accident=accident,
        subtype=subtype,
        name=f"{town}_type001_subtype{subtype:04d}_scenario{pair + 1:05d}",
        split=_split(pair),
    )


def _split(pair: int) -> str:
    """Both of a pair go together: one pair to each split, then about 70, 15 and 15 %."""
    if pair < len(_FIRST_PAIRS):
        return _FIRST_PAIRS[pair]
    share = pair * _GOLDEN_RATIO % 1
    return "train" if share < 0.7 else "val" if share < 0.85 else "test"


def _numbered(
    rng: np.random.Generator, encounter: Encounter, traffic: Sequence[BackgroundActor], *, accident: bool
) -> tuple[list[Actor], dict[AgentName, int]]:
    """All actors with their ids: moving ones in the thousands, parked ones from 20000, in the order of their making."""
    count = len(VEHICLE_AGENTS) + len(traffic)
    moving = (rng.integers(1000, 2000) + rng.integers(1, 4, count).cumsum()).tolist()
    objects = rng.choice(np.arange(1, 2**16), count, replace=False).tolist()
    motions = encounter.accident if accident else encounter.normal
    agents = dict(zip(VEHICLE_AGENTS, moving, strict=False))
    actors = [
        _actor(agents[agent], objects[row], encounter.bodies[agent], motions[agent])
        for row, agent in enumerate(VEHICLE_AGENTS)
    ]
    for row, actor in enumerate(traffic, start=len(VEHICLE_AGENTS)):
        actor_id = STATIC_ACTOR_ID + row if actor.parked else moving[row]
        actors.append(_actor(actor_id, objects[row], actor.body, actor.motion))
    return actors, agents


def _actor(actor_id: int, object_id: int, body: Body, motion: Motion) -> Actor:
    return Actor(
        actor_id=actor_id,
        object_id=object_id,
        category=body.category,
        size=body.size,
        shape=body.shape,
        motion=motion,
        origin=body.origin,
    )


def _collision(encounter: Encounter, agents: dict[AgentName, int]) -> Collision:
    ego, _, other, _ = VEHICLE_AGENTS
    return Collision(
        ids=(agents[ego], agents[other]),
        classes=(encounter.bodies[ego].category, encounter.bodies[other].category),
        impact=encounter.impact,
        spawn_relation="same",
        contact_side="front_side",
        agents=(ego, other),
    )


def _last_two(agents: dict[AgentName, int]) -> tuple[int, int]:
    _, _, other, other_behind = VEHICLE_AGENTS
    return agents[other], agents[other_behind]
