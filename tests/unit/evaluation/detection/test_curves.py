"""The levels of recall at which curves are read, and cells of which not all rows count."""

import numpy as np
from refusals import assert_refused

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.detection import DetectionEvaluator, detection_protocol
from deepaccident_devkit.evaluation.detection.curves import Cell, curves, recall_matches
from deepaccident_devkit.evaluation.detection.matching import COLUMNS


def test_levels_of_recall_are_sums_in_double_precision() -> None:
    """A match for each level that recall exceeds: 7 of 56 is just 5/40, and does not exceed the sum
    of five 0.025.
    """
    assert (recall_matches(np.array([56]), 40) <= 7).sum() == 4
    assert (recall_matches(np.array([40]), 40) <= 40).sum() == 39
    assert recall_matches(np.array([2, 0]), 4).tolist() == [[1, 2, 2, 3], [1, 1, 1, 2]]


def test_a_first_row_that_does_not_count_has_no_precision_and_a_first_sample_may_have_no_rows() -> (
    None
):
    """Of three true boxes two are found by the second and the fourth row; the second sample is
    drawn twice or not.
    """
    ones = np.array([0, 1, 1, 1])
    cell = Cell(
        truths=np.array([1, 1, 1]),
        scores=np.array([0.9, 0.8, 0.7, 0.6]),
        sample=np.array([1, 1, 2, 2]),
        detected=ones,
        tp=np.array([0, 1, 0, 1]),
        spent=ones * 0,
        excused=ones * 0,
        matched=np.array([1, 3]),
        error_rows=ones[:0],
        errors=np.zeros((0, 4)),
    )
    times = np.array([[1, 1, 1], [1, 2, 1], [1, 0, 1]])
    for switches in ({}, {"global_sort": False}):
        made = curves(cell, detection_protocol("opencood", points=4, **switches), times)
        np.testing.assert_allclose(made.precision[0], [1, 1, 2 / 3, 0])
        np.testing.assert_allclose(made.average, [5 / 9, (1 + 1 + 3 / 4) / 4, 1 / 4])
    made = curves(cell, detection_protocol("paper", points=4, min_recall=0, min_precision=0), times)
    np.testing.assert_allclose(
        made.precision, [[0, 1 / 2, 2 / 3, 0], [0, 1, 13 / 18, 0], [0, 1 / 3, 0, 0]]
    )


def test_detections_of_groups_that_are_not_there_are_refused() -> None:
    """Of counts that somebody else has made."""
    evaluator = DetectionEvaluator("opencood")
    counts = {"token": "a", "truths": [0], "scores": [0.5]} | {
        name: [[]] * width for name, width in COLUMNS.items()
    }
    assert evaluator.result_of([counts | {"detections": [[0], [0]]}]).detections.tolist() == [[1]]
    for groups in ([-1], [0, 1]):
        others = counts | {"detections": [groups, [0] * len(groups)]}
        words = ("groups from 0 to 0", f"found {groups[0]} to {groups[-1]}")
        assert_refused(
            (lambda others=others: evaluator.result_of([others]), EvaluationError, words)
        )
