"""`TownMap`: a town's ground as a raster of counts, with classes, drivable area and outlines."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepaccident_devkit.geometry.cell_outlines import multi_polygon, outlines
from deepaccident_devkit.maps.counting import GROUND_CLASSES
from deepaccident_devkit.support.arrays import (
    BoolArray,
    ByteArray,
    FloatArray,
    FrozenArrays,
    as_floats,
    checked,
)
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.text import choice, path_of

if TYPE_CHECKING:
    from shapely import MultiPolygon, Polygon

Area = Literal["drivable", "road_line", "sidewalk"]
AREAS: Final[tuple[Area, ...]] = get_args(Area)
# Decimals of metres in GeoJSON.
_DECIMALS: Final = 3
_ROAD, _ROAD_LINE, _SIDEWALK, _OTHER = range(1, len(GROUND_CLASSES) + 1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TownMap(FrozenArrays):
    """A town's ground as the BEV cameras of its recordings saw it.

    Coordinates are in world, right-handed, metres; arrays are read-only. Rasters are (H, W):
    row = y index, column = x index, both rising. The middle of cell (i, j) is at
    x = origin[0] + (j + 0.5) · resolution, y = origin[1] + (i + 0.5) · resolution.

    A picture shows nothing of a cell that a vehicle or a pedestrian hides, and is not counted
    there. Where actors never moved, `hidden` has the class of the ground around them. Seen from
    above, a bridge hides the ground under it.

    Attributes:
        town: Name of the town.
        resolution: Side of a cell.
        origin: Lowest x and y of the raster, shape (2,), float64.
        counts: Pictures that saw each of `GROUND_CLASSES` at the cell's middle, shape (4, H, W),
            uint16.
        agents: Recordings (an agent in a scenario) that saw the ground of the cell, shape (H, W),
            uint16.
        hidden: Class of the cells around small holes that no picture saw, 1 + the position in
            `GROUND_CLASSES`, shape (H, W), uint8; 0 elsewhere.
        scenarios: Number of scenarios recorded in the town and used.
        looks: Number of pictures that were read.
        missing: Number of pictures without a file.
        damaged: Number of pictures with an unreadable file.
    """

    town: str
    resolution: float
    origin: FloatArray
    counts: NDArray[np.uint16]
    agents: NDArray[np.uint16]
    hidden: ByteArray
    scenarios: int
    looks: int
    missing: int
    damaged: int

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns, (H, W)."""
        rows, columns = self.agents.shape
        return rows, columns

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Lowest and highest x, lowest and highest y, for matplotlib's `imshow(origin="lower")`."""
        x, y = self.origin.tolist()
        high_x, high_y = (self.origin + np.array(self.shape[::-1]) * self.resolution).tolist()
        return x, high_x, y, high_y

    def seen(self) -> BoolArray:
        """Return whether any picture saw the ground of a cell, shape (H, W)."""
        return np.asarray(self.agents > 0)

    def drivable(self) -> BoolArray:
        """Return cells that most pictures saw as road or road line, and hidden ones amid these.

        The mask has shape (H, W); most pictures are more than half.
        """
        surface, total = _surface_and_total(self.counts)
        return np.asarray((2 * surface > total) | (self.hidden == _ROAD))

    def classes(self) -> ByteArray:
        """Return classes, shape (H, W), uint8: 0 if unknown, or 1 + index in `GROUND_CLASSES`.

        Drivable cells are road or road line, whichever more pictures saw; others sidewalk or other.
        """
        return np.maximum(classes_of(self.counts), self.hidden)

    def classes_at(self, points: ArrayLike) -> ByteArray:
        """Return the classes (N,) at points, as in `classes`; 0 beyond the raster.

        Args:
            points: x and y in world, shape (N, 2), metres.

        Raises:
            GeometryError: The points have another shape, or are no numbers.
        """
        xy = checked("points", as_floats(points), (None, 2))
        column, row = np.floor((xy - self.origin) / self.resolution).T
        rows, columns = self.shape
        in_raster = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        result = np.zeros(len(xy), dtype=np.uint8)
        cells = row[in_raster].astype(np.int64), column[in_raster].astype(np.int64)
        classes = classes_of(self.counts[(slice(None), *cells)])
        result[in_raster] = np.maximum(classes, self.hidden[cells])
        return result

    def around(self, center: ArrayLike, reach: float) -> TownMap:
        """Return the part of the map in a square, with all cells that the square touches.

        Args:
            center: x and y of the square's middle, shape (2,), world, metres.
            reach: Distance of the square's sides from its middle, metres.

        Raises:
            GeometryError: The centre is no two numbers.
        """
        middle = checked("center", as_floats(center), (2,)) - self.origin
        limits = np.array(self.shape[::-1])
        low = np.floor((middle - reach) / self.resolution).clip(0, limits).astype(np.int64)
        high = np.ceil((middle + reach) / self.resolution).clip(low, limits).astype(np.int64)
        (column, row), (last_column, last_row) = low.tolist(), high.tolist()
        rows = slice(row, last_row)
        columns = slice(column, last_column)
        return replace(
            self,
            origin=self.origin + low * self.resolution,
            counts=self.counts[:, rows, columns],
            agents=self.agents[rows, columns],
            hidden=self.hidden[rows, columns],
        )

    def area(self, area: Area = "drivable") -> BoolArray:
        """Return the cells of an area, shape (H, W).

        Areas are `drivable` (road and road line), `road_line` and `sidewalk`.

        Raises:
            ChoiceError: The area is unknown.
        """
        area = choice("area", area, AREAS)
        if area == "drivable":
            return self.drivable()
        return np.asarray(self.classes() == 1 + GROUND_CLASSES.index(area))

    def polygons(
        self, area: Area = "drivable", *, tolerance: float | None = None, least_area: float = 1.0
    ) -> MultiPolygon:
        """Return the outline of an area as polygons of shapely, x and y in world, metres.

        Outer rings run counter-clockwise.

        Args:
            area: `drivable` (road and road line), `road_line` or `sidewalk`.
            tolerance: Distance of the outline from that of the cells, metres; None for the side of
                a cell, which turns steps into straight lines. 0 keeps the cells' own outline.
            least_area: Area of the smallest islands and holes to keep, square metres.

        Raises:
            ChoiceError: The area is unknown.
        """
        cell_outlines = outlines(self.area(area), self.origin, self.resolution)
        tolerance = self.resolution if tolerance is None else tolerance
        return simplified_polygons(cell_outlines, tolerance, least_area)

    def to_geojson(self, path: str | os.PathLike[str]) -> Path:
        """Write the drivable area and the sidewalks as GeoJSON, a feature for each polygon.

        Coordinates are x and y of the simulator's world, metres, right-handed, and no longitude and
        latitude, which RFC 7946 asks for: a town of CARLA has no true ones. Open the file in a
        plane coordinate system of metres. The same map gives the same bytes. Returns the path.
        """
        target = path_of(path)
        areas: dict[Area, MultiPolygon] = {
            "drivable": self.polygons("drivable"),
            "sidewalk": self.polygons("sidewalk"),
        }
        write_bytes(target, geojson_of(self.town, areas))
        return target


