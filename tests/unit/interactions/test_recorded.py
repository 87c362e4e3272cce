"""Post-encroachment times of recorded tracks: by hand, and against a fine grid of times."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.interaction_scenes import straight_path

from deepaccident_devkit.interactions import gaps_of_pairs
from deepaccident_devkit.interactions.encroachment import pieces_of, recorded_pet

EAST_PATH = straight_path(60, -20, 0, 10)
NORTH_PATH = straight_path(60, 0, -40, 10, 90)


def make_track(path, size=(4.0, 2.0)) -> np.ndarray:
    rows = [(np.nan,) * 5 if pose is None else (*pose[:2], *size, pose[2]) for pose in path]
    return np.array(rows)


def pet(first_path, second_path) -> float:
    return recorded_pet(pieces_of(make_track(first_path)), pieces_of(make_track(second_path)))


def test_one_crosses_after_the_other() -> None:
    assert pet(EAST_PATH, NORTH_PATH) == pytest.approx(1.4)
    assert pet(NORTH_PATH, EAST_PATH) == pytest.approx(-1.4)
    assert pet(EAST_PATH[:30], NORTH_PATH[:35]) == math.inf
    assert pet(EAST_PATH, straight_path(60, 0, -20, 10, 90)) == 0


def test_a_waiting_car_occupies_its_place_until_it_leaves() -> None:
    waiting_path = [(0.0, 0.0, 0.0)] * 21 + straight_path(30, 0, 0, 10, 90)[1:]
    crossing_path = straight_path(60, -40, 0, 10)
    # the waiting car's tail leaves y < 1 after 2 s + 0.1 · 2.0; the other's front is at x = −2
    # from 3.6 s
    pet_s = pet(waiting_path, crossing_path)
    assert pet_s == pytest.approx(3.6 + 0.1 - 2.2, abs=0.11)
    assert pet(crossing_path, waiting_path) == pytest.approx(-pet_s)
    assert len(pieces_of(make_track(waiting_path)).spans) == 30  # standing is one piece


def test_a_stop_on_the_way_is_a_piece_of_its_own() -> None:
    path = [
        *straight_path(11, -10, 0, 10),
        *[(0.0, 0.0, 0.0)] * 20,
        *straight_path(11, 0, 0, 10)[1:],
    ]
    pieces = pieces_of(make_track(path))
    np.testing.assert_allclose(pieces.velocity[:, 0], [10] * 10 + [0] + [10] * 10)
    np.testing.assert_allclose(pieces.spans[10], [1, 3])
    assert pet(path, straight_path(41, -20, 0, 10)) == 0
    # until 2.5 s it is behind the standing car
    assert pet(path, straight_path(26, -30, 0, 10)) == pytest.approx(1.6)


def test_gaps_are_bridged_and_one_frame_is_enough() -> None:
    every_fifth_pose = [pose if frame % 5 == 0 else None for frame, pose in enumerate(EAST_PATH)]
    assert pet(every_fifth_pose, NORTH_PATH) == pytest.approx(1.4)

    one_pose = [None] * 20 + [(0.0, 0.0, 0.0)] + [None] * 39
    assert pet(one_pose, NORTH_PATH) == pytest.approx(3.7 - 2.0)
    assert pet(one_pose, one_pose) == 0
    assert pet(one_pose, straight_path(60, 0, 9, 10)) == math.inf


coordinates = st.floats(-12, 12)
speeds = st.floats(0, 12)
straight_motions = st.tuples(coordinates, coordinates, speeds, st.floats(-180, 180))
NUM_FRAMES = 25
FINE_TIMES_S = np.linspace(0, 2.4, 241)


def interpolate_track(track: np.ndarray) -> np.ndarray:
    frame_times = np.arange(NUM_FRAMES) / 10
    x = np.interp(FINE_TIMES_S, frame_times, track[:, 0])
    y = np.interp(FINE_TIMES_S, frame_times, track[:, 1])
    return np.column_stack([x, y, np.tile(track[0, 2:], (len(FINE_TIMES_S), 1))])


@settings(max_examples=15)
@given(straight_motions, straight_motions)
def test_as_a_fine_grid_has_it(first_motion, second_motion) -> None:
    first_path = straight_path(NUM_FRAMES, *first_motion)
    second_path = straight_path(NUM_FRAMES, *second_motion)
    pet_s = pet(first_path, second_path)

    first_boxes = interpolate_track(make_track(first_path))
    second_boxes = interpolate_track(make_track(second_path))
    gaps = gaps_of_pairs(first_boxes[:, None], second_boxes[None])
    delays = np.abs(FINE_TIMES_S[None] - FINE_TIMES_S[:, None])
    if (gaps <= 0).any():
        assert abs(pet_s) <= delays[gaps <= 0].min() + 1e-9
    step_length = 0.01 * (first_motion[2] + second_motion[2])
    may_touch = gaps <= step_length + 1e-9  # between two times of the grid
    shortest_delay = delays[may_touch].min() - 0.02 if may_touch.any() else np.inf
    assert abs(pet_s) >= shortest_delay - 1e-9
