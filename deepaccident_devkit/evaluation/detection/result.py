"""`DetectionResult`: average precisions and errors of detected boxes, by class."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import fsum, isnan, nan
from typing import Any, ClassVar, Final

import numpy as np

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.detection.boxes import DetectionProtocol
from deepaccident_devkit.evaluation.detection.curves import Cell, Points, curves
from deepaccident_devkit.evaluation.detection.matching import COLUMNS, ERRORS
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.task import FrozenMappings, Row, TaskResult, plain
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, FrozenArrays, IntArray

# Largest number of values, rows by draws, in one array: it bounds the draws computed together.
_MAX_VALUES: Final = 2**20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectionResult(TaskResult, FrozenArrays):
    """Average precisions and errors, by class; arrays are read-only. NaN: nothing to count.

    C classes, R ranges, K thresholds, P points of a curve.

    Attributes:
        mean_average_precision: Mean over all classes, ranges and thresholds with true boxes, %.
        class_average_precision: Class → mean over thresholds and ranges, %.
        mean_errors: ATE, ASE, AOE, AVE → mean over the classes with true boxes; units as in
            `errors`.
        classes: Names of the classes.
        ranges: (R, 2) start and end of each range, metres.
        thresholds: (C, K) thresholds of the protocol's measure: metres, or shares of overlap.
        average_precision: (C, R, K), %.
        precision: (C, R, K, P) shares.
        recall: (C, R, K, P) shares; on the `released` curve the recall reached at each point (0
            where it is not reached), otherwise the levels of recall.
        errors: (C, 4) in the order of `matching.ERRORS`: metres, 1 − overlap, radians, m/s.
        truths: (C, R) numbers of true boxes that count.
        detections: (C, R) numbers of detections that count.
        samples: Number of samples.
    """

    rows: ClassVar[tuple[Row, ...]] = (
        Row("mean_average_precision", "%", "higher", name="mAP"),
        Row("mean_errors/ATE", "m", name="mATE"),
        Row("mean_errors/ASE", "1 - overlap", name="mASE"),
        Row("mean_errors/AOE", "rad", name="mAOE"),
        Row("mean_errors/AVE", "m/s", name="mAVE"),
        Row("class_average_precision/*", "%", "higher", name="AP *"),
    )
    # the headlines
    mean_average_precision: float
    class_average_precision: Mapping[str, float]
    mean_errors: Mapping[str, float]
    # the axes of the arrays
    classes: tuple[str, ...]
    ranges: FloatArray
    thresholds: FloatArray
    # the numbers by class, range and threshold
    average_precision: FloatArray
    precision: FloatArray
    recall: FloatArray
    errors: FloatArray
    truths: IntArray
    detections: IntArray
    samples: int

    def __post_init__(self) -> None:
        """Freeze arrays and mappings."""
        FrozenArrays.__post_init__(self)
        FrozenMappings.__post_init__(self)

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers except the curves, as JSON holds them; None for nothing to count."""
        by_class = {}
        for position, name in enumerate(self.classes):
            entry = {
                "thresholds": self.thresholds[position].tolist(),
                "AP": plain(self.average_precision[position]),
                "mean_AP": plain(self.class_average_precision[name]),
            }
            for error, value in zip(ERRORS, self.errors[position].tolist(), strict=True):
                entry[error] = plain(value)
            entry["truths"] = self.truths[position].tolist()
            entry["detections"] = self.detections[position].tolist()
            by_class[name] = entry
        return {
            "samples": self.samples,
            "ranges": plain(self.ranges),
            "mAP": plain(self.mean_average_precision),
            **{f"m{name}": plain(value) for name, value in self.mean_errors.items()},
            "classes": by_class,
        }


def mean_of(values: AnyArray) -> float:
    """Return the exact mean of the numbers that are not NaN; NaN if there are none."""
    numbers = np.asarray(values, dtype=np.float64).reshape(-1).tolist()
    known = [number for number in numbers if not isnan(number)]
    return fsum(known) / len(known) if known else nan


def detection_result(counts: Collection[Counts], protocol: DetectionProtocol) -> DetectionResult:
    """Return the metrics of some samples' counts, in any order.

    Args:
        counts: Counts from `frame_counts`, each with its `token`.
        protocol: The rules.
    """
    ledger = Ledger(list(counts), protocol)
    return next(drawn_results(ledger, protocol, np.ones((1, len(ledger)), dtype=np.int64)))


