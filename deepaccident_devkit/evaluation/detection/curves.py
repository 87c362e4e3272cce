"""From the counts of many samples to precision, recall and average precision, by three rules.

Each sample may be taken several times, or not at all: resamples share all that does not depend on
these numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from math import fsum, nan
from typing import Final, NamedTuple

import numpy as np

from deepaccident_devkit.evaluation.detection.boxes import DetectionProtocol
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """Detections of one class within one range at one threshold, by score; S samples by token.

    Attributes:
        truths: (S,) number of true boxes of each sample that count.
        scores: (N,) scores of its detections, falling; equal ones by sample, then in the order of
            `rows_taken`.
        sample: (N,) sample of each detection.
        detected: (N,) 1 where the detection counts.
        tp: (N,) number of true boxes that are found with this detection (0 or 1).
        spent: (N,) number of detections that go to true boxes that do not count.
        excused: (N,) change of the number of true boxes that are neither found nor missed.
        matched: (M,) rows of the matches that decide the points of the `released` curve, rising.
        error_rows: (E,) rows of the matches that have errors, rising, each once; in one cell per
            class.
        errors: (E, 4) in the order of `matching.ERRORS`, NaN where unknown.
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
    """The curves of a cell in each of D draws; for one draw without the first axis.

    Attributes:
        precision: (D, P) shares.
        recall: (D, P) shares.
        average: (D,) average precision as a share.
        errors: (D, 4) mean errors, NaN without.
    """

    precision: FloatArray
    recall: FloatArray
    average: FloatArray | float
    errors: FloatArray


def curves(cell: Cell, protocol: DetectionProtocol, times: IntArray) -> Points:
    """Return precision, recall, average precision and mean errors of a cell by the protocol.

    Args:
        cell: Cell of S samples.
        protocol: The rules.
        times: How often each sample is taken in each draw, shape (D, S).
    """
    if protocol.curve == "released":
        return _released(cell, protocol, times)
    curve = _CURVES[protocol.curve]
    draws = [curve(drawn, protocol) for drawn in _drawn(cell, protocol, times)]
    columns = zip(*draws, strict=True)
    return Points(*(np.array(column, dtype=np.float64) for column in columns))


def average_precision(precision: FloatArray, min_precision: float = 0.0) -> float:
    """Return the average precision (AP) of a curve: the mean of the precision over its points.

    With `min_precision` the part above it counts, spread to [0, 1], as in `calc_ap` of the nuScenes
    devkit (`eval/detection/algo.py`).

    >>> import numpy as np
    >>> average_precision(np.array([1.0, 0.75, 0.5, 0.0]))
    0.5625

    Args:
        precision: (P,) precision at evenly spaced levels of recall, without the lowest levels that
            the protocol leaves out; 0 where the recall is never reached.
        min_precision: Precision that counts as 0.

    Returns:
        A share in [0, 1].
    """
    if not min_precision:
        return _mean(precision)
    above = np.maximum(precision - min_precision, 0)
    return _mean(above) / (1 - min_precision)


def recall_matches(truths: IntArray, points: int) -> IntArray:
    """Return the matches at which the released code reads its curve, from 1 by falling score.

    For each level it takes the first match with a number / truths above it. Levels are
    sums of 1/points in double precision; their rounding decides ties.

    Args:
        truths: (D,) numbers of true boxes.
        points: P, number of levels up to a recall of 1.

    Returns:
        (D, P) rising; more than `truths` for a level that is never exceeded.
    """
    levels = np.cumsum(np.full(points, 1.0 / points))
    positive_truths = np.maximum(truths, 1)[:, None]
    number = np.maximum(np.floor(levels * positive_truths).astype(np.int64) - 1, 1)
    for _ in range(3):
        number += number / positive_truths <= levels
    return np.asarray(number)


