"""The task `detection`: average precision and errors of boxes, by the released rules and others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError, EvaluationError, GeometryError
from deepaccident_devkit.evaluation.detection.boxes import (
    DETECTION_PROTOCOLS,
    DetectedBoxes,
    DetectionProtocol,
    columns_of,
    detection_protocol,
    detection_truth,
)
from deepaccident_devkit.evaluation.detection.curves import average_precision
from deepaccident_devkit.evaluation.detection.matching import (
    Ring,
    boxes_taken,
    frame_counts,
    nearest_by_score,
    nearest_by_truth,
    ring_of,
)
from deepaccident_devkit.evaluation.detection.result import (
    DetectionResult,
    Ledger,
    detection_result,
    drawn_results,
)
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.boxes import checked_boxes
from deepaccident_devkit.support.arrays import FrozenArrays, IntArray

__all__ = [
    "DETECTION_PROTOCOLS",
    "DetectedBoxes",
    "DetectionEvaluator",
    "DetectionMatches",
    "DetectionProtocol",
    "DetectionResult",
    "average_precision",
    "detection_matches",
    "detection_protocol",
    "detection_truth",
]


class DetectionEvaluator(Evaluator[DetectionResult]):
    """Average precision and errors of detected boxes, from matches that are counted by sample.

    ```python
    evaluator = DetectionEvaluator("paper")
    for token in samples(da, "val", "evaluate", "paper"):
        evaluator.update(token, detector(token), detection_truth(da, token, evaluator.protocol))
    print(evaluator.compute().mean_average_precision, evaluator.compute().mean_errors)
    ```

    Attributes:
        protocol: Rules, with the switches that were passed.
    """

    task = "detection"
    description = "Evaluate detected boxes: AP and errors."
    result_kinds: ClassVar[tuple[str, ...]] = ("detection",)
    protocols = DETECTION_PROTOCOLS
    result_class = DetectionResult
    main_numbers: ClassVar[tuple[str, ...]] = ("mean_average_precision",)
    has_horizon = False

    protocol: DetectionProtocol

    def __init__(self, protocol: str | DetectionProtocol = "released", **switches: Any) -> None:
        """Start without samples.

        Args:
            protocol: `released` (its distance_mAP), `released_iou` (its iou_mAP), `paper`,
                `opencood`, or your own.
            **switches: Fields of `DetectionProtocol` to change.

        Raises:
            ChoiceError: no such protocol, switch or choice.
            ConfigError: choices that exclude each other.
        """
        super().__init__(detection_protocol(protocol, **switches))

    @property
    def settings(self) -> dict[str, Any]:
        """The protocol's choices."""
        return self.protocol.as_dict()

    def read(self, results: Any, dataset: Dataset, token: str) -> DetectedBoxes:
        """Return the boxes, which results hold in the world, in the protocol's frame."""
        boxes: DetectedBoxes = results.prediction(token)
        frame = self.protocol.frame
        return boxes.transform(dataset.world_from(token, frame).inverse(), frame)

    def truth(self, dataset: Dataset, token: str, /, *_unused: Any) -> tuple[Boxes]:
        """Return the true boxes in the protocol's frame."""
        return (detection_truth(dataset, token, self.protocol),)

    def update(self, token: str, prediction: DetectedBoxes, truth: Boxes) -> None:
        """Count one sample.

        Args:
            token: Token of the sample.
            prediction: Detections in the protocol's frame; may be empty.
            truth: True boxes in that frame, from `detection_truth`; the protocol's own box, area
                and ranges are applied here.

        Raises:
            GeometryError: the truth is not of boxes, or boxes are in another frame.
            EvaluationError: the prediction is not of boxes, or the sample came before with another
                result.
        """
        frame = self.protocol.frame
        if not isinstance(prediction, DetectedBoxes):
            raise EvaluationError(
                f"{token}: expected DetectedBoxes as the prediction, found "
                f"{type(prediction).__name__}; make them with "
                f"DetectedBoxes.from_arrays(center, size, yaw, scores, frame={frame!r}), of no "
                "rows where nothing is detected"
            )
        true_boxes = checked_boxes("truth", truth)
        for name, boxes in (("prediction", prediction.boxes), ("truth", true_boxes)):
            if boxes.frame != frame:
                raise GeometryError(
                    f"{token}: {name} in frame {boxes.frame!r}, the protocol counts in {frame!r}; "
                    "transform them, or choose frame="
                )
        detections = columns_of(prediction.boxes, prediction.scores)
        counts = frame_counts(detections, columns_of(truth), self.protocol)
        self.add(token, {"token": token, **counts})

    def result_of(self, counts: Collection[Counts]) -> DetectionResult:
        """Return the metrics of some samples' counts, in any order."""
        return detection_result(counts, self.protocol)

    def sample_row(self, token: str) -> dict[str, int]:
        """Return the numbers of boxes that count, and true positives by threshold.

        They are sums over all classes and ranges.
        """
        counts = self._counts[token]
        thresholds = self.protocol.thresholds
        hits = Counter(cell % len(thresholds) for cell in counts["tp"][0])
        row = {"truths": sum(counts["truths"]), "detections": len(counts["detections"][0])}
        for level, threshold in enumerate(thresholds):
            row[f"tp_{threshold:g}"] = hits[level]
        return row

    def resampled(
        self, parts: Sequence[Sequence[Counts]], times: IntArray
    ) -> Iterator[DetectionResult]:
        """Yield the result of each draw (`Evaluator.resampled`).

        What does not depend on the draw is computed once.
        """
        owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
        ledger = Ledger([counts for part in parts for counts in part], self.protocol)
        sample_owner = owner[ledger.order]
        yield from drawn_results(ledger, self.protocol, times[:, sample_owner].astype(np.int32))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectionMatches(FrozenArrays):
    """The matches of one sample at one threshold, with all detections, as rows of the boxes.

    Boxes that do not count (beyond the protocol's area and ranges, of other classes, or matched
    with such boxes) are in no array.

    Attributes:
        threshold: Metres or a share, one of the protocol's.
        detection: (M,) int64 detections that are true positives.
        truth: (M,) int64 true box of each.
        false: (F,) int64 detections without a true box.
        missed: (G,) int64 true boxes without a detection.
    """

    threshold: float
    detection: IntArray
    truth: IntArray
    false: IntArray
    missed: IntArray


