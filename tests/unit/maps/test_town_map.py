"""A map's classes, places and parts."""

import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from refusals import assert_refused

from deepaccident_devkit.errors import ChoiceError, GeometryError
from deepaccident_devkit.geometry.cell_outlines import outlines
from deepaccident_devkit.maps import TownMap
from deepaccident_devkit.maps.town_map import classes_of, simplified_polygons


def tiny() -> TownMap:
    """3 × 4 cells of 0.5 m with their corner at (10, −20): road, line, sidewalk and something else,
    then one each.
    """
    counts = np.zeros((4, 3, 4), np.uint16)
    counts[[0, 1, 2, 3], 0, [0, 1, 2, 3]] = 5
    counts[:, 1, 0] = 3, 3, 4, 1
    counts[:, 1, 1] = 2, 2, 4, 0
    counts[:, 1, 2] = 0, 0, 2, 2
    counts[:, 1, 3] = 60000, 60001, 50000, 60000
    agents = counts.any(axis=0).astype(np.uint16)
    hidden = np.zeros((3, 4), np.uint8)
    hidden[2, 1] = 1
    hidden[2, 2] = 3
    return TownMap(
        town="Town01",
        resolution=0.5,
        origin=np.array([10.0, -20.0]),
        counts=counts,
        agents=agents,
        hidden=hidden,
        scenarios=1,
        looks=5,
        missing=0,
        damaged=0,
    )


def test_classes_follow_the_majority() -> None:
    assert tiny().classes().tolist() == [[1, 2, 3, 4], [1, 3, 3, 2], [0, 1, 3, 0]]
    assert classes_of(np.array([0, 0, 0, 0], np.uint16)) == 0
    assert tiny().seen().tolist() == [[True] * 4, [True] * 4, [False] * 4]


def test_drivable_needs_more_than_half_and_as_many_looks_as_asked_for() -> None:
    town = tiny()
    road = [[True, True, False, False], [True, False, False, True], [False, True, False, False]]
    assert town.drivable().tolist() == road
    np.testing.assert_array_equal(town.drivable(), np.isin(town.classes(), (1, 2)))
    assert not (town.drivable() & town.seen())[2].any()
    assert town.area("road_line").sum() == town.area("sidewalk").sum() - 2 == 2


def test_classes_at_points() -> None:
    points = [
        [10.0, -20.0],
        [10.49, -19.51],
        [10.5, -20.0],
        [11.99, -18.51],
        [10.6, -18.9],
        [11.99, -19.99],
    ]
    outside = [[9.99, -20], [12.0, -20], [10, -20.01], [10, -18.5], [np.nan, 0]]
    assert tiny().classes_at(points + outside).tolist() == [1, 1, 2, 0, 1, 4] + [0] * 5


def test_a_part_has_the_cells_of_its_place() -> None:
    town = tiny()
    part, narrow = town.around((11.0, -19.0), 0.3), town.around((11.3, -19.4), 0.15)
    assert (part.classes().tolist(), part.extent) == ([[3, 3], [1, 3]], (10.5, 11.5, -19.5, -18.5))
    assert part.origin.tolist() == [10.5, -19.5]
    assert (narrow.origin.tolist(), narrow.classes().tolist()) == ([11.0, -20.0], [[3], [3]])
    assert town.around((11, -19), 50).extent == town.extent == (10.0, 12.0, -20.0, -18.5)
    assert town.around((100, 100), 5).agents.size == 0


def test_what_does_not_fit_is_refused() -> None:
    assert_refused(
        (
            lambda: tiny().polygons("grass"),
            ChoiceError,
            ("area", "drivable, road_line, sidewalk", "'grass'"),
        ),  # type: ignore[arg-type]
        (lambda: tiny().classes_at([1.0, 2.0]), GeometryError, ("points", "shape")),
    )


