"""Accidents read off maps, and the matching of instances."""

import math

import numpy as np
import pytest

from deepaccident_devkit.evaluation.map_accidents import (
    AccidentReading,
    InstanceTracks,
    convex_hulls,
    map_accident,
    match_tracks,
)
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import LABEL_PROTOCOLS

RELEASED_LABELS = LABEL_PROTOCOLS["released"]


def tracks_of(names: list[int], *frames: list[tuple[float, float]]) -> InstanceTracks:
    center = np.array(frames, dtype=np.float64)
    return InstanceTracks(identity=np.array(names), center=center)


UNSEEN_POINT = (math.nan, math.nan)
MATCH_X_M = -7 / 6


@pytest.mark.parametrize(
    ("predicted", "truth", "gate", "pairs"),
    [
        # 1 is 3 m from 7 and 5 m from 8; 2 stands on 7 and is 3 m from 8: the least sum of all
        # would leave 1 without a partner
        (
            tracks_of([1, 2], [(MATCH_X_M, math.sqrt(9 - MATCH_X_M * MATCH_X_M)), (0, 0)]),
            tracks_of([7, 8], [(0, 0), (3, 0)]),
            4.0,
            {1: 7, 2: 8},
        ),
        (
            tracks_of([1, 2], [(MATCH_X_M, math.sqrt(9 - MATCH_X_M * MATCH_X_M)), (0, 0)]),
            tracks_of([7, 8], [(0, 0), (3, 0)]),
            6.0,
            {1: 8, 2: 7},
        ),
        # the mean over the frames in which both are seen
        (
            tracks_of([1, 2], [(0, 0), (9, 9)], [(0, 8), UNSEEN_POINT]),
            tracks_of([7, 8], [(0, 0), UNSEEN_POINT], [(0, 0), (9, 9)]),
            4.0,
            {1: 7},
        ),
        (
            tracks_of([1, 2], [(0, 0), (9, 9)], [(0, 8), UNSEEN_POINT]),
            tracks_of([7, 8], [(0, 0), UNSEEN_POINT], [(0, 0), (9, 9)]),
            3.99,
            {},
        ),
    ],
)
def test_as_many_instances_as_possible_are_matched_within_the_gate(
    predicted, truth, gate: float, pairs: dict[int, int]
) -> None:
    """A pair beyond the gate does not take its instances from others."""
    assert match_tracks(predicted, truth, gate) == pairs


POINT_AND_LINE_CELLS = [([100] * 4, range(100, 104), 5), ([101], [105], 7)]
DIAGONAL_CELLS = [([100, 104, 108], [100, 103, 106], 1), ([102], [99], 2)]
"""A line of direction (3, 4) and a cell exactly two cells from it, though their bounding boxes are
nearer.
"""


@pytest.mark.parametrize(
    ("cells", "grid", "danger_distance_m", "expected"),
    [
        (POINT_AND_LINE_CELLS, BevGrid(), 2.0, (0, (5, 7), math.sqrt(5) / 2)),
        (DIAGONAL_CELLS, BevGrid(), 1.01, (0, (1, 2), 1)),
        (DIAGONAL_CELLS, BevGrid(), 1.0, None),  # a metre is not less than a metre
        # cells of 0.5 × 1 m
        (
            POINT_AND_LINE_CELLS,
            BevGrid((-50, 50, 0.5), (-100, 100, 1.0)),
            2.0,
            (0, (5, 7), math.sqrt(2)),
        ),
        ([], BevGrid(), 1.0, None),
    ],
)
def test_points_and_lines_have_distances_too(
    cells, grid: BevGrid, danger_distance_m: float, expected
) -> None:
    maps = np.zeros((1, 200, 200), dtype=np.int32)
    for rows, columns, instance in cells:
        maps[0, rows, columns] = instance

    reading = AccidentReading(danger_distance=danger_distance_m)
    accident = map_accident(maps, grid, RELEASED_LABELS, reading)

    contact = accident.contact
    if expected is None:
        assert contact is None
    else:
        frame, ids, distance = expected
        assert (contact.frame, contact.ids) == (frame, ids)
        assert contact.distance == pytest.approx(distance)
    assert accident.positions.shape == (2, 2)
    assert np.isnan(accident.positions).all() == (expected is None)


@pytest.mark.parametrize(
    ("rules", "offset"),
    [(None, (0.5, 0.5)), (LABEL_PROTOCOLS["clean"], (0.5, 0.5)), (RELEASED_LABELS, (0, 1))],
)
def test_positions_are_means_of_cells_where_the_labels_have_them(
    rules, offset: tuple[float, float]
) -> None:
    maps = np.zeros((2, 200, 200), dtype=np.int32)
    maps[1, 100, [100, 102]] = 3
    maps[1, 101, 103] = 4
    accident = map_accident(maps, BevGrid(), rules, AccidentReading())

    x, y = offset
    assert accident.positions.tolist() == [[(1 + x) / 2, y / 2], [(3 + x) / 2, (1 + y) / 2]]

    explicit = accident.explicit(0.5)
    assert (explicit.time, explicit.score, explicit.ids) == (0.5, 1.0, None)

    empty = map_accident(maps[:1], BevGrid(), rules, AccidentReading())
    assert empty.explicit(0.5) is None


@pytest.mark.parametrize(
    ("points", "group", "hulls"),
    [
        ([(3, 4)], [0], [[(3, 4)]]),
        ([(0, 0), (2, 2), (1, 1)], [0, 0, 0], [[(0, 0), (2, 2)]]),
        (
            [(0, 0), (1, 1), (0, 2), (2, 0), (2, 2), (0, 1)],
            [0] * 6,
            [[(0, 0), (2, 0), (2, 2), (0, 2)]],
        ),
        # the last corner is repeated
        (
            [(5, 5), (0, 0), (0, 1)],
            [1, 0, 0],
            [[(0, 0), (0, 1)], [(5, 5), (5, 5)]],
        ),
    ],
)
def test_hulls_of_points_and_lines_have_one_or_two_corners(points, group, hulls) -> None:
    corners = convex_hulls(np.array(points), np.array(group))
    assert corners.tolist() == np.array(hulls).tolist()


def test_no_points_have_no_hulls() -> None:
    points = np.zeros((0, 2), dtype=np.int64)
    groups = np.zeros(0, dtype=np.int64)
    assert convex_hulls(points, groups).shape == (0, 1, 2)
