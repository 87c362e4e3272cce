"""Post-encroachment times of recorded tracks: by hand, and against a fine grid of times."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from interaction_scenes import straight

from deepaccident_devkit.interactions import gaps_of_pairs
from deepaccident_devkit.interactions.encroachment import pieces_of, recorded_pet


def track(path, size=(4.0, 2.0)) -> np.ndarray:
    return np.array(
        [(np.nan,) * 5 if place is None else (*place[:2], *size, place[2]) for place in path]
    )


def pet(first, second) -> float:
    return recorded_pet(pieces_of(track(first)), pieces_of(track(second)))


def test_one_crosses_after_the_other() -> None:
    east, north = straight(60, -20, 0, 10), straight(60, 0, -40, 10, 90)
    assert (pet(east, north), pet(north, east)) == (pytest.approx(1.4), pytest.approx(-1.4))
    assert (pet(east[:30], north[:35]), pet(east, straight(60, 0, -20, 10, 90))) == (math.inf, 0)


def test_who_waits_is_there_until_it_goes() -> None:
    waits = [(0.0, 0.0, 0.0)] * 21 + straight(30, 0, 0, 10, 90)[1:]
    crosses = straight(60, -40, 0, 10)
    # the waiting one's tail leaves y < 1 after 2 s + 0.1 · 2.0; the other's front is at x = −2 from
    # 3.6 s
    assert pet(waits, crosses) == pytest.approx(3.6 + 0.1 - 2.2, abs=0.11)
    assert pet(crosses, waits) == pytest.approx(-pet(waits, crosses))
    assert len(pieces_of(track(waits)).spans) == 30  # standing is one piece


def test_a_stop_on_the_way_is_a_piece_of_its_own() -> None:
    path = [*straight(11, -10, 0, 10), *[(0.0, 0.0, 0.0)] * 20, *straight(11, 0, 0, 10)[1:]]
    pieces = pieces_of(track(path))
    np.testing.assert_allclose(pieces.velocity[:, 0], [10] * 10 + [0] + [10] * 10)
    np.testing.assert_allclose(pieces.spans[10], [1, 3])
    assert pet(path, straight(41, -20, 0, 10)) == 0
    assert pet(path, straight(26, -30, 0, 10)) == pytest.approx(
        1.6
    )  # until 2.5 s it is behind the one that stands


def test_gaps_are_bridged_and_one_frame_is_enough() -> None:
    east, north = straight(60, -20, 0, 10), straight(60, 0, -40, 10, 90)
    assert pet(
        [place if frame % 5 == 0 else None for frame, place in enumerate(east)], north
    ) == pytest.approx(1.4)
    once = [None] * 20 + [(0.0, 0.0, 0.0)] + [None] * 39
    assert (pet(once, north), pet(once, once)) == (pytest.approx(3.7 - 2.0), 0)
    assert pet(once, straight(60, 0, 9, 10)) == math.inf


speeds, places = st.floats(0, 12), st.floats(-12, 12)
paths = st.tuples(places, places, speeds, st.floats(-180, 180))


@settings(max_examples=15)
@given(paths, paths)
def test_as_a_fine_grid_has_it(one, other) -> None:
    frames, fine = 25, np.linspace(0, 2.4, 241)
    tracks = [track(straight(frames, *each)) for each in (one, other)]
    found = recorded_pet(*map(pieces_of, tracks))
    dense = [
        np.column_stack(
            [
                *(np.interp(fine, np.arange(frames) / 10, rows[:, axis]) for axis in range(2)),
                np.tile(rows[0, 2:], (241, 1)),
            ]
        )
        for rows in tracks
    ]
    gaps = gaps_of_pairs(dense[0][:, None], dense[1][None])
    delays = np.abs(fine[None] - fine[:, None])
    if (gaps <= 0).any():
        assert abs(found) <= delays[gaps <= 0].min() + 1e-9
    reach = gaps <= 0.01 * (one[2] + other[2]) + 1e-9
    assert abs(found) >= (delays[reach].min() - 0.02 if reach.any() else np.inf) - 1e-9
