"""Outlines of cells."""

import json

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from deepaccident_devkit.geometry.cell_outlines import outlines
from deepaccident_devkit.maps import TownMap
from deepaccident_devkit.maps.town_map import geojson_of, simplified

ORIGIN = np.array([-12.5, 7.25])
masks = st.tuples(st.integers(1, 12), st.integers(1, 12)).flatmap(lambda shape: arrays(np.bool_, shape))


@given(masks)
def test_an_outline_holds_its_cells_and_no_others(mask: np.ndarray) -> None:
    polygons = outlines(mask, ORIGIN, 0.25)
    assert polygons.is_valid
    assert polygons.area == pytest.approx(mask.sum() * 0.0625, abs=1e-12)
    rows, columns = np.indices(mask.shape)
    x, y = ORIGIN[0] + (columns + 0.5) * 0.25, ORIGIN[1] + (rows + 0.5) * 0.25
    np.testing.assert_array_equal(shapely.contains_xy(polygons, x, y), mask)
    assert simplified(polygons, 0, 0).equals_exact(polygons, 0)


@given(masks)
def test_outer_rings_run_counter_clockwise_and_simple_outlines_are_valid(mask: np.ndarray) -> None:
    for polygons in (outlines(mask, ORIGIN, 0.25), simplified(outlines(mask, ORIGIN, 0.25), 0.25, 0.0625)):
        assert polygons.is_valid
        for part in polygons.geoms:
            assert part.exterior.is_ccw
            assert not any(ring.is_ccw for ring in part.interiors)


def test_small_islands_and_holes_go() -> None:
    mask = np.zeros((40, 40), np.bool_)
    mask[2:30, 2:30] = True
    mask[5:7, 5:7] = False  # 0.25 m²
    mask[10:16, 10:16] = False  # 2.25 m²
    mask[35:37, 35:37] = True
    kept = simplified(outlines(mask, ORIGIN, 0.25), 0, 1.0)
    assert len(kept.geoms) == 1
    assert [shapely.Polygon(ring).area for ring in kept.geoms[0].interiors] == [2.25]
    everything = simplified(outlines(mask, ORIGIN, 0.25), 0, 0.25)
    assert (len(everything.geoms), len(everything.geoms[0].interiors)) == (2, 2)


def test_steps_of_a_slanting_edge_become_a_line() -> None:
    rows, columns = np.indices((80, 80))
    mask = (np.abs(columns - rows) < 20) & (rows > 2) & (rows < 77)
    exact = outlines(mask, ORIGIN, 0.25)
    straight = simplified(exact, 0.25, 1.0)
    assert len(straight.geoms[0].exterior.coords) < 12 < len(exact.geoms[0].exterior.coords)
    assert straight.hausdorff_distance(exact) <= 0.25


def test_nothing_has_no_polygon() -> None:
    empty = outlines(np.zeros((3, 3), np.bool_), ORIGIN, 0.25)
    assert len(empty.geoms) == len(simplified(empty, 0.25, 1.0).geoms) == 0
    assert json.loads(geojson_of("Town01", {"drivable": empty}))["features"] == []


def test_the_polygons_of_a_map_are_its_raster(mapped: TownMap) -> None:
    for area in ("drivable", "sidewalk", "road_line"):
        cells = mapped.area(area)
        exact = mapped.polygons(area, tolerance=0, least_area=0)
        assert exact.area == pytest.approx(cells.sum() * mapped.resolution**2)
        assert exact.area > 0
        rows, columns = np.indices(mapped.shape)[:, ::7, ::7]
        x, y = (mapped.origin[:, None, None] + (np.stack([columns, rows]) + 0.5) * mapped.resolution).astype(float)
        np.testing.assert_array_equal(shapely.contains_xy(exact, x, y), cells[::7, ::7])
    simple = mapped.polygons()
    exact = mapped.polygons(tolerance=0, least_area=0)
    assert simple.symmetric_difference(exact).area < 0.03 * exact.area


def test_geojson_is_read_back_as_the_same_polygons(mapped: TownMap, tmp_path) -> None:
    path = mapped.to_geojson(tmp_path / "deep" / "town.geojson")
    told = json.loads(path.read_text(encoding="utf-8"))
    assert told["type"] == "FeatureCollection"
    assert "local metres" in told["coordinate_system"]
    assert {each["properties"]["area"] for each in told["features"]} == {"drivable", "sidewalk"}
    for area in ("drivable", "sidewalk"):
        read = shapely.MultiPolygon(
            [
                shapely.geometry.shape(each["geometry"])
                for each in told["features"]
                if each["properties"]["area"] == area
            ]
        )
        assert read.symmetric_difference(mapped.polygons(area)).area < 1.0
    assert {each["properties"]["town"] for each in told["features"]} == {mapped.town}
    content = path.read_bytes()
    assert mapped.to_geojson(path).read_bytes() == content
