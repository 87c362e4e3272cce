"""A map's classes, places and parts."""

import json
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ChoiceError, GeometryError
from deepaccident_devkit.geometry.cell_outlines import outlines
from deepaccident_devkit.maps import TownMap
from deepaccident_devkit.maps.town_map import classes_of, simplified_polygons


def make_tiny_map() -> TownMap:
    """Make a map of 3 × 4 cells of 0.5 m with its corner at (10, −20).

    The cells of the first row are road, road line, sidewalk and something else.
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
    assert make_tiny_map().classes().tolist() == [[1, 2, 3, 4], [1, 3, 3, 2], [0, 1, 3, 0]]
    assert classes_of(np.array([0, 0, 0, 0], np.uint16)) == 0
    assert make_tiny_map().seen().tolist() == [[True] * 4, [True] * 4, [False] * 4]


def test_drivable_needs_more_than_half_and_as_many_looks_as_asked_for() -> None:
    town = make_tiny_map()
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
    assert make_tiny_map().classes_at(points + outside).tolist() == [1, 1, 2, 0, 1, 4] + [0] * 5


def test_a_part_has_the_cells_of_its_place() -> None:
    town = make_tiny_map()
    part = town.around((11.0, -19.0), 0.3)
    assert part.classes().tolist() == [[3, 3], [1, 3]]
    assert part.extent == (10.5, 11.5, -19.5, -18.5)
    assert part.origin.tolist() == [10.5, -19.5]

    narrow_part = town.around((11.3, -19.4), 0.15)
    assert narrow_part.origin.tolist() == [11.0, -20.0]
    assert narrow_part.classes().tolist() == [[3], [3]]

    assert town.around((11, -19), 50).extent == town.extent == (10.0, 12.0, -20.0, -18.5)
    assert town.around((100, 100), 5).agents.size == 0


def test_what_does_not_fit_is_refused() -> None:
    assert_raises(
        (
            lambda: make_tiny_map().polygons("grass"),
            ChoiceError,
            ("area", "drivable, road_line, sidewalk", "'grass'"),
        ),  # type: ignore[arg-type]
        (lambda: make_tiny_map().classes_at([1.0, 2.0]), GeometryError, ("points", "shape")),
    )


ORIGIN_M = np.array([-12.5, 7.25])
masks = st.tuples(st.integers(1, 12), st.integers(1, 12)).flatmap(
    lambda shape: arrays(np.bool_, shape)
)


@given(masks)
def test_an_outline_holds_its_cells_and_no_others(mask: np.ndarray) -> None:
    polygons = outlines(mask, ORIGIN_M, 0.25)
    assert polygons.is_valid
    assert polygons.area == pytest.approx(mask.sum() * 0.0625, abs=1e-12)
    rows, columns = np.indices(mask.shape)
    x = ORIGIN_M[0] + (columns + 0.5) * 0.25
    y = ORIGIN_M[1] + (rows + 0.5) * 0.25
    np.testing.assert_array_equal(shapely.contains_xy(polygons, x, y), mask)

    assert simplified_polygons(polygons, 0, 0).equals_exact(polygons, 0)
    for shape in (polygons, simplified_polygons(polygons, 0.25, 0.0625)):
        assert shape.is_valid
        for polygon in shape.geoms:
            assert polygon.exterior.is_ccw
            assert not any(ring.is_ccw for ring in polygon.interiors)


def test_small_islands_and_holes_go() -> None:
    mask = np.zeros((40, 40), np.bool_)
    mask[2:30, 2:30] = True
    mask[35:37, 35:37] = True
    mask[5:7, 5:7] = False  # 0.25 m²
    mask[10:16, 10:16] = False  # 2.25 m²
    polygons = outlines(mask, ORIGIN_M, 0.25)

    (large_polygon,) = simplified_polygons(polygons, 0, 1.0).geoms
    assert [shapely.Polygon(ring).area for ring in large_polygon.interiors] == [2.25]

    all_polygons = simplified_polygons(polygons, 0, 0.25).geoms
    assert len(all_polygons) == 2
    assert len(all_polygons[0].interiors) == 2


def test_steps_of_a_slanting_edge_become_a_line() -> None:
    rows, columns = np.indices((80, 80))
    is_in_band = (np.abs(columns - rows) < 20) & (rows > 2) & (rows < 77)
    exact = outlines(is_in_band, ORIGIN_M, 0.25)
    straight = simplified_polygons(exact, 0.25, 1.0)
    assert len(straight.geoms[0].exterior.coords) < 12 < len(exact.geoms[0].exterior.coords)
    assert straight.hausdorff_distance(exact) <= 0.25


def test_the_polygons_of_a_map_are_its_raster(mapped_town: TownMap) -> None:
    rows, columns = np.indices(mapped_town.shape)[:, ::7, ::7].astype(float)
    x = mapped_town.origin[0] + (columns + 0.5) * mapped_town.resolution
    y = mapped_town.origin[1] + (rows + 0.5) * mapped_town.resolution
    for area in ("drivable", "sidewalk", "road_line"):
        cells = mapped_town.area(area)
        exact = mapped_town.polygons(area, tolerance=0, least_area=0)
        assert exact.area == pytest.approx(cells.sum() * mapped_town.resolution**2)
        assert exact.area > 0
        np.testing.assert_array_equal(shapely.contains_xy(exact, x, y), cells[::7, ::7])

    simple = mapped_town.polygons()
    exact = mapped_town.polygons(tolerance=0, least_area=0)
    assert simple.symmetric_difference(exact).area < 0.03 * exact.area


def test_geojson_is_read_back_as_the_same_polygons(mapped_town: TownMap, tmp_path: Path) -> None:
    path = mapped_town.to_geojson(tmp_path / "deep" / "town.geojson")
    polygons_by_area = defaultdict(list)
    for feature in json.loads(path.read_text(encoding="utf-8"))["features"]:
        assert feature["properties"]["town"] == mapped_town.town
        area = feature["properties"]["area"]
        polygons_by_area[area].append(shapely.geometry.shape(feature["geometry"]))

    assert polygons_by_area.keys() == {"drivable", "sidewalk"}
    for area, polygons in polygons_by_area.items():
        read_polygons = shapely.MultiPolygon(polygons)
        assert read_polygons.symmetric_difference(mapped_town.polygons(area)).area < 1.0
