"""A scenario that is drawn until it goes as planned, then recorded frame by frame as files.

It is recorded in parts; each part takes every nth frame, so that several processes can share a
scenario.
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
    Recording,
    Stage,
    add_graze,
    draw_duration,
    is_long_enough,
    latest_end,
    perform_twin,
    record_accident,
    record_normal,
    set_stage,
    try_accident,
)
from deepaccident_devkit.plugins.synth.traffic.driving import PERIOD
from deepaccident_devkit.plugins.synth.traffic.lifelike import ON_FOOT
from deepaccident_devkit.plugins.synth.traffic.placement import replan_accident
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
MAX_DRAWS = 40
"""Number of draws without a collision after which a scenario is given up."""
# Number of parts of a scenario with sensors. Without sensors it has one part, because simulating it
# takes longer than writing a frame.
_NUM_PARTS = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scenario:
    """Everything in a scenario that can be recorded; time 0 is the first recorded frame's time.

    Attributes:
        plan: Plan of the scenario.
        spec: Draw that was simulated.
        world: Static world.
        actors: Moving road users, and parked vehicles.
        agents: Actor ids of the four vehicle agents.
        meta: Contents of its meta file.
        frames: Number of recorded frames.
        signals: Phases of the traffic lights; None if there are no lights.
        draws: Number of draws that were needed.
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
    """Make a scenario; the same seed and pair give the same scene, for the accident and its twin.

    If two actors are timed to meet, the scene is drawn again until they touch.

    Raises:
        ConfigError: They do not touch in `MAX_DRAWS` draws; the message tells how close they came
            and which fields to change.
    """
    seeds = [config.seed, plan.pair]
    if plan.misfiled:
        seeds.append(1)  # its scenes differ from its twin's
    # One stream for each part of the scene, so that a change to one part leaves the others.
    streams = [np.random.default_rng(seed) for seed in np.random.SeedSequence(seeds).spawn(4)]
    world_rng, traffic_rng, id_rng, end_rng = streams
    recording: Recording | None
    while True:
        stage, accident, draws = _draw_stage(traffic_rng, config, plan)
        if accident and plan.collides:
            recording = record_accident(end_rng, stage, accident, config.frames)
        else:
            recording = _record_twin(end_rng, stage, config, plan)
        if recording is not None:
            break
    if plan.grazes:
        recording = add_graze(stage, recording)
    spec = stage.spec
    ego_arm = spec.actor("ego").from_arm or "west"
    other_arm = spec.actor("other").from_arm or "west"
    ids = _ActorIds.draw(id_rng, stage)
    world = random_world(
        world_rng,
        stage.junction,
        spec.view,
        between=(ego_arm, other_arm),
        low_pole=plan.kind is not None,
    )
    signals = None
    if stage.signals is not None:
        signals = stage.signals.shifted(-recording.start)
    return Scenario(
        plan=plan,
        spec=spec,
        world=world,
        actors=Actors.of(_make_actors(stage, recording, ids)),
        agents=ids.agents,
        meta=_make_meta(plan, stage, recording, ids, config.decimals),
        frames=recording.frames,
        signals=signals,
        draws=draws,
    )


def _draw_stage(
    rng: np.random.Generator, config: SynthConfig, plan: ScenarioPlan
) -> tuple[Stage, Performance | None, int]:
    """Draw stages until the pair touches.

    Returns:
        The stage, its simulation (None if no pair is timed to meet), and the number of draws.

    Raises:
        ConfigError: The pair does not touch in the largest number of draws.
    """
    kind = plan.kind
    min_distance = np.inf
    max_draws = MAX_DRAWS if kind is None else 10 * MAX_DRAWS
    for draws in range(1, max_draws + 1):
        spec = plan.draw(rng)
        junction = Junction(spec.road)
        if plan.unplanned:
            on_foot = None
            if kind is not None:
                on_foot = kind.labelled and rng.random() < ON_FOOT
            spec = replan_accident(rng, spec, junction, on_foot=on_foot)
        duration = draw_duration(rng, config.frames, kind)
        stage = set_stage(rng, spec, junction, duration, kind)
        if spec.meet is None:
            return stage, None, draws
        attempt = try_accident(stage)
        if not isinstance(attempt, Performance):
            min_distance = min(min_distance, attempt)
        elif is_long_enough(stage, attempt, config.frames):
            return stage, attempt, draws
    if min_distance == np.inf:
        reason = (
            "their paths do not cross, or other road users collide first; change from or turn, "
            "or gap or lane of the others"
        )
    else:
        reason = (
            f"the least distance was {min_distance:.1f} m; choose a meet.offset nearer to 0, "
            "or another max_speed"
        )
    raise ConfigError(
        f"{plan.template.place('meet')}: the two did not collide in {max_draws} draws; {reason}, "
        "or choose fewer background.vehicles"
    )


