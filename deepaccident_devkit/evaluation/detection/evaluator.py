"""`DetectionEvaluator`: average precision and errors of detected boxes, by the released rules or others."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, IntArray
from deepaccident_devkit.errors import EvaluationError, GeometryError
from deepaccident_devkit.evaluation.detection.boxes import DetectedBoxes, columns_of
from deepaccident_devkit.evaluation.detection.curves import Points, curves
from deepaccident_devkit.evaluation.detection.frame_counts import frame_counts
from deepaccident_devkit.evaluation.detection.ledger import Ledger
from deepaccident_devkit.evaluation.detection.measures import ERRORS
from deepaccident_devkit.evaluation.detection.protocols import DetectionProtocol, detection_protocol
from deepaccident_devkit.evaluation.detection.result import DetectionResult, mean_of
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.boxes import checked_boxes

_MOST_VALUES: Final = 2**20
"""Of one array over rows and draws: how many draws are made together."""


class DetectionEvaluator(Evaluator[DetectionResult]):
    """Counts matches of detected and true boxes by sample; `compute` makes curves and errors of them.

    ```python
    evaluator = DetectionEvaluator("paper")
    for token in samples(da, "val", "evaluate", "paper"):
        evaluator.update(token, detector(token), detection_truth(da, token, evaluator.protocol))
    print(evaluator.compute().mean_average_precision, nuscenes_summary(evaluator.compute()))
    ```

    Attributes:
        protocol: the rules, with the switches that were given.
    """

    def __init__(self, protocol: str | DetectionProtocol = "released", **switches: Any) -> None:
        """Start without samples.

        Args:
            protocol: `released` (its distance_mAP), `released_iou` (its iou_mAP), `paper`, `opencood`, or one made.
            **switches: fields of `DetectionProtocol` to change.

        Raises:
            ChoiceError: no such protocol, switch or choice.
            ConfigError: choices that cannot be.
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
            GeometryError: the truth is no boxes, or boxes are in another frame.
            EvaluationError: the prediction is none of boxes, or the sample came before, with another result.
        """
        if not isinstance(prediction, DetectedBoxes):
            raise EvaluationError(
                f"{token}: expected DetectedBoxes as the prediction, found {type(prediction).__name__}; make them with "
                "DetectedBoxes.from_arrays(center, size, yaw, scores), of no rows where nothing is detected"
            )
        for name, boxes in (("prediction", prediction.boxes), ("truth", checked_boxes("truth", truth))):
            if boxes.frame != self.protocol.frame:
                raise GeometryError(
                    f"{token}: {name} in frame {boxes.frame!r}, the protocol counts in {self.protocol.frame!r}; "
                    "transform them, or choose frame="
                )
        counts = frame_counts(columns_of(prediction.boxes, prediction.scores), columns_of(truth), self.protocol)
        self.add(token, {"token": token, **counts.as_dict()})

    def result_of(self, counts: Collection[Counts]) -> DetectionResult:
        """The metrics of some samples' counts, in any order."""
        return detection_result(counts, self.protocol)

    def resampled(self, parts: Sequence[Sequence[Counts]], times: IntArray) -> Iterator[DetectionResult]:
        """The result of each draw (`Evaluator.resampled`); what does not depend on the draw is made once."""
        owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
        ledger = Ledger([counts for part in parts for counts in part], self.protocol)
        yield from _results(ledger, self.protocol, times[:, owner[ledger.order]].astype(np.int32))


def detection_result(counts: Collection[Counts], protocol: DetectionProtocol) -> DetectionResult:
    """The metrics of some samples' counts (`FrameCounts.as_dict`, each with its `token`), in any order."""
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
