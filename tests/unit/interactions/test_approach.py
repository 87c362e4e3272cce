"""The nearest approach and the time to collision with accelerations: by hand, and against small
steps of time.
"""

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
STILL, TEN = np.zeros(2), np.array([10.0, 0.0])


def seconds(first, second, *motion: float) -> float:
    return modified_ttc(first, second, *map(np.float64, motion)).item()


def test_passing_by_the_gap_is_least_beside_the_other() -> None:
    beside = np.array([24.0, 5.0, 4.0, 2.0, 0.0])
    assert nearest_approach(CAR, beside, TEN, STILL) == (pytest.approx(3), pytest.approx(2))
    assert nearest_approach(CAR, beside, TEN, STILL, horizon=1.0) == (
        pytest.approx(math.hypot(10, 3)),
        1,
    )
    assert nearest_approach(CAR, beside, -TEN, STILL) == (pytest.approx(math.hypot(20, 3)), 0)
    assert nearest_approach(CAR, AHEAD, TEN, STILL) == (0, pytest.approx(2))
    assert nearest_approach(CAR, AHEAD, TEN, STILL, horizon=1.0) == (pytest.approx(10), 1)
    assert nearest_approach(CAR, AHEAD, TEN, TEN) == (pytest.approx(20), 0)
    assert np.isnan(nearest_approach(CAR, AHEAD, TEN, np.full(2, np.nan))).all()


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
    assert seconds(first, second, *speeds, *rates) == pytest.approx(expected, nan_ok=True)


places = st.floats(-25, 25)
boxes = st.tuples(places, places, st.floats(1, 12), st.floats(1, 3), st.floats(-7, 7)).map(np.array)
speeds = st.floats(0, 15).map(lambda value: round(value, 3))
rates = st.floats(-6, 3).map(lambda value: round(value, 3))


def at(box: np.ndarray, speed: float, rate: float, times: np.ndarray) -> np.ndarray:
    """Where a box is at times, by the definition."""
    until = np.minimum(times, -speed / rate) if rate < 0 else times
    way, moved = speed * until + rate * until**2 / 2, np.tile(box, (len(times), 1))
    moved[:, :2] += way[:, None] * [math.cos(box[4]), math.sin(box[4])]
    return moved


@given(boxes, boxes, speeds, speeds, rates, rates)
def test_as_steps_of_time_have_it(first, second, one, other, first_rate, second_rate) -> None:
    found = seconds(first, second, one, other, first_rate, second_rate)
    times = np.linspace(0, 10, 2001)
    gaps = gaps_of_pairs(at(first, one, first_rate, times), at(second, other, second_rate, times))
    touching = np.flatnonzero(gaps <= 0)
    if len(touching):
        assert found <= times[touching[0]] + 1e-9
        assert (
            found >= times[max(touching[0] - 1, 0)] - 1e-9 or gaps[: touching[0]].min() < 0.1
        )  # a graze before
    elif found < 10:
        assert gaps.min() < 0.2  # a graze shorter than a step
    if found < 10:
        there = gaps_of_pairs(
            at(first, one, first_rate, np.array([found])),
            at(second, other, second_rate, np.array([found])),
        )
        assert there.item() <= 1e-6


@given(boxes, boxes, speeds, speeds)
def test_without_accelerations_it_is_the_time_to_collision(first, second, one, other) -> None:
    velocity = [
        speed * np.array([math.cos(box[4]), math.sin(box[4])])
        for box, speed in ((first, one), (second, other))
    ]
    expected = time_to_collision(first, second, *velocity)
    gap, _ = nearest_approach(first, second, *velocity, horizon=1e6)
    if not 0 < gap < 1e-6:  # neither a touch nor none
        assert seconds(first, second, one, other, 0, 0) == pytest.approx(
            expected, rel=1e-6, abs=1e-6
        )


@given(boxes, boxes, speeds, speeds, st.floats(0.5, 20))
def test_the_nearest_approach_is_the_least_of_many_moments(
    first, second, one, other, horizon
) -> None:
    velocity = [
        speed * np.array([math.cos(box[4]), math.sin(box[4])])
        for box, speed in ((first, one), (second, other))
    ]
    gap, time = nearest_approach(first, second, *velocity, horizon)
    times = np.append(np.linspace(0, horizon, 200), time)
    moved = [
        np.column_stack([box[:2] + times[:, None] * each, np.tile(box[2:], (len(times), 1))])
        for box, each in zip((first, second), velocity, strict=True)
    ]
    gaps = gaps_of_pairs(*moved)
    assert 0 <= time <= horizon
    assert gaps[-1] == pytest.approx(gap, abs=1e-6)
    assert gap <= gaps.min() + 1e-9
