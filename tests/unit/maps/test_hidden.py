"""The ground beneath actors that stayed."""

import numpy as np
import pytest

from deepaccident_devkit.maps.counting import hidden_ground


@pytest.fixture
def street() -> np.ndarray:
    """A street of 20 × 40 cells with a sidewalk of 8 more rows; cells of 1 m."""
    classes = np.full((28, 40), 1, np.uint8)
    classes[20:] = 3
    return classes


def test_a_hole_is_what_lies_around_it(street: np.ndarray) -> None:
    street[4:6, 10:15] = 0
    street[22:24, 10:15] = 0
    filled = hidden_ground(street, 1.0)
    assert (filled[4:6, 10:15] == 1).all()
    assert (filled[22:24, 10:15] == 3).all()
    assert filled.sum() == 10 + 30


def test_road_lines_are_taken_for_road(street: np.ndarray) -> None:
    street[3:7, 9:16] = 2
    street[4:6, 10:15] = 0
    assert (hidden_ground(street, 1.0)[4:6, 10:15] == 1).all()


def test_a_hole_between_two_kinds_is_what_has_more_of_its_edge(street: np.ndarray) -> None:
    street[18:21, 5:9] = 0  # of its 14 neighbours 4 + 2 · 2 are road
    street[19:23, 20:24] = 0
    filled = hidden_ground(street, 1.0)
    assert set(filled[18:21, 5:9].ravel()) == {1}
    assert set(filled[19:23, 20:24].ravel()) == {3}


def test_large_holes_and_those_at_the_edge_stay(street: np.ndarray) -> None:
    street[2:10, 2:10] = 0  # 64 m²
    street[0:2, 20:22] = 0
    street[12:14, 0] = street[12:14, -1] = street[-1, 7] = 0
    assert not hidden_ground(street, 1.0).any()
    assert (hidden_ground(street, 0.9) > 0).sum() == 64


def test_nothing_seen_and_all_seen() -> None:
    assert not hidden_ground(np.zeros((5, 5), np.uint8), 1.0).any()
    assert not hidden_ground(np.full((5, 5), 2, np.uint8), 1.0).any()
