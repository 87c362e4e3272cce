"""Labels, points and images of a moment agree, and do not depend on what else is made."""

import numpy as np
import pytest

from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.synth.actors import Actors
from deepaccident_devkit.synth.sensors.annotate import _ahead
from deepaccident_devkit.synth.sensors.rig import make_rig
from deepaccident_devkit.taxonomy import CATEGORIES, VEHICLE_AGENTS

PEDESTRIAN = CATEGORIES.index("pedestrian")

TRAFFIC = [("car", 5.0, 1.75, np.pi, 6.0), ("van", -5.0, 1.75, np.pi, 6.0), ("pedestrian", -12.0, 5.0, 0.0, 1.2)]


@pytest.fixture(scope="module")
def others(actor):
    return [actor(10 + k, *each) for k, each in enumerate(TRAFFIC)] + [actor(20, "car", -18.0, -4.75, parked=True)]


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
    without = sightings(rig_of(town, others, sensors="none"))
    large = sightings(rig_of(town, others, image_size=(800, 450)))
    assert all(map(same, without, large))
    assert all(map(same, without, sightings(rig_of(town, others, sensors="cameras"))))
    assert not all(map(same, without, sightings(rig_of(town, others, sensors="none", seed=(1,)))))


def test_a_moment_does_not_depend_on_what_was_recorded_before(world, rig_of, others):
    rig = rig_of(world, others, sensors="none")
    alone = sightings(rig_of(world, others, sensors="none"), 0.9, 10)
    sightings(rig, 0.0, 1)
    assert all(map(same, alone, sightings(rig, 0.9, 10)))


@pytest.mark.parametrize("place", ["world", "hilly_world"])
def test_exact_counts_are_the_points_in_the_boxes(request, rig_of, others, place):
    for sighting in sightings(rig_of(request.getfixturevalue(place), others, sensors="none", exact=True)):
        np.testing.assert_array_equal(sighting.labels.num_lidar_pts, recount(sighting))
        assert sighting.labels.num_lidar_pts.max() > 100


def recount(sighting):
    labels = sighting.labels
    boxes = Boxes.from_arrays(labels.center, labels.size, labels.yaw, frame="lidar")
    return boxes.contains(sighting.points.xyz).sum(axis=1)


def test_counts_of_those_who_move_differ_a_little_from_a_recount(world, rig_of, others):
    """As in a real scenario; those of parked vehicles and of the agent itself do not."""
    differing = []
    for sighting in sightings(rig_of(world, others, sensors="none")):
        labels, found = sighting.labels, recount(sighting)
        still = (labels.actor_id == -100) | (np.hypot(*labels.velocity.T) == 0)
        np.testing.assert_array_equal(labels.num_lidar_pts[still], found[still])
        off = np.abs(labels.num_lidar_pts - found)
        assert (off <= np.maximum(5, 0.2 * found)).all()
        differing.append((off > 0).any())
    assert any(differing)


def test_nobody_goes_on_by_more_than_a_little_until_points_are_counted():
    """Who is slow, as far as it goes in 3 ms; who is fast, no farther than the noise of a point can hide."""
    velocity = np.array([[0.0, 0, 0], [2.0, 0, 0], [0, -30.0, 0]])
    np.testing.assert_allclose(_ahead(velocity), [[0, 0, 0], [0.006, 0, 0], [0, -0.012, 0]], atol=1e-12)


def test_calib_varies_in_its_last_digits_from_frame_to_frame(hilly_world, rig_of, actor):
    """By what numbers of single precision do at some hundred metres; the pole's is always the same."""
    cars = [actor(k, "car", -60.0 + 11 * k, -1.75, 0.0, 9.0) for k in range(4)]
    ids = {name: car.actor_id for name, car in zip(VEHICLE_AGENTS, cars, strict=True)}
    rig = make_rig(
        hilly_world, Actors.of(cars), ids, sky=("Clear", "Noon"), image_size=(96, 54), seed=(0,), sensors="none"
    )
    of_frames = [[each.calib for each in sightings(rig, 0.1 * k, k + 1)] for k in range(12)]
    for agent, calibs in enumerate(zip(*of_frames, strict=True)):
        for poses in ([c.ego_from_lidar for c in calibs], [c.camera_from_lidar["Camera_BackLeft"] for c in calibs]):
            matrices = np.stack([pose.matrix for pose in poses])
            spread = np.ptp(matrices, axis=0)
            assert spread[:3, 3].max() < 3e-4
            assert spread[:3, :3].max() < 2e-6
            turns = matrices[:, :3, :3]
            off_rigid = np.abs(turns @ np.swapaxes(turns, 1, 2) - np.eye(3)).max()
            assert off_rigid < 1e-6
            assert (spread.max() > 1e-6 and off_rigid > 1e-9) == (agent < 4)
            np.testing.assert_array_equal(matrices[:, 3], np.broadcast_to((0, 0, 0, 1), (12, 4)))
        for calib in calibs:
            np.testing.assert_array_equal(calib.intrinsic["Camera_Front"], calibs[0].intrinsic["Camera_Front"])
            world_from_ego = calib.world_from_ego.matrix
            np.testing.assert_array_equal(world_from_ego, world_from_ego.astype(np.float32))


