"""Where the sensors are."""

import numpy as np
import pytest

from deepaccident_devkit.synth.sensors.images.buffers import ray_directions, slopes
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS


@pytest.fixture(scope="module")
def rig(world, rig_of):
    return rig_of(world, images=False, image_size=(96, 54))


def test_all_agents_have_six_cameras(rig):
    assert [agent.name for agent in rig.agents] == list(AGENTS)
    for agent in rig.agents:
        assert [camera.channel for camera in agent.cameras] == list(CAMERAS)


def test_lidar_is_1_94_m_above_the_road_and_on_a_pole_3_to_5(rig):
    scene = rig.scene(0.0)
    heights = [agent.ground_from_lidar(scene).translation[2] for agent in rig.agents]
    np.testing.assert_allclose(heights[:4], 1.94)
    assert 3 <= heights[4] <= 5


def test_a_tall_vehicle_has_its_lidar_above_the_roof(world, actor):
    from deepaccident_devkit.synth.actors import Actors
    from deepaccident_devkit.synth.sensors.rig import make_rig
    from deepaccident_devkit.taxonomy import VEHICLE_AGENTS

    trucks = [actor(k, "truck", -20.0 - 12 * k, -1.75) for k in range(4)]
    ids = {name: truck.actor_id for name, truck in zip(VEHICLE_AGENTS, trucks, strict=True)}
    rig = make_rig(world, Actors.of(trucks), ids, sky=("Clear", "Noon"), image_size=(96, 54), seed=(0,), images=False)
    scene = rig.scene(0.0)
    assert rig.agents[0].ground_from_lidar(scene).translation[2] > trucks[0].size[2] + 0.4
    labels = rig.sighting(scene, rig.agents[0], 1).labels
    assert (labels.num_lidar_pts > 50).sum() >= 2


def test_rays_go_through_the_middles_of_the_pixels(rig):
    scene, agent = rig.scene(0.0), rig.agents[0]
    camera = agent.cameras[1]
    pose = agent.ground_from_lidar(scene) @ camera.camera_from_lidar.inverse()
    right, down = slopes(camera, np.arange(96), np.arange(54))
    rays = ray_directions(pose, right[None], down[:, None])
    pixels, depth = camera.optics.project(pose.inverse().rotate(rays.reshape(-1, 3)))
    row, column = (grid.ravel() for grid in np.mgrid[:54, :96])
    np.testing.assert_allclose(pixels, np.stack([column, row], axis=1) + 0.5, atol=1e-3)
    np.testing.assert_allclose(depth, 1, atol=1e-6)


def test_no_camera_sees_its_own_vehicle(world, rig_of):
    rig = rig_of(world, images=False, image_size=(96, 54))
    scene = rig.scene(0.0)
    for agent in rig.agents[:4]:
        for camera in agent.cameras:
            pose = agent.ground_from_lidar(scene) @ camera.camera_from_lidar.inverse()
            right, down = slopes(camera, np.arange(96), np.arange(54))
            rays = ray_directions(pose, right[None], down[:, None]).reshape(-1, 3)
            _, face = scene.cast(pose.translation, rays)
            assert not (scene.face_owner[face] == agent.row).any()
