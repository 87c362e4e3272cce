"""Recording a scenario: what all agents see, frame by frame, written as files of a release.

A scenario is recorded in parts; each part takes every nth frame, so that several processes can share a scenario.
"""

import multiprocessing
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import cast

from deepaccident_devkit.release import (
    ScenarioFolder,
    write_bev,
    write_calib,
    write_image,
    write_label,
    write_lidar,
    write_meta,
)
from deepaccident_devkit.release.store import real_path
from deepaccident_devkit.synth.config import Sensors, SynthConfig
from deepaccident_devkit.synth.plan import ScenarioPlan
from deepaccident_devkit.synth.roads import Arm
from deepaccident_devkit.synth.scenario import Scenario, build_scenario
from deepaccident_devkit.synth.sensors.agents import Agent
from deepaccident_devkit.synth.sensors.lidar import Scan, intensity
from deepaccident_devkit.synth.sensors.rig import Rig, make_rig
from deepaccident_devkit.synth.sensors.scene import Scene
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA, LIDAR, frame_timestamp

_PARTS = 8
"""Parts of a scenario with sensors. Without sensors it has one: simulating it takes longer than writing a frame."""


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


def parts_of(config: SynthConfig) -> int:
    """The number of parts in which each scenario is recorded."""
    return 1 if config.sensors == "none" else min(_PARTS, config.frames or _PARTS)


def record_scenario(job: RecordingJob) -> None:
    """Make a scenario and write all its files, or those of a part of it."""
    _share_cores()
    scenario, rig = _KEPT.made_ready(_Task(job.config, job.plan))
    labelled = job.plan.split != "test" or not job.config.unlabelled_test
    recorder = _Recorder(folder=job.folder, scenario=scenario, rig=rig, labelled=labelled)
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

    def record(self, frame: int) -> None:
        """Write the files of all agents at one frame, counted from 1."""
        time, rig = frame_timestamp(frame), self.rig
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
                    write_image(real_path(self.folder.channel_path(agent.name, channel, frame)), image)

    def _record_arrays(self, scene: Scene, points: Scan, agent: Agent, frame: int) -> None:
        """Write the point cloud, and if there are labels also the BEV array, whose instances are labels too."""
        place = real_path(self.folder.channel_path(agent.name, LIDAR, frame))
        write_lidar(place, points.xyz, intensity(points, self.rig.air))
        if self.labelled:
            bev = self.rig.bev(scene, agent)
            write_bev(real_path(self.folder.channel_path(agent.name, BEV_CAMERA, frame)), bev.semantic, bev.instance)

    def _signals(self, time: float) -> Mapping[Arm, int]:
        """Arm → the state of its traffic light."""
        signals = self.scenario.signals
        if signals is None:
            return {}
        return {head.arm: int(signals.state(head.arm, time)) for head in self.scenario.world.signals}
