"""Where the sensors are."""

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.actors import MEDIAN_SIZES
from deepaccident_devkit.plugins.synth.roads import Junction, RoadSpec
from deepaccident_devkit.plugins.synth.sensors.render import ray_directions, slopes
from deepaccident_devkit.plugins.synth.solids import face_corners, face_planes
from deepaccident_devkit.plugins.synth.world import random_world
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS


@pytest.fixture(scope="module")
def rig(world, rig_of):
    return rig_of(world, sensors="none", image_size=(96, 54))


def test_all_agents_have_six_cameras(rig):
    cameras = {agent.name: tuple(camera.channel for camera in agent.cameras) for agent in rig.agents}
    assert cameras == dict.fromkeys(AGENTS, tuple(CAMERAS))


def test_lidar_is_half_a_metre_above_its_vehicle_and_on_a_pole_3_to_5_above_the_road(rig):
    scene = rig.scene(0.0)
    heights = [agent.ground_from_lidar(scene).translation[2] for agent in rig.agents]
    np.testing.assert_allclose(heights[:4], 1.52 + 0.5)
    assert 3 <= heights[4] <= 5


def test_a_vehicle_s_cameras_are_at_the_faces_of_its_box(rig):
    """As measured in a real scenario: front and back in the middle, the others at the corners, below the LiDAR."""
    x, y = 4.60 / 2, 1.93 / 2
    expected = {
        "Camera_Front": (x, 0, -0.3),
        "Camera_FrontLeft": (x, y, -0.3),
        "Camera_FrontRight": (x, -y, -0.3),
        "Camera_Back": (-x, 0, -0.3),
        "Camera_BackLeft": (-x, y, -0.3),
        "Camera_BackRight": (-x, -y, -0.3),
    }
    for agent in rig.agents[:4]:
        places = {camera.channel: camera.lidar_from_camera.translation for camera in agent.cameras}
        np.testing.assert_allclose([places[name] for name in expected], [*expected.values()], atol=0.002)


@pytest.mark.parametrize("view", ["open", "hidden"])
@pytest.mark.parametrize("kind", ["four-way", "three-way"])
@pytest.mark.parametrize("seed", range(8))
def test_the_pole_s_cameras_are_in_no_house_and_above_all_trucks(rig, kind, view, seed):
    places = np.array([camera.lidar_from_camera.translation for camera in rig.agents[4].cameras])
    junction = Junction(RoadSpec(kind=kind, lanes=1 + seed % 2))
    town = random_world(np.random.default_rng(seed), junction, view, between=("west", "south"))
    cameras = town.lidar_pole.apply(places)
    assert cameras[:, 2].min() > 1.04 * MEDIAN_SIZES["truck"][2]
    normals, offsets = face_planes(face_corners(town.props.corners))
    assert (cameras @ normals.T - offsets).reshape(len(cameras), -1, 6).max(axis=2).min() > 0


def rays_of(scene, agent, camera):
    """The pose of a camera of 96 x 54 pixels, and its rays (54, 96, 3)."""
    pose = agent.ground_from_lidar(scene) @ camera.camera_from_lidar.inverse()
    right, down = slopes(camera, np.arange(96), np.arange(54))
    return pose, ray_directions(pose, right[None], down[:, None])


def test_rays_go_through_the_middles_of_the_pixels(rig):
    camera = rig.agents[0].cameras[1]
    pose, rays = rays_of(rig.scene(0.0), rig.agents[0], camera)
    pixels, depth = camera.optics.project(pose.inverse().rotate(rays.reshape(-1, 3)))
    row, column = (grid.ravel() for grid in np.mgrid[:54, :96])
    np.testing.assert_allclose(pixels, np.stack([column, row], axis=1) + 0.5, atol=1e-3)
    np.testing.assert_allclose(depth, 1, atol=1e-6)


def test_no_camera_sees_its_own_vehicle(rig):
    scene = rig.scene(0.0)
    for agent in rig.agents[:4]:
        for camera in agent.cameras:
            pose, rays = rays_of(scene, agent, camera)
            _, face = scene.cast(pose.translation, rays.reshape(-1, 3))
            assert not (scene.face_owner[face] == agent.row).any()