ORIGIN = np.array([-12.5, 7.25])
masks = st.tuples(st.integers(1, 12), st.integers(1, 12)).flatmap(
    lambda shape: arrays(np.bool_, shape)
)


@given(masks)
def test_an_outline_holds_its_cells_and_no_others(mask: np.ndarray) -> None:
    polygons = outlines(mask, ORIGIN, 0.25)
    assert polygons.is_valid
    assert polygons.area == pytest.approx(mask.sum() * 0.0625, abs=1e-12)
    rows, columns = np.indices(mask.shape)
    x, y = ORIGIN[0] + (columns + 0.5) * 0.25, ORIGIN[1] + (rows + 0.5) * 0.25
    np.testing.assert_array_equal(shapely.contains_xy(polygons, x, y), mask)
    assert simplified_polygons(polygons, 0, 0).equals_exact(polygons, 0)
    for each in (polygons, simplified_polygons(polygons, 0.25, 0.0625)):
        assert each.is_valid
        rings = [
            (part.exterior.is_ccw, any(ring.is_ccw for ring in part.interiors))
            for part in each.geoms
        ]
        assert rings == [(True, False)] * len(rings)


def test_small_islands_and_holes_go() -> None:
    mask = np.zeros((40, 40), np.bool_)
    mask[2:30, 2:30] = mask[35:37, 35:37] = True
    mask[5:7, 5:7] = mask[10:16, 10:16] = False  # 0.25 m² and 2.25 m²
    kept, everything = (
        simplified_polygons(outlines(mask, ORIGIN, 0.25), 0, least) for least in (1.0, 0.25)
    )
    (part,) = kept.geoms
    assert [shapely.Polygon(ring).area for ring in part.interiors] == [2.25]
    assert (len(everything.geoms), len(everything.geoms[0].interiors)) == (2, 2)


def test_steps_of_a_slanting_edge_become_a_line() -> None:
    rows, columns = np.indices((80, 80))
    exact = outlines((np.abs(columns - rows) < 20) & (rows > 2) & (rows < 77), ORIGIN, 0.25)
    straight = simplified_polygons(exact, 0.25, 1.0)
    assert len(straight.geoms[0].exterior.coords) < 12 < len(exact.geoms[0].exterior.coords)
    assert straight.hausdorff_distance(exact) <= 0.25


def test_the_polygons_of_a_map_are_its_raster(mapped: TownMap) -> None:
    rows, columns = np.indices(mapped.shape)[:, ::7, ::7]
    x, y = (
        mapped.origin[:, None, None] + (np.stack([columns, rows]) + 0.5) * mapped.resolution
    ).astype(float)
    for area in ("drivable", "sidewalk", "road_line"):
        cells, exact = mapped.area(area), mapped.polygons(area, tolerance=0, least_area=0)
        assert exact.area == pytest.approx(cells.sum() * mapped.resolution**2)
        assert exact.area > 0
        np.testing.assert_array_equal(shapely.contains_xy(exact, x, y), cells[::7, ::7])
    simple, exact = mapped.polygons(), mapped.polygons(tolerance=0, least_area=0)
    assert simple.symmetric_difference(exact).area < 0.03 * exact.area


def test_geojson_is_read_back_as_the_same_polygons(mapped: TownMap, tmp_path: Path) -> None:
    path = mapped.to_geojson(tmp_path / "deep" / "town.geojson")
    told = json.loads(path.read_text(encoding="utf-8"))
    properties = {
        (each["properties"]["town"], each["properties"]["area"]) for each in told["features"]
    }
    assert properties == {(mapped.town, "drivable"), (mapped.town, "sidewalk")}
    for area in ("drivable", "sidewalk"):
        parts = [
            each["geometry"] for each in told["features"] if each["properties"]["area"] == area
        ]
        read = shapely.MultiPolygon([shapely.geometry.shape(each) for each in parts])
        assert read.symmetric_difference(mapped.polygons(area)).area < 1.0
