"""What the files say agrees, over agents and kinds of file."""

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
    labels = [
        (agent, read_label(each.label_path(agent, 1))) for each in scenarios for agent in AGENTS
    ]
    ids = np.concatenate([label.actor_id for _, label in labels])
    distance = np.concatenate([np.hypot(*label.center[:, :2].T) for _, label in labels])
    assert ({-100, -1} <= {*ids.tolist()}, ids.max() >= 20000, 100 < distance.max() <= 120) == (
        True,
    ) * 3
    np.testing.assert_array_equal(ids == -1, distance > 115)
    assert {
        (agent == "infrastructure", (label.actor_id == -100).sum()) for agent, label in labels
    } == {
        (True, 0),
        (False, 1),
    }


def test_own_box_lies_around_the_ego_origin(scenarios):
    """Where exactly; that poses, velocities, contacts and pictures agree, `validate` says of each
    release.
    """
    for scenario in scenarios:
        for agent in AGENTS[:4]:
            label = read_label(scenario.label_path(agent, 1))
            height = read_calib(scenario.calib_path(agent, 1)).ego_from_lidar.translation[2]
            own = int(np.flatnonzero(label.actor_id == -100)[0])
            x, y, z = label.center[own]
            assert -0.31 < x <= 0 == y
            assert z - label.size[own, 2] / 2 == pytest.approx(0.02 - height, abs=0.01)


def test_calib_is_as_in_the_real_release(scenarios):
    vehicle, pole = (
        read_calib(scenarios[0].calib_path(agent, 1)) for agent in ("ego_vehicle", "infrastructure")
    )
    label = read_label(scenarios[0].label_path("ego_vehicle", 1))
    length, width, tall = label.size[label.actor_id == -100][0]
    np.testing.assert_allclose(vehicle.ego_from_lidar.translation, [0, 0, tall + 0.5], atol=2e-4)
    np.testing.assert_allclose(pole.ego_from_lidar.matrix, np.eye(4), atol=2e-4)
    assert 3 <= (vehicle.world_from_ego.inverse() @ pole.world_from_ego).translation[2] <= 5
    raw = read_calib(scenarios[0].calib_path("ego_vehicle", 1), raw=True)
    focal, side = 96 / np.tan(np.deg2rad(35)), np.deg2rad(55)
    corner = np.linalg.inv(raw["lidar_to_Camera_FrontLeft"])[:3, 3]
    for found, expected, atol in (
        (raw["intrinsic_Camera_Front"], [[96, focal, 0], [54, 0, -focal], [1, 0, 0]], 1e-9),
        (raw["lidar_to_Camera_Front"][:3, :3], np.eye(3), 1e-6),
        (raw["lidar_to_Camera_Front"][:3, 3], [-length / 2, 0, 0.3], 0.31),
        (raw["lidar_to_Camera_Back"][:3, :3], np.diag([-1, -1, 1]), 1e-6),
        (raw["lidar_to_Camera_FrontLeft"][0, :3], [np.cos(side), -np.sin(side), 0], 1e-6),
        (corner[1], -width / 2, 2e-3),
    ):
        np.testing.assert_allclose(found, expected, atol=atol)


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
    assert (reach.max() <= 70.3, 25_000 < len(cloud) <= 32 * 1400) == (True, True)
    assert (len(np.unique(elevation.round(3))) <= 32, elevation.min()) == (
        True,
        pytest.approx(-30, abs=1e-3),
    )
    assert (
        0 <= cloud.intensity.min() < cloud.intensity.max() <= 1,
        cloud.intensity.std() > 0.05,
    ) == (True, True)
