"""Who overlaps whom: shares of cells, and instances that match."""

import math

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.instances import (
    PanopticQuality,
    SegmentationCounts,
    iou,
    mask_counts,
    panoptic_quality,
    vpq_counts,
    vpq_matches,
)


@pytest.mark.parametrize("large", [0, 7_000_000])
def test_instances_match_as_vpq_counts(large: int) -> None:
    rng = np.random.default_rng(3)
    label = np.kron(rng.integers(0, 5, (3, 5, 5)), np.ones((4, 4), dtype=np.int64))
    prediction = np.roll(np.where(label > 0, label + 10, 0), 1, axis=2)
    prediction[2] = np.where(prediction[2] == 12, 40, prediction[2])
    prediction = np.where(prediction > 0, prediction + large, -1)
    matches, counts = vpq_matches(prediction, label), vpq_counts(prediction, label)
    assert_array_equal(np.bincount(matches[:, 0], minlength=3), counts.true_positive[:, 1])
    for frame, predicted, true in matches.tolist():
        mine, theirs = prediction[frame] == predicted, label[frame] == true
        assert 2 * (mine & theirs).sum() > (mine | theirs).sum()
    with pytest.raises(GeometryError, match=r"prediction: expected \(T, H, W\) as the label's"):
        vpq_matches(prediction[0], label)


def test_half_of_the_union_is_no_match() -> None:
    label, prediction = np.zeros((2, 1, 6, 6), dtype=np.int64)
    label[0, :2, :4], prediction[0, :2, :2] = 3, 5
    assert vpq_counts(prediction, label).true_positive.tolist() == [[1, 0]]
    prediction[0, 0, 2] = 5
    assert vpq_counts(prediction, label).iou[0, 1] == 5 / 8


def test_of_the_background_too_half_of_the_union_is_no_match() -> None:
    for cells, overlap in ((4, 0), (5, 3 / 5)):
        label, prediction = np.zeros((2, 1, 1, cells), dtype=np.int64)
        label[..., -1], prediction[..., 0] = 1, 1
        assert vpq_counts(prediction, label).iou[0, 0] == overlap


def test_iou_of_classes() -> None:
    prediction, label = np.array([0, 1, 2, 2, 7]), np.array([0, 2, 2, 1, 2])
    counts = [mask_counts(prediction == each, label == each) for each in range(3)]
    assert counts[2] == SegmentationCounts(true_positive=1, false_positive=1, false_negative=2)
    assert [iou([each]) for each in counts] == [1.0, 0.0, 0.25]
    assert iou([counts[2], counts[0]]) == 2 / 5
    assert iou([]) == 0.0
    assert math.isnan(iou([], absent=math.nan))


def test_quality_of_sums() -> None:
    assert panoptic_quality(3.0, 4, 2, 6) == PanopticQuality(pq=3 / 8, sq=3 / 4, rq=4 / 8, denominator=8)
    assert panoptic_quality(0.0, 0, 1, 0) == PanopticQuality(pq=0.0, sq=0.0, rq=0.0, denominator=1)


def test_the_background_counts_as_one_that_is_never_missed_nor_a_false_alarm() -> None:
    label, prediction = np.zeros((2, 3, 4, 5), dtype=np.int64)
    label[0, 0, :3], prediction[0, 0, :2] = 1, 4
    label[1], prediction[1, 2] = 2, 5
    counts = vpq_counts(prediction, label)
    assert counts.iou.tolist() == [[17 / 18, 2 / 3], [0, 0], [1, 0]]
    assert counts.true_positive.tolist() == [[1, 1], [0, 0], [1, 0]]
    assert counts.false_positive.tolist() == [[0, 0], [0, 1], [0, 0]]
    assert counts.false_negative.tolist() == [[0, 0], [0, 1], [0, 0]]
