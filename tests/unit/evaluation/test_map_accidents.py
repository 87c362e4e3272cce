"""How accidents are read off maps, and which instances are the same."""

import math

import numpy as np
import pytest

from deepaccident_devkit.evaluation.map_accidents import (
    AccidentReading,
    InstanceTracks,
    accident_of,
    convex_hulls,
    match_tracks,
)
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import LABEL_PROTOCOLS

RELEASED = LABEL_PROTOCOLS["released"]


def test_pairs_beyond_the_gate_use_nobody_up() -> None:
    """1 is 3 m from 7 and 5 m from 8; 2 stands on 7 and is 3 m from 8: the least sum of all would leave 1 alone."""
    truth = InstanceTracks(identity=np.array([7, 8]), center=np.array([[[0.0, 0.0], [3.0, 0.0]]]))
    x = -7 / 6
    predicted = InstanceTracks(identity=np.array([1, 2]), center=np.array([[[x, math.sqrt(9 - x * x)], [0.0, 0.0]]]))
    assert match_tracks(predicted, truth, 4.0) == {1: 7, 2: 8}
    assert match_tracks(predicted, truth, 6.0) == {1: 8, 2: 7}


def test_points_and_lines_have_distances_too() -> None:
    grid = BevGrid()
    maps = np.zeros((1, 200, 200), dtype=np.int32)
    maps[0, 100, 100:104] = 5
    maps[0, 101, 105] = 7
    found = accident_of(maps, grid, RELEASED, AccidentReading(danger_distance=2.0))
    assert found.contact.ids == (5, 7)
    assert found.contact.distance == pytest.approx(math.sqrt(5) / 2)


def test_of_no_points_there_are_no_hulls() -> None:
    assert convex_hulls(np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.int64)).shape == (0, 1, 2)


def test_where_nothing_comes_near_there_are_no_positions() -> None:
    calm = accident_of(np.zeros((1, 200, 200), dtype=np.int32), BevGrid(), RELEASED, AccidentReading())
    assert calm.contact is None
    assert calm.positions.shape == (2, 2)
    assert np.isnan(calm.positions).all()


def test_a_metre_across_is_no_accident_either() -> None:
    """A line of direction (3, 4) and a cell exactly two cells from it; their bounding boxes are nearer."""
    maps = np.zeros((1, 200, 200), dtype=np.int32)
    maps[0, [100, 104, 108], [100, 103, 106]] = 1
    maps[0, 102, 99] = 2
    found = accident_of(maps, BevGrid(), RELEASED, AccidentReading(danger_distance=1.01))
    assert found.contact.distance == 1
    assert accident_of(maps, BevGrid(), RELEASED, AccidentReading()).contact is None


def test_the_distance_of_two_paths_is_the_mean_over_the_moments_at_which_both_are_there() -> None:
    gone = (math.nan, math.nan)
    predicted = InstanceTracks(identity=np.array([1, 2]), center=np.array([[(0, 0), (9, 9)], [(0, 8), gone]]))
    truth = InstanceTracks(identity=np.array([7, 8]), center=np.array([[(0, 0), gone], [(0, 0), (9, 9)]]))
    assert match_tracks(predicted, truth, 4.0) == {1: 7}
    assert match_tracks(predicted, truth, 3.99) == {}
