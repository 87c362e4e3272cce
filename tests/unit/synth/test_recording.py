"""What the files say agrees, over agents and kinds of file."""

import numpy as np
import pytest

from deepaccident_devkit.release import (
    read_bev,
    read_calib,
    read_label,
    read_lidar,
    read_meta,
    world_from_label_velocity,
)
from deepaccident_devkit.synth.traffic.simulate import gap, separation
from deepaccident_devkit.taxonomy import AGENTS, CATEGORIES

FRAMES = (1, 2, 3)


@pytest.mark.parametrize("frame", FRAMES)
def test_actors_have_one_world_pose_in_all_agents_labels(scenarios, world_boxes, frame):
    for scenario in scenarios:
        own = dict(zip(AGENTS, read_meta(scenario.meta_path).agent_ids, strict=False))
        seen: dict[int, list[np.ndarray]] = {}
        for agent in AGENTS:
            boxes, _ = world_boxes(scenario, agent, frame)
            for row, actor in enumerate(boxes.actor_id.tolist()):
                if actor != -1:
                    seen.setdefault(own[agent] if actor == -100 else actor, []).append(boxes.corners()[row])
        assert max(map(len, seen.values())) == 5
        for poses in seen.values():
            np.testing.assert_allclose(poses, np.broadcast_to(poses[0], np.shape(poses)), atol=1e-4)


def test_velocities_are_those_of_the_world_poses(accident, world_boxes):
    for agent in AGENTS:
        (before, _), (now, _), (after, _) = (world_boxes(accident, agent, frame) for frame in FRAMES)
        for row, actor in enumerate(now.actor_id.tolist()):
            if actor == -1 or actor not in before.actor_id or actor not in after.actor_id:
                continue
            step = after.center[after.actor_id == actor][0] - before.center[before.actor_id == actor][0]
            label = read_label(accident.label_path(agent, 2))
            velocity = world_from_label_velocity(label.velocity, label.yaw)[row]
            np.testing.assert_allclose(velocity, step[:2] / 0.2, atol=0.2)
            if actor == -100:
                np.testing.assert_array_equal(label.velocity[row], label.agent_velocity[0])


def test_contact_is_at_the_last_frame_of_the_files(accident, world_boxes):
    ids = read_meta(accident.meta_path).collision.ids
    gaps = []
    for frame in FRAMES:
        boxes = read_label(accident.label_path("infrastructure", frame)).boxes()
        rows = [int(np.flatnonzero(boxes.actor_id == actor)[0]) for actor in ids]
        poses = np.column_stack([boxes.center[rows, :2], boxes.yaw[rows]])
        sizes = boxes.size[rows, :2]
        gaps.append(float(gap(poses[0], sizes[0], poses[1], sizes[1])))
        touching = float(separation(poses[0], sizes[0], poses[1], sizes[1]))
    assert gaps[0] > gaps[1] > 0.3
    assert abs(touching) < 1e-6


def test_ids_of_all_kinds_occur(scenarios):
    labels = [read_label(s.label_path(agent, 1)) for s in scenarios for agent in AGENTS]
    ids = np.concatenate([label.actor_id for label in labels])
    distance = np.concatenate([np.hypot(*label.center[:, :2].T) for label in labels])
    assert {-100, -1} < set(ids.tolist())
    assert (ids >= 20000).any()
    np.testing.assert_array_equal(ids == -1, distance > 115)
    assert 100 < distance.max() <= 120
    for scenario in scenarios:
        for agent in AGENTS:
            own = read_label(scenario.label_path(agent, 1)).actor_id == -100
            assert own.sum() == (agent != "infrastructure")


def test_own_box_lies_around_the_ego_origin(scenarios):
    for scenario in scenarios:
        for agent in AGENTS[:4]:
            label = read_label(scenario.label_path(agent, 1))
            height = read_calib(scenario.calib_path(agent, 1)).ego_from_lidar.translation[2]
            own = int(np.flatnonzero(label.actor_id == -100)[0])
            assert -0.31 < label.center[own, 0] <= 0
            assert label.center[own, 1] == 0
            assert label.center[own, 2] - label.size[own, 2] / 2 == pytest.approx(0.02 - height, abs=0.01)
            assert not label.camera_visible[own]
            assert label.num_lidar_pts[own] > 10


