import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit.baselines import constant_turn_rate, constant_velocity

POSE = np.array([[1.0, 2.0, 0.5], [0.0, 0.0, -3.0]])
numbers = st.floats(-20, 20, allow_nan=False)


def test_constant_velocity_goes_straight_on_and_keeps_the_heading() -> None:
    poses = constant_velocity(POSE, np.array([[2.0, -1.0], [0.0, 3.0]]), np.array([0.0, 0.5, 2.0]))
    assert poses.shape == (3, 2, 3)
    np.testing.assert_array_equal(poses[0], POSE)
    np.testing.assert_allclose(poses[1], [[2.0, 1.5, 0.5], [0.0, 1.5, -3.0]])
    np.testing.assert_allclose(poses[2], [[5.0, 0.0, 0.5], [0.0, 6.0, -3.0]])


def test_who_has_no_velocity_stands() -> None:
    poses = constant_velocity(POSE, np.array([[np.nan, np.nan], [1.0, 0.0]]), np.array([3.0]))
    np.testing.assert_allclose(poses[0], [POSE[0], [3.0, 0.0, -3.0]])


def test_a_full_turn_ends_where_it_began_and_half_of_it_across() -> None:
    rate, speed = 0.5, 4.0
    times = np.array([np.pi, 2 * np.pi]) / rate
    poses = constant_turn_rate(np.zeros((1, 3)), np.array([[speed, 0.0]]), np.array([rate]), times)
    np.testing.assert_allclose(poses[0, 0], [0, 2 * speed / rate, np.pi], atol=1e-9)  # counter-clockwise, to the left
    np.testing.assert_allclose(poses[1, 0], [0, 0, 2 * np.pi], atol=1e-9)


@given(x=numbers, y=numbers, rate=st.floats(-2, 2), first=st.floats(0, 3), second=st.floats(0, 3))
def test_two_steps_are_one(x: float, y: float, rate: float, first: float, second: float) -> None:
    velocity, rates = np.array([[x, y]]), np.array([rate])
    halfway = constant_turn_rate(POSE[:1], velocity, rates, np.array([first]))[0]
    turn = rate * first
    turned = np.array([[np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y]])
    in_steps = constant_turn_rate(halfway, turned, rates, np.array([second]))[0]
    at_once = constant_turn_rate(POSE[:1], velocity, rates, np.array([first + second]))[0]
    np.testing.assert_allclose(in_steps, at_once, atol=1e-4)


@pytest.mark.parametrize("rate", [1e-12, -1e-7, 3e-6])
def test_a_hardly_turning_path_is_a_straight_one(rate: float) -> None:
    velocity, times = np.array([[10.0, 5.0]]), np.array([0.0, 1.0, 4.0])
    turning = constant_turn_rate(POSE[:1], velocity, np.array([rate]), times)
    np.testing.assert_allclose(turning, constant_velocity(POSE[:1], velocity, times), atol=1e-3)
