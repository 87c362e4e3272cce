"""Outlines of the cells of a raster, as shapely's polygons."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from shapely import MultiPolygon


def outlines(cells: BoolArray, origin: FloatArray, resolution: float) -> MultiPolygon:
    """Return the exact outline of the cells that are set: both cover the same area.

    Args:
        cells: (H, W), row = y index, column = x index.
        origin: (2,) x and y of the corner of cell (0, 0).
        resolution: Side of a cell.
    """
    import shapely

    column0, column1, row0, row1 = _rectangles(cells).T
    # in whole numbers, so that all edges meet
    joined = shapely.union_all(shapely.box(column0, row0, column1, row1))
    polygons = shapely.transform(joined, lambda corners: origin + corners * resolution)
    return multi_polygon(list(shapely.get_parts(polygons)))


def multi_polygon(parts: list[Any]) -> MultiPolygon:
    """Return polygons with outer rings counter-clockwise, in an order by their positions."""
    import shapely
    from shapely.geometry.polygon import orient

    polygons: list[Any] = [orient(shapely.normalize(part)) for part in parts]
    polygons.sort(key=lambda polygon: (*polygon.bounds, polygon.area))
    return shapely.MultiPolygon(polygons)


def _rectangles(cells: BoolArray) -> IntArray:
    """Return rectangles that fill the cells: runs of cells, joined over equal rows.

    Returns:
        (R, 4) first and past-the-last column, first and past-the-last row.
    """
    rows, columns = cells.shape
    padded = np.zeros((rows, columns + 2), dtype=np.int8)
    padded[:, 1:-1] = cells
    edges = np.diff(padded, axis=1)
    row, start = np.nonzero(edges == 1)
    end = np.nonzero(edges == -1)[1]
    order = np.lexsort((row, end, start))
    row = row[order]
    start = start[order]
    end = end[order]
    is_first = np.ones(len(row), dtype=np.bool_)
    is_first[1:] = (np.diff(start) != 0) | (np.diff(end) != 0) | (np.diff(row) != 1)
    is_last = np.roll(is_first, -1)
    return np.column_stack([start[is_first], end[is_first], row[is_first], row[is_last] + 1])
