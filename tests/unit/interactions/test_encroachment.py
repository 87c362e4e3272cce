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
    pet_s = post_encroachment_time(EAST, NORTH, TEN_EAST, TEN_NORTH, window=3.8)
    assert pet_s == pytest.approx(1.4)
    assert math.isnan(conflict_area_pet(EAST, NORTH, TEN_EAST, TEN_NORTH, window=3.6))


def test_a_standing_box_occupies_its_place_at_all_times() -> None:
    standing = np.array([0.0, 0.0, 4.0, 2.0, 0.3])
    assert post_encroachment_time(EAST, standing, TEN_EAST, STILL) == 0
    assert post_encroachment_time(standing, standing, STILL, STILL) == 0
    aside = np.array([0.0, 9.0, 4.0, 2.0, 0.3])
    assert post_encroachment_time(EAST, aside, TEN_EAST, STILL) == math.inf
    assert math.isnan(conflict_area_pet(EAST, aside, TEN_EAST, STILL))
    assert conflict_area_pet(EAST, standing, TEN_EAST, STILL) < 0
    assert math.isnan(post_encroachment_time(EAST, NORTH, TEN_EAST, np.full(2, np.nan)))


def test_one_behind_the_other_follows_at_its_headway() -> None:
    follower = np.array([-40.0, 0.0, 4.0, 2.0, 0.0])
    pet_s = post_encroachment_time(EAST, follower, TEN_EAST, TEN_EAST)
    assert pet_s == pytest.approx(1.6)


coordinates = st.floats(-25, 25)
boxes = st.tuples(
    coordinates, coordinates, st.floats(1, 12), st.floats(1, 3), st.floats(-7, 7)
).map(np.array)
velocities = st.tuples(st.floats(-9, 9), st.floats(-9, 9)).map(np.array)
WINDOW_S = 6.0


def move_box(box: np.ndarray, velocity: np.ndarray, times: np.ndarray) -> np.ndarray:
    centers = box[:2] + times[:, None] * velocity
    return np.column_stack([centers, np.tile(box[2:], (len(times), 1))])


@given(boxes, boxes, velocities, velocities)
def test_as_a_grid_of_times_has_it(first, second, first_velocity, second_velocity) -> None:
    pet_s = post_encroachment_time(first, second, first_velocity, second_velocity, WINDOW_S)
    times = np.linspace(0, WINDOW_S, 121)
    first_boxes = move_box(first, first_velocity, times)
    second_boxes = move_box(second, second_velocity, times)
    gaps = gaps_of_pairs(first_boxes[:, None], second_boxes[None])
    delays = np.abs(times[None, :] - times[:, None])

    if (gaps <= 0).any():
        assert abs(pet_s) <= delays[gaps <= 0].min() + 1e-9
    step_length = 0.05 * (np.hypot(*first_velocity) + np.hypot(*second_velocity))
    may_touch = gaps <= step_length + 1e-9  # between two times of the grid
    shortest_delay = delays[may_touch].min() - 0.1 if may_touch.any() else np.inf
    assert abs(pet_s) >= shortest_delay - 1e-9


@given(boxes, boxes, velocities, velocities)
def test_it_is_0_where_they_touch_and_turns_with_the_pair(
    first, second, first_velocity, second_velocity
) -> None:
    pet_s = post_encroachment_time(first, second, first_velocity, second_velocity, WINDOW_S)
    swapped_pet_s = post_encroachment_time(second, first, second_velocity, first_velocity, WINDOW_S)
    expected = -pet_s if np.isfinite(pet_s) else pet_s
    assert swapped_pet_s == pytest.approx(expected, abs=1e-6)

    if time_to_collision(first, second, first_velocity, second_velocity) < WINDOW_S - 1e-6:
        assert pet_s == pytest.approx(0, abs=1e-6)
    area_pet_s = conflict_area_pet(first, second, first_velocity, second_velocity, WINDOW_S)
    if pet_s == math.inf:
        assert math.isnan(area_pet_s) or area_pet_s > 0
