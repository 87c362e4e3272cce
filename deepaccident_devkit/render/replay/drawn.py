"""What a task draws of predictions (`evaluation.drawing`), as data for a replay page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.evaluation.drawing import (
    Drawing,
    DrawnBoxes,
    DrawnCells,
    DrawnPath,
    Role,
)
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs.setups import evaluator_class
from deepaccident_devkit.render.outcomes.described import (
    prediction_kind,
    sample_drawing,
    task_drawing,
)
from deepaccident_devkit.render.outcomes.drawings import ROLE_COLORS, instance_outlines
from deepaccident_devkit.render.replay.entries import ReplayRecording
from deepaccident_devkit.render.styles import POINT_COLOR
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.support.human_names import human_name
from deepaccident_devkit.taxonomy import FRAME_PERIOD, AgentName, short_name

# A results file, or predictions by sample token.
ReplayPrediction = Results | Mapping[str, Any]
# Maximum number of a sample's paths, and of its boxes of one kind; the likeliest are shown.
_MAX_LINES = 80
# Maximum number of a sample's marks; the first are shown.
_MAX_PLACES = 4
# Maximum number of points of a path.
_MAX_POINTS = 12
_DASHED_ROLES = ("truth", "missed")
_VERDICTS: Mapping[Role, str] = {"right": "TP", "false": "FP", "missed": "FN"}
# Colours as the page computes with them: `#rrggbb`.
_COLORS: Mapping[Role, str] = {**ROLE_COLORS, "truth": "#000000"}


def drawing_entries(
    recording: ReplayRecording, prediction: ReplayPrediction, task: str | None
) -> dict[str, Any]:
    """Return what a task draws of each sample with a prediction, and the colours' meanings.

    Args:
        recording: Scenario and shown agents.
        prediction: Predictions by sample.
        task: Name of a task; None for the one that the predictions are for.

    Raises:
        ChoiceError: No such task, or the predictions are for another one.
        NotAvailableError: There is no prediction for this scenario and these agents.
    """
    evaluator_type = evaluator_class(task or _task_of(prediction))
    evaluator = evaluator_type(next(iter(evaluator_type.protocols), ""))
    legend: dict[str, str] = {}
    samples = []
    for agent, frame in predicted_samples(recording, prediction):
        token = recording.sample(agent, frame)
        drawing, words = _describe(recording, prediction, evaluator, token)
        shown = _shown_drawing(drawing)
        parts: list[Any] = [*shown.paths, *shown.boxes, *shown.cells, *shown.places]
        for part in parts:
            legend[part.label] = _COLORS[part.role]
        verdict, color = _verdict(drawing)
        samples.append(
            {
                "frame": frame - 1,
                "agent": recording.agents.index(agent),
                "verdict": verdict,
                "color": color,
                "text": f"{short_name(agent)} at frame {frame}: {words}",
                **_sample_entry(recording, token, frame, shown),
            }
        )
    legend.pop("", None)
    rule = f"Drawn by the task {human_name(evaluator.task)}."
    return {"rule": rule, "samples": samples, "legend": [*legend.items()]}


def _task_of(prediction: ReplayPrediction) -> str:
    """Return the task that predictions are for; empty lists can be for any task."""
    if isinstance(prediction, Results):
        return prediction.task
    kinds = [prediction_kind(predicted) for predicted in prediction.values() if predicted != []]
    return next(filter(None, kinds), "accident")


def predicted_samples(
    recording: ReplayRecording, prediction: ReplayPrediction
) -> list[tuple[AgentName, int]]:
    """Return the agents and frames with a prediction, ordered by frame.

    Raises:
        NotAvailableError: There is no prediction for this scenario and these agents.
    """
    samples = []
    for frame in recording.frames:
        for agent in recording.agents:
            if recording.sample(agent, frame) in prediction:
                samples.append((agent, frame))
    if not samples:
        raise NotAvailableError(
            f"prediction: has no sample of {recording.scenario['token']} and "
            f"{', '.join(recording.agents)}; choose a scenario and agents that the prediction "
            "has, or replay without a prediction"
        )
    return samples


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
    if predicted == [] and "accident" not in evaluator.result_kinds:
        return Drawing(), "nothing predicted"
    try:
        described = sample_drawing(dataset, token, predicted, task=evaluator.task)
    except NotAvailableError:
        drawing = task_drawing(dataset, token, predicted, evaluator.task)
        return drawing, "without a truth to compare with"
    return described.drawing, described.words


def _shown_drawing(drawing: Drawing) -> Drawing:
    """Leave out what the page shows itself: the past, and the true actors at the moment."""
    boxes = []
    for drawn in drawing.boxes:
        if drawn.role not in ("truth", "collision") or drawn.time:
            boxes.append(drawn)
    return replace(
        drawing,
        paths=tuple(path for path in drawing.paths if path.role != "past"),
        boxes=tuple(boxes),
        cells=tuple(cells for cells in drawing.cells if cells.role != "truth"),
        places=drawing.places[:_MAX_PLACES],
    )


def _verdict(drawing: Drawing) -> tuple[str, str]:
    """Return a sample's outcome in a few words, such as `2 TP, 1 FN`, and its colour.

    Instances count once in each of their frames. The colour is that of the most frequent verdict.
    Without verdicts, it is red if an alarm is raised or, in a task without alarms, if something
    collides; there may be no words.
    """
    counts: Counter[Role] = Counter()
    for drawn in drawing.boxes:
        counts[drawn.role] += len(drawn.boxes)
    for cells in drawing.cells:
        for instance in cells.instance:
            counts[cells.role] += len(np.unique(instance[instance > 0]))
    judged = [role for role in _VERDICTS if counts[role]]
    if judged:
        words = [f"{counts[role]} {_VERDICTS[role]}" for role in judged]
        return ", ".join(words), _COLORS[max(judged, key=counts.__getitem__)]
    contacts = [place.note for place in drawing.places if place.role == "collision"]
    text = next(filter(None, contacts), drawing.words)
    is_grave = bool(contacts)
    if drawing.alarm is not None:
        is_grave = drawing.alarm.fires
        text = "alarm" if is_grave else "no alarm"
    return text, _COLORS["collision"] if is_grave else POINT_COLOR


def _sample_entry(
    recording: ReplayRecording, token: str, frame: int, drawing: Drawing
) -> dict[str, Any]:
    """Return the lines, places and alarm of a drawing, in the page's coordinates."""
    paths = sorted(drawing.paths, key=lambda path: -path.probability)
    lines = [_path_line(recording, token, path) for path in paths[:_MAX_LINES]]
    for drawn in drawing.boxes:
        lines += _box_lines(recording, token, frame, drawn)
    count = len(paths)
    count += sum(len(drawn.boxes) for drawn in drawing.boxes)
    left_out = count - len(lines)
    for cells in drawing.cells:
        lines += _cell_lines(recording, token, frame, cells)
    places = []
    for place in drawing.places:
        points = _page_points(recording, token, place.xy)
        words = {"time": place.time, "note": place.note, "label": place.label}
        places.append(_line(points, place.role) | words)
    return {
        "more": left_out,
        "lines": lines,
        "places": places,
        "alarm": drawing.alarm and asdict(drawing.alarm),
    }


