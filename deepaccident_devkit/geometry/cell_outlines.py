"""Outlines of the cells of a raster, as shapely polygons."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from shapely import MultiPolygon


def outlines(cells: BoolArray, origin: FloatArray, resolution: float) -> MultiPolygon:
    """Return the exact outline of the cells that are True.

    Args:
        cells: (H, W) mask of the cells, row = y index, column = x index.
        origin: (2,) x and y of the lower corner of cell (0, 0).
        resolution: Side length of a cell, in the unit of `origin`.
    """
    import shapely

    start_column, end_column, start_row, end_row = _rectangles(cells).T
    # whole numbers, so that all edges meet exactly
    rectangles = shapely.box(start_column, start_row, end_column, end_row)
    outline = shapely.union_all(rectangles)
    polygons = shapely.transform(outline, lambda corners: origin + corners * resolution)
    return multi_polygon(list(shapely.get_parts(polygons)))


def multi_polygon(parts: list[Any]) -> MultiPolygon:
    """Combine polygons, with counter-clockwise outer rings and sorted by position."""
    import shapely
    from shapely.geometry.polygon import orient

    polygons: list[Any] = [orient(shapely.normalize(part)) for part in parts]
    polygons.sort(key=lambda polygon: (*polygon.bounds, polygon.area))
    return shapely.MultiPolygon(polygons)


def _rectangles(cells: BoolArray) -> IntArray:
    """Split the True cells into rectangles: runs along a row, merged over equal successive rows.

    Returns:
        (R, 4) start and end column, start and end row; ends are exclusive.
    """
    row_count, column_count = cells.shape
    padded = np.zeros((row_count, column_count + 2), dtype=np.int8)
    padded[:, 1:-1] = cells
    edges = np.diff(padded, axis=1)
    row, start = np.nonzero(edges == 1)
    _, end = np.nonzero(edges == -1)
    order = np.lexsort((row, end, start))
    row = row[order]
    start = start[order]
    end = end[order]
    is_first = np.ones(len(row), dtype=np.bool_)
    is_first[1:] = (np.diff(start) != 0) | (np.diff(end) != 0) | (np.diff(row) != 1)
    is_last = np.roll(is_first, -1)
    return np.column_stack([start[is_first], end[is_first], row[is_first], row[is_last] + 1])
