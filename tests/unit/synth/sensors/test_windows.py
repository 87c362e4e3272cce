"""Rectangles around boxes, against many points of them."""

import itertools

import numpy as np
import pytest

from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.synth.sensors.images.buffers import ray_directions, slopes
from deepaccident_devkit.synth.sensors.windows import CLOSE, nearest_movers, rectangles

SIZE, SLOPE = (400, 200), np.array([0.004, 0.004])
SHARES = np.array(list(itertools.product(np.linspace(-0.5, 0.5, 41), repeat=3)))


def rectangle_of(box):
    return (each[0] for each in rectangles(box.corners(), SLOPE, SIZE))


@pytest.mark.parametrize("place", [(0.3, -0.2, 12.0), (1.2, 0.4, 0.8), (-1.4, 0.0, 0.2), (0.4, 0.2, -0.5)])
def test_a_rectangle_is_as_large_as_what_is_ahead_of_the_camera(place):
    """Of a box ahead of it, and of boxes that are partly behind it."""
    box = Boxes.from_arrays([place], [[1.5, 1.5, 3.0]], [0.3])
    axis = np.array([np.cos(0.3), np.sin(0.3), 0])
    side = np.array([-axis[1], axis[0], 0])
    points = np.array(place) + SHARES @ (np.array([axis, side, [0, 0, 1.0]]) * np.array([[1.5], [1.5], [3.0]]))
    ahead = points[points[:, 2] >= CLOSE]
    pixels = ahead[:, :2] / ahead[:, 2:] / SLOPE + np.array(SIZE) / 2
    low, high = rectangle_of(box)
    assert (low <= pixels.min(axis=0) + 1e-6).all()
    assert (high >= pixels.max(axis=0) - 1e-6).all()
    for edge, farthest in ((low, pixels.min(axis=0)), (high, pixels.max(axis=0))):
        np.testing.assert_allclose(edge.clip(0, SIZE), farthest.clip(0, SIZE), atol=4)


def test_who_is_behind_the_camera_has_no_rectangle():
    low, high = rectangle_of(Boxes.from_arrays([[0.0, 0.0, -3.0]], [[1.0, 1.0, 1.0]], [0.0]))
    np.testing.assert_array_equal(low, high)


@pytest.mark.parametrize("place", ["world", "hilly_world"])
def test_movers_are_no_nearer_than_their_windows_say(request, actor, rig_of, place):
    others = [actor(10 + k, "truck", -60.0 + 17 * k, 1.75, np.pi) for k in range(8)]
    rig = rig_of(request.getfixturevalue(place), [*others, actor(30, "pedestrian", -26.0, -2.9)])
    scene = rig.scene(0.0)
    near = []
    for agent, number in itertools.product(rig.agents, range(6)):
        camera = agent.cameras[number]
        pose = agent.ground_from_lidar(scene) @ camera.lidar_from_camera
        right, down = slopes(camera, np.arange(camera.optics.width), np.arange(camera.optics.height))
        rays = ray_directions(pose, right[None, :], down[:, None])
        depth, _ = scene.caster.cast(pose.translation, rays.reshape(-1, 3))
        nearest = nearest_movers(scene, camera, pose)[:-2, :-2]
        assert (nearest.ravel() <= depth).all()
        near.append(np.isfinite(nearest).mean())
    assert 0.05 < np.mean(near) < 0.5