def detection_matches(
    prediction: DetectedBoxes,
    truth: Boxes,
    protocol: str | DetectionProtocol = "released",
    threshold: float | None = None,
) -> DetectionMatches:
    """Match one sample's detections with its true boxes as `DetectionEvaluator` does.

    Args:
        prediction: Detections in the protocol's frame.
        truth: True boxes in that frame, from `detection_truth`.
        protocol: Name of a protocol, or a protocol.
        threshold: One of the protocol's thresholds; None for that of its errors, otherwise the
            middle one.

    Raises:
        ChoiceError: no such protocol, or not one of its thresholds.
    """
    rules = detection_protocol(protocol)
    middle = rules.thresholds[len(rules.thresholds) // 2]
    used_threshold = threshold or rules.error_threshold or middle
    if used_threshold not in rules.thresholds:
        raise ChoiceError(
            f"threshold: expected one of {', '.join(map(str, rules.thresholds))}, found "
            f"{threshold!r}"
        )
    level = rules.thresholds.index(used_threshold)
    detected = columns_of(prediction.boxes, prediction.scores)
    true = columns_of(truth)
    (detected, rows), (true, true_rows) = boxes_taken(detected, true, rules)
    pairs: list[tuple[int, int]] = []
    unmatched: set[int] = set()
    missed: set[int] = set()
    for position in range(len(rules.ranges)):
        ring = ring_of(detected, true, rules, position)
        holder = _holders(ring, rules, level)
        for true_box, detection in holder.items():
            if ring.counts[detection] and ring.truth_counts[true_box]:
                pairs.append((rows[detection], true_rows[true_box]))
        unmatched |= {*np.flatnonzero(ring.counts).tolist()} - {*holder.values()}
        missed |= {*np.flatnonzero(ring.truth_counts).tolist()} - {*holder}
    matched = np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)
    return DetectionMatches(
        threshold=used_threshold,
        detection=matched[:, 0],
        truth=matched[:, 1],
        false=np.sort(rows[list(unmatched)]),
        missed=np.sort(true_rows[list(missed)]),
    )


def _holders(ring: Ring, rules: DetectionProtocol, level: int) -> Mapping[int, int]:
    """Return the detection of each matched true box, also of pairs that do not count."""
    reach = ring.reach(level)
    classes = len(rules.classes)
    if rules.matching == "by_score":
        holder = nearest_by_score(reach)
    else:
        counts = {candidate: bool(ring.counts[candidate // classes]) for candidate in reach}
        holder = nearest_by_truth(reach, counts, ring.truth_counts.tolist()).holder
    return {truth: candidate // classes for truth, candidate in holder.items()}
