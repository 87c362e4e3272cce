"""When replays touch, against plain sampling and closed forms, also shorter than any step."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.braking_accidents import (
    erratic_accidents,
    head_on_accident,
    rear_end_accident,
    straight_path,
)
from support.expected_errors import assert_raises

from deepaccident_devkit.collisions.contact import (
    Pair,
    contact_times,
    has_contact,
    impacts,
    pair_of,
)
from deepaccident_devkit.collisions.recorded import Accident
from deepaccident_devkit.collisions.replay import HORIZON, braking_plans, replay
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs

NEITHER_BRAKES = np.array([[np.inf, np.inf]])


def sample_gaps(
    pair: Pair, starts: np.ndarray, decelerations: np.ndarray, times: np.ndarray
) -> np.ndarray:
    """Return the gaps minus the margin, shape (N, T), of N replays at T times."""
    rows = np.repeat(np.arange(len(starts)), len(times))
    replay_times = np.tile(times, len(starts))
    boxes = []
    for motion, size, motion_starts in zip(pair.motions, pair.sizes, starts.T, strict=True):
        plans = braking_plans(motion, motion_starts, decelerations)
        poses = replay(motion, plans, rows, replay_times).poses
        sizes = np.broadcast_to(size, poses[:, :2].shape)
        boxes.append(np.concatenate([poses[:, :2], sizes, poses[:, 2:]], axis=1))
    return gaps_of_pairs(*boxes).reshape(len(starts), len(times)) - pair.margin


@settings(max_examples=15)
@given(erratic_accidents(), st.integers(0, 10_000))
def test_no_sample_is_in_contact_before_the_first_contact(accident: Accident, seed: int) -> None:
    pair = pair_of(accident.paths, accident.sizes)
    rng = np.random.default_rng(seed)
    starts = np.where(rng.random((10, 2)) < 0.3, np.inf, rng.uniform(0, pair.duration, (10, 2)))
    decelerations = rng.uniform(3, 9, 10)
    contacts = contact_times(pair, starts, decelerations)
    is_in_contact = np.isfinite(contacts)
    np.testing.assert_array_equal(has_contact(pair, starts, decelerations), is_in_contact)

    times = np.sort(np.append(np.arange(0, pair.duration + HORIZON, 3e-3), pair.duration))
    touches = sample_gaps(pair, starts, decelerations, times) <= 0
    sampled_contacts = np.where(touches.any(axis=1), times[touches.argmax(axis=1)], np.inf)
    assert (contacts <= sampled_contacts + 1e-9).all()
    for row in np.flatnonzero(is_in_contact):
        gaps = sample_gaps(pair, starts[[row]], decelerations[[row]], contacts[[row]])
        assert gaps[0, 0] <= 0


@settings(max_examples=25)
@given(erratic_accidents())
def test_every_recording_collides_by_its_end(accident: Accident) -> None:
    pair = pair_of(accident.paths, accident.sizes)
    assert contact_times(pair, NEITHER_BRAKES, [1.0])[0] <= pair.duration
    assert contact_times(pair, NEITHER_BRAKES, [1.0], window=(0, pair.duration))[0] <= pair.duration


@pytest.mark.parametrize(("offset", "touches"), [(1e-4, True), (-1e-4, False)])
def test_a_graze_of_a_thousandth_of_a_second_is_found(offset: float, touches: bool) -> None:
    """Two squares, corners ahead, pass each other at 50 m/s and overlap by 0.1 mm for 8 µs."""
    first_path = straight_path((-25, 0), 0, 25, 31)
    second_path = straight_path((25, np.sqrt(2) - offset), np.pi, 25, 31)
    paths = np.stack([first_path, second_path])
    paths[:, :, 2] += np.pi / 4
    pair = pair_of(paths, [[1, 1], [1, 1]], margin=1e-9)
    contact_time = contact_times(pair, NEITHER_BRAKES, [1.0])[0]
    assert np.isfinite(contact_time) == touches
    assert has_contact(pair, NEITHER_BRAKES, [1.0])[0] == touches
    if touches:
        assert contact_time == pytest.approx(1.0, abs=1e-5)


def test_a_corner_that_turns_into_the_other_is_found() -> None:
    """A bar makes half a turn in 0.4 s; the other box stands where only the bar's end passes."""
    turning_path = np.zeros((21, 3))
    turning_path[:, 2] = np.interp(np.arange(21), [8, 12], [0, np.pi])
    standing_path = np.tile([0.0, 3.05, 0.0], (21, 1))
    pair = pair_of([turning_path, standing_path], [[6, 0.2], [0.2, 0.2]], margin=1e-9)
    assert contact_times(pair, NEITHER_BRAKES, [1.0])[0] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("dart", ["turns", "goes and returns"])
