"""A scenario: made so that it happens as its plan says, and recorded frame by frame as files of a release.

It is recorded in parts; each part takes every nth frame, so that several processes can share a scenario.
"""

import multiprocessing
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.actors import Actor, Actors, Body, SampledMotion
from deepaccident_devkit.plugins.synth.plan import ScenarioPlan, Sensors, SynthConfig
from deepaccident_devkit.plugins.synth.roads import Arm, Junction
from deepaccident_devkit.plugins.synth.sensors.agents import Agent
from deepaccident_devkit.plugins.synth.sensors.lidar import Scan, intensity
from deepaccident_devkit.plugins.synth.sensors.rig import Rig, make_rig
from deepaccident_devkit.plugins.synth.sensors.scene import Scene
from deepaccident_devkit.plugins.synth.spec import ScenarioSpec
from deepaccident_devkit.plugins.synth.spec.model import Role
from deepaccident_devkit.plugins.synth.traffic.accidents import (
    Performance,
    Recorded,
    Stage,
    lasts,
    latest_end,
    perform_twin,
    recorded_accident,
    recorded_normal,
    set_stage,
    try_accident,
    usual_duration,
    with_graze,
)
from deepaccident_devkit.plugins.synth.traffic.driving import PERIOD
from deepaccident_devkit.plugins.synth.traffic.lifelike import ON_FOOT
from deepaccident_devkit.plugins.synth.traffic.placement import unplanned
from deepaccident_devkit.plugins.synth.traffic.rights import SignalPlan
from deepaccident_devkit.plugins.synth.world import World, random_world
from deepaccident_devkit.release import (
    Collision,
    Meta,
    ScenarioFolder,
    write_bev,
    write_calib,
    write_image,
    write_label,
    write_lidar,
    write_meta,
)
from deepaccident_devkit.release.store import real_path
from deepaccident_devkit.taxonomy import (
    AGENTS,
    BEV_CAMERA,
    LIDAR,
    STATIC_ACTOR_ID,
    VEHICLE_AGENTS,
    WARM_UP_FRAMES,
    AgentName,
    frame_timestamp,
)

