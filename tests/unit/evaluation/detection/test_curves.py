"""The levels of recall at which curves are read, and cells with rows that do not count."""

import numpy as np
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.detection import DetectionEvaluator, detection_protocol
from deepaccident_devkit.evaluation.detection.curves import Cell, curves, recall_matches
from deepaccident_devkit.evaluation.detection.matching import COLUMNS


def test_levels_of_recall_are_sums_in_double_precision() -> None:
    """A level needs the match with which recall exceeds it: 7 of 56 is just 5/40, and does not
    exceed the sum of five 0.025.
    """
    matches = recall_matches(np.array([56]), 40)
    assert (matches <= 7).sum() == 4
    matches = recall_matches(np.array([40]), 40)
    assert (matches <= 40).sum() == 39
    matches = recall_matches(np.array([2, 0]), 4)
    assert matches.tolist() == [[1, 2, 2, 3], [1, 1, 1, 2]]


def test_a_first_row_may_not_count_and_a_first_sample_may_have_no_rows() -> None:
    """The second and the fourth row match two of three true boxes; the second sample is drawn once,
    twice or not at all.
    """
    counts = np.array([0, 1, 1, 1])
    cell = Cell(
        truths=np.array([1, 1, 1]),
        scores=np.array([0.9, 0.8, 0.7, 0.6]),
        sample=np.array([1, 1, 2, 2]),
        detected=counts,
        tp=np.array([0, 1, 0, 1]),
        spent=counts * 0,
        excused=counts * 0,
        matched=np.array([1, 3]),
        error_rows=counts[:0],
        errors=np.zeros((0, 4)),
    )
    times = np.array([[1, 1, 1], [1, 2, 1], [1, 0, 1]])
    for global_sort in (True, False):
        rules = detection_protocol("opencood", points=4, global_sort=global_sort)
        result = curves(cell, rules, times)
        np.testing.assert_allclose(
            result.precision[0],
            [1, 1, 2 / 3, 0],
        )
        np.testing.assert_allclose(
            result.average,
            [5 / 9, (1 + 1 + 3 / 4) / 4, 1 / 4],
        )
    rules = detection_protocol("paper", points=4, min_recall=0, min_precision=0)
    result = curves(cell, rules, times)
    np.testing.assert_allclose(
        result.precision,
        [[0, 1 / 2, 2 / 3, 0], [0, 1, 13 / 18, 0], [0, 1 / 3, 0, 0]],
    )


def test_counts_of_unknown_groups_are_refused() -> None:
    """Counts may come from a file that another program made."""
    evaluator = DetectionEvaluator("opencood")
    counts = {
        "token": "a",
        "truths": [0],
        "scores": [0.5],
        **{name: [[]] * width for name, width in COLUMNS.items()},
        "detections": [[0], [0]],
    }
    assert evaluator.result_of([counts]).detections.tolist() == [[1]]
    for groups in ([-1], [0, 1]):
        counts["detections"] = [groups, [0] * len(groups)]
        words = ("groups from 0 to 0", f"found {groups[0]} to {groups[-1]}")
        assert_raises((lambda: evaluator.result_of([counts]), EvaluationError, words))
