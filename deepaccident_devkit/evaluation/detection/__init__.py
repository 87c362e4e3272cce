"""The task `detection`: average precision and errors of boxes under the released or other rules."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError, EvaluationError, GeometryError
from deepaccident_devkit.evaluation.detection.boxes import (
    DETECTION_PROTOCOLS,
    DetectionProtocol,
    columns_of,
    detection_protocol,
    detection_truth,
)
from deepaccident_devkit.evaluation.detection.curves import average_precision
from deepaccident_devkit.evaluation.detection.matching import (
    Ring,
    existing_detections,
    existing_truth,
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
from deepaccident_devkit.evaluation.drawing import Drawing, drawn_pair
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.predicted_boxes import DetectedBoxes, drawn_matches
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
    """Evaluator of detected boxes: average precision and errors, from the matches of each sample.

    ```python
    evaluator = DetectionEvaluator("paper")
    for token in samples(da, "val", "evaluate", "paper"):
        evaluator.update(token, detector(token), detection_truth(da, token, evaluator.protocol))
    print(evaluator.compute().mean_average_precision, evaluator.compute().mean_errors)
    ```

    Attributes:
        protocol: Rules of the evaluation, with the switches applied.
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
        """Create an evaluator without samples.

        Args:
            protocol: `released` (the released code's distance_mAP), `released_iou` (its iou_mAP),
                `paper`, `opencood`, or your own `DetectionProtocol`.
            **switches: Fields of `DetectionProtocol` to change.

        Raises:
            ChoiceError: If the protocol, a switch or a choice does not exist.
            ConfigError: If choices exclude each other.
        """
        switched_protocol = detection_protocol(protocol, **switches)
        super().__init__(switched_protocol)

    @property
    def settings(self) -> dict[str, Any]:
        """Names and values of the protocol's fields."""
        return self.protocol.as_dict()

    def read(self, results: Any, dataset: Dataset, token: str) -> DetectedBoxes:
        """Read a sample's boxes, and transform them from the world to the protocol's frame."""
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
            truth: True boxes in the protocol's frame, from `detection_truth`. The protocol's rules
                for the agent's own box, the area and the ranges are applied here.

        Raises:
            GeometryError: If the truth is not `Boxes`, or boxes are in another frame.
            EvaluationError: If the prediction is not `DetectedBoxes`, or the sample was counted
                before with other counts.
        """
        frame = self.protocol.frame
        if not isinstance(prediction, DetectedBoxes):
            raise EvaluationError(
                f"{token}: expected DetectedBoxes as the prediction, found "
                f"{type(prediction).__name__}; make them with DetectedBoxes.from_arrays(center, "
                f"size, yaw, scores, frame={frame!r}), with arrays of no rows if nothing is "
                "detected"
            )
        true_boxes = checked_boxes("truth", truth)
        for name, boxes in (("prediction", prediction.boxes), ("truth", true_boxes)):
            if boxes.frame != frame:
                raise GeometryError(
                    f"{token}: {name} in frame {boxes.frame!r}, but the protocol evaluates in "
                    f"{frame!r}; transform them, or choose frame="
                )
        self.add(token, self._count(token, prediction, truth))

    def _count(self, token: str, prediction: DetectedBoxes, truth: Boxes) -> Counts:
        detections = columns_of(prediction.boxes, prediction.scores)
        counts = frame_counts(detections, columns_of(truth), self.protocol)
        return {"token": token, **counts}

    def drawing(self, dataset: Dataset, token: str, prediction: Any, /, *truth: Any) -> Drawing:
        """Describe matched, false and missed boxes at the threshold of `detection_matches`.

        The prediction may be in any frame of the sample.
        """
        (true_boxes,) = truth
        frame = self.protocol.frame
        truth_from_world = dataset.world_from(token, frame).inverse()
        world_from_prediction = dataset.world_from(token, prediction.boxes.frame)
        prediction = prediction.transform(truth_from_world @ world_from_prediction, frame)
        matches = detection_matches(prediction, true_boxes, self.protocol)
        drawing = drawn_matches(
            prediction,
            true_boxes,
            {"truth": matches.truth, "missed": matches.missed},
            {"right": matches.detection, "false": matches.false},
        )
        counts = self._count(token, prediction, true_boxes)
        precision = self.result_of([counts]).mean_average_precision
        limit = f"with an overlap of {matches.threshold:g}"
        if self.protocol.measure.startswith("distance"):
            limit = f"within {matches.threshold:g} m"
        return replace(
            drawing,
            boxes=(*drawing.boxes, *drawn_pair(dataset, token, frame)),
            words=f"mAP of this sample {precision:.1f} %; boxes match {limit}",
        )

    def result_of(self, counts: Collection[Counts]) -> DetectionResult:
        """Compute the metrics from the counts of samples, in any order."""
        return detection_result(counts, self.protocol)

    def sample_row(self, token: str) -> dict[str, int]:
        """Return a sample's row: how many boxes count, and true positives at each threshold.

        The numbers are summed over all classes and ranges.
        """
        counts = self._counts[token]
        tp_cells = counts["tp"][0]
        detection_groups = counts["detections"][0]
        thresholds = self.protocol.thresholds
        hits = Counter(cell % len(thresholds) for cell in tp_cells)
        row = {"truths": sum(counts["truths"]), "detections": len(detection_groups)}
        for level, threshold in enumerate(thresholds):
            row[f"tp_{threshold:g}"] = hits[level]
        return row

    def resampled(
        self, parts: Sequence[Sequence[Counts]], times: IntArray
    ) -> Iterator[DetectionResult]:
        """Yield the result of each draw (`Evaluator.resampled`).

        Whatever does not depend on the draw is computed only once.
        """
        part_sizes = [len(part) for part in parts]
        part_index = np.repeat(np.arange(len(parts)), part_sizes)
        ledger = Ledger([counts for part in parts for counts in part], self.protocol)
        sample_times = times[:, part_index[ledger.order]]
        yield from drawn_results(ledger, self.protocol, sample_times.astype(np.int32))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectionMatches(FrozenArrays):
    """The matches of one sample at one threshold, as indices of detections and of true boxes.

    Boxes that do not count are left out: boxes outside the protocol's area and ranges, boxes of
    other classes, and boxes that are matched with one of these.

    Attributes:
        threshold: One of the protocol's thresholds, metres or a share.
        detection: (M,) int64 indices of the detections that are true positives.
        truth: (M,) int64 index of the true box of each of these detections.
        false: (F,) int64 indices of the false positives.
        missed: (G,) int64 indices of the missed true boxes.
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
        truth: True boxes in the protocol's frame, from `detection_truth`.
        protocol: Name of a protocol, or a protocol.
        threshold: One of the protocol's thresholds; None takes its `error_threshold` or, if it has
            none, the middle threshold.

    Raises:
        ChoiceError: If the protocol does not exist, or does not have this threshold.
    """
    rules = detection_protocol(protocol)
    middle_threshold = rules.thresholds[len(rules.thresholds) // 2]
    used_threshold = threshold or rules.error_threshold or middle_threshold
    if used_threshold not in rules.thresholds:
        raise ChoiceError(
            f"threshold: expected one of {', '.join(map(str, rules.thresholds))}, found "
            f"{threshold!r}"
        )
    level = rules.thresholds.index(used_threshold)
    all_detections = columns_of(prediction.boxes, prediction.scores)
    detections, rows = existing_detections(all_detections, rules)
    true_boxes, true_rows = existing_truth(columns_of(truth), rules)
    matched_rows = []
    unmatched: set[int] = set()
    missed: set[int] = set()
    for position in range(len(rules.ranges)):
        ring = ring_of(detections, true_boxes, rules, position)
        detection_by_truth = _matched_detections(ring, rules, level)
        for true_box, detection in detection_by_truth.items():
            if ring.counts[detection] and ring.truth_counts[true_box]:
                matched_rows.append((rows[detection], true_rows[true_box]))
        counted_detections = np.flatnonzero(ring.counts).tolist()
        unmatched |= set(counted_detections) - set(detection_by_truth.values())
        counted_truth = np.flatnonzero(ring.truth_counts).tolist()
        missed |= set(counted_truth) - detection_by_truth.keys()
    pairs = np.array(sorted(matched_rows), dtype=np.int64).reshape(-1, 2)
    return DetectionMatches(
        threshold=used_threshold,
        detection=pairs[:, 0],
        truth=pairs[:, 1],
        false=np.sort(rows[list(unmatched)]),
        missed=np.sort(true_rows[list(missed)]),
    )


def _matched_detections(ring: Ring, rules: DetectionProtocol, level: int) -> Mapping[int, int]:
    """Match a range at a threshold: true box → detection, including pairs that do not count."""
    reach = ring.reach(level)
    class_count = len(rules.classes)
    if rules.matching == "by_score":
        candidate_by_truth = nearest_by_score(reach)
    else:
        counts = {candidate: bool(ring.counts[candidate // class_count]) for candidate in reach}
        steps = nearest_by_truth(reach, counts, ring.truth_counts.tolist())
        candidate_by_truth = steps.holder
    return {truth: candidate // class_count for truth, candidate in candidate_by_truth.items()}
