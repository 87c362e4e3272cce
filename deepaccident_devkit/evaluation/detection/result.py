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

# Of one array over rows and draws: how many draws are made together.
_MOST_VALUES: Final = 2**20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectionResult(TaskResult, FrozenArrays):
    """Average precisions and errors, by class; arrays are read-only. NaN: nothing to count.

    C classes, R ranges, K thresholds, P points of a curve.

    Attributes:
        mean_average_precision: the mean over all classes, ranges and thresholds that there are, in %.
        class_average_precision: class → the mean over thresholds and ranges, in %.
        mean_errors: ATE, ASE, AOE, AVE → the mean over the classes that there are; units as of `errors`.
        classes: names of the classes.
        ranges: (R, 2) from and to of each range, metres.
        thresholds: (C, K) of the protocol's measure: metres, or shares of overlap.
        average_precision: (C, R, K) in %.
        precision: (C, R, K, P) shares.
        recall: (C, R, K, P) shares; of the `released` curve what is reached at each point (0 where it is not), else the
            levels asked for.
        errors: (C, 4) in the order of `matching.ERRORS`: metres, 1 − overlap, radians, m/s.
        truths: (C, R) how many true boxes count.
        detections: (C, R) how many detections do.
        samples: number of samples.
    """

    rows: ClassVar[tuple[Row, ...]] = (
        Row("mean_average_precision", "%", "higher", name="mAP"),
        Row("mean_errors/ATE", "m", name="mATE"),
        Row("mean_errors/ASE", "1 - overlap", name="mASE"),
        Row("mean_errors/AOE", "rad", name="mAOE"),
        Row("mean_errors/AVE", "m/s", name="mAVE"),
        Row("class_average_precision/*", "%", "higher", name="AP *"),
    )
    mean_average_precision: float
    class_average_precision: Mapping[str, float]
    mean_errors: Mapping[str, float]
    classes: tuple[str, ...]
    ranges: FloatArray
    thresholds: FloatArray
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
        """All except the curves, as JSON holds it; None where there is nothing to count."""
        by_class = {
            name: {
                "thresholds": self.thresholds[position].tolist(),
                "AP": plain(self.average_precision[position]),
                "mean_AP": plain(self.class_average_precision[name]),
                **{
                    error: plain(value)
                    for error, value in zip(ERRORS, self.errors[position].tolist(), strict=True)
                },
                "truths": self.truths[position].tolist(),
                "detections": self.detections[position].tolist(),
            }
            for position, name in enumerate(self.classes)
        }
        return {
            "samples": self.samples,
            "ranges": plain(self.ranges),
            "mAP": plain(self.mean_average_precision),
            **{f"m{name}": plain(value) for name, value in self.mean_errors.items()},
            "classes": by_class,
        }


def mean_of(values: AnyArray) -> float:
    """The exact mean of the numbers that are not NaN; NaN if there are none."""
    known = [
        value
        for value in np.asarray(values, dtype=np.float64).reshape(-1).tolist()
        if not isnan(value)
    ]
    return fsum(known) / len(known) if known else nan


def detection_result(counts: Collection[Counts], protocol: DetectionProtocol) -> DetectionResult:
    """The metrics of some samples' counts (`frame_counts`, each with its `token`), in any order."""
    ledger = Ledger(list(counts), protocol)
    return next(drawn_results(ledger, protocol, np.ones((1, len(ledger)), dtype=np.int64)))