def _record_twin(
    rng: np.random.Generator, stage: Stage, config: SynthConfig, plan: ScenarioPlan
) -> Recording | None:
    """Record a normal scenario.

    Returns:
        None in a lifelike release if another draw is needed.

    Raises:
        ConfigError: In a designed release, the road users collide whatever they do.
    """
    normal = perform_twin(stage, latest_end(stage, config.frames))
    if normal is not None:
        return record_normal(rng, stage, normal, config.frames)
    if plan.kind is not None:
        return None
    condition = "in the normal twin too" if stage.spec.meet else "although all obey the rules"
    raise ConfigError(
        f"{plan.template.place('actors')}: the road users collide {condition}, even if one of them "
        "comes later; let them start farther from each other"
    )


class _ActorIds(NamedTuple):
    """The ids of all actors of a stage.

    Attributes:
        actor: Ids in labels, of the moving actors and then of the parked ones.
        camera: Ids of the BEV camera, in the same order.
        agents: Actor ids of the four vehicle agents.
    """

    actor: tuple[int, ...]
    camera: tuple[int, ...]
    agents: dict[AgentName, int]

    @classmethod
    def draw(cls, rng: np.random.Generator, stage: Stage) -> "_ActorIds":
        """Draw the ids of a stage's actors.

        Moving actors get ids from 1000 on, parked ones from 20000 on, in the order in which they
        were made.
        """
        num_moving = len(stage.users)
        count = num_moving + len(stage.parked)
        moving_ids = rng.integers(1000, 2000) + rng.integers(1, 4, num_moving).cumsum()
        actor_ids = moving_ids.tolist()
        actor_ids += [STATIC_ACTOR_ID + row for row in range(num_moving, count)]
        camera_ids = rng.choice(np.arange(1, 2**16), count, replace=False).tolist()
        id_by_role = {}
        for user, actor_id in zip(stage.users, actor_ids, strict=False):
            id_by_role[user.role] = actor_id
        role_by_agent = {agent: role for role, agent in AGENT_OF_ROLE.items()}
        agents = {agent: id_by_role[role_by_agent[agent]] for agent in VEHICLE_AGENTS}
        return cls(tuple(actor_ids), tuple(camera_ids), agents)


def _make_actors(stage: Stage, recording: Recording, ids: _ActorIds) -> list[Actor]:
    """Make the actors of a recording: road users that labels name, then parked vehicles."""
    simulation = recording.performance.simulation
    start = float(simulation.time[0]) - recording.start
    actors = []
    for column, row in enumerate(recording.performance.present):
        if row == stage.unlabelled:
            continue
        motion = SampledMotion(
            start=start,
            period=PERIOD,
            samples=simulation.poses[:, column],
            sample_velocities=simulation.velocities[:, column],
        )
        actors.append(_make_actor(ids, row, stage.users[row].body, motion))
    for row, vehicle in enumerate(stage.parked, start=len(stage.users)):
        motion = SampledMotion(
            start=0.0,
            period=PERIOD,
            samples=np.array([vehicle.pose]),
            sample_velocities=np.zeros((1, 2)),
        )
        actors.append(_make_actor(ids, row, vehicle.body, motion))
    return actors


def _make_actor(ids: _ActorIds, row: int, body: Body, motion: SampledMotion) -> Actor:
    """Make the actor of a row of the stage."""
    return Actor(
        actor_id=ids.actor[row],
        object_id=ids.camera[row],
        category=body.category,
        size=body.size,
        shape=body.shape,
        motion=motion,
        origin=body.origin,
    )


