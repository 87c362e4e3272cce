"""Post-encroachment time: by hand, and against a grid of times."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit.interactions import (
    conflict_area_pet,
    gaps_of_pairs,
    post_encroachment_time,
    time_to_collision,
)

EAST = np.array([-20.0, 0.0, 4.0, 2.0, 0.0])
NORTH = np.array([0.0, -40.0, 4.0, 2.0, math.pi / 2])
TEN_EAST, TEN_NORTH, STILL = np.array([10.0, 0.0]), np.array([0.0, 10.0]), np.zeros(2)


def test_one_crosses_two_seconds_after_the_other() -> None:
    # the first is on x −1..1 between 1.7 s and 2.3 s, the second on y −1..1 between 3.7 s and 4.3 s
    assert post_encroachment_time(EAST, NORTH, TEN_EAST, TEN_NORTH) == pytest.approx(1.4)
    assert post_encroachment_time(NORTH, EAST, TEN_NORTH, TEN_EAST) == pytest.approx(-1.4)
    assert conflict_area_pet(EAST, NORTH, TEN_EAST, TEN_NORTH) == pytest.approx(1.4)
    assert conflict_area_pet(NORTH, EAST, TEN_NORTH, TEN_EAST) == pytest.approx(1.4)


def test_the_window_ends_what_counts() -> None:
    assert post_encroachment_time(EAST, NORTH, TEN_EAST, TEN_NORTH, window=3.6) == math.inf
    assert post_encroachment_time(EAST, NORTH, TEN_EAST, TEN_NORTH, window=3.8) == pytest.approx(
        1.4
    )
    assert math.isnan(conflict_area_pet(EAST, NORTH, TEN_EAST, TEN_NORTH, window=3.6))


def test_who_stands_is_always_there() -> None:
    standing = np.array([0.0, 0.0, 4.0, 2.0, 0.3])
    assert post_encroachment_time(EAST, standing, TEN_EAST, STILL) == 0
    assert post_encroachment_time(standing, standing, STILL, STILL) == 0
    aside = np.array([0.0, 9.0, 4.0, 2.0, 0.3])
    assert post_encroachment_time(EAST, aside, TEN_EAST, STILL) == math.inf
    assert math.isnan(conflict_area_pet(EAST, aside, TEN_EAST, STILL))
    assert conflict_area_pet(EAST, standing, TEN_EAST, STILL) < 0
    assert math.isnan(post_encroachment_time(EAST, NORTH, TEN_EAST, np.full(2, np.nan)))


def test_one_behind_the_other_follows_at_its_headway() -> None:
    assert post_encroachment_time(
        EAST, np.array([-40.0, 0.0, 4.0, 2.0, 0.0]), TEN_EAST, TEN_EAST
    ) == pytest.approx(1.6)


places = st.floats(-25, 25)
boxes = st.tuples(places, places, st.floats(1, 12), st.floats(1, 3), st.floats(-7, 7)).map(np.array)
velocities = st.tuples(st.floats(-9, 9), st.floats(-9, 9)).map(np.array)
WINDOW = 6.0


def moved(box: np.ndarray, velocity: np.ndarray, times: np.ndarray) -> np.ndarray:
    return np.column_stack([box[:2] + times[:, None] * velocity, np.tile(box[2:], (len(times), 1))])


@given(boxes, boxes, velocities, velocities)
def test_as_a_grid_of_times_has_it(first, second, one, other) -> None:
    found = post_encroachment_time(first, second, one, other, WINDOW)
    times = np.linspace(0, WINDOW, 121)
    gaps = gaps_of_pairs(moved(first, one, times)[:, None], moved(second, other, times)[None])
    delays, touching = np.abs(times[None, :] - times[:, None]), gaps <= 0
    if touching.any():
        assert abs(found) <= delays[touching].min() + 1e-9
    slack = (
        gaps <= 0.05 * (np.hypot(*one) + np.hypot(*other)) + 1e-9
    )  # what may touch between the grid's times
    assert abs(found) >= (delays[slack].min() - 0.1 if slack.any() else np.inf) - 1e-9


@given(boxes, boxes, velocities, velocities)
def test_it_is_0_where_they_touch_and_turns_with_the_pair(first, second, one, other) -> None:
    found = post_encroachment_time(first, second, one, other, WINDOW)
    assert post_encroachment_time(second, first, other, one, WINDOW) == pytest.approx(
        -found if np.isfinite(found) else found, abs=1e-6
    )
    if time_to_collision(first, second, one, other) < WINDOW - 1e-6:
        assert found == pytest.approx(0, abs=1e-6)
    area = conflict_area_pet(first, second, one, other, WINDOW)
    if found == math.inf:
        assert math.isnan(area) or area > 0
