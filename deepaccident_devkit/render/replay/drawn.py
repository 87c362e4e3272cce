"""Drawings of tasks (`evaluation.drawing`) as data for a replay page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.evaluation.drawing import (
    Drawing,
    DrawnBoxes,
    DrawnPath,
    Role,
)
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs.setups import evaluator_class
from deepaccident_devkit.render.outcomes.described import prediction_kind, sample_drawing
from deepaccident_devkit.render.outcomes.drawings import ROLE_COLORS
from deepaccident_devkit.render.replay.entries import (
    ReplayPrediction,
    ReplayRecording,
    predicted_samples,
)
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.support.human_names import human_name
from deepaccident_devkit.taxonomy import short_name

# Predictions of these kinds are shown as foreseen accidents, with verdicts.
_FORESEEING_KINDS = ("", "motion", "accident")
# Maximum number of a sample's paths, and of its boxes of one kind; the likeliest are shown.
_MAX_LINES = 80
# Maximum number of points of a path.
_MAX_POINTS = 12
_DASHED_ROLES = ("truth", "missed")
_VERDICT_ROLES = ("right", "false", "missed")
# Colours as the page computes with them: `#rrggbb`.
_COLORS: Mapping[Role, str] = {**ROLE_COLORS, "truth": "#000000"}


def task_to_draw(prediction: ReplayPrediction, task: str | None) -> str:
    """Return the task whose drawings a page shows; empty if it shows foreseen accidents.

    Args:
        prediction: Predictions by sample.
        task: Name of a task; None for the one that the predictions are for.

    Raises:
        ChoiceError: No such task.
    """
    if task is not None:
        name = evaluator_class(task).task
    elif isinstance(prediction, Results):
        name = prediction.task
    else:
        name = prediction_kind(next(iter(prediction.values()), None))
    return "" if name in _FORESEEING_KINDS else name


def drawing_entries(
    recording: ReplayRecording, prediction: ReplayPrediction, task: str
) -> dict[str, Any]:
    """Return what a task draws of each sample with a prediction, and the colours' meanings.

    Raises:
        ChoiceError: The predictions are for another task.
        NotAvailableError: There is no prediction for this scenario and these agents.
    """
    evaluator_type = evaluator_class(task)
    evaluator = evaluator_type(next(iter(evaluator_type.protocols), ""))
    legend: dict[str, str] = {}
    samples = []
    for agent, frame in predicted_samples(recording, prediction):
        token = recording.sample(agent, frame)
        drawing, words = _describe(recording, prediction, evaluator, token)
        parts: list[Any] = [*drawing.paths, *drawing.boxes, *drawing.places]
        legend.update({part.label: _COLORS[part.role] for part in parts})
        samples.append(
            {
                "frame": frame - 1,
                "agent": recording.agents.index(agent),
                "text": f"{short_name(agent)} at frame {frame}: {words}",
                **_sample_entry(recording, token, drawing),
            }
        )
    legend.pop("", None)
    rule = f"{human_name(task).capitalize()}: as the task draws each sample."
    return {"rule": rule, "samples": samples, "legend": [*legend.items()]}


def _describe(
    recording: ReplayRecording,
    prediction: ReplayPrediction,
    evaluator: Evaluator[Any],
    token: str,
) -> tuple[Drawing, str]:
    """Return the drawing of a sample, and its outcome in words."""
    dataset = recording.dataset
    predicted: Any
    if isinstance(prediction, Results):
        predicted = evaluator.read(prediction, dataset, token)
    else:
        predicted = prediction[token]
    kind = prediction_kind(predicted)
    if predicted == [] and kind not in evaluator.result_kinds:
        return Drawing(), "nothing predicted"
    try:
        described = sample_drawing(
            dataset, token, predicted, task=evaluator.task, protocol=evaluator.protocol
        )
    except NotAvailableError:
        # the default draws the prediction alone
        drawing = Evaluator.drawing(evaluator, dataset, token, predicted)
        return drawing, "without a truth to compare with"
    return described.drawing, described.words


def _sample_entry(recording: ReplayRecording, token: str, drawing: Drawing) -> dict[str, Any]:
    """Return the lines, places and alarm of a drawing, in the page's coordinates."""
    # the page has trails of its own for the past
    paths = [path for path in drawing.paths if path.role != "past"]
    paths.sort(key=lambda path: -path.probability)
    lines = [_path_line(recording, token, path) for path in paths[:_MAX_LINES]]
    for drawn in drawing.boxes:
        lines += _box_lines(recording, token, drawn)
    count = len(paths) + sum(len(drawn.boxes) for drawn in drawing.boxes)
    places = []
    for place in drawing.places:
        points = _page_points(recording, token, place.xy)
        words = {"time": place.time, "note": place.note, "label": place.label}
        places.append(_line(points, place.role) | words)
    return {
        "verdict": _verdict(drawing),
        "alarms": [],
        "more": count - len(lines),
        "lines": lines,
        "places": places,
        "alarm": drawing.alarm and asdict(drawing.alarm),
    }


def _path_line(recording: ReplayRecording, token: str, path: DrawnPath) -> dict[str, Any]:
    count = min(len(path.xy), _MAX_POINTS)
    rows = np.linspace(0, len(path.xy) - 1, count).round().astype(int)
    line = _line(_page_points(recording, token, path.xy[rows]), path.role)
    return line | {"opacity": path.probability, "width": path.width}


def _box_lines(recording: ReplayRecording, token: str, drawn: DrawnBoxes) -> list[dict[str, Any]]:
    """Return the outlines of the most confident boxes.

    Boxes of a sample's moment are passing: the page hides them when time goes on.
    """
    boxes = drawn.boxes
    if drawn.scores is not None:
        boxes = boxes.select(np.argsort(-drawn.scores, kind="stable"))
    world_from_boxes = recording.dataset.world_from(token, boxes.frame)
    corners = boxes.transform(world_from_boxes, "world").bottom_corners()[:_MAX_LINES, :, :2]
    lines = []
    for outline in recording.page_coordinates(corners):
        line = _line([*outline, outline[0]], drawn.role)
        lines.append(line | {"passing": drawn.role != "collision"})
    return lines


def _line(points: list[Any], role: Role) -> dict[str, Any]:
    return {"points": points, "color": _COLORS[role], "dashed": role in _DASHED_ROLES}


def _page_points(recording: ReplayRecording, token: str, xy: FloatArray) -> list[Any]:
    """Convert positions (N, 2) in the ego frame, metres, to the page's coordinates."""
    points = np.column_stack([xy, np.zeros(len(xy))])
    world_points = recording.dataset.world_from(token, "ego").apply(points)
    return recording.page_coordinates(world_points[:, :2])


def _verdict(drawing: Drawing) -> str:
    """Return a sample's outcome in a few words, such as `2 detected, 1 missed`."""
    if drawing.alarm is not None:
        return "alarm" if drawing.alarm.fires else "no alarm"
    judged = [drawn for drawn in drawing.boxes if drawn.role in _VERDICT_ROLES]
    counts = [f"{len(drawn.boxes)} {drawn.label}" for drawn in judged]
    return ", ".join(counts) or drawing.words or "predicted"