def drawn_results(
    ledger: Ledger, protocol: DetectionProtocol, times: IntArray
) -> Iterator[DetectionResult]:
    """The result of each draw; `times` (D, S) says how often it takes each sample."""
    shape = len(protocol.classes), len(protocol.ranges), len(protocol.thresholds)
    cells = [
        ledger.cell(group, level)
        for group in range(shape[0] * shape[1])
        for level in range(shape[2])
    ]
    most = max(len(cell.scores) for cell in cells)
    together = max(1, _MOST_VALUES // max(most, protocol.points, 1))
    for first in range(0, len(times), together):
        some = times[first : first + together]
        points = [curves(cell, protocol, some) for cell in cells]
        columns = {
            name: _by_draw(points, name, shape)
            for name in ("average", "precision", "recall", "errors")
        }
        truths, detections = (
            (some @ each).reshape(-1, *shape[:2]) for each in (ledger.truths, ledger.detections)
        )
        for draw, samples in enumerate(some.sum(axis=1).tolist()):
            drawn = {name: column[draw] for name, column in columns.items()}
            yield _result(protocol, drawn, truths[draw], detections[draw], samples)


def _result(
    protocol: DetectionProtocol,
    points: Mapping[str, FloatArray],
    truths: IntArray,
    detections: IntArray,
    samples: int,
) -> DetectionResult:
    """A result of what `curves` gives for all cells: (C, R, K) shares, (C, R, K, P) points and (C, R, K, 4) errors."""
    names = [name for name, _ in protocol.classes]
    average, errors = 100 * points["average"], np.full((len(names), 4), np.nan)
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
    """A column of all cells, (D, classes, ranges, thresholds, …)."""
    stacked = np.stack([getattr(each, name) for each in points], axis=1)
    return stacked.reshape(len(stacked), *shape, *stacked.shape[2:])


class Ledger:
    """The columns of many samples, one after the other, by token, and the cells that they make.

    Attributes:
        order: (S,) which of the given counts each sample is of.
        truths: (S, groups) how many true boxes of each group count.
        detections: (S, groups) how many detections do.
    """

    def __init__(self, counts: Sequence[Mapping[str, Any]], protocol: DetectionProtocol) -> None:
        """Put the samples' counts (with their `token`) in order."""
        self._protocol = protocol
        self.order = np.array(
            sorted(range(len(counts)), key=lambda each: counts[each]["token"]), dtype=np.int64
        )
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
        self.truths: IntArray = _joined([each["truths"] for each in counts], np.int64).reshape(
            -1, groups
        )
        self._events = {name: self._by_key([each[name] for each in counts]) for name in COLUMNS}
        group, row, _ = self._events["detections"]
        if (
            len(group) and not 0 <= group[0] <= group[-1] < groups
        ):  # else one number could ask for gigabytes
            raise EvaluationError(
                f"detections: expected groups from 0 to {groups - 1}, found {group[0]} to {group[-1]}"
            )
        cells = np.bincount(self._sample[row] * groups + group, minlength=len(counts) * groups)
        self.detections: IntArray = cells.reshape(-1, groups)

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.order)

    def cell(self, group: int, level: int) -> Cell:
        """A class within a range (`frame_counts`) at a threshold."""
        levels, ranges = len(self._protocol.thresholds), len(self._protocol.ranges)
        key = group * levels + level
        detected, tp, spent = (
            self._of(name, which)[0]
            for name, which in (("detections", group), ("tp", key), ("spent", key))
        )
        excused, change = self._of("excused", key)
        with_errors = self._protocol.thresholds[level] == self._protocol.error_threshold
        error_rows, errors = (
            self._of("errors", group // ranges) if with_errors else (tp[:0], np.zeros((0, 4)))
        )
        rows = np.unique(np.concatenate([detected, excused, tp, spent]))
        matched, _ = self._of("matches" if self._protocol.matching == "by_truth" else "tp", key)
        return Cell(
            truths=self.truths[:, group],
            scores=self._scores[rows],
            sample=self._sample[rows],
            detected=np.isin(rows, detected).astype(np.int64),
            tp=np.isin(rows, tp).astype(np.int64),
            spent=np.isin(rows, spent).astype(np.int64),
            excused=np.bincount(
                np.searchsorted(rows, excused), change.reshape(-1), len(rows)
            ).astype(np.int64),
            matched=np.searchsorted(rows, matched),
            error_rows=np.searchsorted(rows, error_rows),
            errors=errors.reshape(-1, 4),
        )

    def _by_key(
        self, columns: Sequence[Sequence[Sequence[Any]]]
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Keys, positions in the order of scores and further values of all samples' columns, by key and position."""
        width = max((len(each) for each in columns), default=2)
        keys = _joined([each[0] for each in columns], np.int64)
        offset = np.repeat(self._first, [len(each[0]) for each in columns]).astype(np.int64)
        rows = self._position[_joined([each[1] for each in columns], np.int64) + offset]
        values = [
            _joined([each[column] for each in columns], np.float64) for column in range(2, width)
        ]
        order = np.lexsort((rows, keys))
        stacked = np.stack(values, axis=1) if values else np.zeros((len(keys), 0))
        return keys[order], rows[order], stacked[order]

    def _of(self, name: str, key: int) -> tuple[IntArray, FloatArray]:
        keys, rows, values = self._events[name]
        part = slice(*np.searchsorted(keys, [key, key + 1]))
        return rows[part], values[part]


def _joined(parts: Sequence[Sequence[Any]], dtype: type[np.generic]) -> Any:
    """All numbers behind one another; None is NaN."""
    return np.concatenate(
        [np.zeros(0, dtype=dtype), *(np.asarray(part, dtype=dtype) for part in parts)]
    )
