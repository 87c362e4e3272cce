"""All that one scenario holds, made so that it happens as its plan says."""

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from time import perf_counter
from typing import NamedTuple

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.release import Collision, Meta
from deepaccident_devkit.synth.actors import Actor, Actors, Body, Sampled, Snapshot, Uniform
from deepaccident_devkit.synth.config import SynthConfig
from deepaccident_devkit.synth.plan import ScenarioPlan, plan_scenarios
from deepaccident_devkit.synth.roads import Junction
from deepaccident_devkit.synth.spec import ScenarioSpec
from deepaccident_devkit.synth.spec.model import Role
from deepaccident_devkit.synth.stage import World, random_world
from deepaccident_devkit.synth.traffic.casting import unplanned
from deepaccident_devkit.synth.traffic.drama import (
    Performance,
    Recorded,
    Stage,
    latest_end,
    perform_twin,
    recorded_accident,
    recorded_normal,
    set_stage,
    try_accident,
    usual_duration,
)
from deepaccident_devkit.synth.traffic.driving import PERIOD
from deepaccident_devkit.synth.traffic.impact import Miss, by_far, contact_side, misses_text
from deepaccident_devkit.synth.traffic.rights import SignalPlan
from deepaccident_devkit.taxonomy import FRAME_PERIOD, STATIC_ACTOR_ID, VEHICLE_AGENTS, WARM_UP_FRAMES, AgentName

AGENT_OF_ROLE: Mapping[Role, AgentName] = {
    "ego": "ego_vehicle",
    "ego_behind": "ego_vehicle_behind",
    "other": "other_vehicle",
    "other_behind": "other_vehicle_behind",
}
MAX_DRAWS = 100
"""After this many draws without a collision a scenario is given up."""
FAR_DRAWS = 25
"""After this many it is given up if all missed by far and a draw differs from another one only in its numbers."""
_SHOWN_AFTER = 1.0
"""Seconds after which the number of draws is shown."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scenario:
    """All that can be recorded; time 0 is the time of the first recorded frame.

    Attributes:
        plan: which scenario it is.
        spec: the draw that was simulated.
        world: what stands still.
        actors: what moves, and parked vehicles.
        agents: actor ids of the four vehicle agents.
        weather: one of `WEATHERS`.
        time_of_day: one of `taxonomy.TIMES_OF_DAY`.
        meta: the contents of its meta file.
        frames: how many are recorded.
        signals: the phases of the traffic lights; None if there are no lights.
        draws: how many draws were needed.
    """

    plan: ScenarioPlan
    spec: ScenarioSpec
    world: World
    actors: Actors
    agents: dict[AgentName, int]
    weather: str
    time_of_day: str
    meta: Meta
    frames: int
    signals: SignalPlan | None
    draws: int


class RandomStreams(NamedTuple):
    """Independent random numbers for each part of a pair's scene, so that a change to one part leaves the others."""

    world: np.random.Generator
    traffic: np.random.Generator
    ids: np.random.Generator

    @classmethod
    def of(cls, seed: int, pair: int) -> "RandomStreams":
        """The streams of a pair, from their start."""
        spawned = np.random.SeedSequence([seed, pair]).spawn(len(cls._fields))
        return cls(*map(np.random.default_rng, spawned))


def build_scenario(config: SynthConfig, plan: ScenarioPlan, *, progress: bool = False) -> Scenario:
    """Make a scenario; the same seed and pair give the same scene, for the accident and for its twin.

    If two actors are timed to meet, the scene is drawn again until they touch.

    Args:
        config: the settings of the release.
        plan: which scenario it is.
        progress: whether to show the number of draws if they take long.

    Raises:
        ConfigError: they do not touch in `MAX_DRAWS` draws, or miss each other by far in the first `FAR_DRAWS`; the
            message says how near they came, and what to change.
    """
    random = RandomStreams.of(config.seed, plan.pair)
    stage, accident, draws = _first_good_draw(random.traffic, config, plan, progress=progress)
    if plan.accident and accident is not None:
        recorded = recorded_accident(stage, accident, config.frames)
    else:
        recorded = _twin(stage, config, plan)
    spec = stage.spec
    ego, other = (spec.actor(role).from_arm or "west" for role in ("ego", "other"))
    ids = _Ids.of(random.ids, stage)
    return Scenario(
        plan=plan,
        spec=spec,
        world=random_world(random.world, stage.junction, spec.view, between=(ego, other)),
        actors=Actors.of(_actors(stage, recorded, ids)),
        agents=ids.agents,
        weather=spec.weather,
        time_of_day=spec.time_of_day,
        meta=_meta(plan, stage, recorded, ids),
        frames=recorded.frames,
        signals=None if stage.signals is None else stage.signals.shifted(-recorded.start),
        draws=draws,
    )


