"""`TownMap`: a town's ground as a raster of counts, with its classes, its drivable area and its outlines."""

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
# Of metres in GeoJSON.
_DECIMALS: Final = 3
_ROAD, _ROAD_LINE, _SIDEWALK, _OTHER = range(1, len(GROUND_CLASSES) + 1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TownMap(FrozenArrays):
    """What the BEV cameras of a town's recordings saw as its ground; world, right-handed, metres; arrays are read-only.

    Rasters are (H, W): row = y index, column = x index, both rising. The middle of cell (i, j) is at
    x = origin[0] + (j + 0.5) · resolution, y = origin[1] + (i + 0.5) · resolution.

    A picture says nothing of a cell that a vehicle or a pedestrian hides, and is not counted there. Where actors stayed
    all the time, `hidden` has the class of the ground around them. Seen from above, a bridge hides what is beneath it.

    Attributes:
        town: its name.
        resolution: side of a cell.
        origin: (2,) float64 x and y of the raster's corner where both are least.
        counts: (4, H, W) uint16, pictures that saw each of `GROUND_CLASSES` at the cell's middle.
        agents: (H, W) uint16, recordings (an agent in a scenario) that saw the ground there.
        hidden: (H, W) uint8, of small holes that no picture saw the class of the cells around, 1 + the position in
            `GROUND_CLASSES`; 0 elsewhere.
        scenarios: recorded in the town, and looked through.
        looks: pictures that were read.
        missing: pictures that should have been read, and whose files are not there.
        damaged: pictures whose files cannot be read.
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
        """Rows and columns, (H, W)."""
        rows, columns = self.agents.shape
        return rows, columns

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Least and greatest x, least and greatest y, metres: what matplotlib's `imshow(origin="lower")` takes."""
        low, high = (
            self.origin.tolist(),
            (self.origin + np.array(self.shape[::-1]) * self.resolution).tolist(),
        )
        return low[0], high[0], low[1], high[1]

    def seen(self) -> BoolArray:
        """(H, W), whether any picture saw the ground of a cell."""
        return np.asarray(self.agents > 0)

    def drivable(self) -> BoolArray:
        """(H, W), cells that more than half of the pictures saw as road or road line, and hidden ones amid these."""
        surface, every = _surface_and_all(self.counts)
        return np.asarray((2 * surface > every) | (self.hidden == _ROAD))

    def classes(self) -> ByteArray:
        """(H, W) uint8, 0 where nothing is known, else 1 + the position in `GROUND_CLASSES`.

        Drivable cells are road or road line, whichever more pictures saw; the others sidewalk or something else.
        """
        return np.maximum(classes_of(self.counts), self.hidden)

    def classes_at(self, points: ArrayLike) -> ByteArray:
        """The classes (N,) at points (N, 2), x and y in world, as `classes` gives them; 0 beyond the raster.

        Raises:
            GeometryError: the points have another shape, or are no numbers.
        """
        xy = checked("points", as_floats(points), (None, 2))
        column, row = np.floor((xy - self.origin) / self.resolution).T
        rows, columns = self.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        result = np.zeros(len(xy), dtype=np.uint8)
        cells = row[inside].astype(np.int64), column[inside].astype(np.int64)
        result[inside] = np.maximum(
            classes_of(self.counts[(slice(None), *cells)]), self.hidden[cells]
        )
        return result

    def around(self, center: ArrayLike, reach: float) -> TownMap:
        """The part of the map that lies within a square; all of its cells that the square touches.

        Args:
            center: (2,) x and y of the square's middle, world, metres.
            reach: metres from there to each side.

        Raises:
            GeometryError: the centre is no two numbers.
        """
        middle = checked("center", as_floats(center), (2,)) - self.origin
        limits = np.array(self.shape[::-1])
        low = np.floor((middle - reach) / self.resolution).clip(0, limits).astype(np.int64)
        high = np.ceil((middle + reach) / self.resolution).clip(low, limits).astype(np.int64)
        (column, row), (last_column, last_row) = low.tolist(), high.tolist()
        rows, columns = slice(row, last_row), slice(column, last_column)
        return replace(
            self,
            origin=self.origin + low * self.resolution,
            counts=self.counts[:, rows, columns],
            agents=self.agents[rows, columns],
            hidden=self.hidden[rows, columns],
        )

    def area(self, of: Area = "drivable") -> BoolArray:
        """(H, W), the cells of an area: `drivable` (road and road line), `road_line` or `sidewalk`.

        Raises:
            ChoiceError: no such area.
        """
        of = choice("of", of, AREAS)
        return (
            self.drivable()
            if of == "drivable"
            else np.asarray(self.classes() == 1 + GROUND_CLASSES.index(of))
        )

    def polygons(
        self, of: Area = "drivable", *, tolerance: float | None = None, least_area: float = 1.0
    ) -> MultiPolygon:
        """The outline of an area as shapely's polygons, x and y in world, metres; outer rings run counter-clockwise.

        Args:
            of: `drivable` (road and road line), `road_line` or `sidewalk`.
            tolerance: how far the outline may be from that of the cells, metres; None for the side of a cell, which
                turns steps into straight lines. 0 keeps the cells' own outline.
            least_area: smaller islands and holes are left out, square metres.

        Raises:
            ChoiceError: no such area.
        """
        exact = outlines(self.area(of), self.origin, self.resolution)
        return simplified_polygons(
            exact, self.resolution if tolerance is None else tolerance, least_area
        )

    def to_geojson(self, path: str | os.PathLike[str]) -> Path:
        """Write the drivable area and the sidewalks as GeoJSON, a feature for each polygon; returns the path.

        Coordinates are x and y of the simulator's world, metres, right-handed, and no longitude and latitude, which RFC
        7946 asks for: a town of CARLA has none that are true. Open the file in a plane coordinate system of metres.
        The same map gives the same bytes.
        """
        target = path_of(path)
        write_bytes(
            target,
            geojson_of(self.town, {area: self.polygons(area) for area in ("drivable", "sidewalk")}),
        )
        return target


def classes_of(counts: NDArray[np.uint16]) -> ByteArray:
    """The classes (…) uint8 of cells, by the pictures (4, …) that saw each of `GROUND_CLASSES` there; 0 for no picture.

    A tie between the road's surface and the rest is no road; one between road and line is road, and one between
    sidewalk and something else is sidewalk.
    """
    surface, every = _surface_and_all(counts)
    road, line, sidewalk, other = counts
    on_road = np.where(line > road, np.uint8(_ROAD_LINE), np.uint8(_ROAD))
    beside = np.where(sidewalk >= np.maximum(other, 1), np.uint8(_SIDEWALK), np.uint8(_OTHER))
    return np.where(every == 0, np.uint8(0), np.where(2 * surface > every, on_road, beside))


def _surface_and_all(counts: NDArray[np.uint16]) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """How many pictures saw the road's surface, lines included, and how many saw anything."""
    return counts[:_ROAD_LINE].sum(axis=0, dtype=np.uint32), counts.sum(axis=0, dtype=np.uint32)


def simplified_polygons(
    polygons: MultiPolygon, tolerance: float, least_area: float
) -> MultiPolygon:
    """Polygons whose outlines may move by `tolerance` metres, without smaller islands and holes, square metres."""
    import shapely

    parts = shapely.get_parts(polygons)
    kept = [_without_holes(part, least_area) for part in parts[shapely.area(parts) >= least_area]]
    if not tolerance:
        return multi_polygon(kept)
    whole = shapely.simplify(shapely.MultiPolygon(kept), tolerance)
    parts = shapely.get_parts(
        shapely.get_parts(shapely.make_valid(whole))
    )  # twice, as collections may hold several
    return multi_polygon([part for part in parts if part.geom_type == "Polygon"])


def geojson_of(town: str, areas: Mapping[Area, MultiPolygon]) -> bytes:
    """A FeatureCollection with one feature for each polygon of each area; coordinates have three decimals."""
    collection = {
        "type": "FeatureCollection",
        "name": town,
        "coordinate_system": "local metres of the simulator's world, x and y, right-handed; no longitude and latitude",
        "features": [
            {
                "type": "Feature",
                "properties": {"town": town, "area": area, "square_metres": round(part.area, 1)},
                "geometry": {"type": "Polygon", "coordinates": _rings(part)},
            }
            for area, polygons in areas.items()
            for part in polygons.geoms
        ],
    }
    return (json.dumps(collection, allow_nan=False, separators=(",", ":")) + "\n").encode()


def _without_holes(polygon: Polygon, least_area: float) -> Polygon:
    import shapely

    holes = [ring for ring in polygon.interiors if shapely.Polygon(ring).area >= least_area]
    return shapely.Polygon(polygon.exterior, holes)


def _rings(polygon: Polygon) -> list[list[list[float]]]:
    return [
        np.round(np.asarray(ring.coords), _DECIMALS).tolist()
        for ring in (polygon.exterior, *polygon.interiors)
    ]