def _make_meta(
    plan: ScenarioPlan, stage: Stage, recording: Recording, ids: _ActorIds, decimals: int | None
) -> Meta:
    """Return the contents of a scenario's meta file."""
    spec = stage.spec
    collision = _make_collision(stage, recording, ids, decimals)
    pair_agents = _find_pair_agents(stage)
    ego, ego_behind, other, other_behind = (ids.agents[agent] for agent in VEHICLE_AGENTS)
    planned_agents: tuple[AgentName | None, AgentName | None] | None = pair_agents
    # In lifelike releases, half of the normal scenarios do not name the planned agents.
    if collision or pair_agents == (None, None) or (stage.kind and ego % 2):
        planned_agents = None
    return Meta(
        weather=spec.weather,
        time_of_day=spec.time_of_day,
        collision=collision,
        simulated_frames=recording.frames + WARM_UP_FRAMES,
        agent_ids=(ego, ego_behind, other, other_behind),
        road_type=plan.traits.road_type,
        spawn_side=plan.traits.spawn_side,
        ego_direction=spec.actor("ego").turn,
        other_direction=spec.actor("other").turn,
        planned_agents=planned_agents,
    )


def _make_collision(
    stage: Stage, recording: Recording, ids: _ActorIds, decimals: int | None
) -> Collision | None:
    """Return the collision in the meta file; None if there is none."""
    impact = recording.impact
    pair = stage.cast.pair
    if impact is None or pair is None:
        return None
    row, other_row = pair
    strength = impact.strength
    if decimals is not None:
        strength = round(strength, decimals)
    other_id = 0
    if other_row != stage.unlabelled:
        other_id = ids.actor[other_row]
    return Collision(
        ids=(ids.actor[row], other_id),
        classes=(stage.users[row].body.category, stage.users[other_row].body.category),
        impact=strength,
        spawn_relation=impact.relation,
        contact_side=impact.side,
        agents=_find_pair_agents(stage),
    )


def _find_pair_agents(stage: Stage) -> tuple[AgentName | None, AgentName | None]:
    """Return the agents of the two road users that are timed to meet.

    The entry is None for a road user that is not an agent; both are None if no pair is timed.
    """
    if not stage.cast.pair:
        return None, None
    roles = [stage.users[row].role for row in stage.cast.pair]
    agent, other_agent = (AGENT_OF_ROLE.get(role) for role in roles)
    return agent, other_agent


@dataclass(frozen=True, slots=True)
class RecordingJob:
    """A scenario to make, or a part of one.

    Attributes:
        root: Folder of the release to write it into.
        config: Settings of the release.
        plan: Plan of the scenario.
        first: Number of the first frame, counted from 1.
        step: Step from each frame to the next one.
    """

    root: Path
    config: SynthConfig
    plan: ScenarioPlan
    first: int = 1
    step: int = 1

    @property
    def folder(self) -> ScenarioFolder:
        """The folder of the scenario's files."""
        split_folder = self.plan.split if self.config.layout == "B" else ""
        return ScenarioFolder(
            self.root, split_folder, self.plan.scenario_type, self.plan.name, AGENTS
        )


def part_count(config: SynthConfig) -> int:
    """Return the number of parts in which each scenario is recorded."""
    if config.sensors == "none":
        return 1
    return min(_NUM_PARTS, config.frames or _NUM_PARTS)


def record_scenario(job: RecordingJob) -> None:
    """Make a scenario and write all its files, or the files of a part of it."""
    _limit_opencv_threads()
    scenario, rig = _CACHE.scenario_and_rig(_ScenarioTask(job.config, job.plan))
    labelled = job.plan.split != "test" or not job.config.unlabelled_test
    recorder = _Recorder(
        folder=job.folder,
        scenario=scenario,
        rig=rig,
        labelled=labelled,
        sensor_step=job.config.sensor_step,
    )
    if labelled and job.first == 1:
        write_meta(real_path(job.folder.meta_path), scenario.meta)
    for frame in range(job.first, scenario.frames + 1, job.step):
        recorder.record(frame)


