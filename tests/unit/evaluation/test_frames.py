"""The cells within a range."""

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.predictions import cells_within, labels_at_present
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_the_cells_of_a_range(orientation) -> None:
    grid = BevGrid((-20.0, 60.0, 0.5), (-30.0, 10.0, 0.25), orientation)
    for extent in (30.0, 41.0, 1.0, 300.0):
        inside = np.abs(grid.centers()) < extent / 2
        expected = inside.all(axis=-1)
        found = np.zeros(grid.shape, dtype=bool)
        found[cells_within(grid, extent)] = True
        np.testing.assert_array_equal(found, expected)
    inside = (grid.centers() >= -30.5 / 2) & (grid.centers() < 30.5 / 2)  # a centre on the edge is in on one side
    found = np.zeros(grid.shape, dtype=bool)
    found[cells_within(grid, 30.5)] = True
    np.testing.assert_array_equal(found, inside.all(axis=-1))
    away = BevGrid((20.0, 60.0, 0.5), (-30.0, 10.0, 0.25), orientation)
    assert not np.zeros(away.shape)[cells_within(away, 30.0)].size


def test_labels_are_compared_at_the_present_with_bilinear_centres(da_motion: DeepAccident) -> None:
    label = da_motion.motion_labels(f"{da_motion.scenario[0]['token']}/ego_vehicle/010")
    moved = label.to_present(centerness="bilinear")
    assert (labels_at_present(label).centerness == moved.centerness).all()
    assert labels_at_present(moved) is moved
