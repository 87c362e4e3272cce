"""Curves of cells against loops over their rows, and the levels of recall at which they are read."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.detection import DetectionEvaluator, DetectionProtocol, detection_protocol
from deepaccident_devkit.evaluation.metrics.detection.curves import Cell, curves, recall_matches
from deepaccident_devkit.evaluation.metrics.detection.frame_counts import COLUMNS

SAMPLES = 4


def test_levels_of_recall_are_sums_in_double_precision() -> None:
    """A match for each level that recall exceeds: 7 of 56 is just 5/40, and does not exceed the sum of five 0.025."""
    assert (recall_matches(np.array([56]), 40) <= 7).sum() == 4
    assert (recall_matches(np.array([40]), 40) <= 40).sum() == 39
    assert recall_matches(np.array([2, 0]), 4).tolist() == [[1, 2, 2, 3], [1, 1, 1, 2]]


def cell_of(seed: int, *, many: bool) -> Cell:
    """Some rows of four samples, with equal scores; of the first row nothing counts, and the first sample has none."""
    source = np.random.default_rng(seed)
    count = int(source.integers(12, 20)) if many else int(source.integers(0, 4))
    detected = source.uniform(size=count) < 0.8
    detected[:1] = False
    tp = detected & (source.uniform(size=count) < 0.6)
    spent = detected & ~tp & (source.uniform(size=count) < 0.3)
    error_rows = np.flatnonzero(tp)
    errors = source.uniform(size=(len(error_rows), 4)).round(3)
    errors[source.uniform(size=errors.shape) < 0.2] = math.nan
    return Cell(
        truths=source.integers(0, 6, SAMPLES) + many,
        scores=np.sort(source.integers(1, 9, count) / 8)[::-1],
        sample=np.sort(source.integers(1, SAMPLES, count)),
        detected=detected.astype(np.int64),
        tp=tp.astype(np.int64),
        spent=spent.astype(np.int64),
        excused=source.integers(-1, 2, count) * (source.uniform(size=count) < 0.2),
        matched=np.flatnonzero(tp | (source.uniform(size=count) < 0.1)),
        error_rows=error_rows,
        errors=errors,
    )


def running(cell: Cell, end: int) -> tuple[int, int]:
    """How many true boxes the first rows find, and how many detections among them count."""
    return sum(cell.tp[:end].tolist()), sum((cell.detected - cell.spent)[:end].tolist())


def plain_nuscenes(cell: Cell, rules: DetectionProtocol) -> tuple[list[float], float, list[float]]:
    truths, levels = int(cell.truths.sum()), np.linspace(0, 1, rules.points)
    found = [running(cell, end + 1) for end in range(len(cell.scores))]
    if not truths or not found or not found[-1][0]:
        return [0.0] * rules.points, 0.0, [1.0] * 4
    recall = [both / truths for both, _ in found]
    precision = np.interp(levels, recall, [both / counted if counted else 0.0 for both, counted in found], right=0)
    first = round(rules.min_recall * (rules.points - 1)) + 1
    least = rules.min_precision
    average = float(np.mean([max(each - least, 0) / (1 - least) for each in precision[first:]]))
    reached = [at for at in range(first, rules.points) if levels[at] <= recall[-1]]
    errors = []
    for column in cell.errors.T.tolist():
        known = [[each for each in column[: end + 1] if not math.isnan(each)] for end in range(len(column))]
        means = [float(np.mean(each)) if each else 0.0 for each in known]
        scores = np.interp(levels, recall, cell.scores, right=0)[reached]
        at = np.interp(scores, cell.scores[cell.error_rows][::-1], means[::-1]) if reached else [1.0]
        errors.append(float(np.mean(at)) if known[-1] or not reached else math.nan)
    return precision.tolist(), average, errors


def plain_voc(cell: Cell, rules: DetectionProtocol) -> tuple[list[float], float]:
    truths = int(cell.truths.sum())
    found = [running(cell, end + 1) for end in range(len(cell.scores))]
    best = [
        max((both / counted for both, counted in found if both >= least and counted), default=0.0)
        for least in range(99)
    ]
    points = [best[max(math.ceil(level * truths - 1e-9), 1)] for level in np.linspace(0, 1, rules.points)]
    return points, sum(best[1 : (found[-1][0] if found else 0) + 1]) / truths if truths else 0.0


@pytest.mark.parametrize("switches", [{}, {"points": 7, "min_recall": 0.3}, {"min_precision": 0.5, "min_recall": 0.9}])
@pytest.mark.parametrize("seed", range(12))
def test_the_curves_of_nuscenes_and_voc_are_those_of_loops(seed: int, switches: dict[str, Any]) -> None:
    cell, times = cell_of(seed, many=seed > 2), np.ones((1, SAMPLES), dtype=np.int64)
    rules = detection_protocol("paper", **switches)
    made, (precision, average, errors) = curves(cell, rules, times), plain_nuscenes(cell, rules)
    np.testing.assert_allclose(made.precision[0], precision, atol=1e-12)
    np.testing.assert_allclose([*made.average, *made.errors[0]], [average, *errors], atol=1e-12)
    assert made.recall[0].tolist() == np.linspace(0, 1, rules.points).tolist()
    rules = detection_protocol("opencood", points=rules.points)
    made, (precision, average) = curves(cell, rules, times), plain_voc(cell, rules)
    np.testing.assert_allclose(made.precision[0], precision, atol=1e-12)
    assert made.average[0] == pytest.approx(average, abs=1e-12)
    assert np.isnan(made.errors).all()


def plain_released(cell: Cell, rules: DetectionProtocol) -> tuple[list[float], list[float], list[float]]:
    truths, levels = int(cell.truths.sum()), np.cumsum(np.full(rules.points, 1 / rules.points))
    precision, recall, errors = [], [], []
    for level in levels:
        exceeds = [number for number in range(1, len(cell.matched) + 1) if number / max(truths, 1) > level]
        if not exceeds:
            precision.append(0.0)
            recall.append(0.0)
            errors.append([1.0] * 4)
            continue
        end = int(np.sum(cell.scores >= cell.scores[cell.matched[exceeds[0] - 1]]))
        both, counted = running(cell, end)
        there = truths - int(cell.excused[:end].sum())
        precision.append(both / counted if counted > 0 else 0.0)
        recall.append(both / there if there > 0 else math.nan)
        some = cell.errors[cell.error_rows < end]
        errors.append(some.mean(axis=0).tolist() if len(some) else [1.0] * 4)
    return precision, recall, np.mean(errors[int(rules.min_recall * rules.points) :], axis=0).tolist()


def copies_of(cell: Cell, often: list[int]) -> Cell:
    """The cell with the rows of each sample so many times, behind one another."""
    rows = np.repeat(np.arange(len(cell.scores)), np.array(often)[cell.sample])
    which = np.repeat(np.arange(len(cell.error_rows)), np.array(often)[cell.sample[cell.error_rows]])
    names = ("scores", "sample", "detected", "tp", "spent", "excused")
    return replace(
        cell,
        truths=cell.truths * often,
        **{name: getattr(cell, name)[rows] for name in names},
        matched=np.flatnonzero(np.isin(rows, cell.matched)),
        error_rows=np.flatnonzero(np.isin(rows, cell.error_rows)),
        errors=cell.errors[which],
    )


@pytest.mark.parametrize("points", [40, 7])
@pytest.mark.parametrize("seed", range(12))
def test_the_released_curve_of_several_draws_is_that_of_loops(seed: int, points: int) -> None:
    cell, rules = cell_of(seed, many=seed > 2), detection_protocol("released", points=points)
    cell = replace(cell, errors=np.nan_to_num(cell.errors))
    draws = [[1, 1, 1, 1], [2, 0, 1, 3], [0, 0, 0, 0], [0, 3, 0, 0]]
    made = curves(cell, rules, np.array(draws))
    for draw, often in enumerate(draws):
        precision, recall, errors = plain_released(copies_of(cell, often), rules)
        np.testing.assert_allclose(made.precision[draw], precision, atol=1e-12)
        np.testing.assert_allclose(made.recall[draw], recall, atol=1e-12)
        np.testing.assert_allclose(made.errors[draw], errors, atol=1e-12)
        first = int(rules.min_recall * points)
        assert made.average[draw] == pytest.approx(np.mean(precision[first:]))


def test_detections_of_groups_that_are_not_there_are_refused() -> None:
    """Of counts that somebody else has made."""
    evaluator = DetectionEvaluator("opencood")
    counts = {"token": "a", "truths": [0], "scores": [0.5]} | {name: [[]] * width for name, width in COLUMNS.items()}
    assert evaluator.result_of([counts | {"detections": [[0], [0]]}]).detections.tolist() == [[1]]
    for group in (-1, 1):
        with pytest.raises(EvaluationError, match=f"detections: expected groups from 0 to 0, found {group} to {group}"):
            evaluator.result_of([counts | {"detections": [[group], [0]]}])
    with pytest.raises(EvaluationError, match="found 0 to 1"):
        evaluator.result_of([counts | {"detections": [[0, 1], [0, 0]]}])