def test_what_comes_and_goes_between_two_nodes_is_found(dart: str) -> None:
    """A bar sweeps past the other box within 0.1 s, or goes there and is back 0.2 s later."""
    bar_path = np.zeros((21, 3))
    if dart == "turns":
        bar_path[:, 2] = np.interp(np.arange(21), [10, 11], [-1.2, 1.2])
        other_x, contact_time = 3.05, 1.045
    else:
        bar_path[10, 0] = 3.0
        other_x, contact_time = 6.05, 1.0
    standing_path = np.tile([other_x, 0.0, 0.0], (21, 1))
    pair = pair_of([bar_path, standing_path], [[6, 0.2], [0.2, 0.2]], margin=1e-9)
    contacts = contact_times(pair, NEITHER_BRAKES, [1.0])
    assert contacts[0] == pytest.approx(contact_time, abs=0.005)
    assert has_contact(pair, NEITHER_BRAKES, [1.0])[0]


def test_times_and_speeds_of_a_rear_end() -> None:
    accident = rear_end_accident(striker=20, leader=10)
    pair = pair_of(accident.paths, accident.sizes)
    assert pair.margin == pytest.approx(1e-9, abs=1e-10)
    starts = np.array([[np.inf, np.inf], [4.8, np.inf], [4.0, np.inf]])
    decelerations = np.array([1.0, 5.0, 10.0])
    times = contact_times(pair, starts, decelerations)
    # 2 m of gap are left at 4.8 s; 10 τ − 5 τ²/2 = 2
    assert times[1] == pytest.approx(4.8 + (10 - np.sqrt(100 - 20)) / 5, abs=1e-5)
    assert times[[0, 2]] == pytest.approx([5.0, np.inf], abs=1e-6)
    impact = impacts(pair, starts, decelerations, times)
    assert impact.speeds[1] == pytest.approx([10 + np.sqrt(80), 10], abs=1e-4)
    assert impact.relative_speeds[:2] == pytest.approx([10, np.sqrt(80)], abs=1e-4)
    assert np.isnan(impact.speeds[2]).all()
    assert np.isnan(impact.relative_speeds[2])


def test_contact_counts_only_within_a_window() -> None:
    """The first car stands at 36.25 m; the other's front comes from 102 m."""
    accident = head_on_accident()
    pair = pair_of(accident.paths, accident.sizes)
    brakes = (np.array([[3.0, np.inf]]), np.array([8.0]))
    assert not has_contact(pair, *brakes, window=(0, 5))[0]
    assert has_contact(pair, *brakes, window=(0, 6.4))[0]
    assert contact_times(pair, *brakes)[0] == pytest.approx(6.375, abs=1e-5)
    assert contact_times(pair, *brakes, window=(6.5, 8))[0] == pytest.approx(6.5)


def test_arrays_of_other_shapes() -> None:
    accident = rear_end_accident()
    assert_raises(
        (lambda: pair_of(accident.paths[:1], accident.sizes), GeometryError, "paths: expected"),
        (lambda: pair_of(accident.paths, accident.sizes[:1]), GeometryError, "sizes: expected"),
    )
    pair = pair_of(accident.paths, accident.sizes)
    assert_raises(
        (lambda: contact_times(pair, [1.0], [4.0]), GeometryError, "starts: expected"),
    )
