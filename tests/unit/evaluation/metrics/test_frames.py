"""The cells within a range."""

import numpy as np
import pytest

from deepaccident_devkit.evaluation.metrics.frames import cells_within
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
    away = BevGrid((20.0, 60.0, 0.5), (-30.0, 10.0, 0.25), orientation)
    assert not np.zeros(away.shape)[cells_within(away, 30.0)].size
