"""Labels, points and images of a moment agree, and do not depend on what else is made."""

import numpy as np
import pytest

from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.plugins.synth.sensors.annotate import offsets_at_count

TRAFFIC = [
    ("car", 5.0, 1.75, np.pi, 6.0),
    ("van", -5.0, 1.75, np.pi, 6.0),
    ("pedestrian", -12.0, 5.0, 0.0, 1.2),
]


@pytest.fixture(scope="module")
def others(actor):
    return [actor(10 + k, *each) for k, each in enumerate(TRAFFIC)] + [
        actor(20, "car", -18.0, -4.75, parked=True)
    ]


def sightings(rig, time=0.4, frame=5):
    scene = rig.scene(time)
    return [rig.sighting(scene, agent, frame) for agent in rig.agents]


def same(first, second):
    return all(
        np.array_equal(getattr(first.labels, name), getattr(second.labels, name))
        for name in ("center", "yaw", "velocity", "actor_id", "num_lidar_pts", "camera_visible")
    )


@pytest.mark.slow
@pytest.mark.parametrize("place", ["world", "hilly_world"])
def test_labels_do_not_depend_on_images(request, rig_of, others, place):
    town = request.getfixturevalue(place)
    given = (
        {},
        {"image_size": (800, 450), "sensors": "all"},
        {"sensors": "cameras"},
        {"seed": (1,)},
    )
    usual, *alike, another = (
        sightings(rig_of(town, others, **{"sensors": "none", **each})) for each in given
    )
    assert [all(map(same, usual, each)) for each in (*alike, another)] == [True, True, False]


def test_a_moment_does_not_depend_on_what_was_recorded_before(world, rig_of, others):
    rig = rig_of(world, others, sensors="none")
    alone = sightings(rig_of(world, others, sensors="none"), 0.9, 10)
    sightings(rig, 0.0, 1)
    assert all(map(same, alone, sightings(rig, 0.9, 10)))


@pytest.mark.parametrize("place", ["world", "hilly_world"])
def test_exact_counts_are_the_points_in_the_boxes(request, rig_of, others, place):
    for sighting in sightings(
        rig_of(request.getfixturevalue(place), others, sensors="none", exact=True)
    ):
        np.testing.assert_array_equal(sighting.labels.num_lidar_pts, recount(sighting))
        assert sighting.labels.num_lidar_pts.max() > 100


def recount(sighting):
    labels = sighting.labels
    boxes = Boxes.from_arrays(labels.center, labels.size, labels.yaw, frame="lidar")
    return boxes.contains(sighting.points.xyz).sum(axis=1)


def test_nobody_goes_on_by_more_than_a_little_until_points_are_counted():
    """Who is slow, as far as it goes in 3 ms; who is fast, no farther than the noise of a point can
    hide.
    """
    velocity = np.array([[0.0, 0, 0], [2.0, 0, 0], [0, -30.0, 0]])
    np.testing.assert_allclose(
        offsets_at_count(velocity), [[0, 0, 0], [0.006, 0, 0], [0, -0.012, 0]], atol=1e-12
    )


def test_exact_calib_is_ideal(hilly_world, rig_of, others):
    usual, exact = (
        [each.calib for each in sightings(rig_of(hilly_world, others, sensors="none", exact=exact))]
        for exact in (False, True)
    )
    for ideal, other in zip(exact, usual, strict=True):
        np.testing.assert_array_equal(ideal.ego_from_lidar.matrix[:3, :3], np.eye(3))
        np.testing.assert_array_equal(ideal.ego_from_lidar.translation[:2], 0)
        pairs = [
            (ideal.ego_from_lidar, other.ego_from_lidar),
            (ideal.world_from_ego, other.world_from_ego),
        ]
        pairs += [
            (pose, other.camera_from_lidar[channel])
            for channel, pose in ideal.camera_from_lidar.items()
        ]
        for one, two in pairs:
            np.testing.assert_allclose(one.matrix, two.matrix, rtol=0, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("place", ["world", "hilly_world"])
def test_images_show_road_users_where_their_boxes_project(request, rig_of, actor, place):
    """A red car ahead: where the middle of its box projects, the picture is red or glass, not
    road.
    """
    rig = rig_of(
        request.getfixturevalue(place), [actor(9, "car", -16.0, -1.75)], image_size=(640, 360)
    )
    scene, agent = rig.scene(0.0), rig.agents[0]
    image = dict(rig.images(scene, rig.surroundings(scene, {}), agent, 1))["Camera_Front"].astype(
        int
    )
    camera = agent.cameras[0]
    camera_from_ground = camera.camera_from_lidar @ agent.ground_from_lidar(scene).inverse()
    pixels, _ = camera.optics.project(
        camera_from_ground.apply(scene.box_corners[scene.actors.row_of(1009)])
    )
    (left, top), (right, bottom) = pixels.min(axis=0), pixels.max(axis=0)
    reddish = (image[..., 0] > 1.8 * image[..., 1:].max(axis=-1)) & (image[..., 0] > 60)
    assert reddish[int(0.6 * bottom + 0.4 * top), int((left + right) / 2)]
    first = max(int(left) - 15, 0)
    _, columns = np.nonzero(reddish[: int(bottom) + 8, first : int(right) + 15])
    assert (columns.min() + first, columns.max() + first) == pytest.approx((left, right), abs=6)
