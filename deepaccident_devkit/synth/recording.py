"""Recording a scenario: what all agents see, frame by frame, written as files of a release."""

from dataclasses import dataclass
from pathlib import Path

from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.release import (
    ScenarioFolder,
    write_bev,
    write_calib,
    write_image,
    write_label,
    write_lidar,
    write_meta,
)
from deepaccident_devkit.synth.agents import Agent, make_agents
from deepaccident_devkit.synth.annotate import annotate
from deepaccident_devkit.synth.bev import bev_picture
from deepaccident_devkit.synth.camera import Paint, paint, render
from deepaccident_devkit.synth.config import SynthConfig
from deepaccident_devkit.synth.lidar import Scan, scan
from deepaccident_devkit.synth.look import Look, make_look
from deepaccident_devkit.synth.scenario import RandomStreams, Scenario, ScenarioPlan, build_scenario
from deepaccident_devkit.synth.scene import Scene, make_scene
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA, LIDAR, frame_timestamp


@dataclass(frozen=True, slots=True)
class RecordingJob:
    """One scenario to make and write below `root`."""

    root: Path
    config: SynthConfig
    plan: ScenarioPlan


def record_scenario(job: RecordingJob) -> str:
    """Make one scenario and write all its files; returns its token."""
    config, plan = job.config, job.plan
    scenario = build_scenario(config, plan)
    folder = ScenarioFolder(job.root, plan.split if config.layout == "B" else "", plan.scenario_type, plan.name, AGENTS)
    recorder = _Recorder(
        folder=folder,
        scenario=scenario,
        agents=make_agents(scenario, config.image_size),
        look=_look(config, scenario) if config.sensors else None,
    )
    write_meta(folder.meta_path, scenario.meta)
    for frame in range(1, config.frames + 1):
        recorder.record(frame)
    return plan.token


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Recorder:
    """Writes the files of one scenario; without a `look`, only what needs no sensor."""

    folder: ScenarioFolder
    scenario: Scenario
    agents: tuple[Agent, ...]
    look: Look | None

    def record(self, frame: int) -> None:
        """Write the files of all agents at one frame, counted from 1."""
        scene = make_scene(self.scenario.world, self.scenario.actors, frame_timestamp(frame))
        colors = paint(scene, self.scenario.world, self.look) if self.look else None
        for agent in self.agents:
            ground_from_ego = agent.ground_from_ego(scene.snapshot)
            points = self._record_labels(frame, scene, agent, ground_from_ego)
            if self.look and colors:
                write_lidar(self.folder.channel_path(agent.name, LIDAR, frame), points.xyz, points.intensity)
                self._record_bev(frame, scene, agent, ground_from_ego)
                self._record_images(frame, scene, agent, ground_from_ego, self.look, colors)

    def _record_labels(self, frame: int, scene: Scene, agent: Agent, ground_from_ego: SE3) -> Scan:
        """Write label and calib; returns the point cloud that the labels counted."""
        world_from_ground = self.scenario.world.world_from_ground
        ground_from_lidar = ground_from_ego @ agent.ego_from_lidar
        points = scan(scene, ground_from_lidar)
        labels = annotate(scene, agent, world_from_ground, ground_from_lidar, points)
        write_label(self.folder.label_path(agent.name, frame), labels)
        write_calib(self.folder.calib_path(agent.name, frame), agent.calib(world_from_ground @ ground_from_ego))
        return points

    def _record_bev(self, frame: int, scene: Scene, agent: Agent, ground_from_ego: SE3) -> None:
        picture = bev_picture(scene, self.scenario.world.top, ground_from_ego)
        write_bev(self.folder.channel_path(agent.name, BEV_CAMERA, frame), picture.semantic, picture.instance)

    def _record_images(
        self, frame: int, scene: Scene, agent: Agent, ground_from_ego: SE3, look: Look, colors: Paint
    ) -> None:
        ground_from_lidar = ground_from_ego @ agent.ego_from_lidar
        for camera in agent.cameras:
            ground_from_camera = ground_from_lidar @ camera.camera_from_lidar.inverse()
            image = render(scene, colors, look, camera, ground_from_camera)
            write_image(self.folder.channel_path(agent.name, camera.channel, frame), image)


def _look(config: SynthConfig, scenario: Scenario) -> Look:
    rng = RandomStreams.of(config.seed, scenario.plan.pair).look
    return make_look(scenario.world, scenario.weather, scenario.time_of_day, rng)
