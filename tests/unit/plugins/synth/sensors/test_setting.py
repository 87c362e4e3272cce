"""Rays that are skipped, compared with casting all of them."""

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.sensors.lidar import AZIMUTHS, LIDAR_CHANNELS, rotate_rays
from deepaccident_devkit.plugins.synth.sensors.render import ray_directions as camera_rays
from deepaccident_devkit.plugins.synth.sensors.render import slopes

KINDS = ("lidar", "camera")


def make_rays(scene, agent, kind):
    """Return the origin and the rays, shape (R, C, 3), of one turn or of one picture."""
    pose = agent.ground_from_lidar(scene)
    if kind == "lidar":
        return pose.translation, rotate_rays(pose.rotation).reshape(LIDAR_CHANNELS, AZIMUTHS, 3)

    camera = agent.cameras[0]
    pose = pose @ camera.lidar_from_camera
    right, down = slopes(camera, np.arange(camera.optics.width), np.arange(camera.optics.height))
    return pose.translation, camera_rays(pose, right[None, :], down[:, None])


@pytest.fixture
def parked_cars(actor):
    # a row along the road from west to east
    return [actor(10 + k, "car", -60.0 + 12 * k, -4.8, parked=True) for k in range(9)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("world_name", ["world", "hilly_world"])
def test_rays_that_are_not_cast_would_have_met_the_same(
    request, rig_of, parked_cars, world_name, kind
):
    rig = rig_of(request.getfixturevalue(world_name), parked_cars, sensors="none")
    scene = rig.scene(0.0)
    for agent in rig.agents:
        origin, rays = make_rays(scene, agent, kind)
        fast = scene.setting.cast_columns(origin, rays)
        slow = scene.setting.caster.cast(origin, rays.reshape(-1, 3))
        np.testing.assert_array_equal(fast, slow)

        hits = fast[1] >= 0
        assert 0.2 < hits.mean() < 0.9
