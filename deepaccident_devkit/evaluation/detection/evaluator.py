"""`DetectionEvaluator`: average precision and errors of detected boxes, by the released rules or others."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from deepaccident_devkit.errors import EvaluationError, GeometryError
from deepaccident_devkit.evaluation.detection.boxes import DetectedBoxes, columns_of
from deepaccident_devkit.evaluation.detection.curves import Cell, Points, curves
from deepaccident_devkit.evaluation.detection.frame_counts import COLUMNS, frame_counts
from deepaccident_devkit.evaluation.detection.matching import ERRORS
from deepaccident_devkit.evaluation.detection.protocols import DetectionProtocol, detection_protocol
from deepaccident_devkit.evaluation.detection.result import DetectionResult, mean_of
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.boxes import checked_boxes
from deepaccident_devkit.support.arrays import FloatArray, IntArray

_MOST_VALUES: Final = 2**20
"""Of one array over rows and draws: how many draws are made together."""


class DetectionEvaluator(Evaluator[DetectionResult]):
    """Counts matches of detected and true boxes by sample; `compute` makes curves and errors of them.

    ```python
    evaluator = DetectionEvaluator("paper")
    for token in samples(da, "val", "evaluate", "paper"):
        evaluator.update(token, detector(token), detection_truth(da, token, evaluator.protocol))
    print(evaluator.compute().mean_average_precision, evaluator.compute().mean_errors)
    ```

    Attributes:
        protocol: the rules, with the switches that were given.
    """

    def __init__(self, protocol: str | DetectionProtocol = "released", **switches: Any) -> None:
        """Start without samples.

        Args:
            protocol: `released` (its distance_mAP), `released_iou` (its iou_mAP), `paper`, `opencood`, or your own.
            **switches: fields of `DetectionProtocol` to change.

        Raises:
            ChoiceError: no such protocol, switch or choice.
            ConfigError: choices that exclude each other.
        """
        super().__init__()
        self.protocol = detection_protocol(protocol, **switches)

    @property
    def settings(self) -> dict[str, Any]:
        """The protocol's choices."""
        return self.protocol.as_dict()

    def update(self, token: str, prediction: DetectedBoxes, truth: Boxes) -> None:
        """Take a sample.

        Args:
            token: the sample's.
            prediction: what was detected, in the protocol's frame; may be empty.
            truth: the true boxes in that frame, as `detection_truth` gives them; the protocol's own box, area and
                ranges are applied here.

        Raises:
            GeometryError: the truth is not of boxes, or boxes are in another frame.
            EvaluationError: the prediction is not of boxes, or the sample came before, with another result.
        """
        if not isinstance(prediction, DetectedBoxes):
            raise EvaluationError(
                f"{token}: expected DetectedBoxes as the prediction, found {type(prediction).__name__}; make them with "
                f"DetectedBoxes.from_arrays(center, size, yaw, scores, frame={self.protocol.frame!r}), of no rows "
                "where nothing is detected"
            )
        for name, boxes in (("prediction", prediction.boxes), ("truth", checked_boxes("truth", truth))):
            if boxes.frame != self.protocol.frame:
                raise GeometryError(
                    f"{token}: {name} in frame {boxes.frame!r}, the protocol counts in {self.protocol.frame!r}; "
                    "transform them, or choose frame="
                )
        counts = frame_counts(columns_of(prediction.boxes, prediction.scores), columns_of(truth), self.protocol)
        self.add(token, {"token": token, **counts})

    def result_of(self, counts: Collection[Counts]) -> DetectionResult:
        """The metrics of some samples' counts, in any order."""
        return detection_result(counts, self.protocol)

    def resampled(self, parts: Sequence[Sequence[Counts]], times: IntArray) -> Iterator[DetectionResult]:
        """The result of each draw (`Evaluator.resampled`); what does not depend on the draw is made once."""
        owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
        ledger = Ledger([counts for part in parts for counts in part], self.protocol)
        yield from _results(ledger, self.protocol, times[:, owner[ledger.order]].astype(np.int32))


def detection_result(counts: Collection[Counts], protocol: DetectionProtocol) -> DetectionResult:
    """The metrics of some samples' counts (`frame_counts`, each with its `token`), in any order."""
    ledger = Ledger(list(counts), protocol)
    return next(_results(ledger, protocol, np.ones((1, len(ledger)), dtype=np.int64)))


def _results(ledger: Ledger, protocol: DetectionProtocol, times: IntArray) -> Iterator[DetectionResult]:
    """The result of each draw; `times` (D, S) says how often it takes each sample."""
    shape = len(protocol.classes), len(protocol.ranges), len(protocol.thresholds)
    cells = [ledger.cell(group, level) for group in range(shape[0] * shape[1]) for level in range(shape[2])]
    most = max(len(cell.scores) for cell in cells)
    together = max(1, _MOST_VALUES // max(most, protocol.points, 1))
    for first in range(0, len(times), together):
        some = times[first : first + together]
        points = [curves(cell, protocol, some) for cell in cells]
        columns = {name: _by_draw(points, name, shape) for name in ("average", "precision", "recall", "errors")}
        truths, detections = ((some @ each).reshape(-1, *shape[:2]) for each in (ledger.truths, ledger.detections))
        for draw, samples in enumerate(some.sum(axis=1).tolist()):
            drawn = {name: column[draw] for name, column in columns.items()}
            yield _result(protocol, drawn, truths[draw], detections[draw], samples)


def _result(
    protocol: DetectionProtocol, points: Mapping[str, FloatArray], truths: IntArray, detections: IntArray, samples: int
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
        self._events = {name: self._by_key([each[name] for each in counts]) for name in COLUMNS}
        group, row, _ = self._events["detections"]
        if len(group) and not 0 <= group[0] <= group[-1] < groups:  # else one number could ask for gigabytes
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