def drawn_results(
    ledger: Ledger, protocol: DetectionProtocol, times: IntArray
) -> Iterator[DetectionResult]:
    """Yield the result of each draw.

    Args:
        ledger: Counts of S samples.
        protocol: The rules.
        times: How often each draw takes each sample, shape (D, S).
    """
    shape = len(protocol.classes), len(protocol.ranges), len(protocol.thresholds)
    cells = []
    for group in range(shape[0] * shape[1]):
        for level in range(shape[2]):
            cells.append(ledger.cell(group, level))
    longest = max(len(cell.scores) for cell in cells)
    batch = max(1, _MAX_VALUES // max(longest, protocol.points, 1))
    for start in range(0, len(times), batch):
        draws = times[start : start + batch]
        points = [curves(cell, protocol, draws) for cell in cells]
        columns = {}
        for name in ("average", "precision", "recall", "errors"):
            columns[name] = _by_draw(points, name, shape)
        truths = (draws @ ledger.truths).reshape(-1, *shape[:2])
        detections = (draws @ ledger.detections).reshape(-1, *shape[:2])
        for draw, samples in enumerate(draws.sum(axis=1).tolist()):
            drawn = {name: column[draw] for name, column in columns.items()}
            yield _result(protocol, drawn, truths[draw], detections[draw], samples)


def _result(
    protocol: DetectionProtocol,
    points: Mapping[str, FloatArray],
    truths: IntArray,
    detections: IntArray,
    samples: int,
) -> DetectionResult:
    """Return the result of what `curves` returns for all cells.

    Args:
        protocol: The rules.
        points: Average precisions (C, R, K), precision and recall (C, R, K, P), and errors
            (C, R, K, 4), by name.
        truths: (C, R) numbers of true boxes that count.
        detections: (C, R) numbers of detections that count.
        samples: Number of samples.
    """
    names = [name for name, _ in protocol.classes]
    average = 100 * points["average"]
    errors = np.full((len(names), 4), np.nan)
    if protocol.error_threshold is not None:
        errors = points["errors"][:, 0, protocol.thresholds.index(protocol.error_threshold)].copy()
    if not protocol.absent_class_is_zero:
        average[truths == 0] = np.nan
        errors[truths.sum(axis=1) == 0] = np.nan
    by_class = {name: mean_of(values) for name, values in zip(names, average, strict=True)}
    return DetectionResult(
        mean_average_precision=mean_of(np.array(list(by_class.values()))),
        class_average_precision=by_class,
        mean_errors={name: mean_of(column) for name, column in zip(ERRORS, errors.T, strict=True)},
        classes=tuple(names),
        ranges=np.array(protocol.ranges),
        thresholds=np.array([protocol.limits(name) for name in names]),
        average_precision=average,
        precision=points["precision"],
        recall=points["recall"],
        errors=errors,
        truths=truths,
        detections=detections,
        samples=samples,
    )


def _by_draw(points: Sequence[Points], name: str, shape: tuple[int, int, int]) -> FloatArray:
    """Return one field of all cells' points, shape (D, classes, ranges, thresholds, …)."""
    arrays = [getattr(cell_points, name) for cell_points in points]
    stacked = np.stack(arrays, axis=1)
    draws = len(stacked)
    return stacked.reshape(draws, *shape, *stacked.shape[2:])


class Ledger:
    """The columns of many samples, one after the other, by token, and the cells of them.

    Attributes:
        order: (S,) position of each sample's counts in the argument.
        truths: (S, groups) numbers of true boxes that count.
        detections: (S, groups) numbers of detections that count.
    """

    def __init__(self, counts: Sequence[Mapping[str, Any]], protocol: DetectionProtocol) -> None:
        """Put the samples' counts (with their `token`) in order."""
        self._protocol = protocol
        order = sorted(range(len(counts)), key=lambda position: counts[position]["token"])
        self.order = np.array(order, dtype=np.int64)
        counts = [counts[position] for position in order]
        lengths = np.array([len(sample["scores"]) for sample in counts], dtype=np.int64)
        self._start = np.cumsum(lengths) - lengths
        scores = _joined([sample["scores"] for sample in counts], np.float64)
        rows = np.arange(len(scores))
        sample_index = np.repeat(np.arange(len(counts)), lengths)
        keys = [rows, -scores]
        if not protocol.global_sort:
            keys.append(sample_index)
        by_score = np.lexsort(keys)
        self._position = np.empty(len(by_score), dtype=np.int64)
        self._position[by_score] = rows
        self._scores = scores[by_score]
        self._sample = sample_index[by_score]
        groups = len(protocol.classes) * len(protocol.ranges)
        truths = _joined([sample["truths"] for sample in counts], np.int64)
        self.truths: IntArray = truths.reshape(-1, groups)
        self._events = {}
        for name in COLUMNS:
            self._events[name] = self._by_key([sample[name] for sample in counts])
        group, row, _ = self._events["detections"]
        # otherwise one number could ask for gigabytes
        if len(group) and not 0 <= group[0] <= group[-1] < groups:
            raise EvaluationError(
                f"detections: expected groups from 0 to {groups - 1}, found {group[0]} to "
                f"{group[-1]}"
            )
        keys_of_samples = self._sample[row] * groups + group
        cells = np.bincount(keys_of_samples, minlength=len(counts) * groups)
        self.detections: IntArray = cells.reshape(-1, groups)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.order)

    def cell(self, group: int, level: int) -> Cell:
        """Return a class within a range (`frame_counts`) at a threshold."""
        levels = len(self._protocol.thresholds)
        ranges = len(self._protocol.ranges)
        key = group * levels + level
        detected, _ = self._of("detections", group)
        tp, _ = self._of("tp", key)
        spent, _ = self._of("spent", key)
        excused, change = self._of("excused", key)
        error_rows = tp[:0]
        errors = np.zeros((0, 4))
        if self._protocol.thresholds[level] == self._protocol.error_threshold:
            error_rows, errors = self._of("errors", group // ranges)
        rows = np.unique(np.concatenate([detected, excused, tp, spent]))
        excused_index = np.searchsorted(rows, excused)
        changes = np.bincount(excused_index, change.reshape(-1), len(rows))
        matched = tp
        if self._protocol.matching == "by_truth":
            matched, _ = self._of("matches", key)
        return Cell(
            truths=self.truths[:, group],
            scores=self._scores[rows],
            sample=self._sample[rows],
            detected=np.isin(rows, detected).astype(np.int64),
            tp=np.isin(rows, tp).astype(np.int64),
            spent=np.isin(rows, spent).astype(np.int64),
            excused=changes.astype(np.int64),
            matched=np.searchsorted(rows, matched),
            error_rows=np.searchsorted(rows, error_rows),
            errors=errors.reshape(-1, 4),
        )

    def _by_key(
        self, columns: Sequence[Sequence[Sequence[Any]]]
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Return the events of all samples' columns, by key and by position in order of scores.

        Args:
            columns: For each sample keys, rows of its detections, and further values.

        Returns:
            Keys (E,), positions in the order of scores (E,), and further values (E, …).
        """
        width = max((len(sample) for sample in columns), default=2)
        keys = _joined([sample[0] for sample in columns], np.int64)
        lengths = [len(sample[0]) for sample in columns]
        offset = np.repeat(self._start, lengths).astype(np.int64)
        rows = self._position[_joined([sample[1] for sample in columns], np.int64) + offset]
        values = []
        for column in range(2, width):
            values.append(_joined([sample[column] for sample in columns], np.float64))
        order = np.lexsort((rows, keys))
        stacked = np.stack(values, axis=1) if values else np.zeros((len(keys), 0))
        return keys[order], rows[order], stacked[order]

    def _of(self, name: str, key: int) -> tuple[IntArray, FloatArray]:
        """Return the positions and further values of the events of one key."""
        keys, rows, values = self._events[name]
        events = slice(*np.searchsorted(keys, [key, key + 1]))
        return rows[events], values[events]


def _joined(parts: Sequence[Sequence[Any]], dtype: type[np.generic]) -> Any:
    """Return all numbers one after another; None is NaN."""
    arrays = [np.asarray(part, dtype=dtype) for part in parts]
    return np.concatenate([np.zeros(0, dtype=dtype), *arrays])
