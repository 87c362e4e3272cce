"""What a protocol says of a sample's prediction: a verdict of motion, of accidents or of detections."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final, TypeAlias

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.evaluation.accident import (
    AccidentEvaluator,
    BoxTruth,
    ComparedAccidents,
    accident_context,
    compared_accidents,
)
from deepaccident_devkit.evaluation.detection import (
    DetectedBoxes,
    DetectionEvaluator,
    DetectionMatches,
    DetectionProtocol,
    detection_matches,
    detection_protocol,
    detection_truth,
)
from deepaccident_devkit.evaluation.motion import MotionEvaluator
from deepaccident_devkit.evaluation.predictions import (
    Accident,
    MotionOutput,
    Prediction,
    checked_prediction,
)
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.motion import MotionLabelConfig, MotionLabels, motion_labels
from deepaccident_devkit.render.outcomes.above import MotionOutcome, motion_outcome, verdict_words
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x import cooperative_boxes

Judged: TypeAlias = MotionOutput | list[Accident] | DetectedBoxes
# Half a second from frame to frame, two seconds ahead.
_RELEASED: Final = MotionLabelConfig()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionVerdict(ShortRepr):
    """Predicted instances against the labels'.

    Attributes:
        sample: token.
        label: the truth.
        outcome: which instances match, frame by frame.
        words: the numbers of each range.
    """

    sample: str
    label: MotionLabels
    outcome: MotionOutcome
    words: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AccidentVerdict(ShortRepr):
    """Foreseen accidents against the one to come.

    Attributes:
        sample: token.
        compared: the accidents that the protocol compares, in the present ego frame.
        truth: the actors around; None if it is not known.
        words: what the sample counts as, by the allowed distance.
    """

    sample: str
    compared: ComparedAccidents
    truth: BoxTruth | None
    words: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectionVerdict(ShortRepr):
    """Detected boxes against the true ones.

    Attributes:
        sample: token.
        rules: the protocol.
        detected: in its frame.
        truth: the true boxes in that frame.
        matches: at the threshold of the protocol's errors or, if it has none, at the middle one.
        words: the mean average precision of the sample.
    """

    sample: str
    rules: DetectionProtocol
    detected: DetectedBoxes
    truth: Boxes
    matches: DetectionMatches
    words: str


Verdict: TypeAlias = MotionVerdict | AccidentVerdict | DetectionVerdict


def judged_as(prediction: object, task: str | None) -> tuple[Judged, str]:
    """A prediction, explicit accidents as a list, and the task that it is judged in: the one given, or its own.

    Raises ChoiceError if the prediction is not of the task, EvaluationError if it is no prediction.
    """
    given = prediction if isinstance(prediction, DetectedBoxes) else checked_prediction(prediction)
    possible: tuple[str, ...] = ("accident",)
    if isinstance(given, DetectedBoxes):
        possible = ("detection",)
    elif isinstance(given, MotionOutput):
        possible = ("motion", "accident")
    return given, possible[0] if task is None else choice("task of this prediction", task, possible)


def sample_verdict(
    dataset: Dataset,
    sample: RowArgument,
    prediction: Prediction | DetectedBoxes,
    *,
    task: str | None = None,
    protocol: Any = None,
    label: MotionLabels | None = None,
) -> Verdict:
    """Judge a prediction for a sample; arguments and errors are those of `render_evaluation`."""
    given, chosen = judged_as(prediction, task)
    token = dataset.get("sample", sample)["token"]
    if isinstance(given, DetectedBoxes):
        return _of_detection(dataset, token, given, protocol or "released")
    if isinstance(given, MotionOutput) and chosen == "motion":
        judge = MotionEvaluator(protocol or "released")
        return _of_motion(
            token, given, label or _label(dataset, token, given, judge.protocol.labels), judge
        )
    default = "released" if isinstance(given, MotionOutput) else "boxes"
    return _of_accident(dataset, token, given, label, AccidentEvaluator(protocol or default))


def _of_motion(
    token: str, given: MotionOutput, label: MotionLabels, judge: MotionEvaluator
) -> MotionVerdict:
    judge.update(token, given, label)
    ranges = [
        f"{name} m: IoU {within.iou:.1f} %, VPQ {within.pq:.1f} %, {within.true_positive} TP, "
        f"{within.false_positive} FP, {within.false_negative} FN"
        for name, within in judge.compute().ranges.items()
    ]
    return MotionVerdict(
        sample=token, label=label, outcome=motion_outcome(given, label), words="; ".join(ranges)
    )


def _of_accident(
    dataset: Dataset,
    token: str,
    given: Prediction,
    label: MotionLabels | None,
    judge: AccidentEvaluator,
) -> AccidentVerdict:
    if label is None and hasattr(judge.protocol, "labels"):
        label = _label(dataset, token, given, judge.protocol.labels)
    context = accident_context(dataset, token, _horizon(given))
    judge.update(token, given, label, context)
    return AccidentVerdict(
        sample=token,
        compared=compared_accidents(given, label, context, judge.protocol),
        truth=context.truth,
        words=f"accident: {verdict_words(judge.compute())}",
    )


def _of_detection(
    dataset: Dataset, token: str, given: DetectedBoxes, protocol: Any
) -> DetectionVerdict:
    rules = detection_protocol(protocol)
    truth = detection_truth(dataset, token, rules)
    here = dataset.world_from(token, rules.frame).inverse() @ dataset.world_from(
        token, given.boxes.frame
    )
    detected = DetectedBoxes(boxes=given.boxes.transform(here, rules.frame), scores=given.scores)
    judge = DetectionEvaluator(rules)
    judge.update(token, detected, truth)
    return DetectionVerdict(
        sample=token,
        rules=rules,
        detected=detected,
        truth=truth,
        matches=detection_matches(detected, truth, rules),
        words=f"detection: mean average precision of this sample {judge.compute().mean_average_precision:.1f} %",
    )


def _frames(given: Prediction) -> int | None:
    """How many frames motion has; None for other predictions."""
    if not isinstance(given, MotionOutput):
        return None
    if given.instances is not None:
        return int(given.instances.shape[1])
    return len((given.heads or ())[-1].segmentation)


def _horizon(given: Prediction) -> float:
    frames = _frames(given)
    ahead = _RELEASED.future_frames if frames is None else frames - 1
    return ahead * _RELEASED.step * FRAME_PERIOD


def _label(dataset: Dataset, token: str, given: Prediction, protocol: str | None) -> MotionLabels:
    config, frames = replace(_RELEASED, protocol=protocol or "released"), _frames(given)
    if isinstance(given, MotionOutput) and frames is not None:
        config = replace(config, grid=given.grid, future_frames=frames - 1)
    return motion_labels(dataset, token, config)


def boxes_of(dataset: Dataset, verdict: AccidentVerdict) -> Boxes:
    """The boxes, now and in world, of who collides by meta, or else of whom the first alarm names."""
    record = dataset.get("sample", verdict.sample)
    collision = dataset.get("scenario", record["scenario_token"])["collision"]
    named = next((alarm.ids for alarm in verdict.compared.predicted), None)
    boxes = cooperative_boxes(dataset, record)
    return boxes.select(
        np.isin(boxes.actor_id, (named or ()) if collision is None else collision["ids"])
    )
