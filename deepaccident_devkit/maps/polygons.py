"""Polygons: outlines of the cells of a raster, exact or simplified, and as GeoJSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from shapely import MultiPolygon, Polygon

Area = Literal["drivable", "road_line", "sidewalk"]
AREAS: Final[tuple[Area, ...]] = get_args(Area)
_DECIMALS: Final = 3
"""Of metres in GeoJSON."""


def outlines(cells: BoolArray, origin: FloatArray, resolution: float) -> MultiPolygon:
    """The exact outline of the cells that are set: the polygons' area is theirs.

    Args:
        cells: (H, W), row = y index, column = x index.
        origin: (2,) x and y of the corner of cell (0, 0).
        resolution: side of a cell.
    """
    import shapely

    column0, column1, row0, row1 = _rectangles(cells).T
    joined = shapely.union_all(shapely.box(column0, row0, column1, row1))  # in whole numbers, so that all edges meet
    placed = shapely.transform(joined, lambda corners: origin + corners * resolution)
    return _multi(list(shapely.get_parts(placed)))


def simplified(polygons: MultiPolygon, tolerance: float, least_area: float) -> MultiPolygon:
    """Polygons with fewer corners, without small islands and holes.

    Args:
        polygons: of one area.
        tolerance: how far an outline may move, metres; 0 leaves it.
        least_area: smaller islands and holes go, square metres.
    """
    import shapely

    parts = shapely.get_parts(polygons)
    kept = [_without_holes(part, least_area) for part in parts[shapely.area(parts) >= least_area]]
    if not tolerance:
        return _multi(kept)
    whole = shapely.simplify(shapely.MultiPolygon(kept), tolerance)
    parts = shapely.get_parts(shapely.get_parts(shapely.make_valid(whole)))  # twice, as collections may hold several
    return _multi([part for part in parts if part.geom_type == "Polygon"])


def geojson_of(town: str, areas: Mapping[Area, MultiPolygon]) -> bytes:
    """A FeatureCollection with one feature for each polygon of each area; coordinates have three decimals."""
    features = [
        {
            "type": "Feature",
            "properties": {"town": town, "area": area, "square_metres": round(part.area, 1)},
            "geometry": {"type": "Polygon", "coordinates": _rings(part)},
        }
        for area, polygons in areas.items()
        for part in polygons.geoms
    ]
    collection = {
        "type": "FeatureCollection",
        "name": town,
        "coordinate_system": "local metres of the simulator's world, x and y, right-handed; no longitude and latitude",
        "features": features,
    }
    return (json.dumps(collection, allow_nan=False, separators=(",", ":")) + "\n").encode()


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


def _without_holes(polygon: Polygon, least_area: float) -> Polygon:
    import shapely

    holes = [ring for ring in polygon.interiors if shapely.Polygon(ring).area >= least_area]
    return shapely.Polygon(polygon.exterior, holes)


def _multi(parts: list[Any]) -> MultiPolygon:
    """Polygons in an order that depends on their places alone, with outer rings counter-clockwise."""
    import shapely
    from shapely.geometry.polygon import orient

    turned: list[Any] = [orient(shapely.normalize(part)) for part in parts]
    turned.sort(key=lambda part: (*part.bounds, part.area))
    return shapely.MultiPolygon(turned)


def _rings(polygon: Polygon) -> list[list[list[float]]]:
    rings = [polygon.exterior, *polygon.interiors]
    return [np.round(np.asarray(ring.coords), _DECIMALS).tolist() for ring in rings]