def forget_scenario() -> None:
    """Free the memory of the scenario that this thread holds for its next part."""
    _CACHE.scenario_and_rig.cache_clear()


def _limit_opencv_threads() -> None:
    """Give OpenCV one thread in a worker process.

    Each worker has one core, and OpenCV would start threads for all cores.
    """
    import cv2

    if multiprocessing.parent_process() is not None:
        cv2.setNumThreads(1)


@dataclass(frozen=True, slots=True)
class _ScenarioTask:
    """A scenario to make."""

    config: SynthConfig
    plan: ScenarioPlan = field(hash=False)


def _make_scenario_and_rig(task: _ScenarioTask) -> tuple[Scenario, Rig]:
    """Make a scenario and its sensors."""
    config = task.config
    plan = task.plan
    scenario = build_scenario(config, plan)
    # `sensors` is never True or False once the configuration is made.
    sensors = cast(Sensors, config.sensors)
    rig = make_rig(
        scenario.world,
        scenario.actors,
        scenario.agents,
        sky=(scenario.spec.weather, scenario.spec.time_of_day),
        image_size=config.pixels,
        seed=(config.seed, plan.pair, int(plan.accident)),
        sensors=sensors,
        exact=config.exact,
        decimals=config.decimals,
        name=config.rig,
    )
    return scenario, rig


class _ScenarioCache(threading.local):
    """The last scenario of a thread, for the next part of it.

    Threads share no scenario: a rig remembers the rays that it casts.
    """

    def __init__(self) -> None:
        self.scenario_and_rig = lru_cache(maxsize=1)(_make_scenario_and_rig)


_CACHE = _ScenarioCache()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Recorder:
    """A writer of the files of one scenario.

    Attributes:
        folder: Folder of the files.
        scenario: The scenario.
        rig: Sensors of the scenario.
        labelled: Whether labels are written.
        sensor_step: Step between frames with sensors' files, counted back from the last frame.
    """

    folder: ScenarioFolder
    scenario: Scenario
    rig: Rig
    labelled: bool
    sensor_step: int

    def record(self, frame: int) -> None:
        """Write the files of all agents at one frame, counted from 1."""
        time = frame_timestamp(frame)
        rig = self.rig
        if (self.scenario.frames - frame) % self.sensor_step:
            rig = replace(rig, clouds=False, studio=None)
        scene = rig.scene(time)
        surroundings = rig.surroundings(scene, self._find_signal_states(time))
        folder = self.folder
        for agent in rig.agents:
            sighting = rig.sighting(scene, agent, frame)
            calib_path = real_path(folder.calib_path(agent.name, frame))
            write_calib(calib_path, sighting.calib)
            if self.labelled:
                label_path = real_path(folder.label_path(agent.name, frame))
                write_label(label_path, sighting.labels)
            if rig.clouds:
                self._record_arrays(scene, sighting.points, agent, frame)
            if surroundings:
                for channel, image in rig.images(scene, surroundings, agent, frame):
                    image_path = real_path(folder.channel_path(agent.name, channel, frame))
                    write_image(image_path, image)

    def _record_arrays(self, scene: Scene, points: Scan, agent: Agent, frame: int) -> None:
        """Write the point cloud of an agent, and the BEV array where it is recorded.

        The BEV array is recorded with all sensors and labels, because its instances are labels.
        """
        cloud_path = real_path(self.folder.channel_path(agent.name, LIDAR, frame))
        write_lidar(cloud_path, points.xyz, intensity(points, self.rig.air))
        if self.labelled and self.rig.studio:
            bev = self.rig.bev(scene, agent)
            bev_path = real_path(self.folder.channel_path(agent.name, BEV_CAMERA, frame))
            write_bev(bev_path, bev.semantic, bev.instance)

    def _find_signal_states(self, time: float) -> Mapping[Arm, int]:
        """Return the states of the traffic lights at a time, by arm."""
        signals = self.scenario.signals
        if signals is None:
            return {}
        arms = [head.arm for head in self.scenario.world.signals]
        return {arm: int(signals.state(arm, time)) for arm in arms}
