"""A map's classes, places and parts."""

import pickle

import numpy as np
import pytest

from deepaccident_devkit.errors import ChoiceError, GeometryError
from deepaccident_devkit.maps import TownMap
from deepaccident_devkit.maps.town_map import classes_of


def tiny() -> TownMap:
    """3 × 4 cells of 0.5 m with their corner at (10, −20): road, line, sidewalk and something else, then one each."""
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
    points = [[10.0, -20.0], [10.49, -19.51], [10.5, -20.0], [11.99, -18.51], [10.6, -18.9], [11.99, -19.99]]
    assert tiny().classes_at(points).tolist() == [1, 1, 2, 0, 1, 4]
    assert tiny().classes_at([[9.99, -20], [12.0, -20], [10, -20.01], [10, -18.5], [np.nan, 0]]).tolist() == [0] * 5
    with pytest.raises(GeometryError, match="points: expected shape"):
        tiny().classes_at([1.0, 2.0])


def test_a_part_has_the_cells_of_its_place() -> None:
    town = tiny()
    part = town.around((11.0, -19.0), 0.3)
    assert part.shape == (2, 2)
    assert part.origin.tolist() == [10.5, -19.5]
    assert part.classes().tolist() == [[3, 3], [1, 3]]
    assert part.extent == (10.5, 11.5, -19.5, -18.5)
    narrow = town.around((11.3, -19.4), 0.15)
    assert (narrow.shape, narrow.origin.tolist(), narrow.classes().tolist()) == ((2, 1), [11.0, -20.0], [[3], [3]])
    assert town.around((11, -19), 50).extent == town.extent == (10.0, 12.0, -20.0, -18.5)
    assert town.around((100, 100), 5).agents.size == 0


def test_arrays_are_read_only_also_in_copies() -> None:
    for each in (tiny(), pickle.loads(pickle.dumps(tiny()))):
        with pytest.raises(ValueError, match="read-only"):
            each.agents[0, 0] = 1
    assert len(repr(tiny())) < 200
    assert repr(tiny()).startswith("TownMap(town='Town01', resolution=0.5, ")


def test_an_area_that_is_none() -> None:
    with pytest.raises(ChoiceError, match="of: expected one of drivable, road_line, sidewalk, found 'grass'"):
        tiny().polygons("grass")  # type: ignore[arg-type]
