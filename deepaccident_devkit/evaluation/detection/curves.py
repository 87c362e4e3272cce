"""From the counts of many samples to precision, recall and average precision, by three rules.

Each sample may be taken several times, or not at all: resamples share all that does not depend on these numbers.
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
    """All of one class within one range at one threshold, in the order of scores; S samples, by their tokens.

    Attributes:
        truths: (S,) how many true boxes of each sample count.
        scores: (N,) of the detections that come into it, falling; equal ones by sample, then as `rows_taken` has them.
        sample: (N,) the sample of each.
        detected: (N,) 1 where the detection counts.
        tp: (N,) how many more true boxes are found with this detection (0 or 1).
        spent: (N,) how many more detections go to true boxes that do not count.
        excused: (N,) how many more true boxes are neither found nor missed.
        matched: (M,) rows of the matches that decide the points of the `released` curve, rising.
        error_rows: (E,) rows of the matches that have errors, rising, each once; of one cell a class alone.
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
    """The curves of a cell in each of D draws; of one draw without the first axis.

    Attributes:
        precision: (D, P).
        recall: (D, P).
        average: (D,) average precision as a share.
        errors: (D, 4) mean errors, NaN without.
    """

    precision: FloatArray
    recall: FloatArray
    average: FloatArray | float
    errors: FloatArray


def curves(cell: Cell, protocol: DetectionProtocol, times: IntArray) -> Points:
    """Precision, recall and average precision of a cell, and the mean errors of its matches, by the protocol's rule.

    Args:
        cell: of S samples.
        protocol: whose rule.
        times: (D, S) how often each sample is taken in each draw.
    """
    if protocol.curve == "released":
        return _released(cell, protocol, times)
    made = [_CURVES[protocol.curve](each, protocol) for each in _drawn(cell, protocol, times)]
    return Points(*(np.array(column, dtype=np.float64) for column in zip(*made, strict=True)))


def recall_matches(truths: IntArray, points: int) -> IntArray:
    """The matches, counted from 1 by falling score, at which the released code reads its curve.

    For each level it takes the first of which number/truths exceeds it; levels are sums of 1/points in double
    precision, whose rounding decides ties.

    Args:
        truths: (D,) how many true boxes there are.
        points: P, how many levels up to a recall of 1.

    Returns:
        (D, P) rising; more than `truths` for a level that is never exceeded.
    """
    levels = np.cumsum(np.full(points, 1.0 / points))
    some = np.maximum(truths, 1)[:, None]
    number = np.maximum(np.floor(levels * some).astype(np.int64) - 1, 1)
    for _ in range(3):
        number += number / some <= levels
    return np.asarray(number)


class _Sums:
    """How much comes of a cell's rows in each draw."""

    def __init__(
        self, cell: Cell, times: IntArray, rows: IntArray, each: IntArray | None = None
    ) -> None:
        """Count some rows as often as their samples are taken, times what each adds, 1 if None."""
        weights = np.take(times, cell.sample[rows], axis=1)
        self._rows = rows
        self._sums: AnyArray = np.zeros((len(times), len(rows) + 1), dtype=np.int32)
        np.cumsum(
            weights if each is None else weights * each,
            axis=1,
            dtype=np.int32,
            out=self._sums[:, 1:],
        )

    @property
    def all(self) -> IntArray:
        """(D,) of all rows."""
        return np.asarray(self._sums[:, -1])

    def above(self, ends: IntArray) -> IntArray:
        """(D, P) of the first rows of the cell, as many as `ends` (D, P) says."""
        return np.take_along_axis(self._sums, np.searchsorted(self._rows, ends), axis=1)

    def row_of(self, number: IntArray) -> IntArray:
        """(D, P) the row with which the sum comes to `number` (D, P), from 1; any row if it never does."""
        apart = (self.all.max(initial=0) + 1) * np.arange(len(self._sums))[:, None]
        found = np.searchsorted((self._sums[:, 1:] + apart).reshape(-1), number + apart)
        found -= len(self._rows) * np.arange(len(self._sums))[:, None]
        return np.asarray(self._rows[np.minimum(found, len(self._rows) - 1)])


def _released(cell: Cell, protocol: DetectionProtocol, times: IntArray) -> Points:
    truths, matched = times @ cell.truths, _Sums(cell, times, cell.matched)
    number = recall_matches(truths, protocol.points)
    is_reached = number <= matched.all[:, None]
    ends = np.zeros(number.shape, dtype=np.int64)
    if is_reached.any():
        threshold = cell.scores[matched.row_of(np.where(is_reached, number, 1))]
        # how many rows have at least each score: equal scores come in together
        ends = np.where(is_reached, np.searchsorted(-cell.scores, -threshold, side="right"), 0)
    tp, spent, detected = (
        _Sums(cell, times, np.flatnonzero(each)).above(ends)
        for each in (cell.tp, cell.spent, cell.detected)
    )
    changed = np.flatnonzero(cell.excused)
    excused = _Sums(cell, times, changed, cell.excused[changed]).above(ends)
    # at a score all of whose detections went to boxes that do not count, the released code divides 0 by 0 and stops
    precision = _ratio(tp, detected - spent, 0.0)
    recall = np.where(is_reached, _ratio(tp, truths[:, None] - excused, nan), 0.0)
    first = int(protocol.min_recall * protocol.points)
    return Points(
        precision=precision,
        recall=recall,
        average=np.array([_mean(each[first:]) for each in precision]),
        errors=np.array(
            [[_mean(column) for column in each[first:].T] for each in _errors_at(cell, times, ends)]
        ),
    )