def _first_good_draw(
    rng: np.random.Generator, config: SynthConfig, plan: ScenarioPlan, *, progress: bool
) -> tuple[Stage, Performance | None, int]:
    """The first draw in which the pair touches, what happens in it, and how many draws were needed."""
    from tqdm.auto import tqdm

    misses: list[Miss] = []
    roles: tuple[Role, Role] = ("ego", "other")
    counted = tqdm(range(1, MAX_DRAWS + 1), "draws", leave=False, disable=not progress, delay=_SHOWN_AFTER)
    with closing(counted):
        for draws in counted:
            spec = plan.draw(rng)
            junction = Junction(spec.road)
            if plan.unplanned:
                spec = unplanned(rng, spec, junction)
            stage = set_stage(rng, spec, junction, usual_duration(rng, spec, config.frames))
            if spec.meet is None:
                return stage, None, draws
            tried, roles = try_accident(stage), spec.meet.actors
            if isinstance(tried, Performance):
                return stage, tried, draws
            misses.append(tried)
            if draws == FAR_DRAWS and plan.template.draws_alike and by_far(misses):
                break
    raise ConfigError(f"{plan.template.place('meet')}: {misses_text(misses, roles)}")


def _twin(stage: Stage, config: SynthConfig, plan: ScenarioPlan) -> Recorded:
    normal = perform_twin(stage, latest_end(stage, config.frames))
    if normal is None:
        where = "in the normal twin too" if stage.spec.meet else "although all obey the rules"
        raise ConfigError(
            f"{plan.template.place('actors')}: the road users collide {where}, even if one of them comes later; let "
            "them start farther from each other"
        )
    return recorded_normal(stage, normal, config.frames)


class _Ids(NamedTuple):
    """The ids of all actors of a stage: first the moving ones, then the parked ones."""

    actor: tuple[int, ...]
    camera: tuple[int, ...]
    agents: dict[AgentName, int]

    @classmethod
    def of(cls, rng: np.random.Generator, stage: Stage) -> "_Ids":
        """Moving actors get ids from 1000 on, parked ones from 20000 on, in the order in which they were made."""
        moving, count = len(stage.users), len(stage.users) + len(stage.parked)
        actor = (rng.integers(1000, 2000) + rng.integers(1, 4, moving).cumsum()).tolist()
        actor += [STATIC_ACTOR_ID + row for row in range(moving, count)]
        camera = rng.choice(np.arange(1, 2**16), count, replace=False).tolist()
        agents = {
            AGENT_OF_ROLE[user.role]: actor[row] for row, user in enumerate(stage.users) if user.role in AGENT_OF_ROLE
        }
        return cls(tuple(actor), tuple(camera), {agent: agents[agent] for agent in VEHICLE_AGENTS})


def _actors(stage: Stage, recorded: Recorded, ids: _Ids) -> list[Actor]:
    simulation = recorded.performance.simulation
    start = float(simulation.time[0]) - recorded.start
    actors = []
    for column, row in enumerate(recorded.performance.present):
        motion = Sampled(
            start=start,
            period=PERIOD,
            samples=simulation.poses[:, column],
            sample_velocities=simulation.velocities[:, column],
        )
        actors.append(_actor(ids, row, stage.users[row].body, motion))
    for row, vehicle in enumerate(stage.parked, start=len(stage.users)):
        actors.append(_actor(ids, row, vehicle.body, Uniform(*vehicle.pose)))
    return actors


def _actor(ids: _Ids, row: int, body: Body, motion: Sampled | Uniform) -> Actor:
    return Actor(
        actor_id=ids.actor[row],
        object_id=ids.camera[row],
        category=body.category,
        size=body.size,
        shape=body.shape,
        motion=motion,
        origin=body.origin,
    )


