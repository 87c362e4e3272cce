"""`render_evaluation`: a sample's label, a model's prediction, and the verdict of a protocol."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.evaluation.metrics.accident import (
    AccidentEvaluator,
    ComparedAccidents,
    accident_context,
    compared_accidents,
)
from deepaccident_devkit.evaluation.metrics.detection import (
    DetectedBoxes,
    DetectionEvaluator,
    detection_matches,
    detection_protocol,
    detection_truth,
)
from deepaccident_devkit.evaluation.metrics.frames import labels_at_present
from deepaccident_devkit.evaluation.metrics.motion import MotionEvaluator
from deepaccident_devkit.evaluation.metrics.predictions import MotionOutput, Prediction, checked_prediction
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabelConfig, MotionLabels, motion_labels
from deepaccident_devkit.render.axes import figure_or_new, settled, titled_from_above
from deepaccident_devkit.render.boxes import draw_boxes_from_above
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.colors import COLLIDER_COLOR
from deepaccident_devkit.render.layers import Layer, layers_of
from deepaccident_devkit.render.motion_cells import draw_edge
from deepaccident_devkit.render.motion_maps import maps_of_labels
from deepaccident_devkit.render.outcomes.accident import ACCIDENT_LAYERS, draw_accident_outcome, verdict_words
from deepaccident_devkit.render.outcomes.detection import DETECTION_LAYERS, WINDOW, draw_detection_outcome, draw_true
from deepaccident_devkit.render.outcomes.motion import MOTION_LAYERS, draw_motion_side, motion_outcome
from deepaccident_devkit.render.roles import collider_ids
from deepaccident_devkit.render.titles import set_scene_title
from deepaccident_devkit.taxonomy import FRAME_PERIOD, OWN_ACTOR_ID
from deepaccident_devkit.text import choice

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_POSSIBLE: Final[Mapping[str, tuple[Layer, ...]]] = {
    "motion": MOTION_LAYERS,
    "accident": ACCIDENT_LAYERS,
    "detection": DETECTION_LAYERS,
}
_SIZE: Final = (12.4, 6.9)


def render_evaluation(
    dataset: Dataset,
    sample: RowArgument,
    prediction: Prediction | DetectedBoxes,
    *,
    task: str | None = None,
    protocol: Any = None,
    label: MotionLabels | None = None,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render a sample's truth and beside it a model's prediction, with a protocol's verdict in numbers.

    Motion: true instances are found or missed, predicted ones right or false, frame by frame. Accidents: the places
    where two collide, with the metres between foreseen and true places. Detections: matched, false and missed boxes.
    The true pair that collides is red.

    Args:
        dataset: the release.
        sample: token or record.
        prediction: motion, explicit accidents (a list, empty for none), or detected boxes in any frame of the sample.
        task: `motion`, `accident` or `detection`; None for the prediction's. Motion can be evaluated as motion or as
            accident.
        protocol: of the task, by name, or your own; None for `released`, or `boxes` for explicit accidents.
        label: the motion labels that motion is compared with; None makes the labels that the protocol needs, on the
            prediction's cells and half a second apart.
        layers: for motion `labels`, `trajectories`, `ids`, `grid`; for accidents `boxes`, `trajectories`, `ids`,
            `grid`; for detections `boxes`, `ids`, `grid`. All except `ids` are the default.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure: truth to the left, prediction to the right, the verdict above.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label, or its scenario no meta that an accident needs.
        ChoiceError: no such task, protocol or layer, or the prediction is not of this task.
        EvaluationError: the protocol cannot evaluate such a prediction.
    """
    given = prediction if isinstance(prediction, DetectedBoxes) else checked_prediction(prediction)
    chosen = _task(given, task)
    possible = _POSSIBLE[chosen]
    shown = layers_of(layers, [layer for layer in possible if layer != "ids"], possible)
    token = dataset.get("sample", sample)["token"]
    if isinstance(given, DetectedBoxes):
        fig, words = _draw_detection(dataset, token, given, protocol or "released", shown, fig)
    elif isinstance(given, MotionOutput) and chosen == "motion":
        rules = MotionEvaluator(protocol or "released")
        truth = label or _label(dataset, token, given, rules.protocol.labels)
        fig, words = _draw_motion(token, given, truth, rules, shown, fig)
        if "labels" in shown:
            _edge_pair(truth, collider_ids(dataset, token), fig.axes[0])
    else:
        default = "released" if isinstance(given, MotionOutput) else "boxes"
        judge = AccidentEvaluator(protocol or default)
        fig, words = _draw_accident(dataset, token, given, label, judge, shown, fig)
    set_scene_title(fig, dataset, token, below=words, fontsize=11)
    return settled(fig)


