"""`DetectionResult`: average precisions and errors of detected boxes for each class."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import fsum, isnan, nan
from typing import Any, ClassVar

import numpy as np

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.detection.boxes import DetectionProtocol
from deepaccident_devkit.evaluation.detection.curves import Cell, curves
from deepaccident_devkit.evaluation.detection.matching import COLUMNS, ERRORS
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.task import FrozenMappings, Row, TaskResult, plain
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.support.values import ReadOnlyValues

# Largest number of values (rows × draws) in one array; it limits how many draws are computed
# together.
_MAX_VALUES = 2**20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectionResult(TaskResult, FrozenArrays):
    """Average precisions and errors for each class; arrays are read-only.

    A number is NaN if there is nothing to count. There are C classes, R ranges, K thresholds and P
    points of a curve.

    Attributes:
        mean_average_precision: Average precision averaged over thresholds, and over classes and
            ranges with true boxes, %.
        class_average_precision: Class → average precision averaged over thresholds and ranges, %.
        mean_errors: ATE, ASE, AOE, AVE → error averaged over the classes with true boxes; units as
            in `errors`.
        classes: Names of the classes.
        ranges: (R, 2) start and end of each range, metres.
        thresholds: (C, K) thresholds of the protocol's measure: metres, or shares of overlap.
        average_precision: (C, R, K) average precisions, %.
        precision: (C, R, K, P) precision in [0, 1].
        recall: (C, R, K, P) recall in [0, 1]; for the `released` curve the recall at each point (0
            if the point is not reached), otherwise the levels of recall.
        errors: (C, 4) errors in the order of `matching.ERRORS`: metres, 1 − overlap, radians, m/s.
        truths: (C, R) how many true boxes count.
        detections: (C, R) how many detections count.
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
    # the main metrics
    mean_average_precision: float
    class_average_precision: Mapping[str, float]
    mean_errors: Mapping[str, float]
    # the axes of the arrays
    classes: tuple[str, ...]
    ranges: FloatArray
    thresholds: FloatArray
    # the numbers for each class, range and threshold
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
        """Convert all numbers except the curves to JSON-compatible values, with None for NaN."""
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
    """Return the mean of the numbers that are not NaN, exactly summed; NaN if there are none."""
    numbers = np.asarray(values, dtype=np.float64).reshape(-1)
    known_numbers = [number for number in numbers.tolist() if not isnan(number)]
    if not known_numbers:
        return nan
    return fsum(known_numbers) / len(known_numbers)


def detection_result(counts: Collection[Counts], protocol: DetectionProtocol) -> DetectionResult:
    """Compute the metrics from the counts of samples, in any order.

    Args:
        counts: Counts from `frame_counts`, each with the `token` of its sample.
        protocol: Rules for counting the samples.
    """
    ledger = Ledger(list(counts), protocol)
    once_each = np.ones((1, len(ledger)), dtype=np.int64)
    return next(drawn_results(ledger, protocol, once_each))


