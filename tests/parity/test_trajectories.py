"""The golden paths (tests/data/golden, d_accident): continued, paired with the true ones, and how
far they are apart.

Made by the released functions under numpy 1.23.5, `*_stable_sort` with a stable sort
(tests/data/golden/README.md; docs/released_code.md, Paths). Points are [column, row] in cells of
0.5 m. Points, pairs, their order and costs equal; the sums of `eval_metrics` to 1e-9.
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

CELL = 0.5
pytestmark = pytest.mark.golden_cases("d_accident", "samples")


def metres(points: Mapping[str, Any]) -> dict[int, np.ndarray]:
    return {int(name): CELL * np.asarray(path) for name, path in points.items()}


def sides(golden) -> tuple[list[dict[int, np.ndarray]], dict[int, np.ndarray]]:
    """The six predictions and the truth, as long as the longest true path."""
    out = golden.entry["out"]
    truth = metres(out["matched_centers_label"])
    predictions = [padded(metres(one), longest(truth)) for one in out["matched_centers_pred"]]
    return predictions, padded(truth, longest(truth))


def as_cells(paths: Mapping[int, np.ndarray]) -> dict[str, Any]:
    return {str(name): (path / CELL).tolist() for name, path in paths.items()}


def test_continued_paths_equal_the_released_codes(golden) -> None:
    predictions, truth = sides(golden)
    out = golden.entry["out"]
    assert as_cells(truth) == out["trajectories_label_after_interpolation"]
    assert [as_cells(paths) for paths in predictions] == out[
        "trajectories_pred_after_interpolation"
    ]


def test_pairs_equal_the_released_codes(golden) -> None:
    predictions, truth = sides(golden)
    expected = golden.entry["out"]["traj_mapping_stable_sort"]
    assert len(expected) == len(predictions)
    for paths, (pairs, with_cost, unmatched_prediction, unmatched_truth) in zip(
        predictions, expected, strict=True
    ):
        found = match_trajectories(paths, truth)
        assert [list(pair) for pair in found.pairs] == pairs
        found_costs = [
            [list(pair), cost] for pair, cost in zip(found.pairs, found.costs, strict=True)
        ]
        assert [[[0, 0], 0.0], *found_costs] == (with_cost or [[[0, 0], 0.0]])
        assert list(found.unmatched_prediction) == unmatched_prediction
        assert list(found.unmatched_truth) == unmatched_truth


def test_who_is_whose_pair_in_each_prediction(golden) -> None:
    predictions, truth = sides(golden)
    matches = [
        {true: mine for mine, true in match_trajectories(paths, truth).pairs}
        for paths in predictions
    ]
    found = {str(name): [match.get(name, -1) for match in matches] for name in truth}
    assert found == golden.entry["out"]["mapping_all"]


def test_errors_equal_the_released_codes(golden) -> None:
    predictions, truth = sides(golden)
    found = trajectory_errors(
        predictions, truth, [match_trajectories(paths, truth) for paths in predictions]
    )
    ade, fde, missed = found.ade, found.fde, found.missed
    expected = golden.entry["out"]["eval_metrics"]
    assert_allclose(
        [ade, ade, ade, fde, fde, fde, missed, missed, found.count], expected, rtol=0, atol=1e-9
    )
