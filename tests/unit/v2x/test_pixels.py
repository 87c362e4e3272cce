"""Projected box centres fall on the pixels that the synthetic renderer painted for that actor. The
painted pixels come from the generator's own rays; the projected centres come from the labels of
one agent, the calib files and the devkit's transforms into the cameras of another.
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
MIN_LARGE_PIXELS = 30


@pytest.fixture(scope="module")
def recorded_scenario(tmp_path_factory: pytest.TempPathFactory) -> tuple[DeepAccident, Scenario]:
    plan = plan_scenarios(CONFIG)[0]
    root: Path = tmp_path_factory.mktemp("pixels")
    record_scenario(RecordingJob(root, CONFIG, plan))
    return DeepAccident(dataroot=root, verbose=False), build_scenario(CONFIG, plan)


def paint_actor_ids(scene: Scene, camera: Camera, ground_from_camera: SE3) -> np.ndarray:
    """Return the actor id of each pixel, shape (H, W), or −1."""
    columns = np.arange(camera.optics.width)
    rows = np.arange(camera.optics.height)
    right, down = slopes(camera, columns, rows)
    directions = ray_directions(ground_from_camera, right[None, :], down[:, None])
    _, faces = scene.cast(ground_from_camera.translation, directions.reshape(-1, 3))
    owners = scene.face_owner[faces]
    actor_ids = np.where(owners >= 0, scene.actors.actor_id[np.maximum(owners, 0)], -1)
    return actor_ids.reshape(directions.shape[:2])


def find_unoccluded_ids(scene: Scene, ground_from_camera: SE3) -> set[int]:
    """Return the actors (in their true poses) with a middle that no other surface hides."""
    camera_center = ground_from_camera.translation
    middles = scene.frames[:, :3, 3] + scene.frames[:, :3, 2] * scene.actors.size[:, 2:] / 2
    _, faces = scene.cast(camera_center, (middles - camera_center).astype(np.float32))
    is_first = scene.face_owner[faces] == np.arange(len(scene.actors))
    return set(scene.actors.actor_id[is_first].tolist())


def find_large_ids(image_ids: np.ndarray) -> set[int]:
    """Return the actors of many pixels; the ray through a pixel of a small one may pass between a
    pedestrian's legs.
    """
    actor_ids, counts = np.unique(image_ids, return_counts=True)
    return set(actor_ids[counts >= MIN_LARGE_PIXELS].tolist())


def count_hits(da: DeepAccident, scene: Scene, agent: Agent, labeller: str) -> tuple[int, int]:
    """Count a labeller's boxes that land on their own actor in the images of an agent, and all
    that should.
    """
    scenario = da.scenario[0]["token"]
    source = f"{scenario}/{labeller}/{FRAME:03d}"
    sample = f"{scenario}/{agent.name}/{FRAME:03d}"
    centers = da.boxes(source, "lidar").center
    ids = da.actor_ids(source)
    hits = 0
    tries = 0
    for camera in agent.cameras:
        ground_from_camera = agent.ground_from_lidar(scene) @ camera.camera_from_lidar.inverse()
        image_ids = paint_actor_ids(scene, camera, ground_from_camera)
        visible = find_unoccluded_ids(scene, ground_from_camera) & find_large_ids(image_ids)
        projected = da.project_to_image(
            centers, source, f"{sample}/{camera.channel}", frame="lidar", colors=False
        )
        expected = projected.mask & np.isin(ids, list(visible))
        u, v = projected.pixels[expected].astype(int).T
        hits += int((image_ids[v, u] == ids[expected]).sum())
        tries += int(expected.sum())
    return hits, tries


@pytest.mark.slow
@pytest.mark.parametrize("labeller", ["ego_vehicle", "other_vehicle_behind", "infrastructure"])
def test_box_centres_fall_on_their_actors_pixels(
    recorded_scenario: tuple[DeepAccident, Scenario], labeller: str
) -> None:
    da, scenario = recorded_scenario
    scene = make_scene(Setting(scenario.world, scenario.actors), frame_timestamp(FRAME))
    agents = make_agents(scenario.world, scenario.actors, scenario.agents, CONFIG.image_size)
    counts = [count_hits(da, scene, agent, labeller) for agent in agents]
    hits, tries = np.sum(counts, axis=0)

    assert tries > 50
    assert hits == tries
