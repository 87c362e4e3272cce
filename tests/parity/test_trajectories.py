"""The golden paths (tests/data/golden, d_accident): continued, matched with the true paths, and
their errors.

The released functions made them under numpy 1.23.5, `*_stable_sort` with a stable sort
(tests/data/golden/README.md; docs/released_code.md, Paths). Points are [column, row] in cells of
0.5 m. Points, pairs, their order and costs are equal; the sums of `eval_metrics` agree to 1e-9.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from deepaccident_devkit.evaluation.instances import (
    longest,
    match_trajectories,
    padded,
    trajectory_errors,
)

CELL_M = 0.5
pytestmark = pytest.mark.golden_cases("d_accident", "samples")


def to_metres(points: Mapping[str, Any]) -> dict[int, np.ndarray]:
    return {int(name): CELL_M * np.asarray(path) for name, path in points.items()}


def read_paths(golden) -> tuple[list[dict[int, np.ndarray]], dict[int, np.ndarray]]:
    """Return the six predictions and the truth, all as long as the longest true path."""
    out = golden.entry["out"]
    truth = to_metres(out["matched_centers_label"])
    length = longest(truth)
    predictions = [padded(to_metres(points), length) for points in out["matched_centers_pred"]]
    return predictions, padded(truth, length)


def to_cells(paths: Mapping[int, np.ndarray]) -> dict[str, Any]:
    return {str(name): (path / CELL_M).tolist() for name, path in paths.items()}


def test_continued_paths_equal_the_released_codes(golden) -> None:
    predictions, truth = read_paths(golden)
    out = golden.entry["out"]
    predicted_cells = [to_cells(paths) for paths in predictions]
    assert to_cells(truth) == out["trajectories_label_after_interpolation"]
    assert predicted_cells == out["trajectories_pred_after_interpolation"]


def test_pairs_equal_the_released_codes(golden) -> None:
    predictions, truth = read_paths(golden)
    expected = golden.entry["out"]["traj_mapping_stable_sort"]
    assert len(expected) == len(predictions)
    for paths, expected_matching in zip(predictions, expected, strict=True):
        matching = match_trajectories(paths, truth)

        pairs, pairs_with_cost, unmatched_prediction, unmatched_truth = expected_matching
        our_pairs = [list(pair) for pair in matching.pairs]
        assert our_pairs == pairs
        our_costs = [list(row) for row in zip(our_pairs, matching.costs, strict=True)]
        assert [[[0, 0], 0.0], *our_costs] == (pairs_with_cost or [[[0, 0], 0.0]])
        assert list(matching.unmatched_prediction) == unmatched_prediction
        assert list(matching.unmatched_truth) == unmatched_truth


def test_matched_ids_by_true_path_equal_the_released_codes(golden) -> None:
    predictions, truth = read_paths(golden)
    matchings = [
        {true: predicted for predicted, true in match_trajectories(paths, truth).pairs}
        for paths in predictions
    ]
    matched_ids = {str(name): [matching.get(name, -1) for matching in matchings] for name in truth}
    assert matched_ids == golden.entry["out"]["mapping_all"]


def test_errors_equal_the_released_codes(golden) -> None:
    predictions, truth = read_paths(golden)
    matchings = [match_trajectories(paths, truth) for paths in predictions]
    errors = trajectory_errors(predictions, truth, matchings)
    sums = [errors.ade] * 3 + [errors.fde] * 3 + [errors.missed] * 2 + [errors.count]
    assert_allclose(sums, golden.entry["out"]["eval_metrics"], rtol=0, atol=1e-9)
