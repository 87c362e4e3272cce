"""Rays that need no casting, against all cast."""

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.sensors.lidar import AZIMUTHS, LIDAR_CHANNELS, turned_rays
from deepaccident_devkit.plugins.synth.sensors.render import ray_directions as camera_rays
from deepaccident_devkit.plugins.synth.sensors.render import slopes

KINDS = ("lidar", "camera")


def rays_of(scene, agent, kind):
    """Origin and rays (R, C, 3) of one turn, or of a picture."""
    pose = agent.ground_from_lidar(scene)
    if kind == "lidar":
        return pose.translation, turned_rays(pose.rotation).reshape(LIDAR_CHANNELS, AZIMUTHS, 3)
    camera = agent.cameras[0]
    pose = pose @ camera.lidar_from_camera
    right, down = slopes(camera, np.arange(camera.optics.width), np.arange(camera.optics.height))
    return pose.translation, camera_rays(pose, right[None, :], down[:, None])


@pytest.fixture
def parked(actor):
    return [actor(10 + k, "car", -60.0 + 12 * k, -4.8, parked=True) for k in range(9)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("place", ["world", "hilly_world"])
def test_rays_that_are_not_cast_would_have_met_the_same(request, rig_of, parked, place, kind):
    rig = rig_of(request.getfixturevalue(place), parked, sensors="none")
    scene = rig.scene(0.0)
    for agent in rig.agents:
        origin, rays = rays_of(scene, agent, kind)
        found, slow = (
            scene.setting.cast_columns(origin, rays),
            scene.setting.caster.cast(origin, rays.reshape(-1, 3)),
        )
        np.testing.assert_array_equal(found, slow)
        assert 0.2 < (found[1] >= 0).mean() < 0.9
