"""Labels, points and images of a moment agree, and do not depend on other outputs."""

import numpy as np
import pytest

from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.plugins.synth.sensors.annotate import offsets_at_count


@pytest.fixture(scope="module")
def traffic(actor):
    return [
        actor(10, "car", 5.0, 1.75, np.pi, 6.0),
        actor(11, "van", -5.0, 1.75, np.pi, 6.0),
        actor(12, "pedestrian", -12.0, 5.0, 0.0, 1.2),
        actor(20, "car", -18.0, -4.75, parked=True),
    ]


def make_sightings(rig, time=0.4, frame=5):
    scene = rig.scene(time)
    return [rig.sighting(scene, agent, frame) for agent in rig.agents]


def have_same_labels(first, second):
    return all(
        np.array_equal(getattr(one.labels, name), getattr(other.labels, name))
        for one, other in zip(first, second, strict=True)
        for name in ("center", "yaw", "velocity", "actor_id", "num_lidar_pts", "camera_visible")
    )


@pytest.mark.slow
@pytest.mark.parametrize("world_name", ["world", "hilly_world"])
def test_labels_do_not_depend_on_images(request, rig_of, traffic, world_name):
    town = request.getfixturevalue(world_name)
    usual = make_sightings(rig_of(town, traffic, sensors="none"))
    for options, expected in (
        ({"image_size": (800, 450), "sensors": "all"}, True),
        ({"sensors": "cameras"}, True),
        ({"sensors": "none", "seed": (1,)}, False),
    ):
        sightings = make_sightings(rig_of(town, traffic, **options))
        assert have_same_labels(usual, sightings) == expected


def test_a_moment_does_not_depend_on_what_was_recorded_before(world, rig_of, traffic):
    fresh = make_sightings(rig_of(world, traffic, sensors="none"), 0.9, 10)
    rig = rig_of(world, traffic, sensors="none")
    make_sightings(rig, 0.0, 1)
    assert have_same_labels(fresh, make_sightings(rig, 0.9, 10))


@pytest.mark.parametrize("world_name", ["world", "hilly_world"])
def test_exact_counts_are_the_points_in_the_boxes(request, rig_of, traffic, world_name):
    town = request.getfixturevalue(world_name)

    for sighting in make_sightings(rig_of(town, traffic, sensors="none", exact=True)):
        labels = sighting.labels
        boxes = Boxes.from_arrays(labels.center, labels.size, labels.yaw, frame="lidar")
        inside = boxes.contains(sighting.points.xyz).sum(axis=1)
        np.testing.assert_array_equal(labels.num_lidar_pts, inside)
        assert labels.num_lidar_pts.max() > 100


def test_actors_move_only_a_little_until_points_are_counted():
    """A slow actor moves as far as it gets in 3 ms, a fast one no farther than the noise of a point
    can hide.
    """
    velocities = np.array([[0.0, 0, 0], [2.0, 0, 0], [0, -30.0, 0]])
    np.testing.assert_allclose(
        offsets_at_count(velocities),
        [[0, 0, 0], [0.006, 0, 0], [0, -0.012, 0]],
        atol=1e-12,
    )


def test_exact_calib_is_ideal(hilly_world, rig_of, traffic):
    exact = make_sightings(rig_of(hilly_world, traffic, sensors="none", exact=True))
    usual = make_sightings(rig_of(hilly_world, traffic, sensors="none", exact=False))
    for exact_sighting, usual_sighting in zip(exact, usual, strict=True):
        ideal, calib = exact_sighting.calib, usual_sighting.calib
        np.testing.assert_array_equal(ideal.ego_from_lidar.matrix[:3, :3], np.eye(3))
        np.testing.assert_array_equal(ideal.ego_from_lidar.translation[:2], 0)

        pairs = [
            (ideal.ego_from_lidar, calib.ego_from_lidar),
            (ideal.world_from_ego, calib.world_from_ego),
        ]
        for channel, pose in ideal.camera_from_lidar.items():
            pairs.append((pose, calib.camera_from_lidar[channel]))
        for ideal_pose, pose in pairs:
            np.testing.assert_allclose(ideal_pose.matrix, pose.matrix, rtol=0, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("world_name", ["world", "hilly_world"])
def test_images_show_road_users_where_their_boxes_project(request, rig_of, actor, world_name):
    """The middle of a red car ahead projects to a pixel that is red or glass, not road."""
    rig = rig_of(
        request.getfixturevalue(world_name),
        [actor(9, "car", -16.0, -1.75)],
        image_size=(640, 360),
    )
    scene = rig.scene(0.0)
    agent = rig.agents[0]
    images = dict(rig.images(scene, rig.surroundings(scene, {}), agent, 1))
    image = images["Camera_Front"].astype(int)

    camera = agent.cameras[0]
    camera_from_ground = camera.camera_from_lidar @ agent.ground_from_lidar(scene).inverse()
    corners = scene.box_corners[scene.actors.row_of(1009)]
    pixels, _ = camera.optics.project(camera_from_ground.apply(corners))
    left, top = pixels.min(axis=0)
    right, bottom = pixels.max(axis=0)

    reddish = (image[..., 0] > 1.8 * image[..., 1:].max(axis=-1)) & (image[..., 0] > 60)
    assert reddish[int(0.6 * bottom + 0.4 * top), int((left + right) / 2)]

    first = max(int(left) - 15, 0)
    _, columns = np.nonzero(reddish[: int(bottom) + 8, first : int(right) + 15])
    assert columns.min() + first == pytest.approx(left, abs=6)
    assert columns.max() + first == pytest.approx(right, abs=6)