def _meta(plan: ScenarioPlan, stage: Stage, recorded: Recorded, ids: _Ids) -> Meta:
    spec, collision, planned = stage.spec, _collision(stage, recorded, ids), _pair_agents(stage)
    ego, ego_behind, other, other_behind = (ids.agents[agent] for agent in VEHICLE_AGENTS)
    return Meta(
        weather=spec.weather,
        time_of_day=spec.time_of_day,
        collision=collision,
        simulated_frames=recorded.frames + WARM_UP_FRAMES,
        agent_ids=(ego, ego_behind, other, other_behind),
        road_type=plan.traits.road_type,
        spawn_side=plan.traits.spawn_side,
        ego_direction=spec.actor("ego").turn,
        other_direction=spec.actor("other").turn,
        planned_agents=None if collision or planned == (None, None) else planned,
    )


def _collision(stage: Stage, recorded: Recorded, ids: _Ids) -> Collision | None:
    impact, pair = recorded.impact, stage.cast.pair
    if impact is None or pair is None:
        return None
    first, second = (stage.users[row] for row in pair)
    return Collision(
        ids=(ids.actor[pair[0]], ids.actor[pair[1]]),
        classes=(first.body.category, second.body.category),
        impact=impact.strength,
        spawn_relation="same",
        contact_side=f"{impact.side}_side",
        agents=_pair_agents(stage),
    )


def _pair_agents(stage: Stage) -> tuple[AgentName | None, AgentName | None]:
    """The agents of the two who are timed to meet; None for a road user that is no agent, or if nobody is timed."""
    first, second = (stage.users[row] for row in stage.cast.pair) if stage.cast.pair else (None, None)
    return AGENT_OF_ROLE.get(first.role) if first else None, AGENT_OF_ROLE.get(second.role) if second else None


def checked_text(config: SynthConfig, *, progress: bool = False) -> str:
    """What happens in the first pair of a release of a scenario file, as text of some lines.

    Args:
        config: the settings of the release; `spec` is the file.
        progress: whether to show the number of draws if they take long.

    Raises:
        ConfigError: there is no file, it is no possible scenario, or its accident or twin cannot be made.
    """
    if config.spec is None:
        raise ConfigError("spec: nothing to check; give a scenario file")
    began = perf_counter()
    plans = plan_scenarios(replace(config, scenarios=2, sensors="none"))
    made = [build_scenario(config, plan, progress=progress) for plan in plans if plan.pair == 0]
    lines = [f"{config.spec}: can be simulated; one draw of it, with seed {config.seed}:"]
    for scenario in made:
        lines += [f"  {_outcome(scenario)}", f"    {_extent(scenario)}"]
    return "\n".join([*lines, f"checked in {perf_counter() - began:.1f} s; nothing is written"])


def _outcome(scenario: Scenario) -> str:
    """Who collides with whom, when, how fast and with which sides."""
    collision, meet = scenario.meta.collision, scenario.spec.meet
    if collision is None or meet is None:
        return "normal: nobody collides"
    time = _duration(scenario)
    now = scenario.actors.at(time)
    rows = [scenario.actors.row_of(actor) for actor in collision.ids]
    speeds = np.hypot(*now.velocities[rows].T)
    both = [
        f"{role} ({scenario.actors.all[pair[0]].category}, {speed:.1f} m/s, {_side(scenario, pair, now)})"
        for role, speed, pair in zip(meet.actors, speeds, (rows, rows[::-1]), strict=True)
    ]
    return f"accident: {' and '.join(both)} collide at {time:.1f} s; found in draw {scenario.draws}"


def _side(scenario: Scenario, pair: list[int], now: Snapshot) -> str:
    """The side of the first of a pair that is hit."""
    side = contact_side(now.poses[pair], scenario.actors.size[pair, :2])
    return f"{side} side" if side in ("left", "right") else side


def _extent(scenario: Scenario) -> str:
    """How long it is and how many take part."""
    parked = sum(actor.parked for actor in scenario.actors.all)
    moving = len(scenario.actors) - parked
    frames = f"{scenario.frames} frames ({_duration(scenario):.1f} s)"
    return f"{frames}, {moving} road users that move, {parked} parked; {scenario.weather}, {scenario.time_of_day}"


def _duration(scenario: Scenario) -> float:
    """Seconds from the first to the last frame."""
    return (scenario.frames - 1) * FRAME_PERIOD
