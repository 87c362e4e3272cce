"""The levels of recall at which curves are read."""

import numpy as np

from deepaccident_devkit.evaluation.metrics.detection.curves import recall_matches


def test_levels_of_recall_are_sums_in_double_precision() -> None:
    """A match for each level that recall exceeds: 7 of 56 is just 5/40, and does not exceed the sum of five 0.025."""
    assert (recall_matches(np.array([56]), 40) <= 7).sum() == 4
    assert (recall_matches(np.array([40]), 40) <= 40).sum() == 39
    assert recall_matches(np.array([2, 0]), 4).tolist() == [[1, 2, 2, 3], [1, 1, 1, 2]]
