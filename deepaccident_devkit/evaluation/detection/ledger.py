"""The counts of many samples put in the order of scores, from which curves are made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, IntArray
from deepaccident_devkit.evaluation.detection.protocols import DetectionProtocol

_EVENTS: Final = ("detections", "tp", "spent", "excused", "matches", "errors")
"""The columns of `frame_counts.FrameCounts` that name detections by their rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """All of one class within one range at one threshold, in the order of scores; S samples, by their tokens.

    Attributes:
        truths: (S,) how many true boxes of each sample count.
        scores: (N,) of the detections that come into it, falling; equal ones by sample, then as given.
        sample: (N,) the sample of each.
        detected: (N,) 1 where the detection counts.
        tp: (N,) how many more true boxes are found with this detection (0 or 1).
        spent: (N,) how many more detections go to true boxes that do not count.
        excused: (N,) how many more true boxes are neither found nor missed.
        matched: (M,) rows of the matches that decide the points of the `released` curve, rising.
        error_rows: (E,) rows of the matches that have errors, rising, each once; of one cell a class alone.
        errors: (E, 4) in the order of `measures.ERRORS`, NaN where unknown.
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


class Ledger:
    """The columns of many samples behind one another, by token, and the cells that they make.

    Attributes:
        order: (S,) which of the given counts each sample is of.
        truths: (S, groups) how many true boxes of each group count.
        detections: (S, groups) how many detections do.
    """

    def __init__(self, counts: Sequence[Mapping[str, Any]], protocol: DetectionProtocol) -> None:
        """Put the samples' counts (with their `token`) in order."""
        self._protocol = protocol
        self.order = np.array(sorted(range(len(counts)), key=lambda each: counts[each]["token"]), dtype=np.int64)
        counts = [counts[each] for each in self.order.tolist()]
        lengths = np.array([len(each["scores"]) for each in counts], dtype=np.int64)
        self._first = np.cumsum(lengths) - lengths
        scores = _joined([each["scores"] for each in counts], np.float64)
        rows, sample = np.arange(len(scores)), np.repeat(np.arange(len(counts)), lengths)
        keys = (rows, -scores) if protocol.global_sort else (rows, -scores, sample)
        order = np.lexsort(keys)
        self._position = np.empty(len(order), dtype=np.int64)
        self._position[order] = rows
        self._scores, self._sample = scores[order], sample[order]
        groups = len(protocol.classes) * len(protocol.ranges)
        self.truths: IntArray = _joined([each["truths"] for each in counts], np.int64).reshape(-1, groups)
        self._events = {name: self._by_key([each[name] for each in counts]) for name in _EVENTS}
        group, row, _ = self._events["detections"]
        cells = np.bincount(self._sample[row] * groups + group, minlength=len(counts) * groups)
        self.detections: IntArray = cells.reshape(-1, groups)

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.order)

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
        matched, _ = self._of("matches" if self._protocol.matching == "by_truth" else "tp", key)
        return Cell(
            truths=self.truths[:, group],
            scores=self._scores[rows],
            sample=self._sample[rows],
            detected=np.isin(rows, detected).astype(np.int64),
            tp=np.isin(rows, tp).astype(np.int64),
            spent=np.isin(rows, spent).astype(np.int64),
            excused=np.bincount(np.searchsorted(rows, excused), change.reshape(-1), len(rows)).astype(np.int64),
            matched=np.searchsorted(rows, matched),
            error_rows=np.searchsorted(rows, error_rows),
            errors=errors.reshape(-1, 4),
        )

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


def _joined(parts: Sequence[Sequence[Any]], dtype: type[np.generic]) -> Any:
    """All numbers behind one another; None is NaN."""
    return np.concatenate([np.zeros(0, dtype=dtype), *(np.asarray(part, dtype=dtype) for part in parts)])