def drawn_results(
    ledger: Ledger, protocol: DetectionProtocol, times: IntArray
) -> Iterator[DetectionResult]:
    """Yield the result of each draw.

    Args:
        ledger: Counts of S samples.
        protocol: Rules for counting the samples.
        times: (D, S) how often each draw contains each sample.
    """
    class_count = len(protocol.classes)
    range_count = len(protocol.ranges)
    level_count = len(protocol.thresholds)
    cells = []
    for group in range(class_count * range_count):
        for level in range(level_count):
            cells.append(ledger.cell(group, level))
    longest_cell = max(len(cell.scores) for cell in cells)
    batch_size = max(1, _MAX_VALUES // max(longest_cell, protocol.points, 1))
    for start in range(0, len(times), batch_size):
        batch_times = times[start : start + batch_size]
        points = [curves(cell, protocol, batch_times) for cell in cells]
        points_by_name = {}
        for name in ("average", "precision", "recall", "errors"):
            # (D, cells, …)
            values = np.stack([getattr(cell_points, name) for cell_points in points], axis=1)
            points_by_name[name] = values.reshape(
                len(values), class_count, range_count, level_count, *values.shape[2:]
            )
        truths = (batch_times @ ledger.truths).reshape(-1, class_count, range_count)
        detections = (batch_times @ ledger.detections).reshape(-1, class_count, range_count)
        for draw, samples in enumerate(batch_times.sum(axis=1).tolist()):
            drawn_points = {name: values[draw] for name, values in points_by_name.items()}
            yield _result(protocol, drawn_points, truths[draw], detections[draw], samples)


def _result(
    protocol: DetectionProtocol,
    points: Mapping[str, FloatArray],
    truths: IntArray,
    detections: IntArray,
    samples: int,
) -> DetectionResult:
    """Build the result of one draw from the curves of all cells.

    Args:
        protocol: Rules for counting the samples.
        points: Field of `Points` → values of all cells: average precisions (C, R, K), precision and
            recall (C, R, K, P), errors (C, R, K, 4).
        truths: (C, R) how many true boxes count.
        detections: (C, R) how many detections count.
        samples: Number of samples.
    """
    names = tuple(name for name, _ in protocol.classes)
    average_precision = 100 * points["average"]
    errors = np.full((len(names), 4), np.nan)
    if protocol.error_threshold is not None:
        level = protocol.thresholds.index(protocol.error_threshold)
        errors = points["errors"][:, 0, level].copy()
    if not protocol.absent_class_is_zero:
        average_precision[truths == 0] = np.nan
        errors[truths.sum(axis=1) == 0] = np.nan
    class_means = [mean_of(values) for values in average_precision]
    mean_errors = [mean_of(column) for column in errors.T]
    return DetectionResult(
        mean_average_precision=mean_of(np.array(class_means)),
        class_average_precision=dict(zip(names, class_means, strict=True)),
        mean_errors=dict(zip(ERRORS, mean_errors, strict=True)),
        classes=names,
        ranges=np.array(protocol.ranges),
        thresholds=np.array([protocol.limits(name) for name in names]),
        average_precision=average_precision,
        precision=points["precision"],
        recall=points["recall"],
        errors=errors,
        truths=truths,
        detections=detections,
        samples=samples,
    )


class Ledger:
    """The counts of many samples, joined in the order of their tokens, from which cells are read.

    Attributes:
        order: (S,) index of each sample's counts in the constructor's argument.
        truths: (S, groups) how many true boxes count.
        detections: (S, groups) how many detections count.
    """

    def __init__(self, counts: Sequence[ReadOnlyValues], protocol: DetectionProtocol) -> None:
        """Join the samples' counts; each has the `token` of its sample.

        Raises:
            EvaluationError: If a detection has a class or range that does not exist.
        """
        self._protocol = protocol
        order = sorted(range(len(counts)), key=lambda index: counts[index]["token"])
        self.order = np.array(order, dtype=np.int64)
        counts = [counts[index] for index in order]
        lengths = np.array([len(sample["scores"]) for sample in counts], dtype=np.int64)
        self._start = np.cumsum(lengths) - lengths
        scores = _joined([sample["scores"] for sample in counts], np.float64)
        rows = np.arange(len(scores))
        sample_index = np.repeat(np.arange(len(counts)), lengths)
        sort_keys = [rows, -scores]
        if not protocol.global_sort:
            sort_keys.append(sample_index)
        order_of_scores = np.lexsort(sort_keys)
        self._position = np.empty(len(rows), dtype=np.int64)
        self._position[order_of_scores] = rows
        self._scores = scores[order_of_scores]
        self._sample = sample_index[order_of_scores]
        group_count = len(protocol.classes) * len(protocol.ranges)
        truths = _joined([sample["truths"] for sample in counts], np.int64)
        self.truths: IntArray = truths.reshape(-1, group_count)
        self._events = {}
        for name in COLUMNS:
            self._events[name] = self._sorted_events([sample[name] for sample in counts])
        groups, positions, _ = self._events["detections"]
        # otherwise a single number could require gigabytes
        if len(groups) and not 0 <= groups[0] <= groups[-1] < group_count:
            raise EvaluationError(
                f"detections: expected groups from 0 to {group_count - 1}, found {groups[0]} to "
                f"{groups[-1]}"
            )
        keys = self._sample[positions] * group_count + groups
        detections = np.bincount(keys, minlength=len(counts) * group_count)
        self.detections: IntArray = detections.reshape(-1, group_count)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.order)

    def cell(self, group: int, level: int) -> Cell:
        """Return the cell of a group at a threshold; see `frame_counts`.

        Args:
            group: Index of the group, a class in a range.
            level: Index of the threshold.
        """
        key = group * len(self._protocol.thresholds) + level
        detected, _ = self._select_events("detections", group)
        tp, _ = self._select_events("tp", key)
        spent, _ = self._select_events("spent", key)
        excused, changes = self._select_events("excused", key)
        matched = tp
        if self._protocol.matching == "by_truth":
            matched, _ = self._select_events("matches", key)
        error_rows = tp[:0]
        errors = np.zeros((0, 4))
        if self._protocol.thresholds[level] == self._protocol.error_threshold:
            class_index = group // len(self._protocol.ranges)
            error_rows, errors = self._select_events("errors", class_index)
        rows = np.unique(np.concatenate([detected, excused, tp, spent]))
        excused_index = np.searchsorted(rows, excused)
        excused_changes = np.bincount(excused_index, changes.reshape(-1), len(rows))
        return Cell(
            truths=self.truths[:, group],
            scores=self._scores[rows],
            sample=self._sample[rows],
            detected=np.isin(rows, detected).astype(np.int64),
            tp=np.isin(rows, tp).astype(np.int64),
            spent=np.isin(rows, spent).astype(np.int64),
            excused=excused_changes.astype(np.int64),
            matched=np.searchsorted(rows, matched),
            error_rows=np.searchsorted(rows, error_rows),
            errors=errors.reshape(-1, 4),
        )

    def _sorted_events(
        self, events: Sequence[Sequence[Sequence[Any]]]
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Join the events of all samples, sorted by key, then by position in the order of scores.

        Args:
            events: For each sample, the columns of its events: keys, indices of its detections, and
                further values.

        Returns:
            Keys (E,), positions in the order of scores (E,), and further values (E, …).
        """
        column_count = max((len(columns) for columns in events), default=2)
        keys = _joined([columns[0] for columns in events], np.int64)
        sample_rows = _joined([columns[1] for columns in events], np.int64)
        event_counts = [len(columns[0]) for columns in events]
        starts = np.repeat(self._start, event_counts).astype(np.int64)
        positions = self._position[sample_rows + starts]
        order = np.lexsort((positions, keys))
        values = np.zeros((len(keys), column_count - 2))
        for column in range(2, column_count):
            values[:, column - 2] = _joined([columns[column] for columns in events], np.float64)
        return keys[order], positions[order], values[order]

    def _select_events(self, name: str, key: int) -> tuple[IntArray, FloatArray]:
        """Return the positions and further values of the events with a key."""
        keys, positions, values = self._events[name]
        start, end = np.searchsorted(keys, [key, key + 1])
        return positions[start:end], values[start:end]


def _joined(parts: Sequence[Sequence[Any]], dtype: type[np.generic]) -> Any:
    """Join the numbers of all parts to one array; None becomes NaN."""
    arrays = [np.asarray(part, dtype=dtype) for part in parts]
    return np.concatenate([np.zeros(0, dtype=dtype), *arrays])