AGENT_OF_ROLE: Mapping[Role, AgentName] = {
    "ego": "ego_vehicle",
    "ego_behind": "ego_vehicle_behind",
    "other": "other_vehicle",
    "other_behind": "other_vehicle_behind",
}
# After this many draws without a collision a scenario is given up.
MAX_DRAWS = 40
# Parts of a scenario with sensors. Without sensors it has one: simulating it takes longer than writing a frame.
_PARTS = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scenario:
    """All that can be recorded; time 0 is the time of the first recorded frame.

    Attributes:
        plan: which scenario it is.
        spec: the draw that was simulated.
        world: what stands still.
        actors: what moves, and parked vehicles.
        agents: actor ids of the four vehicle agents.
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
    meta: Meta
    frames: int
    signals: SignalPlan | None
    draws: int


def build_scenario(config: SynthConfig, plan: ScenarioPlan) -> Scenario:
    """Make a scenario; the same seed and pair give the same scene, for the accident and for its twin.

    If two actors are timed to meet, the scene is drawn again until they touch. Raises ConfigError if they do not in
    `MAX_DRAWS` draws; the message says how near they came, and what to change.
    """
    # a stream for each part of the scene, so that a change to one part leaves the others
    seeds = [
        config.seed,
        plan.pair,
        *([1] if plan.misfiled else []),
    ]  # it shows other scenes than its twin
    of_world, of_traffic, of_ids, of_end = map(
        np.random.default_rng, np.random.SeedSequence(seeds).spawn(4)
    )
    while True:
        stage, accident, draws = _first_good_draw(of_traffic, config, plan)
        recorded = (
            recorded_accident(of_end, stage, accident, config.frames)
            if accident and plan.collides
            else _twin(of_end, stage, config, plan)
        )
        if recorded is not None:
            break
    if plan.grazes:
        recorded = with_graze(stage, recorded)
    spec = stage.spec
    ego, other = (spec.actor(role).from_arm or "west" for role in ("ego", "other"))
    ids = _Ids.of(of_ids, stage)
    return Scenario(
        plan=plan,
        spec=spec,
        world=random_world(
            of_world,
            stage.junction,
            spec.view,
            between=(ego, other),
            low_pole=plan.kind is not None,
        ),
        actors=Actors.of(_actors(stage, recorded, ids)),
        agents=ids.agents,
        meta=_meta(plan, stage, recorded, ids, config.decimals),
        frames=recorded.frames,
        signals=None if stage.signals is None else stage.signals.shifted(-recorded.start),
        draws=draws,
    )


def _first_good_draw(
    rng: np.random.Generator, config: SynthConfig, plan: ScenarioPlan
) -> tuple[Stage, Performance | None, int]:
    """The first draw in which the pair touches, what happens in it, and how many draws were needed."""
    least = np.inf
    most = MAX_DRAWS if plan.kind is None else 10 * MAX_DRAWS
    for draws in range(1, most + 1):
        spec = plan.draw(rng)
        junction = Junction(spec.road)
        if plan.unplanned:
            on_foot = None if plan.kind is None else plan.kind.labelled and rng.random() < ON_FOOT
            spec = unplanned(rng, spec, junction, on_foot=on_foot)
        stage = set_stage(
            rng, spec, junction, usual_duration(rng, config.frames, plan.kind), plan.kind
        )
        if spec.meet is None:
            return stage, None, draws
        tried = try_accident(stage)
        if isinstance(tried, Performance) and lasts(stage, tried, config.frames):
            return stage, tried, draws
        least = min(least, np.inf if isinstance(tried, Performance) else tried)
    came = f"the least distance was {least:.1f} m; choose a meet.offset nearer to 0, or another max_speed"
    if least == np.inf:
        came = "their paths do not cross, or others touch before; change from or turn, or the others' gap or lane"
    raise ConfigError(
        f"{plan.template.place('meet')}: the two did not collide in {most} draws; {came}, or choose fewer "
        "background.vehicles"
    )


def _twin(
    rng: np.random.Generator, stage: Stage, config: SynthConfig, plan: ScenarioPlan
) -> Recorded | None:
    """The recording of a normal scenario; None where all is as in the real release and another draw is needed."""
    normal = perform_twin(stage, latest_end(stage, config.frames))
    if normal is not None:
        return recorded_normal(rng, stage, normal, config.frames)
    if plan.kind is not None:
        return None
    where = "in the normal twin too" if stage.spec.meet else "although all obey the rules"
    raise ConfigError(
        f"{plan.template.place('actors')}: the road users collide {where}, even if one of them comes later; let "
        "them start farther from each other"
    )


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
            AGENT_OF_ROLE[user.role]: actor[row]
            for row, user in enumerate(stage.users)
            if user.role in AGENT_OF_ROLE
        }
        return cls(tuple(actor), tuple(camera), {agent: agents[agent] for agent in VEHICLE_AGENTS})


def _actors(stage: Stage, recorded: Recorded, ids: _Ids) -> list[Actor]:
    simulation = recorded.performance.simulation
    start = float(simulation.time[0]) - recorded.start
    actors = []
    for column, row in enumerate(recorded.performance.present):
        if row == stage.unlabelled:
            continue
        motion = SampledMotion(
            start=start,
            period=PERIOD,
            samples=simulation.poses[:, column],
            sample_velocities=simulation.velocities[:, column],
        )
        actors.append(_actor(ids, row, stage.users[row].body, motion))
    for row, vehicle in enumerate(stage.parked, start=len(stage.users)):
        motion = SampledMotion(
            start=0.0,
            period=PERIOD,
            samples=np.array([vehicle.pose]),
            sample_velocities=np.zeros((1, 2)),
        )
        actors.append(_actor(ids, row, vehicle.body, motion))
    return actors


def _actor(ids: _Ids, row: int, body: Body, motion: SampledMotion) -> Actor:
    return Actor(
        actor_id=ids.actor[row],
        object_id=ids.camera[row],
        category=body.category,
        size=body.size,
        shape=body.shape,
        motion=motion,
        origin=body.origin,
    )


def _meta(
    plan: ScenarioPlan, stage: Stage, recorded: Recorded, ids: _Ids, decimals: int | None
) -> Meta:
    spec, collision, planned = (
        stage.spec,
        _collision(stage, recorded, ids, decimals),
        _pair_agents(stage),
    )
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
        planned_agents=None
        if collision or planned == (None, None) or (stage.kind and ego % 2)
        else planned,
    )


def _collision(
    stage: Stage, recorded: Recorded, ids: _Ids, decimals: int | None
) -> Collision | None:
    impact, pair = recorded.impact, stage.cast.pair
    if impact is None or pair is None:
        return None
    first, second = (stage.users[row] for row in pair)
    return Collision(
        ids=(ids.actor[pair[0]], 0 if pair[1] == stage.unlabelled else ids.actor[pair[1]]),
        classes=(first.body.category, second.body.category),
        impact=impact.strength if decimals is None else round(impact.strength, decimals),
        spawn_relation=impact.relation,
        contact_side=impact.side,
        agents=_pair_agents(stage),
    )


def _pair_agents(stage: Stage) -> tuple[AgentName | None, AgentName | None]:
    """The agents of the two who are timed to meet; None for a road user that is no agent, or if nobody is timed."""
    first, second = (
        (AGENT_OF_ROLE.get(stage.users[row].role) for row in stage.cast.pair)
        if stage.cast.pair
        else (None, None)
    )
    return first, second


@dataclass(frozen=True, slots=True)
class RecordingJob:
    """A scenario to make, or a part of one.

    Attributes:
        root: the release to write it into.
        config: the settings of the release.
        plan: which scenario it is.
        first: the first frame, counted from 1.
        step: from each frame to the next one.
    """

    root: Path
    config: SynthConfig
    plan: ScenarioPlan
    first: int = 1
    step: int = 1

    @property
    def folder(self) -> ScenarioFolder:
        """Where the scenario's files lie."""
        folder = self.plan.split if self.config.layout == "B" else ""
        return ScenarioFolder(self.root, folder, self.plan.scenario_type, self.plan.name, AGENTS)


