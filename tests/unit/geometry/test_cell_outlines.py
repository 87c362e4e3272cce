"""Outlines of cells, each cell looked at by itself."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from shapely import Point

from deepaccident_devkit.geometry.cell_outlines import outlines


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 1.0])
def test_they_hold_the_very_cells_and_their_order_is_that_of_their_places(share: float) -> None:
    cells = np.random.default_rng(1).random((9, 7)) < share
    found = outlines(cells, np.array([10.0, -3.0]), 0.5)
    for row, column in np.ndindex(9, 7):
        assert found.contains(Point(10.25 + column / 2, -2.75 + row / 2)) == cells[row, column]
    places = [(*part.bounds, part.area) for part in found.geoms]
    assert (found.area, places) == (cells.sum() / 4, sorted(places))
    assert_array_equal([part.exterior.is_ccw for part in found.geoms], np.ones(len(places)))