def _errors_at(cell: Cell, times: IntArray, ends: IntArray) -> FloatArray:
    """(D, P, 4) mean errors of the matches among the first rows of a cell, as many as `ends` (D, P) says; 1 of none."""
    if not len(cell.errors):
        return np.ones((*ends.shape, 4))
    below = _Sums(cell, times, cell.error_rows).above(ends)
    weights = np.take(times, cell.sample[cell.error_rows], axis=1)
    rows, means = np.searchsorted(cell.error_rows, ends), []
    for error in cell.errors.T:
        sums = np.zeros((len(times), len(error) + 1))
        some = weights * error
        some[weights == 0] = 0.0  # and not NaN
        np.cumsum(some, axis=1, out=sums[:, 1:])
        means.append(_ratio(np.take_along_axis(sums, rows, axis=1), below, 1.0))
    return np.stack(means, axis=-1)


def _drawn(cell: Cell, protocol: DetectionProtocol, times: IntArray) -> Iterator[Cell]:
    """The cell of each draw, with copies of its rows as of that many samples with one token."""
    is_first = np.diff(cell.sample, prepend=-1) != 0
    if protocol.global_sort:
        is_first |= np.diff(cell.scores, prepend=np.inf) != 0
    starts = np.flatnonzero(is_first)
    lengths = np.diff(np.append(starts, len(cell.scores)))
    with_error = np.full(len(cell.scores), -1)
    with_error[cell.error_rows] = np.arange(len(cell.error_rows))
    for each in times:
        copies = np.repeat(np.arange(len(starts)), each[cell.sample[starts]])
        length = lengths[copies]
        ends = np.cumsum(length)
        rows = np.arange(ends[-1] if ends.size else 0) + np.repeat(
            starts[copies] - (ends - length), length
        )
        error = with_error[rows]
        yield replace(
            cell,
            truths=cell.truths * each,
            **{
                name: getattr(cell, name)[rows]
                for name in ("scores", "sample", "detected", "tp", "spent", "excused")
            },
            error_rows=np.flatnonzero(error >= 0),
            errors=cell.errors[error[error >= 0]],
        )


def _nuscenes(cell: Cell, protocol: DetectionProtocol) -> Points:
    truths = int(cell.truths.sum())
    levels = np.linspace(0, 1, protocol.points)
    found, counted = np.cumsum(cell.tp), np.cumsum(cell.detected - cell.spent)
    if not found.size or not found[-1] or not truths:
        return Points(
            precision=np.zeros(len(levels)), recall=levels, average=0.0, errors=np.ones(4)
        )
    recall = found / truths
    precision = np.interp(
        levels,
        recall,
        np.divide(found, counted, out=np.zeros(len(found)), where=counted > 0),
        right=0,
    )
    scores = np.interp(levels, recall, cell.scores, right=0)
    first = round(protocol.min_recall * (protocol.points - 1)) + 1
    above = np.maximum(precision[first:] - protocol.min_precision, 0)
    last = int(np.searchsorted(levels, recall[-1], side="right")) - 1
    return Points(
        precision=precision,
        recall=levels,
        average=_mean(above) / (1 - protocol.min_precision),
        errors=_interpolated_errors(cell, scores, first, last),
    )


def _interpolated_errors(cell: Cell, scores: FloatArray, first: int, last: int) -> FloatArray:
    """The mean of the running means of errors at the points from `first` to `last`; 1 where there are none.

    NaN if no match has a known error, and for cells that have no errors.
    """
    if last < first or not len(cell.errors):
        return np.ones(4)
    known = ~np.isnan(cell.errors)
    sums, numbers = np.cumsum(np.where(known, cell.errors, 0), axis=0), np.cumsum(known, axis=0)
    running = np.divide(sums, numbers, out=np.zeros_like(sums), where=numbers > 0)
    rising = cell.scores[cell.error_rows][::-1]
    means = [
        _mean(np.interp(scores[first : last + 1], rising, column[::-1])) for column in running.T
    ]
    return np.where(numbers[-1] > 0, means, nan)


def _voc(cell: Cell, protocol: DetectionProtocol) -> Points:
    truths = int(cell.truths.sum())
    levels = np.linspace(0, 1, protocol.points)
    found, counted = np.cumsum(cell.tp), np.cumsum(cell.detected - cell.spent)
    precision = np.divide(found, counted, out=np.zeros(len(found)), where=counted > 0)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    # of as many truths as were found, the best precision with at least so many: recall rises by 1/truths at each
    at_tp = envelope[cell.tp > 0]
    needed = np.maximum(np.ceil(levels * truths - 1e-9).astype(np.int64), 1)
    sampled = np.append(at_tp, np.zeros(1))[np.minimum(needed - 1, len(at_tp))]
    average = fsum(at_tp.tolist()) / truths if truths else 0.0
    return Points(precision=sampled, recall=levels, average=average, errors=np.full(4, nan))


_CURVES: Final[Mapping[str, Callable[[Cell, DetectionProtocol], Points]]] = {
    "nuscenes": _nuscenes,
    "voc": _voc,
}


def _ratio(part: AnyArray, whole: IntArray, otherwise: float) -> FloatArray:
    """`part / whole`, and a number where there is nothing."""
    shape = np.broadcast_shapes(part.shape, whole.shape)
    return np.asarray(np.divide(part, whole, out=np.full(shape, otherwise), where=whole > 0))


def _mean(values: FloatArray) -> float:
    return fsum(values.tolist()) / len(values)
