"""Outlines of the cells of a raster, as shapely's polygons."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from shapely import MultiPolygon


def outlines(cells: BoolArray, origin: FloatArray, resolution: float) -> MultiPolygon:
    """The exact outline of the cells that are set: the polygons' area is theirs.

    Args:
        cells: (H, W), row = y index, column = x index.
        origin: (2,) x and y of the corner of cell (0, 0).
        resolution: side of a cell.
    """
    import shapely

    column0, column1, row0, row1 = _rectangles(cells).T
    joined = shapely.union_all(
        shapely.box(column0, row0, column1, row1)
    )  # in whole numbers, so that all edges meet
    placed = shapely.transform(joined, lambda corners: origin + corners * resolution)
    return multi_polygon(list(shapely.get_parts(placed)))


def multi_polygon(parts: list[Any]) -> MultiPolygon:
    """Polygons in an order that depends on their places alone, with outer rings counter-clockwise."""
    import shapely
    from shapely.geometry.polygon import orient

    turned: list[Any] = [orient(shapely.normalize(part)) for part in parts]
    turned.sort(key=lambda part: (*part.bounds, part.area))
    return shapely.MultiPolygon(turned)


def _rectangles(cells: BoolArray) -> IntArray:
    """(R, 4) first and past-the-last column and row of rectangles that fill the cells: runs, joined over equal rows."""
    rows, columns = cells.shape
    padded = np.zeros((rows, columns + 2), dtype=np.int8)
    padded[:, 1:-1] = cells
    edges = np.diff(padded, axis=1)
    row, start = np.nonzero(edges == 1)
    end = np.nonzero(edges == -1)[1]
    order = np.lexsort((row, end, start))
    row, start, end = row[order], start[order], end[order]
    first = np.ones(len(row), dtype=np.bool_)
    first[1:] = (np.diff(start) != 0) | (np.diff(end) != 0) | (np.diff(row) != 1)
    last = np.roll(first, -1)
    return np.column_stack([start[first], end[first], row[first], row[last] + 1])
