"""Outlines of cells, checked cell by cell."""

import numpy as np
import pytest
from shapely import Point

from deepaccident_devkit.geometry.cell_outlines import outlines


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 1.0])
def test_outlines_hold_exactly_their_cells_and_are_sorted_by_place(share: float) -> None:
    cells = np.random.default_rng(1).random((9, 7)) < share
    result = outlines(cells, np.array([10.0, -3.0]), 0.5)
    for row, column in np.ndindex(9, 7):
        center = Point(10.25 + column / 2, -2.75 + row / 2)
        assert result.contains(center) == cells[row, column]

    places = [(*polygon.bounds, polygon.area) for polygon in result.geoms]
    assert result.area == cells.sum() / 4
    assert places == sorted(places)
    assert all(polygon.exterior.is_ccw for polygon in result.geoms)