def _path_line(recording: ReplayRecording, token: str, path: DrawnPath) -> dict[str, Any]:
    count = min(len(path.xy), _MAX_POINTS)
    rows = np.linspace(0, len(path.xy) - 1, count).round().astype(int)
    line = _line(_page_points(recording, token, path.xy[rows]), path.role)
    return line | {"opacity": path.probability, "width": path.width}


def _box_lines(
    recording: ReplayRecording, token: str, frame: int, drawn: DrawnBoxes
) -> list[dict[str, Any]]:
    """Return the outlines of the most confident boxes.

    The page shows boxes of a sample's moment only in its frame, and those of a later time longer.
    """
    boxes = drawn.boxes
    if drawn.scores is not None:
        boxes = boxes.select(np.argsort(-drawn.scores, kind="stable"))
    world_from_boxes = recording.dataset.world_from(token, boxes.frame)
    corners = boxes.transform(world_from_boxes, "world").bottom_corners()[:_MAX_LINES, :, :2]
    moment = {} if drawn.time else {"frames": [frame - 1, frame - 1]}
    lines = []
    for outline in recording.page_coordinates(corners):
        lines.append(_line([*outline, outline[0]], drawn.role) | moment)
    return lines


def _cell_lines(
    recording: ReplayRecording, token: str, frame: int, cells: DrawnCells
) -> list[dict[str, Any]]:
    """Return the outline of each instance in each of its frames, without holes.

    A line has the first and the last frame of the recording that it is predicted for.
    """
    import shapely

    starts = frame - 1 + np.rint(cells.times / FRAME_PERIOD).astype(int)
    step = int(np.diff(starts, append=starts[-1] + 1).max())
    lines = []
    for start, instance in zip(starts.tolist(), cells.instance, strict=True):
        moment = {"frames": [start, start + step - 1], "filled": cells.role != "missed"}
        for outline in instance_outlines(instance, cells.grid):
            ring = shapely.simplify(shapely.linearrings(outline), cells.grid.x[2])
            points = _page_points(recording, token, shapely.get_coordinates(ring))
            lines.append(_line(points, cells.role) | moment)
    return lines


def _line(points: list[Any], role: Role) -> dict[str, Any]:
    return {"points": points, "color": _COLORS[role], "dashed": role in _DASHED_ROLES}


def _page_points(recording: ReplayRecording, token: str, xy: FloatArray) -> list[Any]:
    """Convert positions (N, 2) in the ego frame, metres, to the page's coordinates."""
    points = np.column_stack([xy, np.zeros(len(xy))])
    world_points = recording.dataset.world_from(token, "ego").apply(points)
    return recording.page_coordinates(world_points[:, :2])
