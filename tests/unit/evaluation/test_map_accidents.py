"""How accidents are read off maps, and which instances are the same."""

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

RELEASED = LABEL_PROTOCOLS["released"]


def tracks(names: list[int], *frames: list[tuple[float, float]]) -> InstanceTracks:
    return InstanceTracks(identity=np.array(names), center=np.array(frames, dtype=np.float64))


GONE, X = (math.nan, math.nan), -7 / 6


@pytest.mark.parametrize(
    ("predicted", "truth", "gate", "pairs"),
    [
        # 1 is 3 m from 7 and 5 m from 8; 2 stands on 7 and is 3 m from 8: the least sum of all
        # would leave 1 alone
        (
            tracks([1, 2], [(X, math.sqrt(9 - X * X)), (0, 0)]),
            tracks([7, 8], [(0, 0), (3, 0)]),
            4.0,
            {1: 7, 2: 8},
        ),
        (
            tracks([1, 2], [(X, math.sqrt(9 - X * X)), (0, 0)]),
            tracks([7, 8], [(0, 0), (3, 0)]),
            6.0,
            {1: 8, 2: 7},
        ),
        # the mean over the moments at which both are there
        (
            tracks([1, 2], [(0, 0), (9, 9)], [(0, 8), GONE]),
            tracks([7, 8], [(0, 0), GONE], [(0, 0), (9, 9)]),
            4.0,
            {1: 7},
        ),
        (
            tracks([1, 2], [(0, 0), (9, 9)], [(0, 8), GONE]),
            tracks([7, 8], [(0, 0), GONE], [(0, 0), (9, 9)]),
            3.99,
            {},
        ),
    ],
)
def test_who_is_matched_within_the_gate(
    predicted, truth, gate: float, pairs: dict[int, int]
) -> None:
    """As many as possible: pairs beyond the gate use nobody up."""
    assert match_tracks(predicted, truth, gate) == pairs


POINTS_AND_LINES = [([100] * 4, range(100, 104), 5), ([101], [105], 7)]
ACROSS = [([100, 104, 108], [100, 103, 106], 1), ([102], [99], 2)]
"""A line of direction (3, 4) and a cell exactly two cells from it; their bounding boxes are nearer.
"""


@pytest.mark.parametrize(
    ("cells", "grid", "danger", "expected"),
    [
        (POINTS_AND_LINES, BevGrid(), 2.0, (0, (5, 7), math.sqrt(5) / 2)),
        (ACROSS, BevGrid(), 1.01, (0, (1, 2), 1)),
        (ACROSS, BevGrid(), 1.0, None),  # a metre across is none either
        (
            POINTS_AND_LINES,
            BevGrid((-50, 50, 0.5), (-100, 100, 1.0)),
            2.0,
            (0, (5, 7), math.sqrt(2)),
        ),  # of 0.5 × 1 m
        ([], BevGrid(), 1.0, None),
    ],
)
def test_points_and_lines_have_distances_too(cells, grid: BevGrid, danger: float, expected) -> None:
    maps = np.zeros((1, 200, 200), dtype=np.int32)
    for rows, columns, name in cells:
        maps[0, rows, columns] = name
    found = map_accident(maps, grid, RELEASED, AccidentReading(danger_distance=danger))
    contact = found.contact and (found.contact.frame, found.contact.ids, found.contact.distance)
    assert contact == (expected and (*expected[:2], pytest.approx(expected[2])))
    assert found.positions.shape == (2, 2)
    assert np.isnan(found.positions).all() == (expected is None)


@pytest.mark.parametrize(
    ("rules", "place"),
    [(None, (0.5, 0.5)), (LABEL_PROTOCOLS["clean"], (0.5, 0.5)), (RELEASED, (0, 1))],
)
def test_positions_are_means_of_cells_where_the_labels_have_them(
    rules, place: tuple[float, float]
) -> None:
    maps = np.zeros((2, 200, 200), dtype=np.int32)
    maps[1, 100, [100, 102]], maps[1, 101, 103] = 3, 4
    found = map_accident(maps, BevGrid(), rules, AccidentReading())
    assert found.positions.tolist() == [
        [(x + place[0]) / 2, (y + place[1]) / 2] for x, y in ((1, 0), (3, 1))
    ]
    explicit = found.explicit(0.5)
    assert (explicit.time, explicit.score, explicit.ids) == (0.5, 1.0, None)
    assert map_accident(maps[:1], BevGrid(), rules, AccidentReading()).explicit(0.5) is None


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
        (
            [(5, 5), (0, 0), (0, 1)],
            [1, 0, 0],
            [[(0, 0), (0, 1)], [(5, 5), (5, 5)]],
        ),  # the last one again
    ],
)
def test_hulls_of_points_and_lines_have_one_or_two_corners(points, group, hulls) -> None:
    assert convex_hulls(np.array(points), np.array(group)).tolist() == [
        [list(each) for each in hull] for hull in hulls
    ]


def test_of_no_points_there_are_no_hulls() -> None:
    assert convex_hulls(np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.int64)).shape == (
        0,
        1,
        2,
    )
