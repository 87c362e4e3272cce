"""From the counts of many samples to precision, recall and average precision, by three rules."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import fsum, nan
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, IntArray
from deepaccident_devkit.evaluation.detection.protocols import DetectionProtocol

_EVENTS: Final = ("detections", "tp", "spent", "excused", "matches", "errors")
"""The columns of `frame_counts.FrameCounts` that name detections by their rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """All of one class within one range at one threshold, in the order of scores.

    Attributes:
        truths: how many true boxes count.
        scores: (N,) of the detections that come into it, falling; equal ones by sample token, then as given.
        detected: (N,) 1 where the detection counts.
        tp: (N,) how many more true boxes are found with this detection (0 or 1).
        spent: (N,) how many more detections go to true boxes that do not count.
        excused: (N,) how many more true boxes are neither found nor missed.
        matched: (M,) rows of the matches that decide the points of the `released` curve.
        error_rows: (E,) rows of the matches that have errors, in order; of one cell a class alone.
        errors: (E, 4) in the order of `measures.ERRORS`, NaN where unknown.
    """

    truths: int
    scores: FloatArray
    detected: IntArray
    tp: IntArray
    spent: IntArray
    excused: IntArray
    matched: IntArray
    error_rows: IntArray
    errors: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Points:
    """The curve of a cell: precision and recall (P,), average precision as a share, mean errors (4,), NaN without."""

    precision: FloatArray
    recall: FloatArray
    average: float
    errors: FloatArray