def test_calib_is_as_in_the_real_release(scenarios):
    vehicle, pole = (read_calib(scenarios[0].calib_path(agent, 1)) for agent in ("ego_vehicle", "infrastructure"))
    label = read_label(scenarios[0].label_path("ego_vehicle", 1))
    length, width, tall = label.size[label.actor_id == -100][0]
    np.testing.assert_allclose(vehicle.ego_from_lidar.translation, [0, 0, tall + 0.5], atol=2e-4)
    np.testing.assert_allclose(pole.ego_from_lidar.matrix, np.eye(4), atol=2e-4)
    height = (vehicle.world_from_ego.inverse() @ pole.world_from_ego).translation[2]
    assert 3 <= height <= 5
    raw = read_calib(scenarios[0].calib_path("ego_vehicle", 1), raw=True)
    focal = 96 / np.tan(np.deg2rad(35))
    np.testing.assert_allclose(raw["intrinsic_Camera_Front"], [[96, focal, 0], [54, 0, -focal], [1, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(raw["lidar_to_Camera_Front"][:3, :3], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(raw["lidar_to_Camera_Front"][:3, 3], [-length / 2, 0, 0.3], atol=0.31)
    np.testing.assert_allclose(raw["lidar_to_Camera_Back"][:3, :3], np.diag([-1, -1, 1]), atol=1e-6)
    left = raw["lidar_to_Camera_FrontLeft"]
    np.testing.assert_allclose(left[0, :3], [np.cos(np.deg2rad(55)), -np.sin(np.deg2rad(55)), 0], atol=1e-6)
    corner = np.linalg.inv(left)[:3, 3]
    assert corner[1] == pytest.approx(-width / 2, abs=2e-3)


@pytest.mark.parametrize("agent", AGENTS)
def test_counts_are_nearly_the_stored_points_in_the_boxes(scenarios, agent):
    """Those of who stands are just these; `test_rig` has those of an exact release."""
    for scenario in scenarios:
        cloud = read_lidar(scenario.channel_path(agent, "lidar01", 2))
        label = read_label(scenario.label_path(agent, 2))
        found = label.boxes().contains(cloud.xyz).sum(axis=1)
        still = (label.actor_id == -100) | (np.hypot(*label.velocity.T) == 0)
        np.testing.assert_array_equal(label.num_lidar_pts[still], found[still])
        assert (np.abs(label.num_lidar_pts - found) <= np.maximum(5, 0.25 * found)).all()
        assert (label.num_lidar_pts > 5).sum() > 5


def test_clouds_are_of_double_precision_with_single_numbers(scenarios):
    cloud = read_lidar(scenarios[0].channel_path("ego_vehicle", "lidar01", 2), raw=True)
    assert cloud.dtype == np.float64
    np.testing.assert_array_equal(cloud, cloud.astype(np.float32))


def test_points_are_a_scan_of_32_channels(scenarios):
    cloud = read_lidar(scenarios[0].channel_path("infrastructure", "lidar01", 1))
    reach = np.linalg.norm(cloud.xyz, axis=1)
    elevation = np.rad2deg(np.arcsin(cloud.xyz[:, 2] / reach))
    assert reach.max() <= 70.3
    assert 25_000 < len(cloud) <= 32 * 1400
    assert len(np.unique(elevation.round(3))) <= 32
    assert elevation.min() == pytest.approx(-30, abs=1e-3)
    assert 0 <= cloud.intensity.min() < cloud.intensity.max() <= 1
    assert cloud.intensity.std() > 0.05


def test_bev_shows_the_labels_boxes(scenarios):
    for agent in AGENTS:
        bev = read_bev(scenarios[0].channel_path(agent, "BEV_instance_camera", 1))
        calib = read_calib(scenarios[0].calib_path(agent, 1))
        boxes = read_label(scenarios[0].label_path(agent, 1)).boxes().transform(calib.ego_from_lidar, "ego")
        inside = np.abs(boxes.center[:, :2]).max(axis=1) < 59
        row, column = (np.rint(599.5 - boxes.center[inside, axis] / 0.1).astype(int) for axis in (0, 1))
        walking = boxes.category[inside] == CATEGORIES.index("pedestrian")
        np.testing.assert_array_equal(bev.semantic[row, column], np.where(walking, 4, 10))
        assert (bev.instance[row, column] > 0).all()
        assert len(np.unique(bev.instance[row, column])) == inside.sum()
        assert {7, 8, 6, 1} < set(np.unique(bev.semantic).tolist())
        np.testing.assert_array_equal(bev.instance > 0, np.isin(bev.semantic, (4, 10)))
