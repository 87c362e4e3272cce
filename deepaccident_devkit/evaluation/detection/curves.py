"""Precision, recall and average precision from the counts of many samples, under three rules.

Each sample may be drawn several times, or not at all: resamples share everything that does not
depend on how often.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import fsum, nan
from typing import NamedTuple

import numpy as np

from deepaccident_devkit.evaluation.detection.boxes import DetectionProtocol
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """N detections of one class in one range at one threshold, in descending order of score.

    They belong to S samples, which are sorted by token.

    Attributes:
        truths: (S,) how many true boxes of each sample count.
        scores: (N,) descending scores of the detections; ties are ordered by sample, then as in
            `matching.existing_detections`.
        sample: (N,) index of the sample of each detection.
        detected: (N,) 1 if the detection counts, otherwise 0.
        tp: (N,) change that the detection causes in the number of found true boxes (0 or 1).
        spent: (N,) change that it causes in the number of detections that are matched with true
            boxes that do not count.
        excused: (N,) change that it causes in the number of true boxes that are neither found nor
            missed.
        matched: (M,) ascending indices of the matches that decide the points of the `released`
            curve.
        error_rows: (E,) ascending, unique indices of the matches that have errors; only one cell of
            each class has them.
        errors: (E, 4) errors in the order of `matching.ERRORS`; NaN if unknown.
    """

    truths: IntArray
    scores: FloatArray
    sample: IntArray
    detected: IntArray
    tp: IntArray
    spent: IntArray
    excused: IntArray
    matched: IntArray
    error_rows: IntArray
    errors: FloatArray


class Points(NamedTuple):
    """The curves of a cell in each of D draws; for a single draw, the first axis is missing.

    Attributes:
        precision: (D, P) precision in [0, 1].
        recall: (D, P) recall in [0, 1].
        average: (D,) average precision in [0, 1].
        errors: (D, 4) mean errors; NaN if no error is known.
    """

    precision: FloatArray
    recall: FloatArray
    average: FloatArray | float
    errors: FloatArray


def curves(cell: Cell, protocol: DetectionProtocol, times: IntArray) -> Points:
    """Compute precision, recall, average precision and mean errors of a cell under a protocol.

    Args:
        cell: Cell of S samples.
        protocol: Rules, such as the type of the curve.
        times: (D, S) how often each draw contains each sample.
    """
    if protocol.curve == "released":
        return _released_curves(cell, protocol, times)
    compute_curve = _nuscenes_curve if protocol.curve == "nuscenes" else _voc_curve
    curves_by_draw = []
    for drawn_cell in _drawn_cells(cell, protocol, times):
        curves_by_draw.append(compute_curve(drawn_cell, protocol))
    fields = zip(*curves_by_draw, strict=True)
    return Points(*(np.array(field, dtype=np.float64) for field in fields))


def average_precision(precision: FloatArray, min_precision: float = 0.0) -> float:
    """Return the average precision (AP) of a curve: the mean of the precision over its points.

    With `min_precision`, only the part above it counts, rescaled to [0, 1], as in `calc_ap` of the
    nuScenes devkit (`eval/detection/algo.py`).

    >>> import numpy as np
    >>> average_precision(np.array([1.0, 0.75, 0.5, 0.0]))
    0.5625

    Args:
        precision: (P,) precision at evenly spaced levels of recall, without the lowest levels that
            the protocol leaves out; 0 where the recall is never reached.
        min_precision: Precision that counts as 0.

    Returns:
        The average precision in [0, 1].
    """
    if not min_precision:
        return _mean(precision)
    excess = np.maximum(precision - min_precision, 0)
    return _mean(excess) / (1 - min_precision)


def recall_matches(truths: IntArray, points: int) -> IntArray:
    """Return the numbers of the matches at which the released code reads its curve.

    Matches are numbered from 1 in descending order of score. Each level of recall takes the first
    match for which number / truths exceeds it. Levels are sums of 1/points in double precision;
    their rounding decides ties.

    Args:
        truths: (D,) numbers of true boxes.
        points: Number P of levels up to a recall of 1.

    Returns:
        (D, P) ascending numbers; greater than `truths` for a level that is never exceeded.
    """
    levels = np.cumsum(np.full(points, 1.0 / points))
    positive_truths = np.maximum(truths, 1)[:, None]
    lower_bounds = np.floor(levels * positive_truths).astype(np.int64) - 1
    number = np.maximum(lower_bounds, 1)
    for _ in range(3):
        number += number / positive_truths <= levels
    return np.asarray(number)


class _Sums:
    """Cumulative sums over selected rows of a cell, for each draw."""

    def __init__(
        self, cell: Cell, times: IntArray, rows: IntArray, values: IntArray | None = None
    ) -> None:
        """Sum the values of rows, each as often as the draw contains its sample.

        Args:
            cell: Cell of S samples.
            times: (D, S) how often each draw contains each sample.
            rows: (R,) ascending indices of the rows to sum.
            values: (R,) value of each row; None if all are 1.
        """
        weights = np.take(times, cell.sample[rows], axis=1)
        if values is not None:
            weights = weights * values
        self._rows = rows
        self._sums: AnyArray = np.zeros((len(times), len(rows) + 1), dtype=np.int32)
        np.cumsum(weights, axis=1, dtype=np.int32, out=self._sums[:, 1:])

    @property
    def all(self) -> IntArray:
        """(D,) sums over all selected rows."""
        return np.asarray(self._sums[:, -1])

    def above(self, row_counts: IntArray) -> IntArray:
        """Return the sums over the selected rows that are among the cell's first rows.

        Args:
            row_counts: (D, P) number of first rows of the cell.

        Returns:
            Sums, shape (D, P).
        """
        counts = np.searchsorted(self._rows, row_counts)
        return np.take_along_axis(self._sums, counts, axis=1)

    def find_rows(self, number: IntArray) -> IntArray:
        """Return the rows of the cell at which the sum reaches the numbers.

        Args:
            number: (D, P) numbers from 1.

        Returns:
            (D, P) indices of rows; arbitrary if the sum never reaches the number.
        """
        # search all draws in one sorted array: shift each draw above the sums of the previous ones
        draw = np.arange(len(self._sums))[:, None]
        lift = (self.all.max(initial=0) + 1) * draw
        lifted_sums = self._sums[:, 1:] + lift
        row_count = len(self._rows)
        index = np.searchsorted(lifted_sums.reshape(-1), number + lift)
        index -= row_count * draw
        return np.asarray(self._rows[np.minimum(index, row_count - 1)])


def _released_curves(cell: Cell, protocol: DetectionProtocol, times: IntArray) -> Points:
    """Compute the curves as the released code does."""
    truths = times @ cell.truths
    matches = _Sums(cell, times, cell.matched)
    number = recall_matches(truths, protocol.points)
    is_reached = number <= matches.all[:, None]
    row_counts = np.zeros(number.shape, dtype=np.int64)
    if is_reached.any():
        reached_number = np.where(is_reached, number, 1)
        threshold = cell.scores[matches.find_rows(reached_number)]
        # number of rows with at least each score: rows with equal scores are added together
        reached_counts = np.searchsorted(-cell.scores, -threshold, side="right")
        row_counts = np.where(is_reached, reached_counts, 0)
    tp = _Sums(cell, times, np.flatnonzero(cell.tp)).above(row_counts)
    spent = _Sums(cell, times, np.flatnonzero(cell.spent)).above(row_counts)
    detected = _Sums(cell, times, np.flatnonzero(cell.detected)).above(row_counts)
    changed = np.flatnonzero(cell.excused)
    excused = _Sums(cell, times, changed, cell.excused[changed]).above(row_counts)
    # if all detections down to a score match boxes that do not count, the released code divides 0
    # by 0 and stops
    precision = _ratio(tp, detected - spent, 0.0)
    known_recall = _ratio(tp, truths[:, None] - excused, nan)
    start = int(protocol.min_recall * protocol.points)
    mean_errors = []
    for errors in _errors_at(cell, times, row_counts):
        mean_errors.append([_mean(column) for column in errors[start:].T])
    return Points(
        precision=precision,
        recall=np.where(is_reached, known_recall, 0.0),
        average=np.array([average_precision(draw[start:]) for draw in precision]),
        errors=np.array(mean_errors),
    )


def _errors_at(cell: Cell, times: IntArray, row_counts: IntArray) -> FloatArray:
    """Return the mean errors of the matches among a cell's first rows; 1 if there are no matches.

    Args:
        cell: Cell of S samples.
        times: (D, S) how often each draw contains each sample.
        row_counts: (D, P) number of first rows.

    Returns:
        Errors, shape (D, P, 4), in the order of `matching.ERRORS`.
    """
    if not len(cell.errors):
        return np.ones((*row_counts.shape, 4))
    match_counts = _Sums(cell, times, cell.error_rows).above(row_counts)
    weights = np.take(times, cell.sample[cell.error_rows], axis=1)
    error_counts = np.searchsorted(cell.error_rows, row_counts)
    means = []
    for errors in cell.errors.T:
        sums = np.zeros((len(times), len(errors) + 1))
        weighted_errors = weights * errors
        weighted_errors[weights == 0] = 0.0  # instead of NaN
        np.cumsum(weighted_errors, axis=1, out=sums[:, 1:])
        error_sums = np.take_along_axis(sums, error_counts, axis=1)
        means.append(_ratio(error_sums, match_counts, 1.0))
    return np.stack(means, axis=-1)


def _drawn_cells(cell: Cell, protocol: DetectionProtocol, times: IntArray) -> Iterator[Cell]:
    """Yield the cell of each draw, with a sample's rows repeated as often as the draw contains it.

    A block of successive rows is repeated as a whole. Its rows belong to the same sample, and if
    scores are sorted over all samples, have the same score.
    """
    is_start = np.diff(cell.sample, prepend=-1) != 0
    if protocol.global_sort:
        is_start |= np.diff(cell.scores, prepend=np.inf) != 0
    starts = np.flatnonzero(is_start)
    lengths = np.diff(np.append(starts, len(cell.scores)))
    error_index = np.full(len(cell.scores), -1)
    error_index[cell.error_rows] = np.arange(len(cell.error_rows))
    for draw in times:
        block_times = draw[cell.sample[starts]]
        blocks = np.repeat(np.arange(len(starts)), block_times)
        block_lengths = lengths[blocks]
        block_ends = np.cumsum(block_lengths)
        offsets = starts[blocks] - (block_ends - block_lengths)
        rows = np.arange(block_lengths.sum()) + np.repeat(offsets, block_lengths)
        row_errors = error_index[rows]
        has_error = row_errors >= 0
        yield replace(
            cell,
            truths=cell.truths * draw,
            scores=cell.scores[rows],
            sample=cell.sample[rows],
            detected=cell.detected[rows],
            tp=cell.tp[rows],
            spent=cell.spent[rows],
            excused=cell.excused[rows],
            error_rows=np.flatnonzero(has_error),
            errors=cell.errors[row_errors[has_error]],
        )


def _nuscenes_curve(cell: Cell, protocol: DetectionProtocol) -> Points:
    """Compute the precision-recall curve of one draw as the nuScenes devkit does."""
    truths = int(cell.truths.sum())
    levels = np.linspace(0, 1, protocol.points)
    hits = np.cumsum(cell.tp)
    num_counted = np.cumsum(cell.detected - cell.spent)
    if not hits.size or not hits[-1] or not truths:
        zeros = np.zeros(len(levels))
        return Points(precision=zeros, recall=levels, average=0.0, errors=np.ones(4))
    recall = hits / truths
    precision = np.interp(levels, recall, _ratio(hits, num_counted, 0.0), right=0)
    scores = np.interp(levels, recall, cell.scores, right=0)
    start = round(protocol.min_recall * (protocol.points - 1)) + 1
    end = int(np.searchsorted(levels, recall[-1], side="right"))
    return Points(
        precision=precision,
        recall=levels,
        average=average_precision(precision[start:], protocol.min_precision),
        errors=_interpolated_errors(cell, scores[start:end]),
    )


def _interpolated_errors(cell: Cell, scores: FloatArray) -> FloatArray:
    """Average the running means of errors at the scores, shape (4,).

    The result is 1 if there are no scores or no errors, and NaN if no match has a known error.
    """
    if not len(scores) or not len(cell.errors):
        return np.ones(4)
    is_known = ~np.isnan(cell.errors)
    known_errors = np.where(is_known, cell.errors, 0)
    error_counts = np.cumsum(is_known, axis=0)
    running_means = _ratio(np.cumsum(known_errors, axis=0), error_counts, 0.0)
    rising_scores = cell.scores[cell.error_rows][::-1]
    means = []
    for column in running_means.T:
        interpolated_errors = np.interp(scores, rising_scores, column[::-1])
        means.append(_mean(interpolated_errors))
    return np.where(error_counts[-1] > 0, means, nan)


def _voc_curve(cell: Cell, protocol: DetectionProtocol) -> Points:
    """Compute the curve of one draw as PASCAL VOC does; its average precision is the exact area."""
    truths = int(cell.truths.sum())
    levels = np.linspace(0, 1, protocol.points)
    hits = np.cumsum(cell.tp)
    num_counted = np.cumsum(cell.detected - cell.spent)
    precision = _ratio(hits, num_counted, 0.0)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    # for each number of found true boxes, the best precision with at least as many; each one raises
    # recall by 1/truths
    best_precision = envelope[cell.tp > 0]
    required_hits = np.maximum(np.ceil(levels * truths - 1e-9).astype(np.int64), 1)
    index = np.minimum(required_hits - 1, len(best_precision))
    sampled_precision = np.append(best_precision, 0.0)[index]
    average = fsum(best_precision.tolist()) / truths if truths else 0.0
    no_errors = np.full(4, nan)
    return Points(precision=sampled_precision, recall=levels, average=average, errors=no_errors)


def _ratio(part: AnyArray, total: IntArray, default: float) -> FloatArray:
    """Return `part / total`, or `default` where the total is not positive."""
    shape = np.broadcast_shapes(part.shape, total.shape)
    result = np.full(shape, default)
    np.divide(part, total, out=result, where=total > 0)
    return result


def _mean(values: FloatArray) -> float:
    """Return the mean of values (N,), from their exactly rounded sum."""
    total = fsum(values.tolist())
    return total / len(values)