class _Sums:
    """Sums over a cell's rows in each draw."""

    def __init__(
        self, cell: Cell, times: IntArray, rows: IntArray, values: IntArray | None = None
    ) -> None:
        """Count some rows as often as their samples are taken.

        Args:
            cell: Cell of S samples.
            times: How often each sample is taken in each draw, shape (D, S).
            rows: Rows that are counted.
            values: What each row adds; None for 1.
        """
        weights = np.take(times, cell.sample[rows], axis=1)
        if values is not None:
            weights = weights * values
        self._rows = rows
        self._sums: AnyArray = np.zeros((len(times), len(rows) + 1), dtype=np.int32)
        np.cumsum(weights, axis=1, dtype=np.int32, out=self._sums[:, 1:])

    @property
    def all(self) -> IntArray:
        """(D,) sums of all rows."""
        return np.asarray(self._sums[:, -1])

    def above(self, ends: IntArray) -> IntArray:
        """Return the sums of the cell's first rows, as many as `ends` (D, P), shape (D, P)."""
        counts = np.searchsorted(self._rows, ends)
        return np.take_along_axis(self._sums, counts, axis=1)

    def row_of(self, number: IntArray) -> IntArray:
        """Return the row with which the sum reaches a number.

        Args:
            number: (D, P) numbers from 1.

        Returns:
            (D, P) rows; any row if the sum never reaches it.
        """
        draws = np.arange(len(self._sums))[:, None]
        # one sorted array for all draws: each is lifted above the sums of the draws before it
        lift = (self.all.max(initial=0) + 1) * draws
        index = np.searchsorted((self._sums[:, 1:] + lift).reshape(-1), number + lift)
        index -= len(self._rows) * draws
        return np.asarray(self._rows[np.minimum(index, len(self._rows) - 1)])


def _released(cell: Cell, protocol: DetectionProtocol, times: IntArray) -> Points:
    """Return the curve of the released code."""
    truths = times @ cell.truths
    matched = _Sums(cell, times, cell.matched)
    number = recall_matches(truths, protocol.points)
    is_reached = number <= matched.all[:, None]
    ends = np.zeros(number.shape, dtype=np.int64)
    if is_reached.any():
        threshold = cell.scores[matched.row_of(np.where(is_reached, number, 1))]
        # number of rows with at least each score: equal scores come in together
        reached_ends = np.searchsorted(-cell.scores, -threshold, side="right")
        ends = np.where(is_reached, reached_ends, 0)
    tp = _Sums(cell, times, np.flatnonzero(cell.tp)).above(ends)
    spent = _Sums(cell, times, np.flatnonzero(cell.spent)).above(ends)
    detected = _Sums(cell, times, np.flatnonzero(cell.detected)).above(ends)
    changed = np.flatnonzero(cell.excused)
    excused = _Sums(cell, times, changed, cell.excused[changed]).above(ends)
    # where all detections of a score went to boxes that do not count, the released code divides
    # 0 by 0 and stops
    precision = _ratio(tp, detected - spent, 0.0)
    recall = np.where(is_reached, _ratio(tp, truths[:, None] - excused, nan), 0.0)
    start = int(protocol.min_recall * protocol.points)
    errors = []
    for draw in _errors_at(cell, times, ends):
        errors.append([_mean(column) for column in draw[start:].T])
    return Points(
        precision=precision,
        recall=recall,
        average=np.array([average_precision(draw[start:]) for draw in precision]),
        errors=np.array(errors),
    )


def _errors_at(cell: Cell, times: IntArray, ends: IntArray) -> FloatArray:
    """Return mean errors of the matches among the first rows of a cell; 1 without matches.

    Args:
        cell: Cell of S samples.
        times: How often each sample is taken in each draw, shape (D, S).
        ends: Numbers of rows, shape (D, P).

    Returns:
        Errors, shape (D, P, 4).
    """
    if not len(cell.errors):
        return np.ones((*ends.shape, 4))
    matches = _Sums(cell, times, cell.error_rows).above(ends)
    weights = np.take(times, cell.sample[cell.error_rows], axis=1)
    rows = np.searchsorted(cell.error_rows, ends)
    means = []
    for error in cell.errors.T:
        sums = np.zeros((len(times), len(error) + 1))
        weighted = weights * error
        weighted[weights == 0] = 0.0  # and not NaN
        np.cumsum(weighted, axis=1, out=sums[:, 1:])
        means.append(_ratio(np.take_along_axis(sums, rows, axis=1), matches, 1.0))
    return np.stack(means, axis=-1)


