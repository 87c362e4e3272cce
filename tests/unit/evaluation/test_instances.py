"""Who overlaps whom, shares of cells and instances that match; paths of instances, their partners
and errors.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from refusals import assert_refused

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.instances import (
    PanopticQuality,
    SegmentationCounts,
    instance_paths,
    iou,
    longest,
    mask_counts,
    match_trajectories,
    padded,
    panoptic_quality,
    trajectory_errors,
    vpq_counts,
    vpq_matches,
)
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, to_orientation


@pytest.mark.parametrize("large", [0, 7_000_000, 2 * 10**9])
def test_instances_match_as_vpq_counts(large: int) -> None:
    """Whatever their ids are, which are numbered anew if they are large."""
    rng = np.random.default_rng(3)
    label = np.kron(rng.integers(0, 5, (3, 5, 5)), np.ones((4, 4), dtype=np.int64))
    prediction = np.roll(np.where(label > 0, label + 10, 0), 1, axis=2)
    prediction[2] = np.where(prediction[2] == 12, 40, prediction[2])
    small, prediction = prediction, np.where(prediction > 0, prediction + large, -1)
    matches, counts = vpq_matches(prediction, label), vpq_counts(prediction, label)
    assert_array_equal(np.bincount(matches[:, 0], minlength=3), counts.true_positive[:, 1])
    for name in ("iou", "true_positive", "false_positive", "false_negative"):
        assert_array_equal(getattr(counts, name), getattr(vpq_counts(small, label), name))
    for frame, predicted, true in matches.tolist():
        mine, theirs = prediction[frame] == predicted, label[frame] == true
        assert 2 * (mine & theirs).sum() > (mine | theirs).sum()
    assert_refused(
        (
            lambda: vpq_matches(prediction[0], label),
            GeometryError,
            ("prediction", "(T, H, W)", "(3, 20, 20)"),
        ),
        (lambda: vpq_counts(prediction[:2], label), GeometryError, ("(3, 20, 20)", "(2, 20, 20)")),
    )


@pytest.mark.parametrize(
    ("true", "predicted", "background", "overlap"),
    [
        ([3, 3, 3, 3, 0, 0], [5, 5, 0, 0, 0, 0], 0, 0),  # 2 of 4 cells
        ([3, 3, 3, 3, 0, 0], [5, 5, 5, 0, 0, 0], 2 / 3, 3 / 4),
        ([0, 0, 0, 1], [1, 0, 0, 0], 0, 0),  # of the background 2 of 4, too
        ([0, 0, 0, 0, 1], [1, 0, 0, 0, 0], 3 / 5, 0),
    ],
)
def test_half_of_the_union_is_no_match(
    true: list[int], predicted: list[int], background: float, overlap: float
) -> None:
    label, prediction = (np.array([[each]]) for each in (true, predicted))
    assert vpq_counts(prediction, label).iou.tolist() == [[background, overlap]]


def test_the_background_counts_as_one_that_is_never_missed_nor_a_false_alarm() -> None:
    label, prediction = np.zeros((2, 3, 4, 5), dtype=np.int64)
    label[0, 0, :3], prediction[0, 0, :2] = 1, 4
    label[1], prediction[1, 2] = 2, 5
    counts = vpq_counts(prediction, label)
    assert counts.iou.tolist() == [[17 / 18, 2 / 3], [0, 0], [1, 0]]
    assert counts.true_positive.tolist() == [[1, 1], [0, 0], [1, 0]]
    assert counts.false_positive.tolist() == [[0, 0], [0, 1], [0, 0]]
    assert counts.false_negative.tolist() == [[0, 0], [0, 1], [0, 0]]


def test_an_id_that_changes_is_a_miss_unless_frames_are_alone() -> None:
    label = np.full((4, 2, 2), 3)
    prediction = np.array([5, 5, 7, 7])[:, None, None] * np.ones((1, 2, 2), dtype=np.int64)
    found = [
        vpq_counts(prediction, label, temporally_consistent=each).true_positive[:, 1]
        for each in (True, False)
    ]
    assert [each.tolist() for each in found] == [[1, 1, 0, 1], [1, 1, 1, 1]]


def test_iou_of_classes() -> None:
    prediction, label = np.array([0, 1, 2, 2, 7]), np.array([0, 2, 2, 1, 2])
    counts = [mask_counts(prediction == each, label == each) for each in range(3)]
    assert counts[2] == SegmentationCounts(true_positive=1, false_positive=1, false_negative=2)
    assert [iou([each]) for each in counts] == [1.0, 0.0, 0.25]
    assert (iou([counts[2], counts[0]]), iou([])) == (2 / 5, 0.0)
    assert math.isnan(iou([], absent=math.nan))


def test_quality_of_sums() -> None:
    assert panoptic_quality(3.0, 4, 2, 6) == PanopticQuality(
        pq=3 / 8, sq=3 / 4, rq=4 / 8, denominator=8
    )
    assert panoptic_quality(0.0, 0, 1, 0) == PanopticQuality(pq=0.0, sq=0.0, rq=0.0, denominator=1)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_paths_of_instances(orientation) -> None:
    """Those of the first frame alone, with a point for each frame that they are in."""
    maps = np.zeros((3, 200, 200), dtype=np.int32)
    for frame, name, column in ((0, 1, 100), (0, 2, 40), (1, 2, 42), (1, 3, 10), (2, 1, 104)):
        maps[frame, 100:104, column : column + 4] = name
    grid = BevGrid()
    turned = to_orientation(maps, vectors=False, source="devkit", target=orientation)
    found = instance_paths(turned, grid.with_orientation(orientation))
    assert {name: path.tolist() for name, path in found.items()} == {
        1: [[1.0, 1.0], [3.0, 1.0]],
        2: [[-29.0, 1.0], [-28.0, 1.0]],
    }
    below = np.where(turned == 0, -3, turned)
    assert [
        path.tolist() for path in instance_paths(below, grid.with_orientation(orientation)).values()
    ] == [path.tolist() for path in found.values()]
    assert (
        instance_paths(maps[:2] * 0, grid),
        instance_paths(maps[1:] * [[[0]], [[1]]], grid),
    ) == ({}, {})


def row(*x: float) -> np.ndarray:
    return np.array([(each, 0.0) for each in x])


def test_a_path_that_ends_early_goes_on_ever_faster() -> None:
    made = padded({1: row(0, 2), 2: row(5), 3: row(0, 1, 2, 3, 4, 9)}, 5)
    expected = {1: [0, 2, 4, 8, 14], 2: [5] * 5, 3: [0, 1, 2, 3, 4, 9]}
    assert {name: path[:, 0].tolist() for name, path in made.items()} == expected
    assert (longest(made), longest({})) == (6, 0)


@pytest.mark.parametrize(
    ("predicted", "true", "pairs", "costs", "left"),
    [
        (
            {5: row(4, 4, 4)},
            {8: row(0, 0, 0)},
            ((5, 8),),
            (12,),
            ((), ()),
        ),  # a mean of 4 metres over the frames
        ({5: row(4.001, 4, 4)}, {8: row(0, 0, 0)}, (), (), ((5,), (8,))),
        (
            {5: row(0, 0), 6: row(9, 9)},
            {8: row(9, 8), 7: row(1, 2)},
            ((6, 8), (5, 7)),
            (1, 3),
            ((), ()),
        ),  # by cost
        (
            {4: row(99), 5: row(0), 2: row(50)},
            {8: row(1)},
            ((5, 8),),
            (1,),
            ((2, 4), ()),
        ),  # left over, ascending
        (
            {5: row(0, 0)},
            {8: row(9, 0), 9: row(0, 20), 7: row(0, 21)},
            (),
            (),
            ((5,), (7, 9, 8)),
        ),  # too far: used up
        ({5: row(0, 0, 7)}, {8: row(0, 0)}, ((5, 8),), (0,), ((), ())),  # only so many points count
    ],
)
def test_partners_are_the_nearest_two_first(predicted, true, pairs, costs, left) -> None:
    found = match_trajectories(predicted, true)
    assert (found.pairs, found.costs) == (pairs, costs)
    assert (found.unmatched_prediction, found.unmatched_truth) == left


def test_paths_of_several_lengths_are_refused() -> None:
    assert_refused(
        (
            lambda: match_trajectories({5: row(0, 0)}, {8: row(0, 0, 0)}),
            GeometryError,
            ("3 points", "padded"),
        ),
        (
            lambda: match_trajectories({}, {8: row(0, 0, 0), 9: row(0)}),
            GeometryError,
            ("3 points", "padded"),
        ),
    )


@pytest.mark.parametrize(
    ("end", "ade", "fde", "missed"),
    [
        (5.0, 2.5, 5.0, 0),
        (5.5, 2.75, 5.5, 1),
        (11.0, 5.5, 10.0, 1),
        (17.0, 8.0, 10.0, 1),
        (0.0, 0.0, 0.0, 0),
    ],
)
def test_errors_at_the_end_and_their_limits(
    end: float, ade: float, fde: float, missed: int
) -> None:
    truth, predicted = {1: row(0, 0)}, {4: row(0, end)}
    made = trajectory_errors(
        [predicted], truth, [replace(match_trajectories(truth, truth), pairs=((4, 1),))]
    )
    assert (made.ade, made.fde, made.missed, made.count) == (ade, fde, missed, 1)


@pytest.mark.parametrize(
    ("predictions", "errors"),
    [
        ([row(0, 0, 4), row(3, 2, 1)], (2, 1, 0, 1)),  # the one with the least error at the end
        ([row(3, 2, 1), row(0, 0, 4)], (2, 1, 0, 1)),
        ([row(3, 0, 1), row(0, 0, 1)], (4 / 3, 1, 0, 1)),  # the first of ties
        ([row(99, 99, 99), row(0, 0, 1)], (1 / 3, 1, 0, 1)),  # of those that have a partner
        ([row(99, 99, 99)], (0, 0, 0, 0)),
        ([None, row(0, 0, 1)], (0, 0, 0, 0)),  # an empty first prediction ends it
        ([row(0, 0, 1), None], (1 / 3, 1, 0, 1)),
        ([], (0, 0, 0, 0)),
    ],
)
def test_errors_are_those_of_the_best_prediction(predictions, errors) -> None:
    truth, given = {1: row(0, 0, 0)}, [{} if each is None else {7: each} for each in predictions]
    made = trajectory_errors(given, truth, [match_trajectories(each, truth) for each in given])
    assert (made.ade, made.fde, made.missed, made.count) == pytest.approx(errors)
