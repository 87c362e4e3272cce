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
    cameras = {
        agent.name: tuple(camera.channel for camera in agent.cameras) for agent in rig.agents
    }
    assert cameras == dict.fromkeys(AGENTS, tuple(CAMERAS))


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


def test_no_camera_sees_its_own_vehicle(rig):
    scene = rig.scene(0.0)
    for agent in rig.agents[:4]:
        for camera in agent.cameras:
            pose, rays = rays_of(scene, agent, camera)
            _, face = scene.cast(pose.translation, rays.reshape(-1, 3))
            assert not (scene.face_owner[face] == agent.row).any()
