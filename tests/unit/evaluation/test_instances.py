"""Shares of cells and instances that match; paths of instances, their partners and errors."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from support.expected_errors import assert_raises

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
    """Large ids, which are renumbered, change nothing."""
    generator = np.random.default_rng(3)
    label = np.kron(generator.integers(0, 5, (3, 5, 5)), np.ones((4, 4), dtype=np.int64))
    small_ids = np.roll(np.where(label > 0, label + 10, 0), 1, axis=2)
    small_ids[2] = np.where(small_ids[2] == 12, 40, small_ids[2])
    prediction = np.where(small_ids > 0, small_ids + large, -1)

    matches = vpq_matches(prediction, label)
    counts = vpq_counts(prediction, label)
    assert_array_equal(np.bincount(matches[:, 0], minlength=3), counts.true_positive[:, 1])

    small_counts = vpq_counts(small_ids, label)
    for name in ("iou", "true_positive", "false_positive", "false_negative"):
        assert_array_equal(getattr(counts, name), getattr(small_counts, name))

    for frame, predicted_id, true_id in matches.tolist():
        predicted_mask = prediction[frame] == predicted_id
        true_mask = label[frame] == true_id
        assert 2 * (predicted_mask & true_mask).sum() > (predicted_mask | true_mask).sum()

    assert_raises(
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
        ([0, 0, 0, 1], [1, 0, 0, 0], 0, 0),  # the background, too, has only 2 of 4 cells
        ([0, 0, 0, 0, 1], [1, 0, 0, 0, 0], 3 / 5, 0),
    ],
)
def test_half_of_the_union_is_no_match(
    true: list[int], predicted: list[int], background: float, overlap: float
) -> None:
    label = np.array([[true]])
    prediction = np.array([[predicted]])
    assert vpq_counts(prediction, label).iou.tolist() == [[background, overlap]]


def test_the_background_is_an_instance_without_misses_and_false_alarms() -> None:
    label = np.zeros((3, 4, 5), dtype=np.int64)
    label[0, 0, :3] = 1
    label[1] = 2
    prediction = np.zeros((3, 4, 5), dtype=np.int64)
    prediction[0, 0, :2] = 4
    prediction[1, 2] = 5

    counts = vpq_counts(prediction, label)
    assert counts.iou.tolist() == [[17 / 18, 2 / 3], [0, 0], [1, 0]]
    assert counts.true_positive.tolist() == [[1, 1], [0, 0], [1, 0]]
    assert counts.false_positive.tolist() == [[0, 0], [0, 1], [0, 0]]
    assert counts.false_negative.tolist() == [[0, 0], [0, 1], [0, 0]]


def test_an_id_that_changes_is_a_miss_unless_frames_are_judged_separately() -> None:
    label = np.full((4, 2, 2), 3)
    ids = np.array([5, 5, 7, 7])
    prediction = ids[:, None, None] * np.ones((1, 2, 2), dtype=np.int64)

    counts = vpq_counts(prediction, label, temporally_consistent=True)
    assert counts.true_positive[:, 1].tolist() == [1, 1, 0, 1]

    counts = vpq_counts(prediction, label, temporally_consistent=False)
    assert counts.true_positive[:, 1].tolist() == [1, 1, 1, 1]


def test_iou_of_classes() -> None:
    prediction = np.array([0, 1, 2, 2, 7])
    label = np.array([0, 2, 2, 1, 2])
    counts = [mask_counts(prediction == index, label == index) for index in range(3)]

    assert counts[2] == SegmentationCounts(true_positive=1, false_positive=1, false_negative=2)
    assert [iou([class_counts]) for class_counts in counts] == [1.0, 0.0, 0.25]
    assert iou([counts[2], counts[0]]) == 2 / 5
    assert iou([]) == 0.0
    assert math.isnan(iou([], absent=math.nan))


def test_quality_of_sums() -> None:
    assert panoptic_quality(3.0, 4, 2, 6) == PanopticQuality(
        pq=3 / 8, sq=3 / 4, rq=4 / 8, denominator=8
    )
    assert panoptic_quality(0.0, 0, 1, 0) == PanopticQuality(pq=0.0, sq=0.0, rq=0.0, denominator=1)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_paths_of_instances(orientation) -> None:
    """Only instances of the first frame have a path, with a point for each frame they are in."""
    maps = np.zeros((3, 200, 200), dtype=np.int32)
    for frame, instance, column in ((0, 1, 100), (0, 2, 40), (1, 2, 42), (1, 3, 10), (2, 1, 104)):
        maps[frame, 100:104, column : column + 4] = instance

    turned = to_orientation(maps, vectors=False, source="devkit", target=orientation)
    turned_grid = BevGrid().with_orientation(orientation)

    paths = instance_paths(turned, turned_grid)
    points = {instance: path.tolist() for instance, path in paths.items()}
    assert points == {
        1: [[1.0, 1.0], [3.0, 1.0]],
        2: [[-29.0, 1.0], [-28.0, 1.0]],
    }

    negative_background = np.where(turned == 0, -3, turned)
    paths = instance_paths(negative_background, turned_grid)
    assert [path.tolist() for path in paths.values()] == list(points.values())

    empty_maps = np.zeros_like(maps)
    assert instance_paths(empty_maps, BevGrid()) == {}

    empty_first_frame = maps[1:] * [[[0]], [[1]]]
    assert instance_paths(empty_first_frame, BevGrid()) == {}


def path_along_x(*x: float) -> np.ndarray:
    return np.column_stack([x, np.zeros(len(x))])


def test_a_path_that_ends_early_goes_on_with_growing_steps() -> None:
    paths = {
        1: path_along_x(0, 2),
        2: path_along_x(5),
        3: path_along_x(0, 1, 2, 3, 4, 9),
    }
    padded_paths = padded(paths, 5)

    assert {instance: path[:, 0].tolist() for instance, path in padded_paths.items()} == {
        1: [0, 2, 4, 8, 14],
        2: [5] * 5,
        3: [0, 1, 2, 3, 4, 9],
    }
    assert longest(padded_paths) == 6
    assert longest({}) == 0


@pytest.mark.parametrize(
    ("predicted", "true", "pairs", "costs", "unmatched"),
    [
        # a mean of 4 m over the frames
        (
            {5: path_along_x(4, 4, 4)},
            {8: path_along_x(0, 0, 0)},
            ((5, 8),),
            (12,),
            ((), ()),
        ),
        ({5: path_along_x(4.001, 4, 4)}, {8: path_along_x(0, 0, 0)}, (), (), ((5,), (8,))),
        # the pair of least cost is first
        (
            {5: path_along_x(0, 0), 6: path_along_x(9, 9)},
            {8: path_along_x(9, 8), 7: path_along_x(1, 2)},
            ((6, 8), (5, 7)),
            (1, 3),
            ((), ()),
        ),
        # instances without a partner are in ascending order
        (
            {4: path_along_x(99), 5: path_along_x(0), 2: path_along_x(50)},
            {8: path_along_x(1)},
            ((5, 8),),
            (1,),
            ((2, 4), ()),
        ),
        # a pair that is too far apart uses its instances up
        (
            {5: path_along_x(0, 0)},
            {8: path_along_x(9, 0), 9: path_along_x(0, 20), 7: path_along_x(0, 21)},
            (),
            (),
            ((5,), (7, 9, 8)),
        ),
        # points beyond the true path do not count
        (
            {5: path_along_x(0, 0, 7)},
            {8: path_along_x(0, 0)},
            ((5, 8),),
            (0,),
            ((), ()),
        ),
    ],
)
def test_the_nearest_pair_is_matched_first(predicted, true, pairs, costs, unmatched) -> None:
    matching = match_trajectories(predicted, true)
    assert (matching.pairs, matching.costs) == (pairs, costs)
    assert (matching.unmatched_prediction, matching.unmatched_truth) == unmatched


def test_paths_of_several_lengths_are_refused() -> None:
    assert_raises(
        (
            lambda: match_trajectories({5: path_along_x(0, 0)}, {8: path_along_x(0, 0, 0)}),
            GeometryError,
            ("3 points", "padded"),
        ),
        (
            lambda: match_trajectories({}, {8: path_along_x(0, 0, 0), 9: path_along_x(0)}),
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
    truth = {1: path_along_x(0, 0)}
    predicted = {4: path_along_x(0, end)}
    matching = replace(match_trajectories(truth, truth), pairs=((4, 1),))

    errors = trajectory_errors([predicted], truth, [matching])
    assert (errors.ade, errors.fde, errors.missed, errors.count) == (ade, fde, missed, 1)


@pytest.mark.parametrize(
    ("predictions", "errors"),
    [
        # the prediction with the least error at the end
        (
            [path_along_x(0, 0, 4), path_along_x(3, 2, 1)],
            (2, 1, 0, 1),
        ),
        ([path_along_x(3, 2, 1), path_along_x(0, 0, 4)], (2, 1, 0, 1)),
        # the first of equal ones
        (
            [path_along_x(3, 0, 1), path_along_x(0, 0, 1)],
            (4 / 3, 1, 0, 1),
        ),
        # only predictions with a partner count
        (
            [path_along_x(99, 99, 99), path_along_x(0, 0, 1)],
            (1 / 3, 1, 0, 1),
        ),
        ([path_along_x(99, 99, 99)], (0, 0, 0, 0)),
        ([None, path_along_x(0, 0, 1)], (0, 0, 0, 0)),  # an empty first prediction ends the search
        ([path_along_x(0, 0, 1), None], (1 / 3, 1, 0, 1)),
        ([], (0, 0, 0, 0)),
    ],
)
def test_errors_are_those_of_the_best_prediction(predictions, errors) -> None:
    truth = {1: path_along_x(0, 0, 0)}
    predicted = [{} if path is None else {7: path} for path in predictions]
    matchings = [match_trajectories(paths, truth) for paths in predicted]

    result = trajectory_errors(predicted, truth, matchings)
    assert (result.ade, result.fde, result.missed, result.count) == pytest.approx(errors)
