"""The nearest approach and the modified time to collision, by hand and against small time steps."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit.interactions import (
    gaps_of_pairs,
    modified_ttc,
    nearest_approach,
    time_to_collision,
)

CAR = np.array([0.0, 0.0, 4.0, 2.0, 0.0])
AHEAD = np.array([24.0, 0.0, 4.0, 2.0, 0.0])
TURNED = np.array([24.0, 0.0, 4.0, 2.0, math.pi])
STILL, TEN_EAST = np.zeros(2), np.array([10.0, 0.0])


def compute_mttc_s(first, second, *motion: float) -> float:
    return modified_ttc(first, second, *map(np.float64, motion)).item()


def test_passing_by_the_gap_is_least_beside_the_other() -> None:
    other_lane = np.array([24.0, 5.0, 4.0, 2.0, 0.0])
    assert nearest_approach(CAR, other_lane, TEN_EAST, STILL) == (
        pytest.approx(3),
        pytest.approx(2),
    )
    expected_gap_m = pytest.approx(math.hypot(10, 3))
    assert nearest_approach(CAR, other_lane, TEN_EAST, STILL, horizon=1.0) == (expected_gap_m, 1)
    assert nearest_approach(CAR, other_lane, -TEN_EAST, STILL) == (
        pytest.approx(math.hypot(20, 3)),
        0,
    )

    assert nearest_approach(CAR, AHEAD, TEN_EAST, STILL) == (0, pytest.approx(2))
    assert nearest_approach(CAR, AHEAD, TEN_EAST, STILL, horizon=1.0) == (pytest.approx(10), 1)
    assert nearest_approach(CAR, AHEAD, TEN_EAST, TEN_EAST) == (pytest.approx(20), 0)
    assert np.isnan(nearest_approach(CAR, AHEAD, TEN_EAST, np.full(2, np.nan))).all()


@pytest.mark.parametrize(
    ("first", "second", "speeds", "rates", "expected"),
    [
        (CAR, AHEAD, (10, 0), (0, 0), 2),
        (CAR, AHEAD, (10, 0), (-2.5, 0), 4),  # stops at the bumper
        (CAR, AHEAD, (10, 0), (-2.51, 0), math.inf),
        (CAR, AHEAD, (0, 0), (-1, 0), math.inf),
        (CAR, AHEAD, (0, 0), (0, -1), math.inf),
        (CAR, AHEAD, (0, 0), (1, 0), math.sqrt(40)),
        (CAR, AHEAD, (10, 5), (0, -5), 2.25),  # the one ahead stops after 2.5 m
        (CAR, TURNED, (10, 10), (-20, -20), math.inf),
        (CAR, TURNED, (10, 10), (-5, -5), 2),
        (CAR, AHEAD, (0, -10), (0, 2), (10 - math.sqrt(20)) / 2),  # it backs, slower and slower
        (CAR, CAR, (0, 0), (0, 0), 0),
        (CAR, AHEAD, (10, 0), (np.nan, 0), math.nan),
    ],
)
def test_one_that_brakes_stops_and_stays(
    first: np.ndarray,
    second: np.ndarray,
    speeds: tuple[float, float],
    rates: tuple[float, float],
    expected: float,
) -> None:
    assert compute_mttc_s(first, second, *speeds, *rates) == pytest.approx(expected, nan_ok=True)


coordinates = st.floats(-25, 25)
boxes = st.tuples(
    coordinates, coordinates, st.floats(1, 12), st.floats(1, 3), st.floats(-7, 7)
).map(np.array)
speeds = st.floats(0, 15).map(lambda value: round(value, 3))
rates = st.floats(-6, 3).map(lambda value: round(value, 3))


def heading_of(box: np.ndarray) -> np.ndarray:
    yaw = box[4]
    return np.array([math.cos(yaw), math.sin(yaw)])


def move_along_heading(box: np.ndarray, speed: float, rate: float, times: np.ndarray) -> np.ndarray:
    """Return the box at each time, from the formula; a box that brakes stops and stays."""
    driving_times = np.minimum(times, -speed / rate) if rate < 0 else times
    distances = speed * driving_times + rate * driving_times**2 / 2
    moved_boxes = np.tile(box, (len(times), 1))
    moved_boxes[:, :2] += distances[:, None] * heading_of(box)
    return moved_boxes


def move_with_velocity(box: np.ndarray, velocity: np.ndarray, times: np.ndarray) -> np.ndarray:
    centers = box[:2] + times[:, None] * velocity
    return np.column_stack([centers, np.tile(box[2:], (len(times), 1))])


@given(boxes, boxes, speeds, speeds, rates, rates)
def test_as_steps_of_time_have_it(
    first, second, first_speed, second_speed, first_rate, second_rate
) -> None:
    def gaps_at(times: np.ndarray) -> np.ndarray:
        return gaps_of_pairs(
            move_along_heading(first, first_speed, first_rate, times),
            move_along_heading(second, second_speed, second_rate, times),
        )

    mttc_s = compute_mttc_s(first, second, first_speed, second_speed, first_rate, second_rate)
    times = np.linspace(0, 10, 2001)
    gaps = gaps_at(times)
    touching_steps = np.flatnonzero(gaps <= 0)
    if len(touching_steps):
        contact_step = touching_steps[0]
        assert mttc_s <= times[contact_step] + 1e-9
        is_within_a_step = mttc_s >= times[max(contact_step - 1, 0)] - 1e-9
        # otherwise they grazed each other before
        assert is_within_a_step or gaps[:contact_step].min() < 0.1
    elif mttc_s < 10:
        assert gaps.min() < 0.2  # a graze shorter than a step
    if mttc_s < 10:
        assert gaps_at(np.array([mttc_s])).item() <= 1e-6


@given(boxes, boxes, speeds, speeds)
def test_without_accelerations_it_is_the_time_to_collision(
    first, second, first_speed, second_speed
) -> None:
    velocities = (first_speed * heading_of(first), second_speed * heading_of(second))
    gap, _ = nearest_approach(first, second, *velocities, horizon=1e6)
    if not 0 < gap < 1e-6:  # otherwise rounding decides whether they touch
        mttc_s = compute_mttc_s(first, second, first_speed, second_speed, 0, 0)
        ttc_s = time_to_collision(first, second, *velocities)
        assert mttc_s == pytest.approx(ttc_s, rel=1e-6, abs=1e-6)


@given(boxes, boxes, speeds, speeds, st.floats(0.5, 20))
def test_the_nearest_approach_is_the_least_of_many_moments(
    first, second, first_speed, second_speed, horizon
) -> None:
    first_velocity = first_speed * heading_of(first)
    second_velocity = second_speed * heading_of(second)
    gap, time = nearest_approach(first, second, first_velocity, second_velocity, horizon)

    times = np.append(np.linspace(0, horizon, 200), time)
    gaps = gaps_of_pairs(
        move_with_velocity(first, first_velocity, times),
        move_with_velocity(second, second_velocity, times),
    )
    assert 0 <= time <= horizon
    assert gaps[-1] == pytest.approx(gap, abs=1e-6)
    assert gap <= gaps.min() + 1e-9
