"""Projected box centres fall on the pixels that the synthetic renderer painted for that actor.

What is painted where comes from the generator's own rays; where a box lands comes from the labels
of one agent, the calib files and the devkit's transforms into the cameras of another.
"""

from pathlib import Path

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.plugins.synth import SynthConfig
from deepaccident_devkit.plugins.synth.plan import plan_scenarios
from deepaccident_devkit.plugins.synth.scenario import (
    RecordingJob,
    Scenario,
    build_scenario,
    record_scenario,
)
from deepaccident_devkit.plugins.synth.sensors.agents import Agent, Camera, make_agents
from deepaccident_devkit.plugins.synth.sensors.render import ray_directions, slopes
from deepaccident_devkit.plugins.synth.sensors.scene import Scene, Setting, make_scene
from deepaccident_devkit.taxonomy import frame_timestamp

CONFIG = SynthConfig(scenarios=1, frames=2, image_size=(320, 180), seed=11, designed=True)
FRAME = 2
LARGE = 30
"""Pixels."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[DeepAccident, Scenario]:
    plan = plan_scenarios(CONFIG)[0]
    root: Path = tmp_path_factory.mktemp("pixels")
    record_scenario(RecordingJob(root, CONFIG, plan))
    return DeepAccident(dataroot=root, verbose=False), build_scenario(CONFIG, plan)


def painted(scene: Scene, camera: Camera, ground_from_camera: SE3) -> np.ndarray:
    """The actor id of each pixel (H, W), or −1."""
    right, down = slopes(camera, np.arange(camera.optics.width), np.arange(camera.optics.height))
    directions = ray_directions(ground_from_camera, right[None, :], down[:, None])
    _, face = scene.cast(ground_from_camera.translation, directions.reshape(-1, 3))
    owner = scene.face_owner[face]
    return np.where(owner >= 0, scene.actors.actor_id[np.maximum(owner, 0)], -1).reshape(
        directions.shape[:2]
    )


def unoccluded(scene: Scene, ground_from_camera: SE3) -> set[int]:
    """The actors (true poses) towards whose middle the first surface is their own."""
    middle = scene.frames[:, :3, 3] + scene.frames[:, :3, 2] * scene.actors.size[:, 2:] / 2
    _, face = scene.cast(
        ground_from_camera.translation, (middle - ground_from_camera.translation).astype(np.float32)
    )
    return set(
        scene.actors.actor_id[scene.face_owner[face] == np.arange(len(scene.actors))].tolist()
    )


def drawn_large(picture: np.ndarray) -> set[int]:
    """The actors of many pixels: the ray through a pixel of a small one may pass between a
    pedestrian's legs.
    """
    actors, counts = np.unique(picture, return_counts=True)
    return set(actors[counts >= LARGE].tolist())


def hits_and_tries(da: DeepAccident, scene: Scene, agent: Agent, labeller: str) -> tuple[int, int]:
    """How many of a labeller's boxes land on their own actor in the images of an agent, and how
    many should.
    """
    scenario, hits, tries = da.scenario[0]["token"], 0, 0
    source, sample = (f"{scenario}/{name}/{FRAME:03d}" for name in (labeller, agent.name))
    boxes, ids = da.boxes(source, "lidar"), da.actor_ids(source)
    for camera in agent.cameras:
        ground_from_camera = agent.ground_from_lidar(scene) @ camera.camera_from_lidar.inverse()
        picture, free = (
            painted(scene, camera, ground_from_camera),
            unoccluded(scene, ground_from_camera),
        )
        shown = da.project_to_image(
            boxes.center, source, f"{sample}/{camera.channel}", frame="lidar", colors=False
        )
        wanted = shown.mask & np.isin(ids, list(free & drawn_large(picture)))
        u, v = shown.pixels[wanted].astype(int).T
        hits += int((picture[v, u] == ids[wanted]).sum())
        tries += int(wanted.sum())
    return hits, tries


@pytest.mark.slow
@pytest.mark.parametrize("labeller", ["ego_vehicle", "other_vehicle_behind", "infrastructure"])
def test_box_centres_fall_on_their_actors_pixels(
    recorded: tuple[DeepAccident, Scenario], labeller: str
) -> None:
    da, scenario = recorded
    scene = make_scene(Setting(scenario.world, scenario.actors), frame_timestamp(FRAME))
    agents = make_agents(scenario.world, scenario.actors, scenario.agents, CONFIG.image_size)
    hits, tries = np.sum([hits_and_tries(da, scene, agent, labeller) for agent in agents], axis=0)
    assert tries > 50
    assert hits == tries
