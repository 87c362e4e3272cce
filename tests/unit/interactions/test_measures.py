"""Surrogate measures by hand: car-following, crossing, contact, and numbers that are not known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit.interactions import (
    closing_speed,
    closing_speed_of_boxes,
    delta_v,
    drac,
    drac_1d,
    gaps_of_pairs,
    impact_direction,
    impact_heading,
    modified_ttc_1d,
    relative_speed,
    time_exposed,
    time_integrated,
    time_to_collision,
    time_to_collision_1d,
)

CAR = np.array([0.0, 0.0, 4.0, 2.0, 0.0])
AHEAD = np.array([24.0, 0.0, 4.0, 2.0, 0.0])
CROSSING = np.array([13.0, -13.0, 4.0, 2.0, math.pi / 2])
OTHER_LANE = np.array([24.0, 2.5, 4.0, 2.0, 0.0])
STILL, FIVE_EAST, TEN_EAST = np.zeros(2), np.array([5.0, 0.0]), np.array([10.0, 0.0])
TEN_NORTH = np.array([0.0, 10.0])
UNKNOWN = np.full(2, np.nan)


def test_behind_another_the_gap_counts_at_the_closing_speed() -> None:
    assert time_to_collision_1d(CAR, AHEAD, TEN_EAST, FIVE_EAST) == pytest.approx(4)
    assert drac_1d(CAR, AHEAD, TEN_EAST, FIVE_EAST) == pytest.approx(25 / 40)
    assert drac(CAR, AHEAD, TEN_EAST, FIVE_EAST) == pytest.approx(5 / 8)
    assert closing_speed(CAR, AHEAD, TEN_EAST, FIVE_EAST) == 5
    assert closing_speed_of_boxes(CAR, AHEAD, TEN_EAST, FIVE_EAST) == 5
    assert relative_speed(TEN_EAST, TEN_NORTH) == pytest.approx(math.sqrt(200))


def test_the_one_ahead_measures_the_same_behind_it() -> None:
    assert time_to_collision_1d(AHEAD, CAR, FIVE_EAST, TEN_EAST) == pytest.approx(4)
    assert time_to_collision_1d(AHEAD, CAR, TEN_EAST, FIVE_EAST) == math.inf


def test_one_dimension_sees_no_crossing_and_nobody_beside() -> None:
    assert time_to_collision(CAR, CROSSING, TEN_EAST, TEN_NORTH) == pytest.approx(1)
    assert time_to_collision_1d(CAR, CROSSING, TEN_EAST, TEN_NORTH) == math.inf
    assert time_to_collision_1d(CAR, OTHER_LANE, TEN_EAST, STILL) == math.inf
    assert drac_1d(CAR, OTHER_LANE, TEN_EAST, STILL) == 0
    assert drac_1d(CAR, AHEAD, FIVE_EAST, TEN_EAST) == 0
    assert drac(CAR, OTHER_LANE, TEN_EAST, STILL) == 0
    assert (
        modified_ttc_1d(CAR, OTHER_LANE, TEN_EAST, STILL, np.float64(1), np.float64(0)) == math.inf
    )


@pytest.mark.parametrize("angle", [0.7, 2.4, -1.2])
def test_one_dimension_follows_the_heading_not_the_axes_of_the_world(angle: float) -> None:
    cosine, sine = math.cos(angle), math.sin(angle)
    rotation = np.array([[cosine, -sine], [sine, cosine]])

    def rotated(box: np.ndarray) -> np.ndarray:
        return np.concatenate([rotation @ box[:2], box[2:4], [box[4] + angle]])

    speeds = (rotation @ TEN_EAST, rotation @ FIVE_EAST)
    same_lane = AHEAD + np.array([0.0, 1.5, 0.0, 0.0, 0.0])
    assert time_to_collision_1d(rotated(CAR), rotated(same_lane), *speeds) == pytest.approx(4)
    assert time_to_collision_1d(rotated(CAR), rotated(OTHER_LANE), *speeds) == math.inf


def test_at_contact_there_is_no_time_and_no_brake_is_enough() -> None:
    touching = np.array([3.0, 0.5, 4.0, 2.0, 0.2])
    assert time_to_collision_1d(CAR, touching, TEN_EAST, STILL) == 0
    assert time_to_collision_1d(CAR, touching, STILL, TEN_EAST) == 0
    assert drac_1d(CAR, touching, TEN_EAST, STILL) == math.inf
    assert drac(CAR, touching, STILL, STILL) == math.inf
    assert modified_ttc_1d(CAR, touching, TEN_EAST, STILL, np.float64(0), np.float64(0)) == 0
    assert math.isnan(closing_speed_of_boxes(CAR, touching, TEN_EAST, STILL))
    assert math.isnan(closing_speed(CAR, CAR, TEN_EAST, STILL))


def test_accelerations_along_one_line() -> None:
    def compute_mttc_s(first, second, first_velocity, second_velocity, *rates: float) -> float:
        accelerations = map(np.float64, rates)
        return modified_ttc_1d(first, second, first_velocity, second_velocity, *accelerations)

    # 20 m = 2.5 t² / 2
    assert compute_mttc_s(CAR, AHEAD, TEN_EAST, TEN_EAST, 0, -2.5) == pytest.approx(4)
    assert compute_mttc_s(CAR, AHEAD, TEN_EAST, FIVE_EAST, -10, 0) == math.inf
    assert compute_mttc_s(CAR, AHEAD, TEN_EAST, FIVE_EAST, 1e-14, 0) == pytest.approx(4)
    # in this definition a car that brakes reverses at last, and so it backs into the one behind
    expected_s = (5 + math.sqrt(25 + 400)) / 10
    mttc_s = compute_mttc_s(AHEAD, CAR, TEN_EAST, FIVE_EAST, -10, 0)
    assert mttc_s == pytest.approx(expected_s)


def test_what_a_collision_would_do() -> None:
    changes = delta_v(TEN_EAST, -TEN_EAST, np.float64(1500), np.float64(9000))
    assert changes == pytest.approx([20 * 9000 / 10500, 20 * 1500 / 10500])
    assert impact_heading(CAR, CROSSING) == pytest.approx(math.pi / 2)
    assert impact_direction(CAR, TEN_EAST, TEN_NORTH) == pytest.approx(-math.pi / 4)
    assert impact_direction(CROSSING, TEN_EAST, STILL) == pytest.approx(-math.pi / 2)
    assert math.isnan(impact_direction(CAR, TEN_EAST, TEN_EAST))
    backwards = np.array([0.0, 0.0, 4.0, 2.0, math.pi])
    assert impact_heading(CAR, backwards) == impact_heading(backwards, CAR)
    assert impact_heading(CAR, backwards) == pytest.approx(math.pi)


def test_time_below_a_threshold() -> None:
    times = np.array([[np.inf, 2.0, 1.5, 0.5, 0.0], [np.nan] * 5])
    assert time_exposed(times, 1.5, 0.1) == pytest.approx([0.3, 0])
    assert time_integrated(times, 1.5, 0.1) == pytest.approx([0.25, 0])
    assert time_integrated(times, 3.0, 0.1) == pytest.approx([0.8, 0])


def test_an_unknown_velocity_makes_no_number() -> None:
    for measure in (
        time_to_collision,
        time_to_collision_1d,
        drac,
        drac_1d,
        closing_speed,
        closing_speed_of_boxes,
    ):
        for velocities in ((UNKNOWN, TEN_EAST), (TEN_EAST, UNKNOWN)):
            assert math.isnan(measure(CAR, AHEAD, *velocities)), measure.__name__


positions = st.floats(-40, 40)
boxes = st.tuples(
    positions, positions, st.floats(0.3, 12), st.floats(0.3, 3), st.floats(-7, 7)
).map(np.array)
velocities = st.tuples(st.floats(-15, 15), st.floats(-15, 15)).map(np.array)


@given(boxes, boxes, velocities, velocities)
def test_pairs_are_symmetric(first, second, first_velocity, second_velocity) -> None:
    for measure in (time_to_collision, closing_speed, drac):
        value = measure(first, second, first_velocity, second_velocity)
        swapped_value = measure(second, first, second_velocity, first_velocity)
        assert value == pytest.approx(swapped_value, rel=1e-6, abs=1e-9, nan_ok=True)
    assert gaps_of_pairs(first, second) == pytest.approx(gaps_of_pairs(second, first), abs=1e-9)

    heading = impact_heading(first, second)
    is_opposite = heading == pytest.approx(-impact_heading(second, first), abs=1e-9)
    assert is_opposite or abs(heading) == pytest.approx(math.pi)


@given(boxes, boxes, velocities, velocities)
def test_the_gap_shrinks_at_the_boxes_closing_speed(
    first, second, first_velocity, second_velocity
) -> None:
    speed = closing_speed_of_boxes(first, second, first_velocity, second_velocity)
    gap = gaps_of_pairs(first, second)
    if np.isnan(speed):
        assert gap == 0
        return
    step_s = 1e-7
    moved_first = np.concatenate([first[:2] + step_s * first_velocity, first[2:]])
    moved_second = np.concatenate([second[:2] + step_s * second_velocity, second[2:]])
    if gap > 1e-3:
        moved_gap = gaps_of_pairs(moved_first, moved_second)
        assert (gap - moved_gap) / step_s == pytest.approx(speed, abs=1e-2)
