"""When replays touch: against plain sampling, against closed forms, and contacts shorter than any
step.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import assert_refused
from replayed_accidents import head_on, rear_end, straight, wild_accidents

from deepaccident_devkit.collisions.contact import (
    Pair,
    contact_made,
    contact_times,
    impacts,
    pair_of,
)
from deepaccident_devkit.collisions.recorded import Accident
from deepaccident_devkit.collisions.replay import HORIZON, braking_plans, replay
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs

NOBODY = np.array([[np.inf, np.inf]])


def sampled_gaps(pair: Pair, starts: np.ndarray, hard: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(N, T) gaps less the margin at times."""
    rows, columns = (each.ravel() for each in np.indices((len(starts), len(times))))
    outlines = []
    for which, motion in enumerate(pair.motions):
        poses = replay(
            motion, braking_plans(motion, starts[:, which], hard), rows, times[columns]
        ).poses
        sizes = np.broadcast_to(pair.sizes[which], poses[:, :2].shape)
        outlines.append(np.concatenate([poses[:, :2], sizes, poses[:, 2:]], axis=1))
    return gaps_of_pairs(*outlines).reshape(len(starts), len(times)) - pair.margin


@settings(max_examples=15)
@given(wild_accidents(), st.integers(0, 10_000))
def test_no_sample_is_in_contact_before_the_first_contact(accident: Accident, seed: int) -> None:
    pair, rng = pair_of(accident.paths, accident.sizes), np.random.default_rng(seed)
    starts = np.where(rng.random((10, 2)) < 0.3, np.inf, rng.uniform(0, pair.duration, (10, 2)))
    hard = rng.uniform(3, 9, 10)
    times = np.sort(np.append(np.arange(0, pair.duration + HORIZON, 3e-3), pair.duration))
    hit = sampled_gaps(pair, starts, hard, times) <= 0
    first = np.where(hit.any(axis=1), times[hit.argmax(axis=1)], np.inf)
    found = contact_times(pair, starts, hard)
    np.testing.assert_array_equal(contact_made(pair, starts, hard), np.isfinite(found))
    assert (found <= first + 1e-9).all()
    touching = np.flatnonzero(np.isfinite(found))
    assert all(
        sampled_gaps(pair, starts[[row]], hard[[row]], found[[row]])[0, 0] <= 0 for row in touching
    )


@settings(max_examples=25)
@given(wild_accidents())
def test_every_recording_collides_by_its_end(accident: Accident) -> None:
    pair = pair_of(accident.paths, accident.sizes)
    assert contact_times(pair, NOBODY, [1.0])[0] <= pair.duration
    assert contact_times(pair, NOBODY, [1.0], window=(0, pair.duration))[0] <= pair.duration


@pytest.mark.parametrize(("offset", "touches"), [(1e-4, True), (-1e-4, False)])
def test_a_graze_of_a_thousandth_of_a_second_is_found(offset: float, touches: bool) -> None:
    """Two squares with their corners ahead pass each other at 50 m/s; they overlap by 0.1 mm, for 8
    µs.
    """
    paths = np.stack(
        [straight((-25, 0), 0, 25, 31), straight((25, np.sqrt(2) - offset), np.pi, 25, 31)]
    )
    paths[:, :, 2] += np.pi / 4
    pair = pair_of(paths, [[1, 1], [1, 1]], margin=1e-9)
    found = contact_times(pair, NOBODY, [1.0])
    assert (np.isfinite(found[0]), contact_made(pair, NOBODY, [1.0])[0]) == (touches, touches)
    if touches:
        assert found[0] == pytest.approx(1.0, abs=1e-5)


def test_a_corner_that_turns_into_the_other_is_found() -> None:
    """A standing bar turns once around its centre within 0.4 s; the other stands where only its end
    comes by.
    """
    turning = np.column_stack([np.zeros((21, 2)), np.interp(np.arange(21), [8, 12], [0, np.pi])])
    pair = pair_of(
        [turning, np.tile([0.0, 3.05, 0.0], (21, 1))], [[6, 0.2], [0.2, 0.2]], margin=1e-9
    )
    assert contact_times(pair, NOBODY, [1.0])[0] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("dart", ["turns", "goes and returns"])
def test_what_comes_and_goes_between_two_nodes_is_found(dart: str) -> None:
    """Within a tenth of a second a bar sweeps past the other; or it goes there and is back 0.2 s
    later.
    """
    frames = np.arange(21)
    yaws = np.interp(frames, [10, 11], [-1.2, 1.2]) if dart == "turns" else np.zeros(21)
    ahead = 3.0 * (frames == 10) if dart != "turns" else np.zeros(21)
    standing = np.tile([3.05 if dart == "turns" else 6.05, 0.0, 0.0], (21, 1))
    pair = pair_of(
        [np.column_stack([ahead, np.zeros(21), yaws]), standing],
        [[6, 0.2], [0.2, 0.2]],
        margin=1e-9,
    )
    assert contact_times(pair, NOBODY, [1.0])[0] == pytest.approx(
        1.045 if dart == "turns" else 1.0, abs=0.005
    )
    assert contact_made(pair, NOBODY, [1.0])[0]


def test_times_and_speeds_of_a_rear_end() -> None:
    accident = rear_end(striker=20, leader=10)
    pair = pair_of(accident.paths, accident.sizes)
    assert pair.margin == pytest.approx(1e-9, abs=1e-10)
    starts, hard = (
        np.array([[np.inf, np.inf], [4.8, np.inf], [4.0, np.inf]]),
        np.array([1.0, 5.0, 10.0]),
    )
    times = contact_times(pair, starts, hard)
    # 2 m of gap are left at 4.8 s; 10 τ − 5 τ²/2 = 2
    assert times[1] == pytest.approx(4.8 + (10 - np.sqrt(100 - 20)) / 5, abs=1e-5)
    assert times[[0, 2]] == pytest.approx([5.0, np.inf], abs=1e-6)
    impact = impacts(pair, starts, hard, times)
    assert impact.speeds[1] == pytest.approx([10 + np.sqrt(80), 10], abs=1e-4)
    assert impact.relative_speeds[:2] == pytest.approx([10, np.sqrt(80)], abs=1e-4)
    assert np.isnan(impact.speeds[2]).all()
    assert np.isnan(impact.relative_speeds[2])


def test_contact_counts_within_a_window_alone() -> None:
    accident = head_on()
    pair = pair_of(accident.paths, accident.sizes)
    starts, hard = (
        np.array([[3.0, np.inf]]),
        np.array([8.0]),
    )  # stands at 36.25 m, the other's front comes from 102 m
    assert not contact_made(pair, starts, hard, window=(0, 5))[0]
    assert contact_made(pair, starts, hard, window=(0, 6.4))[0]
    assert contact_times(pair, starts, hard)[0] == pytest.approx(6.375, abs=1e-5)
    assert contact_times(pair, starts, hard, window=(6.5, 8))[0] == pytest.approx(6.5)


def test_arrays_of_other_shapes() -> None:
    accident = rear_end()
    assert_refused(
        (lambda: pair_of(accident.paths[:1], accident.sizes), GeometryError, "paths: expected"),
        (lambda: pair_of(accident.paths, accident.sizes[:1]), GeometryError, "sizes: expected"),
    )
    pair = pair_of(accident.paths, accident.sizes)
    assert_refused(
        (lambda: contact_times(pair, [1.0], [4.0]), GeometryError, "starts: expected"),
    )
