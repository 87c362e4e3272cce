"""Perfect predictions, and empty ones, in the form of given ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from deepaccident_devkit.evaluation.metrics.accident import AccidentContext, AccidentReading
from deepaccident_devkit.evaluation.metrics.alarms.reading import accident_of
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes
from deepaccident_devkit.evaluation.metrics.frames import frames_there, labels_at_present
from deepaccident_devkit.evaluation.metrics.predictions import Accident, MotionOutput, instances_of
from deepaccident_devkit.motion import MotionHeads, MotionLabels
from deepaccident_devkit.taxonomy import FRAME_PERIOD

Arguments = tuple[Any, ...]
"""What an evaluator takes of a sample after its token: the prediction, then the truth."""


def perfect(arguments: Arguments, rules: Any) -> Arguments:
    """The same sample with the truth as prediction, in the form of the given one; K predictions become one.

    Explicit accidents are those that the protocol itself compares with: of maps where it reads the truth off maps.

    Args:
        arguments: of the sample.
        rules: the protocol.
    """
    prediction, truth, *more = arguments
    if isinstance(prediction, MotionOutput):
        return _as_output(prediction, labels_at_present(truth)), truth, *more
    if isinstance(prediction, DetectedBoxes):
        return DetectedBoxes(boxes=truth, scores=np.ones(len(truth))), truth, *more
    reading = getattr(rules, "reading", AccidentReading())
    return _accidents(truth, more, reading), truth, *more


def empty(arguments: Arguments) -> Arguments:
    """The same sample with nothing predicted, in the form of the given prediction."""
    prediction, *truth = arguments
    if isinstance(prediction, DetectedBoxes):
        nothing = prediction.boxes.select(np.zeros(len(prediction), dtype=bool))
        return DetectedBoxes(boxes=nothing, scores=np.zeros(0)), *truth
    if not isinstance(prediction, MotionOutput):
        return [], *truth
    if prediction.instances is not None:
        return replace(prediction, instances=np.zeros_like(prediction.instances[-1:])), *truth
    return replace(prediction, heads=tuple(_empty_heads(each) for each in (prediction.heads or ())[-1:])), *truth


def _as_output(given: MotionOutput, label: MotionLabels) -> MotionOutput:
    if given.heads is None:
        return instances_of(label.instance, label.config.grid)
    return MotionOutput(grid=label.config.grid, heads=(MotionHeads.from_labels(label),))


def _empty_heads(heads: MotionHeads) -> MotionHeads:
    background = np.zeros_like(heads.segmentation)
    background[:, 0] = 1.0
    nothing = np.zeros_like(heads.offset)
    return replace(
        heads, segmentation=background, centerness=np.zeros_like(heads.centerness), offset=nothing, flow=nothing
    )


def _accidents(label: MotionLabels | None, more: Sequence[Any], reading: AccidentReading) -> list[Accident]:
    context = next((each for each in more if isinstance(each, AccidentContext)), AccidentContext())
    if label is None:
        return [] if context.truth is None or context.truth.accident is None else [context.truth.accident]
    at_present, frames = labels_at_present(label), frames_there(label)
    found = accident_of(at_present.instance[:frames], label.config.grid, label.config.rules, reading)
    if found.contact is None:
        return []
    time = found.contact.frame * label.config.step * FRAME_PERIOD
    return [Accident(positions=found.positions, time=time)]