def _task(given: object, task: str | None) -> str:
    possible: tuple[str, ...] = ("accident",)
    if isinstance(given, DetectedBoxes):
        possible = ("detection",)
    elif isinstance(given, MotionOutput):
        possible = ("motion", "accident")
    return possible[0] if task is None else choice("task of this prediction", task, possible)


def _draw_motion(
    token: str,
    given: MotionOutput,
    label: MotionLabels,
    judge: MotionEvaluator,
    shown: frozenset[Layer],
    fig: Figure | None,
) -> tuple[Figure, str]:
    judge.update(token, given, label)
    result = judge.compute()
    outcome = motion_outcome(given, label, judge.protocol)
    fig = figure_or_new(fig, _SIZE)
    left, right = fig.subplots(1, 2)
    draw_motion_side(outcome, "true", layers=shown, ax=left)
    draw_motion_side(outcome, "predicted", layers=shown, ax=right)
    ranges = [
        f"{name} m: IoU {within.iou:.1f} %, PQ {within.pq:.1f} %, {within.true_positive} TP, "
        f"{within.false_positive} FP, {within.false_negative} FN"
        for name, within in result.ranges.items()
    ]
    return fig, "; ".join(ranges)


def _edge_pair(label: MotionLabels, ids: Collection[int], ax: Axes) -> None:
    """Render red edges around the present cells of the actors with these label ids."""
    maps = maps_of_labels(labels_at_present(label))
    for actor in ids:
        draw_edge(maps, label.id_map.get(OWN_BOX_ID if actor == OWN_ACTOR_ID else actor, -1), ax, COLLIDER_COLOR)


def _draw_accident(
    dataset: Dataset,
    token: str,
    given: Prediction,
    label: MotionLabels | None,
    judge: AccidentEvaluator,
    shown: frozenset[Layer],
    fig: Figure | None,
) -> tuple[Figure, str]:
    if label is None and hasattr(judge.protocol, "labels"):
        label = _label(dataset, token, given, judge.protocol.labels)
    context = accident_context(dataset, token, _horizon(given))
    judge.update(token, given, label, context)
    compared = compared_accidents(given, label, context, judge.protocol)
    fig = figure_or_new(fig, _SIZE)
    left, right = fig.subplots(1, 2)
    draw_accident_outcome(compared, context.truth, layers=shown, ax=right)
    limits = right.get_xlim(), right.get_ylim()
    draw_accident_outcome(ComparedAccidents(true=compared.true, predicted=()), context.truth, layers=shown, ax=left)
    left.set(xlim=limits[0], ylim=limits[1])
    left.set_title("truth" if compared.true else "truth: no accident comes", fontsize=SMALLEST_TEXT)
    return fig, f"accident: {verdict_words(judge.compute())}"


def _draw_detection(
    dataset: Dataset, token: str, given: DetectedBoxes, protocol: Any, shown: frozenset[Layer], fig: Figure | None
) -> tuple[Figure, str]:
    rules = detection_protocol(protocol)
    truth = detection_truth(dataset, token, rules)
    here = dataset.world_from(token, rules.frame).inverse() @ dataset.world_from(token, given.boxes.frame)
    given = DetectedBoxes(boxes=given.boxes.transform(here, rules.frame), scores=given.scores)
    judge = DetectionEvaluator(rules)
    judge.update(token, given, truth)
    fig = figure_or_new(fig, _SIZE)
    left, right = fig.subplots(1, 2)
    draw_detection_outcome(given, truth, rules, layers=shown, ax=right)
    matches = detection_matches(given, truth, rules)
    if "boxes" in shown:
        draw_true(truth, matches, left)
        pair = truth.select(np.isin(truth.actor_id, [*collider_ids(dataset, token)]))
        for ax in (left, right):
            draw_boxes_from_above(pair, ax, [COLLIDER_COLOR] * len(pair), fill=0, linewidths=1.6)
    left.set(xlim=(-WINDOW, WINDOW), ylim=(-WINDOW, WINDOW))
    titled_from_above(
        left, f"true boxes: {len(matches.truth)} found, {len(matches.missed)} missed (dashed)", grid="grid" in shown
    )
    return fig, f"detection: mean average precision of this sample {judge.compute().mean_average_precision:.1f} %"


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


_RELEASED: Final = MotionLabelConfig()
"""Half a second from frame to frame, two seconds ahead."""
