"""`DetectionEvaluator`: average precision and errors of detected boxes, by the released rules or others."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from deepaccident_devkit.errors import EvaluationError, GeometryError
from deepaccident_devkit.evaluation.detection.boxes import DetectedBoxes, columns_of
from deepaccident_devkit.evaluation.detection.curves import Ledger, Points, curve, pooled
from deepaccident_devkit.evaluation.detection.frame_counts import frame_counts
from deepaccident_devkit.evaluation.detection.measures import ERRORS
from deepaccident_devkit.evaluation.detection.protocols import DetectionProtocol, detection_protocol
from deepaccident_devkit.evaluation.detection.result import DetectionResult, mean_of
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.boxes import checked_boxes


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

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """One sample's counts in place of many; the same where scores are sorted by sample."""
        return [pooled(list(counts))] if counts and self.protocol.global_sort else list(counts)


def detection_result(counts: Collection[Counts], protocol: DetectionProtocol) -> DetectionResult:
    """The metrics of some samples' counts (`FrameCounts.as_dict`, each with its `token`, or pooled), in any order."""
    ledger = Ledger(list(counts), protocol)
    names = [name for name, _ in protocol.classes]
    shape = len(names), len(protocol.ranges), len(protocol.thresholds)
    points = [
        [[curve(ledger.cell(c * shape[1] + r, k), protocol) for k in range(shape[2])] for r in range(shape[1])]
        for c in range(shape[0])
    ]
    truths = ledger.truths.reshape(shape[:2])
    average = 100 * np.array([[[each.average for each in row] for row in part] for part in points])
    errors = np.full((shape[0], 4), np.nan)
    if protocol.error_threshold is not None:
        level = protocol.thresholds.index(protocol.error_threshold)
        errors = np.stack([part[0][level].errors for part in points])
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
        precision=_stacked(points, "precision"),
        recall=_stacked(points, "recall"),
        errors=errors,
        truths=truths,
        detections=ledger.detections.reshape(shape[:2]),
        samples=sum(each.get("samples", 1) for each in counts),
    )


def _stacked(points: list[list[list[Points]]], name: str) -> Any:
    return np.array([[[getattr(each, name) for each in row] for row in part] for part in points])