def test_exact_calib_is_ideal(hilly_world, rig_of, others):
    exact = [each.calib for each in sightings(rig_of(hilly_world, others, sensors="none", exact=True))]
    usual = [each.calib for each in sightings(rig_of(hilly_world, others, sensors="none"))]
    for ideal, other in zip(exact, usual, strict=True):
        np.testing.assert_array_equal(ideal.ego_from_lidar.rotation, np.eye(3))
        assert (ideal.ego_from_lidar.translation[:2] == 0).all()
        np.testing.assert_allclose(ideal.ego_from_lidar.matrix, other.ego_from_lidar.matrix, rtol=0, atol=2e-4)
        np.testing.assert_allclose(ideal.world_from_ego.matrix, other.world_from_ego.matrix, rtol=0, atol=2e-4)
        for channel, pose in ideal.camera_from_lidar.items():
            np.testing.assert_allclose(pose.matrix, other.camera_from_lidar[channel].matrix, rtol=0, atol=2e-4)


def test_velocities_are_written_as_the_release_does(hilly_world, rig_of, others):
    """The world's, turned by the box's yaw in the agent's LiDAR frame; of the own row, whose yaw is 0, the world's."""
    rig = rig_of(hilly_world, others, sensors="none")
    scene = rig.scene(0.4)
    ground = np.column_stack([scene.snapshot.velocities, np.zeros(len(scene.actors))])
    flat = np.hypot(*(hilly_world.world_from_ground.rotate(ground)[:, :2]).T)
    world = dict(zip(scene.actors.actor_id.tolist(), hilly_world.world_from_ground.rotate(ground)[:, :2], strict=True))
    assert flat.max() > 5
    for agent in rig.agents:
        labels = rig.sighting(scene, agent, 5).labels
        for row in np.flatnonzero(labels.actor_id > 0).tolist():
            yaw, (vx, vy) = labels.yaw[row], world[int(labels.actor_id[row])]
            expected = (np.cos(yaw) * vx - np.sin(yaw) * vy, np.sin(yaw) * vx + np.cos(yaw) * vy)
            np.testing.assert_allclose(labels.velocity[row], expected, atol=1e-9)
        own = labels.actor_id == -100
        assert (labels.yaw[own] == 0).all()
        np.testing.assert_array_equal(
            labels.velocity[own], np.broadcast_to(labels.agent_velocity, labels.velocity[own].shape)
        )


def test_labels_list_parked_vehicles_then_vehicles_then_pedestrians_in_one_order(world, rig_of, others, actor):
    more = [actor(30 + k, category, -20.0 + 6 * k, 8.0) for k, category in enumerate(["truck", "cyclist", "car"])]
    rig = rig_of(world, [*others, *more], sensors="none")
    orders = []
    for sighting in sightings(rig):
        labels = sighting.labels
        group = np.where(labels.actor_id >= 20000, 0, np.where(labels.category == PEDESTRIAN, 2, 1))
        assert (np.diff(group) >= 0).all()
        orders.append([number for number in labels.actor_id.tolist() if number >= 1010])
    assert all(order == orders[0] for order in orders)


def test_boxes_have_one_place_in_the_world(hilly_world, rig_of, others):
    """Every agent's labels, brought into the world by its calib, show the same corners where the ground is flat."""
    seen = {}
    for sighting in sightings(rig_of(hilly_world, others, sensors="none")):
        labels, calib = sighting.labels, sighting.calib
        boxes = Boxes.from_arrays(labels.center, labels.size, labels.yaw, frame="lidar", actor_id=labels.actor_id)
        world_boxes = boxes.transform(calib.world_from_ego @ calib.ego_from_lidar, "world")
        for actor, center in zip(labels.actor_id.tolist(), world_boxes.center, strict=True):
            if actor > 0:
                seen.setdefault(actor, []).append(center)
    assert max(map(len, seen.values())) == 5
    for centers in seen.values():
        np.testing.assert_allclose(centers, np.broadcast_to(centers[0], np.shape(centers)), atol=3e-4)


@pytest.mark.slow
@pytest.mark.parametrize("place", ["world", "hilly_world"])
def test_images_show_road_users_where_their_boxes_project(request, rig_of, actor, place):
    """A red car ahead: where the middle of its box projects, the picture is red or glass, not road."""
    car = actor(9, "car", -16.0, -1.75)
    rig = rig_of(request.getfixturevalue(place), [car], image_size=(640, 360))
    scene, agent = rig.scene(0.0), rig.agents[0]
    image = dict(rig.images(scene, rig.surroundings(scene, {}), agent, 1))["Camera_Front"]
    camera = agent.cameras[0]
    corners = scene.box_corners[scene.actors.row_of(1009)]
    lidar_from_ground = agent.ground_from_lidar(scene).inverse()
    local = (camera.camera_from_lidar @ lidar_from_ground).apply(corners)
    pixels = local @ camera.optics.intrinsic.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    (left, top), (right, bottom) = pixels.min(axis=0), pixels.max(axis=0)
    row, column = int(0.6 * bottom + 0.4 * top), int((left + right) / 2)
    red, green, blue = image[row, column].astype(int)
    assert red > 1.8 * max(green, blue)
    reddish = (image[..., 0].astype(int) > 1.8 * image[..., 1:].astype(int).max(axis=-1)) & (image[..., 0] > 60)
    _, columns = np.nonzero(reddish[: int(bottom) + 8, max(int(left) - 15, 0) : int(right) + 15])
    assert columns.min() + max(int(left) - 15, 0) == pytest.approx(left, abs=6)
    assert columns.max() + max(int(left) - 15, 0) == pytest.approx(right, abs=6)


def test_bev_shows_every_road_user_by_its_id(world, rig_of, others):
    rig = rig_of(world, others, sensors="none")
    scene = rig.scene(0.0)
    picture = rig.bev(scene, rig.agents[0])
    assert set(np.unique(picture.instance)) >= set(scene.actors.object_id.tolist())
    assert {4, 6, 7, 8, 10} <= set(np.unique(picture.semantic))