def classes_of(counts: NDArray[np.uint16]) -> ByteArray:
    """Return the classes (…), uint8, of cells by the pictures (4, …) of each of `GROUND_CLASSES`.

    It is 0 without any picture. A tie between the road's surface and other ground is no road; one
    between road and line is road, and one between sidewalk and other is sidewalk.
    """
    surface, total = _surface_and_total(counts)
    road, line, sidewalk, other = counts
    on_road = np.where(line > road, np.uint8(_ROAD_LINE), np.uint8(_ROAD))
    beside = np.where(sidewalk >= np.maximum(other, 1), np.uint8(_SIDEWALK), np.uint8(_OTHER))
    ground = np.where(2 * surface > total, on_road, beside)
    return np.where(total == 0, np.uint8(0), ground)


def _surface_and_total(counts: NDArray[np.uint16]) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return how many pictures saw the road's surface, lines included, and how many saw ground."""
    surface = counts[:_ROAD_LINE].sum(axis=0, dtype=np.uint32)
    total = counts.sum(axis=0, dtype=np.uint32)
    return surface, total


def simplified_polygons(
    polygons: MultiPolygon, tolerance: float, least_area: float
) -> MultiPolygon:
    """Return polygons with outlines moved by at most `tolerance` metres.

    Islands and holes under `least_area` square metres are left out.
    """
    import shapely

    parts = shapely.get_parts(polygons)
    large_parts = parts[shapely.area(parts) >= least_area]
    islands = [_fill_holes(part, least_area) for part in large_parts]
    if not tolerance:
        return multi_polygon(islands)
    simplified = shapely.simplify(shapely.MultiPolygon(islands), tolerance)
    # Parts are taken twice, as collections may hold several.
    parts = shapely.get_parts(shapely.get_parts(shapely.make_valid(simplified)))
    return multi_polygon([part for part in parts if part.geom_type == "Polygon"])


def geojson_of(town: str, areas: Mapping[Area, MultiPolygon]) -> bytes:
    """Return a FeatureCollection with a feature for each polygon; coordinates have 3 decimals."""
    features = []
    for area, polygons in areas.items():
        for part in polygons.geoms:
            properties = {"town": town, "area": area, "square_metres": round(part.area, 1)}
            geometry = {"type": "Polygon", "coordinates": _rings(part)}
            feature = {"type": "Feature", "properties": properties, "geometry": geometry}
            features.append(feature)
    collection = {
        "type": "FeatureCollection",
        "name": town,
        "coordinate_system": (
            "local metres of the simulator's world, x and y, right-handed; no longitude and "
            "latitude"
        ),
        "features": features,
    }
    return (json.dumps(collection, allow_nan=False, separators=(",", ":")) + "\n").encode()


def _fill_holes(polygon: Polygon, least_area: float) -> Polygon:
    """Return a polygon without its holes under `least_area` square metres."""
    import shapely

    holes = [ring for ring in polygon.interiors if shapely.Polygon(ring).area >= least_area]
    return shapely.Polygon(polygon.exterior, holes)


def _rings(polygon: Polygon) -> list[list[list[float]]]:
    rings = []
    for ring in (polygon.exterior, *polygon.interiors):
        rings.append(np.round(np.asarray(ring.coords), _DECIMALS).tolist())
    return rings
