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
BESIDE = np.array([24.0, 2.5, 4.0, 2.0, 0.0])
STILL, FIVE, TEN = np.zeros(2), np.array([5.0, 0.0]), np.array([10.0, 0.0])
NORTH = np.array([0.0, 10.0])
UNKNOWN = np.full(2, np.nan)


def test_behind_another_the_gap_counts_at_the_closing_speed() -> None:
    assert time_to_collision_1d(CAR, AHEAD, TEN, FIVE) == pytest.approx(4)
    assert drac_1d(CAR, AHEAD, TEN, FIVE) == pytest.approx(25 / 40)
    assert drac(CAR, AHEAD, TEN, FIVE) == pytest.approx(5 / 8)
    assert (
        closing_speed(CAR, AHEAD, TEN, FIVE) == closing_speed_of_boxes(CAR, AHEAD, TEN, FIVE) == 5
    )
    assert relative_speed(TEN, NORTH) == pytest.approx(math.sqrt(200))


def test_the_one_ahead_measures_the_same_behind_it() -> None:
    assert time_to_collision_1d(AHEAD, CAR, FIVE, TEN) == pytest.approx(4)
    assert time_to_collision_1d(AHEAD, CAR, TEN, FIVE) == math.inf


def test_one_dimension_sees_no_crossing_and_nobody_beside() -> None:
    assert time_to_collision(CAR, CROSSING, TEN, NORTH) == pytest.approx(1)
    assert time_to_collision_1d(CAR, CROSSING, TEN, NORTH) == math.inf
    assert time_to_collision_1d(CAR, BESIDE, TEN, STILL) == math.inf
    assert (
        drac_1d(CAR, BESIDE, TEN, STILL)
        == drac_1d(CAR, AHEAD, FIVE, TEN)
        == drac(CAR, BESIDE, TEN, STILL)
        == 0
    )
    assert modified_ttc_1d(CAR, BESIDE, TEN, STILL, np.float64(1), np.float64(0)) == math.inf


def test_at_contact_there_is_no_time_and_no_brake_is_enough() -> None:
    touching = np.array([3.0, 0.5, 4.0, 2.0, 0.2])
    assert (
        time_to_collision_1d(CAR, touching, TEN, STILL),
        time_to_collision_1d(CAR, touching, STILL, TEN),
    ) == (0, 0)
    assert drac_1d(CAR, touching, TEN, STILL) == drac(CAR, touching, STILL, STILL) == math.inf
    assert modified_ttc_1d(CAR, touching, TEN, STILL, np.float64(0), np.float64(0)) == 0
    assert math.isnan(closing_speed_of_boxes(CAR, touching, TEN, STILL))
    assert math.isnan(closing_speed(CAR, CAR, TEN, STILL))


def test_accelerations_along_one_line() -> None:
    brakes = modified_ttc_1d(CAR, AHEAD, TEN, TEN, np.float64(0), np.float64(-2.5))
    assert brakes == pytest.approx(4)  # 20 m = 2.5 t² / 2
    assert modified_ttc_1d(CAR, AHEAD, TEN, FIVE, np.float64(-10), np.float64(0)) == math.inf
    assert modified_ttc_1d(
        CAR, AHEAD, TEN, FIVE, np.float64(1e-14), np.float64(0)
    ) == pytest.approx(4)
    # who brakes behind reverses in this definition, and the one ahead backs into it
    assert modified_ttc_1d(AHEAD, CAR, TEN, FIVE, np.float64(-10), np.float64(0)) == pytest.approx(
        (5 + math.sqrt(25 + 400)) / 10
    )


def test_what_a_collision_would_do() -> None:
    assert delta_v(TEN, -TEN, np.float64(1500), np.float64(9000)) == pytest.approx(
        [20 * 9000 / 10500, 20 * 1500 / 10500]
    )
    assert impact_heading(CAR, CROSSING) == pytest.approx(math.pi / 2)
    assert impact_direction(CAR, TEN, NORTH) == pytest.approx(-math.pi / 4)
    assert impact_direction(CROSSING, TEN, STILL) == pytest.approx(-math.pi / 2)
    assert math.isnan(impact_direction(CAR, TEN, TEN))
    backwards = np.array([0.0, 0.0, 4.0, 2.0, math.pi])
    assert (
        impact_heading(CAR, backwards) == impact_heading(backwards, CAR) == pytest.approx(math.pi)
    )


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
        for velocities in ((UNKNOWN, TEN), (TEN, UNKNOWN)):
            assert math.isnan(measure(CAR, AHEAD, *velocities)), measure.__name__


positions = st.floats(-40, 40)
boxes = st.tuples(
    positions, positions, st.floats(0.3, 12), st.floats(0.3, 3), st.floats(-7, 7)
).map(np.array)
velocities = st.tuples(st.floats(-15, 15), st.floats(-15, 15)).map(np.array)


@given(boxes, boxes, velocities, velocities)
def test_pairs_are_symmetric(first, second, first_velocity, second_velocity) -> None:
    there = (first, second, first_velocity, second_velocity)
    back = (second, first, second_velocity, first_velocity)
    for measure in (time_to_collision, closing_speed, drac):
        assert measure(*there) == pytest.approx(measure(*back), rel=1e-6, abs=1e-9, nan_ok=True)
    assert gaps_of_pairs(first, second) == pytest.approx(gaps_of_pairs(second, first), abs=1e-9)
    assert impact_heading(first, second) == pytest.approx(
        -impact_heading(second, first), abs=1e-9
    ) or abs(impact_heading(first, second)) == pytest.approx(math.pi)


@given(boxes, boxes, velocities, velocities)
def test_the_gap_shrinks_at_the_boxes_closing_speed(
    first, second, first_velocity, second_velocity
) -> None:
    speed = closing_speed_of_boxes(first, second, first_velocity, second_velocity)
    gap = gaps_of_pairs(first, second)
    if np.isnan(speed):
        assert gap == 0
        return
    step = 1e-7
    moved = [
        np.concatenate([box[:2] + step * velocity, box[2:]])
        for box, velocity in ((first, first_velocity), (second, second_velocity))
    ]
    if gap > 1e-3:
        assert (gap - gaps_of_pairs(*moved)) / step == pytest.approx(speed, abs=1e-2)