def part_count(config: SynthConfig) -> int:
    """The number of parts in which each scenario is recorded."""
    return 1 if config.sensors == "none" else min(_PARTS, config.frames or _PARTS)


def record_scenario(job: RecordingJob) -> None:
    """Make a scenario and write all its files, or those of a part of it."""
    _share_cores()
    scenario, rig = _KEPT.made_ready(_Task(job.config, job.plan))
    labelled = job.plan.split != "test" or not job.config.unlabelled_test
    step = job.config.sensor_step
    recorder = _Recorder(
        folder=job.folder, scenario=scenario, rig=rig, labelled=labelled, sensor_step=step
    )
    if labelled and job.first == 1:
        write_meta(real_path(job.folder.meta_path), scenario.meta)
    for frame in range(job.first, scenario.frames + 1, job.step):
        recorder.record(frame)


def forget_scenario() -> None:
    """Free the memory of the scenario that this thread keeps for its next part."""
    _KEPT.made_ready.cache_clear()


def _share_cores() -> None:
    """Give OpenCV one thread in a worker process: each worker has one core, and OpenCV would start threads for all."""
    import cv2

    if multiprocessing.parent_process() is not None:
        cv2.setNumThreads(1)


@dataclass(frozen=True, slots=True)
class _Task:
    """Which scenario to make."""

    config: SynthConfig
    plan: ScenarioPlan = field(hash=False)


def _made_ready(task: _Task) -> tuple[Scenario, Rig]:
    """A scenario and its sensors."""
    config, plan = task.config, task.plan
    scenario = build_scenario(config, plan)
    rig = make_rig(
        scenario.world,
        scenario.actors,
        scenario.agents,
        sky=(scenario.spec.weather, scenario.spec.time_of_day),
        image_size=config.pixels,
        seed=(config.seed, plan.pair, int(plan.accident)),
        sensors=cast(Sensors, config.sensors),  # never True or False once the configuration is made
        exact=config.exact,
        decimals=config.decimals,
        name=config.rig,
    )
    return scenario, rig


class _Kept(threading.local):
    """Keeps a thread's last scenario for the next part of it. Threads share none: a rig remembers what it casts."""

    def __init__(self) -> None:
        self.made_ready = lru_cache(maxsize=1)(_made_ready)


_KEPT = _Kept()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Recorder:
    """Writes the files of one scenario: those that need no sensor, and what the rig makes of the others."""

    folder: ScenarioFolder
    scenario: Scenario
    rig: Rig
    labelled: bool
    sensor_step: int

    def record(self, frame: int) -> None:
        """Write the files of all agents at one frame, counted from 1."""
        time, rig = frame_timestamp(frame), self.rig
        if (self.scenario.frames - frame) % self.sensor_step:
            rig = replace(rig, clouds=False, studio=None)
        scene = rig.scene(time)
        around = rig.surroundings(scene, self._signals(time))
        for agent in rig.agents:
            sighting = rig.sighting(scene, agent, frame)
            write_calib(real_path(self.folder.calib_path(agent.name, frame)), sighting.calib)
            if self.labelled:
                write_label(real_path(self.folder.label_path(agent.name, frame)), sighting.labels)
            if rig.clouds:
                self._record_arrays(scene, sighting.points, agent, frame)
            if around:
                for channel, image in rig.images(scene, around, agent, frame):
                    write_image(
                        real_path(self.folder.channel_path(agent.name, channel, frame)), image
                    )

    def _record_arrays(self, scene: Scene, points: Scan, agent: Agent, frame: int) -> None:
        """Write the point cloud, and if all is recorded and labelled also the BEV array, whose instances are labels."""
        place = real_path(self.folder.channel_path(agent.name, LIDAR, frame))
        write_lidar(place, points.xyz, intensity(points, self.rig.air))
        if self.labelled and self.rig.studio:
            bev = self.rig.bev(scene, agent)
            write_bev(
                real_path(self.folder.channel_path(agent.name, BEV_CAMERA, frame)),
                bev.semantic,
                bev.instance,
            )

    def _signals(self, time: float) -> Mapping[Arm, int]:
        """Arm → the state of its traffic light."""
        signals = self.scenario.signals
        if signals is None:
            return {}
        return {
            head.arm: int(signals.state(head.arm, time)) for head in self.scenario.world.signals
        }