class Ledger:
    """The columns of many samples behind one another, by token, and the cells that they make."""

    truths: IntArray
    """(groups,) how many true boxes of each group count."""

    def __init__(self, counts: Sequence[Mapping[str, Any]], protocol: DetectionProtocol) -> None:
        """Put the samples' counts (with their `token`) in order."""
        self._protocol = protocol
        counts = sorted(counts, key=lambda each: each["token"])
        lengths = np.array([len(each["scores"]) for each in counts], dtype=np.int64)
        self._first = np.cumsum(lengths) - lengths
        scores = _joined([each["scores"] for each in counts], np.float64)
        rows, sample = np.arange(len(scores)), np.repeat(np.arange(len(counts)), lengths)
        keys = (rows, -scores) if protocol.global_sort else (rows, -scores, sample)
        order = np.lexsort(keys)
        self._position = np.empty(len(order), dtype=np.int64)
        self._position[order] = rows
        self._scores = scores[order]
        groups = len(protocol.classes) * len(protocol.ranges)
        self.truths = _joined([each["truths"] for each in counts], np.int64).reshape(-1, groups).sum(axis=0)
        self._events = {name: self._by_key([each[name] for each in counts]) for name in _EVENTS}

    def cell(self, group: int, level: int) -> Cell:
        """A class within a range (`frame_counts.FrameCounts`) at a threshold."""
        levels, ranges = len(self._protocol.thresholds), len(self._protocol.ranges)
        key = group * levels + level
        detected, tp, spent = (
            self._of(name, which)[0] for name, which in (("detections", group), ("tp", key), ("spent", key))
        )
        excused, change = self._of("excused", key)
        with_errors = self._protocol.thresholds[level] == self._protocol.error_threshold
        error_rows, errors = self._of("errors", group // ranges) if with_errors else (tp[:0], np.zeros((0, 4)))
        rows = np.unique(np.concatenate([detected, excused, tp, spent]))
        return Cell(
            truths=int(self.truths[group]),
            scores=self._scores[rows],
            detected=np.isin(rows, detected).astype(np.int64),
            tp=np.isin(rows, tp).astype(np.int64),
            spent=np.isin(rows, spent).astype(np.int64),
            excused=np.bincount(np.searchsorted(rows, excused), change.reshape(-1), len(rows)).astype(np.int64),
            matched=np.searchsorted(rows, self._of("matches" if self._by_truth else "tp", key)[0]),
            error_rows=np.searchsorted(rows, error_rows),
            errors=errors.reshape(-1, 4),
        )

    @property
    def detections(self) -> IntArray:
        """(groups,) how many detections of each group count."""
        edges = np.arange(len(self._protocol.classes) * len(self._protocol.ranges) + 1)
        return np.diff(np.searchsorted(self._events["detections"][0], edges))

    @property
    def _by_truth(self) -> bool:
        return self._protocol.matching == "by_truth"

    def _by_key(self, columns: Sequence[Sequence[Sequence[Any]]]) -> tuple[IntArray, IntArray, FloatArray]:
        """Keys, positions in the order of scores and further values of all samples' columns, by key and position."""
        width = max((len(each) for each in columns), default=2)
        keys = _joined([each[0] for each in columns], np.int64)
        offset = np.repeat(self._first, [len(each[0]) for each in columns]).astype(np.int64)
        rows = self._position[_joined([each[1] for each in columns], np.int64) + offset]
        values = [_joined([each[column] for each in columns], np.float64) for column in range(2, width)]
        order = np.lexsort((rows, keys))
        stacked = np.stack(values, axis=1) if values else np.zeros((len(keys), 0))
        return keys[order], rows[order], stacked[order]

    def _of(self, name: str, key: int) -> tuple[IntArray, FloatArray]:
        keys, rows, values = self._events[name]
        part = slice(*np.searchsorted(keys, [key, key + 1]))
        return rows[part], values[part]


def pooled(counts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The counts of some samples as though they were one sample's, as arrays: for results that are asked for often.

    The order of equal scores stays that of tokens where no other sample's token lies between theirs.
    """
    counts = sorted(counts, key=lambda each: each["token"])
    first = np.cumsum([0, *(len(each["scores"]) for each in counts)])
    result: dict[str, Any] = {
        "token": counts[0]["token"],
        "samples": sum(each.get("samples", 1) for each in counts),
        "truths": np.sum([each["truths"] for each in counts], axis=0),
        "scores": _joined([each["scores"] for each in counts], np.float64),
    }
    for name in _EVENTS:
        columns = [_joined(column, np.float64) for column in zip(*(each[name] for each in counts), strict=True)]
        keys, rows = (column.astype(np.int64) for column in columns[:2])
        offset = np.repeat(first[:-1], [len(each[name][0]) for each in counts])
        result[name] = [keys, rows + offset, *columns[2:]]
    return result


def curve(cell: Cell, protocol: DetectionProtocol) -> Points:
    """Precision, recall and average precision of a cell, and the mean errors of its matches, by the protocol's rule."""
    return _CURVES[protocol.curve](cell, protocol)


def recall_scores(scores: FloatArray, truths: int, points: int) -> FloatArray:
    """The scores at which the released code reads its curve.

    With the matches' scores in falling order, the (i + 1)-th is taken for each level that (i + 1)/truths exceeds for
    the first time; levels are sums of 1/points in double precision, whose rounding decides ties.

    Args:
        scores: of all matches, in any order.
        truths: how many true boxes there are.
        points: how many levels up to a recall of 1.
    """
    step, level, result = 1.0 / points, 1.0 / points, []
    for found, score in enumerate(np.sort(scores)[::-1].tolist(), start=1):
        while found / truths > level:
            result.append(score)
            level += step
    return np.array(result, dtype=np.float64)


def _released(cell: Cell, protocol: DetectionProtocol) -> Points:
    matched = cell.scores[cell.matched]
    thresholds = recall_scores(matched, cell.truths, protocol.points)
    # how many rows have at least each score: equal scores come in together
    reached = np.searchsorted(-cell.scores, -thresholds, side="right")
    tp, spent, excused, detected = (
        np.concatenate([[0], np.cumsum(each)])[reached] for each in (cell.tp, cell.spent, cell.excused, cell.detected)
    )
    precision, recall = np.zeros(protocol.points), np.zeros(protocol.points)
    counted, asked = detected - spent, cell.truths - excused
    # at a score all of whose detections went to boxes that do not count, the released code divides 0 by 0 and stops
    precision[: len(tp)] = np.divide(tp, counted, out=np.zeros(len(tp)), where=counted > 0)
    recall[: len(tp)] = np.divide(tp, asked, out=np.full(len(tp), nan), where=asked > 0)
    first = int(protocol.min_recall * protocol.points)
    error_scores = cell.scores[cell.error_rows]
    errors = np.ones((protocol.points, 4))
    sums = np.cumsum(cell.errors, axis=0)
    for point, threshold in enumerate(thresholds.tolist()):
        below = int(np.searchsorted(-error_scores, -threshold, side="right"))
        if below and point >= first:
            errors[point] = sums[below - 1] / below
    return Points(
        precision=precision,
        recall=recall,
        average=_mean(precision[first:]),
        errors=np.array([_mean(column) for column in errors[first:].T]),
    )


def _nuscenes(cell: Cell, protocol: DetectionProtocol) -> Points:
    levels = np.linspace(0, 1, protocol.points)
    found, counted = np.cumsum(cell.tp), np.cumsum(cell.detected - cell.spent)
    if not found.size or not found[-1] or not cell.truths:
        return Points(precision=np.zeros(len(levels)), recall=levels, average=0.0, errors=np.ones(4))
    recall = found / cell.truths
    precision = np.interp(
        levels, recall, np.divide(found, counted, out=np.zeros(len(found)), where=counted > 0), right=0
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

    NaN where nothing is known of any match, and for cells that have no errors.
    """
    if last < first or not len(cell.errors):
        return np.ones(4)
    known = ~np.isnan(cell.errors)
    sums, numbers = np.cumsum(np.where(known, cell.errors, 0), axis=0), np.cumsum(known, axis=0)
    running = np.divide(sums, numbers, out=np.zeros_like(sums), where=numbers > 0)
    rising = cell.scores[cell.error_rows][::-1]
    means = [_mean(np.interp(scores[first : last + 1], rising, column[::-1])) for column in running.T]
    return np.where(numbers[-1] > 0, means, nan)


def _voc(cell: Cell, protocol: DetectionProtocol) -> Points:
    levels = np.linspace(0, 1, protocol.points)
    found, counted = np.cumsum(cell.tp), np.cumsum(cell.detected - cell.spent)
    precision = np.divide(found, counted, out=np.zeros(len(found)), where=counted > 0)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    # of as many truths as were found, the best precision with at least so many: recall rises by 1/truths at each
    at_tp = envelope[cell.tp > 0]
    needed = np.maximum(np.ceil(levels * cell.truths - 1e-9).astype(np.int64), 1)
    sampled = np.append(at_tp, np.zeros(1))[np.minimum(needed - 1, len(at_tp))]
    average = fsum(at_tp.tolist()) / cell.truths if cell.truths else 0.0
    return Points(precision=sampled, recall=levels, average=average, errors=np.full(4, nan))


_CURVES: Final[Mapping[str, Callable[[Cell, DetectionProtocol], Points]]] = {
    "released": _released,
    "nuscenes": _nuscenes,
    "voc": _voc,
}


def _joined(parts: Sequence[Sequence[Any]], dtype: type[np.generic]) -> Any:
    """All numbers behind one another; None is NaN."""
    return np.concatenate([np.zeros(0, dtype=dtype), *(np.asarray(part, dtype=dtype) for part in parts)])


def _mean(values: FloatArray) -> float:
    return fsum(values.tolist()) / len(values)
