"""`TownMap`: a town's ground as a raster of counts, with classes, drivable area and outlines."""

from __future__ import annotations

import json
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
from deepaccident_devkit.support.text import PathType, choice, path_of

if TYPE_CHECKING:
    from shapely import MultiPolygon, Polygon

Area = Literal["drivable", "road_line", "sidewalk"]
AREAS: Final[tuple[Area, ...]] = get_args(Area)
# Decimals of metres in GeoJSON.
_DECIMALS = 3
_ROAD, _ROAD_LINE, _SIDEWALK, _OTHER = range(1, len(GROUND_CLASSES) + 1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TownMap(FrozenArrays):
    """A town's ground as the BEV cameras of its recordings saw it.

    Coordinates are in world, right-handed, metres; arrays are read-only. Rasters have shape (H, W):
    rows run along y and columns along x, both ascending. The centre of cell (i, j) is at
    x = origin[0] + (j + 0.5) · resolution, y = origin[1] + (i + 0.5) · resolution.

    A picture does not count for cells that a vehicle or a pedestrian hides in it. Where actors
    never moved, `hidden` has the class of the ground around them. A bridge hides the ground under
    it.

    Attributes:
        town: Name of the town.
        resolution: Side of a cell.
        origin: Lowest x and y of the raster, shape (2,), float64.
        counts: Number of pictures that show each of `GROUND_CLASSES` at the cell's centre, shape
            (4, H, W), uint16.
        agents: Number of recordings (an agent in a scenario) that show the ground of the cell,
            shape (H, W), uint16.
        hidden: In small holes that no picture shows, the class of the cells around them: 1 + the
            index in `GROUND_CLASSES`, shape (H, W), uint8; 0 elsewhere.
        scenarios: Number of the town's scenarios that were used.
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
        rows, columns = self.shape
        size = np.array([columns, rows]) * self.resolution
        low_x, low_y = self.origin.tolist()
        high_x, high_y = (self.origin + size).tolist()
        return low_x, high_x, low_y, high_y

    def seen(self) -> BoolArray:
        """Return whether any picture shows the ground of each cell, shape (H, W)."""
        return np.asarray(self.agents > 0)

    def drivable(self) -> BoolArray:
        """Return whether each cell is drivable, shape (H, W).

        A cell is drivable if more than half of its pictures show it as road or road line, or if it
        is hidden and surrounded by such cells.
        """
        surface, total = _surface_and_total(self.counts)
        is_surface = 2 * surface > total
        is_hidden_road = self.hidden == _ROAD
        return np.asarray(is_surface | is_hidden_road)

    def classes(self) -> ByteArray:
        """Return the classes of cells, shape (H, W), uint8.

        A class is 0 if unknown, otherwise 1 + the index in `GROUND_CLASSES`. Drivable cells are
        road or road line, whichever more pictures show; all others are sidewalk or other.
        """
        seen_classes = classes_of(self.counts)
        return np.maximum(seen_classes, self.hidden)

    def classes_at(self, points: ArrayLike) -> ByteArray:
        """Return the classes (N,) at points, as in `classes`; 0 beyond the raster.

        Args:
            points: x and y in world, shape (N, 2), metres.

        Raises:
            GeometryError: The points have another shape, or are not numbers.
        """
        xy = checked("points", as_floats(points), (None, 2))
        cells = np.floor((xy - self.origin) / self.resolution)
        shape = self.shape[::-1]
        in_raster = ((cells >= 0) & (cells < shape)).all(axis=1)
        column, row = cells[in_raster].astype(np.int64).T
        seen_classes = classes_of(self.counts[:, row, column])
        classes = np.zeros(len(xy), dtype=np.uint8)
        classes[in_raster] = np.maximum(seen_classes, self.hidden[row, column])
        return classes

    def around(self, center: ArrayLike, reach: float) -> TownMap:
        """Return the part of the map that consists of all cells touched by a square.

        Args:
            center: x and y of the square's centre in world, shape (2,), metres.
            reach: Half the side of the square, metres.

        Raises:
            GeometryError: The centre is not a pair of numbers.
        """
        middle = checked("center", as_floats(center), (2,)) - self.origin
        limits = np.array(self.shape[::-1])
        low_cell = np.floor((middle - reach) / self.resolution)
        high_cell = np.ceil((middle + reach) / self.resolution)
        low = low_cell.clip(0, limits).astype(np.int64)
        high = high_cell.clip(low, limits).astype(np.int64)
        columns, rows = map(slice, low, high)
        return replace(
            self,
            origin=self.origin + low * self.resolution,
            counts=self.counts[:, rows, columns],
            agents=self.agents[rows, columns],
            hidden=self.hidden[rows, columns],
        )

    def area(self, area: Area = "drivable") -> BoolArray:
        """Return whether each cell belongs to an area, shape (H, W).

        Areas are `drivable` (road and road line), `road_line` and `sidewalk`.

        Raises:
            ChoiceError: The area is unknown.
        """
        area = choice("area", area, AREAS)
        if area == "drivable":
            return self.drivable()
        code = 1 + GROUND_CLASSES.index(area)
        return np.asarray(self.classes() == code)

    def polygons(
        self, area: Area = "drivable", *, tolerance: float | None = None, least_area: float = 1.0
    ) -> MultiPolygon:
        """Return the outline of an area as polygons of shapely, x and y in world, metres.

        Outer rings run counter-clockwise.

        Args:
            area: `drivable` (road and road line), `road_line` or `sidewalk`.
            tolerance: Largest distance of the result from the outline of the cells, metres. None
                means the side of a cell, which turns steps into straight lines; 0 keeps the cells'
                outline.
            least_area: Area of the smallest islands and holes to keep, square metres.

        Raises:
            ChoiceError: The area is unknown.
        """
        cell_outlines = outlines(self.area(area), self.origin, self.resolution)
        if tolerance is None:
            tolerance = self.resolution
        return simplified_polygons(cell_outlines, tolerance, least_area)

    def to_geojson(self, path: PathType) -> Path:
        """Write the drivable area and the sidewalks as GeoJSON, a feature for each polygon.

        Coordinates are x and y in the simulator's world, right-handed, in metres. They are not
        longitude and latitude, as RFC 7946 requires, because CARLA's towns have none. Open the file
        in a planar coordinate system in metres. The same map gives the same bytes. Returns the
        path.
        """
        target = path_of(path)
        areas: dict[Area, MultiPolygon] = {
            "drivable": self.polygons("drivable"),
            "sidewalk": self.polygons("sidewalk"),
        }
        write_bytes(target, geojson_of(self.town, areas))
        return target


def classes_of(counts: NDArray[np.uint16]) -> ByteArray:
    """Return the class that most pictures show in each cell, shape (…), uint8.

    A class is 1 + the index in `GROUND_CLASSES`, or 0 if no picture shows the cell. If road surface
    and other ground are tied, the cell is not road; if road and line are tied, it is road; if
    sidewalk and other are tied, it is sidewalk.

    Args:
        counts: Number of pictures that show each of `GROUND_CLASSES` in the cell, shape (4, …).
    """
    surface, total = _surface_and_total(counts)
    road, line, sidewalk, other = counts
    classes = np.full(total.shape, _OTHER, dtype=np.uint8)
    classes[sidewalk >= np.maximum(other, 1)] = _SIDEWALK
    is_surface = 2 * surface > total
    classes[is_surface] = _ROAD
    classes[is_surface & (line > road)] = _ROAD_LINE
    classes[total == 0] = 0
    return classes


def _surface_and_total(counts: NDArray[np.uint16]) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return how many pictures show road surface, and how many show any ground, in each cell.

    The road surface includes lines: it is the first two of `GROUND_CLASSES`. Both arrays have the
    shape of the cells.
    """
    surface = counts[:2].sum(axis=0, dtype=np.uint32)
    total = counts.sum(axis=0, dtype=np.uint32)
    return surface, total


def simplified_polygons(
    polygons: MultiPolygon, tolerance: float, least_area: float
) -> MultiPolygon:
    """Simplify the outlines of polygons, which move by at most `tolerance` metres.

    Islands and holes under `least_area` square metres are left out.
    """
    import shapely

    parts = shapely.get_parts(polygons)
    large_parts = parts[shapely.area(parts) >= least_area]
    islands = [_fill_holes(part, least_area) for part in large_parts]
    if not tolerance:
        return multi_polygon(islands)
    simplified = shapely.simplify(shapely.MultiPolygon(islands), tolerance)
    # Parts are taken twice, because collections may contain collections.
    parts = shapely.get_parts(shapely.get_parts(shapely.make_valid(simplified)))
    return multi_polygon([part for part in parts if part.geom_type == "Polygon"])


def geojson_of(town: str, areas: Mapping[Area, MultiPolygon]) -> bytes:
    """Return a FeatureCollection as JSON, with a feature for each polygon.

    Coordinates have 3 decimals.
    """
    features = []
    for area, polygons in areas.items():
        for polygon in polygons.geoms:
            properties = {"town": town, "area": area, "square_metres": round(polygon.area, 1)}
            geometry = {"type": "Polygon", "coordinates": _ring_coordinates(polygon)}
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
    text = json.dumps(collection, allow_nan=False, separators=(",", ":"))
    return f"{text}\n".encode()


def _fill_holes(polygon: Polygon, least_area: float) -> Polygon:
    """Return a polygon without its holes under `least_area` square metres."""
    import shapely

    large_holes = [ring for ring in polygon.interiors if shapely.Polygon(ring).area >= least_area]
    return shapely.Polygon(polygon.exterior, large_holes)


def _ring_coordinates(polygon: Polygon) -> list[list[list[float]]]:
    """Return the coordinates of the outer ring and of the holes, rounded."""
    rings = []
    for ring in (polygon.exterior, *polygon.interiors):
        rounded = np.round(np.asarray(ring.coords), _DECIMALS)
        rings.append(rounded.tolist())
    return rings
