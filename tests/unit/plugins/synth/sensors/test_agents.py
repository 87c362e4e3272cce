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
    return rig_of(
        world,
        sensors="none",
        image_size=(96, 54),
    )


def test_all_agents_have_six_cameras(rig):
    cameras = {
        agent.name: tuple(camera.channel for camera in agent.cameras) for agent in rig.agents
    }
    assert cameras == dict.fromkeys(AGENTS, tuple(CAMERAS))


@pytest.mark.parametrize("view", ["open", "hidden"])
@pytest.mark.parametrize("kind", ["four-way", "three-way"])
@pytest.mark.parametrize("seed", range(8))
def test_the_pole_s_cameras_are_in_no_house_and_above_all_trucks(rig, kind, view, seed):
    junction = Junction(RoadSpec(kind=kind, lanes=1 + seed % 2))
    town = random_world(np.random.default_rng(seed), junction, view, between=("west", "south"))
    in_lidar = [camera.lidar_from_camera.translation for camera in rig.agents[4].cameras]
    cameras = town.lidar_pole.apply(np.array(in_lidar))
    assert cameras[:, 2].min() > 1.04 * MEDIAN_SIZES["truck"][2]

    normals, offsets = face_planes(face_corners(town.props.corners))
    distances = (cameras @ normals.T - offsets).reshape(len(cameras), -1, 6)
    assert distances.max(axis=2).min() > 0


def cast_pixels(scene, agent, camera):
    """Return the faces that the pixels of a camera of 96 x 54 pixels show."""
    pose = agent.ground_from_lidar(scene) @ camera.camera_from_lidar.inverse()
    right, down = slopes(camera, np.arange(96), np.arange(54))
    rays = ray_directions(pose, right[None], down[:, None])
    _, faces = scene.cast(pose.translation, rays.reshape(-1, 3))

    return faces


def test_no_camera_sees_its_own_vehicle(rig):
    scene = rig.scene(0.0)

    for agent in rig.agents[:4]:
        for camera in agent.cameras:
            owners = scene.face_owner[cast_pixels(scene, agent, camera)]
            assert not (owners == agent.row).any()