def _drawn(cell: Cell, protocol: DetectionProtocol, times: IntArray) -> Iterator[Cell]:
    """Yield the cell of each draw, with the rows of a sample repeated as often as it is taken."""
    is_start = np.diff(cell.sample, prepend=-1) != 0
    if protocol.global_sort:
        is_start |= np.diff(cell.scores, prepend=np.inf) != 0
    starts = np.flatnonzero(is_start)
    lengths = np.diff(np.append(starts, len(cell.scores)))
    error_index = np.full(len(cell.scores), -1)
    error_index[cell.error_rows] = np.arange(len(cell.error_rows))
    for draw in times:
        copies = np.repeat(np.arange(len(starts)), draw[cell.sample[starts]])
        length = lengths[copies]
        ends = np.cumsum(length)
        offsets = np.repeat(starts[copies] - (ends - length), length)
        rows = np.arange(ends[-1] if ends.size else 0) + offsets
        error = error_index[rows]
        yield replace(
            cell,
            truths=cell.truths * draw,
            scores=cell.scores[rows],
            sample=cell.sample[rows],
            detected=cell.detected[rows],
            tp=cell.tp[rows],
            spent=cell.spent[rows],
            excused=cell.excused[rows],
            error_rows=np.flatnonzero(error >= 0),
            errors=cell.errors[error[error >= 0]],
        )


def _nuscenes(cell: Cell, protocol: DetectionProtocol) -> Points:
    """Return the precision-recall curve of one draw, as the nuScenes devkit computes it."""
    truths = int(cell.truths.sum())
    levels = np.linspace(0, 1, protocol.points)
    hits = np.cumsum(cell.tp)
    counted = np.cumsum(cell.detected - cell.spent)
    if not hits.size or not hits[-1] or not truths:
        zeros = np.zeros(len(levels))
        return Points(precision=zeros, recall=levels, average=0.0, errors=np.ones(4))
    recall = hits / truths
    row_precision = np.divide(hits, counted, out=np.zeros(len(hits)), where=counted > 0)
    precision = np.interp(levels, recall, row_precision, right=0)
    scores = np.interp(levels, recall, cell.scores, right=0)
    start = round(protocol.min_recall * (protocol.points - 1)) + 1
    last = int(np.searchsorted(levels, recall[-1], side="right")) - 1
    return Points(
        precision=precision,
        recall=levels,
        average=average_precision(precision[start:], protocol.min_precision),
        errors=_interpolated_errors(cell, scores, start, last),
    )


def _interpolated_errors(cell: Cell, scores: FloatArray, start: int, last: int) -> FloatArray:
    """Return the mean of the running means of errors at the points from `start` to `last`.

    It is 1 without such points or without errors; NaN if no match has a known error.
    """
    if last < start or not len(cell.errors):
        return np.ones(4)
    is_known = ~np.isnan(cell.errors)
    sums = np.cumsum(np.where(is_known, cell.errors, 0), axis=0)
    numbers = np.cumsum(is_known, axis=0)
    running = np.divide(sums, numbers, out=np.zeros_like(sums), where=numbers > 0)
    rising = cell.scores[cell.error_rows][::-1]
    means = []
    for column in running.T:
        means.append(_mean(np.interp(scores[start : last + 1], rising, column[::-1])))
    return np.where(numbers[-1] > 0, means, nan)


def _voc(cell: Cell, protocol: DetectionProtocol) -> Points:
    """Return the curve of PASCAL VOC for one draw; its average precision is the exact area."""
    truths = int(cell.truths.sum())
    levels = np.linspace(0, 1, protocol.points)
    hits = np.cumsum(cell.tp)
    counted = np.cumsum(cell.detected - cell.spent)
    precision = np.divide(hits, counted, out=np.zeros(len(hits)), where=counted > 0)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    # for each number of found truths, the best precision with at least as many: recall rises by
    # 1/truths at each
    at_hits = envelope[cell.tp > 0]
    required = np.maximum(np.ceil(levels * truths - 1e-9).astype(np.int64), 1)
    sampled = np.append(at_hits, np.zeros(1))[np.minimum(required - 1, len(at_hits))]
    average = fsum(at_hits.tolist()) / truths if truths else 0.0
    return Points(precision=sampled, recall=levels, average=average, errors=np.full(4, nan))


_CURVES: Final[Mapping[str, Callable[[Cell, DetectionProtocol], Points]]] = {
    "nuscenes": _nuscenes,
    "voc": _voc,
}


def _ratio(part: AnyArray, total: IntArray, default: float) -> FloatArray:
    """Return `part / total`, and a default where there is nothing."""
    shape = np.broadcast_shapes(part.shape, total.shape)
    result = np.full(shape, default)
    np.divide(part, total, out=result, where=total > 0)
    return result


def _mean(values: FloatArray) -> float:
    """Return the exact mean of values (N,)."""
    return fsum(values.tolist()) / len(values)
