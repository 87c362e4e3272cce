"""The files of a release agree with each other, across agents and kinds of file."""

import numpy as np
import pytest

from deepaccident_devkit.release import (
    read_calib,
    read_label,
    read_lidar,
)
from deepaccident_devkit.taxonomy import AGENTS

pytestmark = pytest.mark.slow


def test_ids_of_all_kinds_occur(scenarios):
    ids, distances = [], []
    for scenario in scenarios:
        for agent in AGENTS:
            label = read_label(scenario.label_path(agent, 1))
            ids.append(label.actor_id)
            distances.append(np.hypot(*label.center[:, :2].T))
            own_boxes = (label.actor_id == -100).sum()
            assert own_boxes == (0 if agent == "infrastructure" else 1)

    all_ids, all_distances = np.concatenate(ids), np.concatenate(distances)
    assert {-100, -1} <= {*all_ids.tolist()}
    assert all_ids.max() >= 20000
    assert 100 < all_distances.max() <= 120
    np.testing.assert_array_equal(all_ids == -1, all_distances > 115)


def test_own_box_lies_around_the_ego_origin(scenarios):
    """The exact place. `validate` checks for each release that poses, velocities, contacts and
    pictures agree.
    """
    for scenario in scenarios:
        for agent in AGENTS[:4]:
            label = read_label(scenario.label_path(agent, 1))
            height = read_calib(scenario.calib_path(agent, 1)).ego_from_lidar.translation[2]
            own = int(np.flatnonzero(label.actor_id == -100)[0])

            x, y, z = label.center[own]
            assert -0.31 < x <= 0 == y
            bottom = z - label.size[own, 2] / 2
            assert bottom == pytest.approx(0.02 - height, abs=0.01)


def test_calib_is_as_in_the_real_release(scenarios):
    path = scenarios[0].calib_path("ego_vehicle", 1)
    vehicle = read_calib(path)
    pole = read_calib(scenarios[0].calib_path("infrastructure", 1))
    label = read_label(scenarios[0].label_path("ego_vehicle", 1))
    length, width, height = label.size[label.actor_id == -100][0]

    np.testing.assert_allclose(vehicle.ego_from_lidar.translation, [0, 0, height + 0.5], atol=2e-4)
    np.testing.assert_allclose(pole.ego_from_lidar.matrix, np.eye(4), atol=2e-4)
    vehicle_from_pole = vehicle.world_from_ego.inverse() @ pole.world_from_ego
    assert 3 <= vehicle_from_pole.translation[2] <= 5

    raw = read_calib(path, raw=True)
    focal, side = 96 / np.tan(np.deg2rad(35)), np.deg2rad(55)
    corner = np.linalg.inv(raw["lidar_to_Camera_FrontLeft"])[:3, 3]
    for values, expected, atol in (
        (raw["intrinsic_Camera_Front"], [[96, focal, 0], [54, 0, -focal], [1, 0, 0]], 1e-9),
        (raw["lidar_to_Camera_Front"][:3, :3], np.eye(3), 1e-6),
        (raw["lidar_to_Camera_Front"][:3, 3], [-length / 2, 0, 0.3], 0.31),
        (raw["lidar_to_Camera_Back"][:3, :3], np.diag([-1, -1, 1]), 1e-6),
        (raw["lidar_to_Camera_FrontLeft"][0, :3], [np.cos(side), -np.sin(side), 0], 1e-6),
        (corner[1], -width / 2, 2e-3),
    ):
        np.testing.assert_allclose(values, expected, atol=atol)


@pytest.mark.parametrize("agent", AGENTS)
def test_counts_are_nearly_the_stored_points_in_the_boxes(scenarios, agent):
    """The counts of standing actors are exact; `test_rig` checks the counts of an exact release."""
    for scenario in scenarios:
        cloud = read_lidar(scenario.channel_path(agent, "lidar01", 2))
        label = read_label(scenario.label_path(agent, 2))
        inside = label.boxes().contains(cloud.xyz).sum(axis=1)

        standing = (label.actor_id == -100) | (np.hypot(*label.velocity.T) == 0)
        np.testing.assert_array_equal(label.num_lidar_pts[standing], inside[standing])
        differences = np.abs(label.num_lidar_pts - inside)
        assert (differences <= np.maximum(5, 0.25 * inside)).all()
        assert (label.num_lidar_pts > 5).sum() > 5


def test_clouds_store_single_precision_numbers_as_double(scenarios):
    cloud = read_lidar(scenarios[0].channel_path("ego_vehicle", "lidar01", 2), raw=True)
    assert cloud.dtype == np.float64
    np.testing.assert_array_equal(cloud, cloud.astype(np.float32))


def test_points_are_a_scan_of_32_channels(scenarios):
    cloud = read_lidar(scenarios[0].channel_path("infrastructure", "lidar01", 1))
    assert 25_000 < len(cloud) <= 32 * 1400
    distances = np.linalg.norm(cloud.xyz, axis=1)
    assert distances.max() <= 70.3

    elevations = np.rad2deg(np.arcsin(cloud.xyz[:, 2] / distances))
    assert len(np.unique(elevations.round(3))) <= 32
    assert elevations.min() == pytest.approx(-30, abs=1e-3)
    assert 0 <= cloud.intensity.min() < cloud.intensity.max() <= 1
    assert cloud.intensity.std() > 0.05
