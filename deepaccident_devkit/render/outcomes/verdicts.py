"""The verdict of a protocol on a prediction of motion, accidents or detections for a sample."""

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
from deepaccident_devkit.support.human_names import human_name
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x import cooperative_boxes

# Tasks whose predictions have a verdict; the others draw themselves.
JUDGED_TASKS: Final = ("motion", "accident", "detection")
Judged: TypeAlias = MotionOutput | list[Accident] | DetectedBoxes
# Configuration of the released labels: half a second from frame to frame, two seconds ahead.
_RELEASED_CONFIG = MotionLabelConfig()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionVerdict(ShortRepr):
    """Predicted instances compared with the labels' instances.

    Attributes:
        sample: Token of the sample.
        label: Ground truth.
        outcome: Which instances match, frame by frame.
        words: The metrics of each range, in words.
    """

    sample: str
    label: MotionLabels
    outcome: MotionOutcome
    words: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AccidentVerdict(ShortRepr):
    """Foreseen accidents compared with the one that follows.

    Attributes:
        sample: Token of the sample.
        compared: Accidents that the protocol compares, in the ego frame at t = 0.
        truth: Surrounding actors; None if unknown.
        words: Outcome of the sample at each allowed distance, in words.
    """

    sample: str
    compared: ComparedAccidents
    truth: BoxTruth | None
    words: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectionVerdict(ShortRepr):
    """Detected boxes compared with the true ones.

    Attributes:
        sample: Token of the sample.
        rules: The protocol.
        detected: Detections in the protocol's frame.
        truth: True boxes in the protocol's frame.
        matches: Matches at the threshold at which the protocol computes errors or, if it computes
            none, at the middle one.
        words: Mean average precision of the sample, in words.
    """

    sample: str
    rules: DetectionProtocol
    detected: DetectedBoxes
    truth: Boxes
    matches: DetectionMatches
    words: str


Verdict: TypeAlias = MotionVerdict | AccidentVerdict | DetectionVerdict


def check_judged_prediction(prediction: object, task: str | None) -> tuple[Judged, str]:
    """Check a prediction; return it with the task to judge it by: `task`, or if None its own.

    Explicit accidents become a list.

    Raises:
        ChoiceError: The prediction is for another task.
        EvaluationError: The object is not a prediction.
    """
    if isinstance(prediction, DetectedBoxes):
        return prediction, _chosen_task(task, ("detection",))
    checked = checked_prediction(prediction)
    if isinstance(checked, MotionOutput):
        return checked, _chosen_task(task, ("motion", "accident"))
    return checked, _chosen_task(task, ("accident",))


def _chosen_task(task: str | None, possible: tuple[str, ...]) -> str:
    if task is None:
        return possible[0]
    return choice("task of this prediction", task, possible)


def sample_verdict(
    dataset: Dataset,
    sample: RowArgument,
    prediction: Prediction | DetectedBoxes,
    *,
    task: str | None = None,
    protocol: Any = None,
    label: MotionLabels | None = None,
) -> Verdict:
    """Judge a prediction for a sample; arguments and errors are as for `render_evaluation`."""
    checked, task = check_judged_prediction(prediction, task)
    token = dataset.get("sample", sample)["token"]
    if isinstance(checked, DetectedBoxes):
        return _detection_verdict(dataset, token, checked, protocol or "released")
    if isinstance(checked, MotionOutput) and task == "motion":
        evaluator = MotionEvaluator(protocol or "released")
        label = label or _make_label(dataset, token, checked, evaluator.protocol.labels)
        return _motion_verdict(token, checked, label, evaluator)
    default = "boxes"
    if isinstance(checked, MotionOutput):
        default = "released"
    accident_evaluator = AccidentEvaluator(protocol or default)
    return _accident_verdict(dataset, token, checked, label, accident_evaluator)


def _motion_verdict(
    token: str, output: MotionOutput, label: MotionLabels, evaluator: MotionEvaluator
) -> MotionVerdict:
    evaluator.update(token, output, label)
    ranges = []
    for name, within in evaluator.compute().ranges.items():
        ranges.append(
            f"{human_name(name, 'qualifiers')}: IoU {within.iou:.1f} %, VPQ {within.pq:.1f} %, "
            f"{within.true_positive} TP, {within.false_positive} FP, {within.false_negative} FN"
        )
    outcome = motion_outcome(output, label)
    return MotionVerdict(sample=token, label=label, outcome=outcome, words="; ".join(ranges))


def _accident_verdict(
    dataset: Dataset,
    token: str,
    prediction: Prediction,
    label: MotionLabels | None,
    evaluator: AccidentEvaluator,
) -> AccidentVerdict:
    if label is None and hasattr(evaluator.protocol, "labels"):
        label = _make_label(dataset, token, prediction, evaluator.protocol.labels)
    frames = num_motion_frames(prediction)
    future_frames = _RELEASED_CONFIG.future_frames if frames is None else frames - 1
    horizon = future_frames * _RELEASED_CONFIG.step * FRAME_PERIOD
    context = accident_context(dataset, token, horizon)
    evaluator.update(token, prediction, label, context)
    return AccidentVerdict(
        sample=token,
        compared=compared_accidents(prediction, label, context, evaluator.protocol),
        truth=context.truth,
        words=f"accident prediction: {verdict_words(evaluator.compute())}",
    )


def _detection_verdict(
    dataset: Dataset, token: str, prediction: DetectedBoxes, protocol: Any
) -> DetectionVerdict:
    rules = detection_protocol(protocol)
    truth = detection_truth(dataset, token, rules)
    world_from_prediction = dataset.world_from(token, prediction.boxes.frame)
    truth_from_world = dataset.world_from(token, rules.frame).inverse()
    detected = prediction.transform(truth_from_world @ world_from_prediction, rules.frame)
    evaluator = DetectionEvaluator(rules)
    evaluator.update(token, detected, truth)
    precision = evaluator.compute().mean_average_precision
    return DetectionVerdict(
        sample=token,
        rules=rules,
        detected=detected,
        truth=truth,
        matches=detection_matches(detected, truth, rules),
        words=f"object detection: mAP of this sample {precision:.1f} %",
    )


def num_motion_frames(prediction: object) -> int | None:
    """Return how many frames a motion prediction has; None for other predictions."""
    if not isinstance(prediction, MotionOutput):
        return None
    if prediction.instances is not None:
        return int(prediction.instances.shape[1])
    return len((prediction.heads or ())[-1].segmentation)


def _make_label(
    dataset: Dataset, token: str, prediction: Prediction, protocol: str | None
) -> MotionLabels:
    """Make a sample's motion labels (by token) on the grid and for the frames of a prediction."""
    config = replace(_RELEASED_CONFIG, protocol=protocol or "released")
    frames = num_motion_frames(prediction)
    if isinstance(prediction, MotionOutput) and frames is not None:
        config = replace(config, grid=prediction.grid, future_frames=frames - 1)
    return motion_labels(dataset, token, config)


def boxes_of(dataset: Dataset, verdict: AccidentVerdict) -> Boxes:
    """Return the boxes of an accident's pair in the current frame, in the world frame.

    The pair is the one that collides according to meta, otherwise the one that the first alarm
    names.
    """
    record = dataset.get("sample", verdict.sample)
    collision = dataset.get("scenario", record["scenario_token"])["collision"]
    ids: Any = ()
    if collision is not None:
        ids = collision["ids"]
    elif verdict.compared.predicted:
        ids = verdict.compared.predicted[0].ids or ()
    boxes = cooperative_boxes(dataset, record)
    return boxes.select(np.isin(boxes.actor_id, ids))
