"""Motions replayed with braking, against school physics and on erratic paths."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.braking_accidents import erratic_paths, straight_path
from support.expected_errors import assert_raises

from deepaccident_devkit.collisions.replay import (
    HORIZON,
    Motion,
    ReplayStates,
    braking_plans,
    motion_of,
    replay,
)
from deepaccident_devkit.errors import GeometryError

NEVER = np.inf


def replay_at(
    motion: Motion, times: np.ndarray, start: float = NEVER, deceleration: float = 5.0
) -> ReplayStates:
    plans = braking_plans(motion, [start], [deceleration])
    rows = np.zeros(len(times), dtype=np.int64)
    return replay(motion, plans, rows, np.asarray(times, dtype=float))


def test_without_braking_it_is_the_recording_and_goes_straight_on() -> None:
    path = np.column_stack([[0, 1, 3, 3, 3.5], [0, 0, 0, 1, 2], [0, 0, 3.1, -3.1, -3.0]])
    motion = motion_of(path)
    states = replay_at(motion, np.arange(5) / 10)
    np.testing.assert_allclose(states.poses[:, :2], path[:, :2], atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * states.poses[:, 2]), np.exp(1j * path[:, 2]))
    np.testing.assert_allclose(states.speeds, [10, 20, 10, np.hypot(5, 10), np.hypot(5, 10)])
    np.testing.assert_allclose(states.turned, [0, 0, 3.1, 2 * np.pi - 3.1, 2 * np.pi - 3.0])

    between_frames = replay_at(motion, np.array([0.25]))
    assert abs(between_frames.poses[0, 2]) == pytest.approx(
        np.pi
    )  # the shorter way from 3.1 to −3.1
    np.testing.assert_allclose(between_frames.poses[0, :2], [3, 0.5])

    # turns add up, whichever way they go
    turning = replay_at(motion, np.array([0.15, 0.25, 0.35]))
    np.testing.assert_allclose(turning.turned, [1.55, np.pi, 2 * np.pi - 3.05])
    swerving_motion = motion_of([[0, 0, 0], [1, 0, 0.4], [2, 0, 0.1]])
    swerving = replay_at(swerving_motion, np.array([0.1, 0.15, 0.2]))
    np.testing.assert_allclose(swerving.turned, [0.4, 0.55, 0.7])

    last = replay_at(motion, np.array([0.4 + HORIZON]))
    np.testing.assert_allclose(last.poses[0], [3.5 + 5 * 3, 2 + 10 * 3, motion.poses[4, 2]])
    np.testing.assert_allclose(last.velocities(motion)[0], [5, 10])


@pytest.mark.parametrize(("step", "moves"), [(0.0009, False), (0.0011, True)])
def test_an_actor_that_hardly_moved_at_the_end_stands_afterwards(step: float, moves: bool) -> None:
    motion = motion_of([[0, 0, 0], [1, 0, 0], [1 + step, 0, 0]])
    states = replay_at(motion, np.array([3.0]))
    assert (states.poses[0, 0] > 1 + step) == moves


def test_braking_from_constant_speed() -> None:
    motion = motion_of(straight_path((0, 0), 0.3, 20, 51))
    plans = braking_plans(motion, [1.0], [5.0])
    assert (plans.arcs[0], plans.speeds[0], plans.starts[0]) == pytest.approx((20, 20, 1))
    states = replay_at(motion, np.array([0.9, 1.0, 2.0, 4.9, 6.0, 8.0]), start=1.0)
    np.testing.assert_allclose(states.arcs, [18, 20, 37.5, 60 - 5 * 0.1**2 / 2, 60, 60])
    np.testing.assert_allclose(states.speeds, [20, 20, 15, 0.5, 0, 0], atol=1e-9)
    np.testing.assert_allclose(states.velocities(motion)[2], [15 * np.cos(0.3), 15 * np.sin(0.3)])
    np.testing.assert_allclose(states.poses[:, 0], states.arcs * np.cos(0.3))


def test_a_recording_that_brakes_harder_stays() -> None:
    path = np.zeros((9, 3))
    path[:, 0] = [0, 1, 2, 2.1, 2.2, 2.3, 2.4, 2.5, 2.6]
    motion = motion_of(path)
    times = np.linspace(0, 0.8, 81)
    recorded = replay_at(motion, times)
    braked = replay_at(motion, times, start=0.05, deceleration=4.0)
    is_late = times > 0.29
    np.testing.assert_allclose(braked.arcs[is_late], recorded.arcs[is_late])
    np.testing.assert_allclose(braked.speeds[is_late], recorded.speeds[is_late])
    assert braked.arcs[15] < recorded.arcs[15]


def test_a_car_that_stands_when_braking_begins_never_leaves_but_turns_as_recorded() -> None:
    path = np.column_stack([[0, 1, 1, 1, 2, 3], np.zeros(6), [0, 0, 0.1, 0.2, 0.2, 0.2]])
    motion = motion_of(path)
    standing = replay_at(motion, np.array([0.25, 0.35, 0.6]), start=0.15)
    np.testing.assert_allclose(standing.poses, [[1, 0, 0.15], [1, 0, 0.2], [1, 0, 0.2]], atol=1e-12)
    np.testing.assert_allclose(standing.speeds, 0)


def test_when_braking_has_no_effect_or_begins_at_once() -> None:
    motion = motion_of(straight_path((0, 0), 0, 10, 11))
    plans = braking_plans(motion, [1.0, 5.0, np.inf, np.nan, -3.0, 0.99], 4.0)
    np.testing.assert_array_equal(plans.starts, [np.inf, np.inf, np.inf, np.inf, 0.0, 0.99])
    np.testing.assert_allclose(plans.speeds, [0, 0, 0, 0, 10, 10])


@pytest.mark.parametrize("path", [[[0, 0, 0]], [[0, 0], [1, 1]], [[0, 0, 0], [np.nan, 0, 0]]])
def test_paths_that_are_none(path: list[list[float]]) -> None:
    assert_raises(
        (lambda: motion_of(path), GeometryError, "path: expected"),
    )


@given(erratic_paths(), st.floats(0, 2), st.floats(1, 10))
def test_nobody_is_sped_up(path: np.ndarray, start: float, deceleration: float) -> None:
    motion = motion_of(path)
    times = np.linspace(0, motion.duration + HORIZON, 400)
    recorded = replay_at(motion, times)
    braked = replay_at(motion, times, start, deceleration)
    assert (braked.arcs <= recorded.arcs + 1e-9).all()
    assert (np.diff(braked.arcs) >= -1e-9).all()
    assert (np.diff(braked.turned) >= -1e-9).all()
    is_before = times <= start
    np.testing.assert_array_equal(braked.poses[is_before], recorded.poses[is_before])
    first_speed = braking_plans(motion, [start], [deceleration]).speeds[0]
    max_speeds = np.maximum(recorded.speeds[~is_before], first_speed)
    assert (braked.speeds[~is_before] <= max_speeds).all()


@given(erratic_paths(), st.floats(0, 1.9), st.floats(1, 10))
def test_a_replay_stays_on_its_path(path: np.ndarray, start: float, deceleration: float) -> None:
    motion = motion_of(path)
    times = np.linspace(0, motion.duration + HORIZON, 300)
    braked = replay_at(motion, times, start, deceleration)
    for axis in (0, 1):
        expected = np.interp(braked.arcs, motion.arcs, motion.poses[:, axis])
        np.testing.assert_allclose(braked.poses[:, axis], expected, atol=1e-6)
