"""`render_evaluation`: a sample's truth next to a prediction, with the verdict of a protocol."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.predictions import Prediction, labels_at_present
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabels
from deepaccident_devkit.render.bev import BevView, draw_bev
from deepaccident_devkit.render.boxes import camera_name, collider_ids, draw_boxes_from_above
from deepaccident_devkit.render.camera import best_view
from deepaccident_devkit.render.captions import (
    draw_legend,
    set_scene_title,
    titled_from_above,
)
from deepaccident_devkit.render.figures import (
    Layer,
    Layers,
    figure_or_new,
    lay_out_figure,
    show_square,
)
from deepaccident_devkit.render.motion_maps import draw_edge, maps_of_labels
from deepaccident_devkit.render.outcomes.above import (
    ACCIDENT_LAYERS,
    DETECTION_LAYERS,
    MOTION_LAYERS,
    VIEW_RANGE,
    draw_accidents,
    draw_detection_outcome,
    draw_motion_side,
    draw_true,
    layers_without_ids,
    shown_square,
)
from deepaccident_devkit.render.outcomes.cameras import draw_accidents_in_camera
from deepaccident_devkit.render.outcomes.described import (
    SampleDrawing,
    sample_drawing,
    task_to_describe,
)
from deepaccident_devkit.render.outcomes.drawings import (
    DRAWING_LAYERS,
    best_camera_of_drawing,
    draw_drawing_from_above,
    draw_drawing_in_camera,
)
from deepaccident_devkit.render.outcomes.verdicts import (
    AccidentVerdict,
    DetectionVerdict,
    MotionVerdict,
    boxes_of,
    check_judged_prediction,
    sample_verdict,
)
from deepaccident_devkit.render.styles import (
    COLLIDER_COLOR,
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID, short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LAYERS_OF_TASK: Mapping[str, Layers] = {
    "motion": MOTION_LAYERS,
    "accident": ("image", "bev", *ACCIDENT_LAYERS),
    "detection": DETECTION_LAYERS,
}
# Width and height in inches of the figure for each judged task, and for a task that draws itself.
_FIGURE_SIZES = {"motion": (12.4, 6.9), "accident": (12.4, 5.9), "detection": (12.4, 6.9)}
_DRAWING_SIZE = (12.4, 5.9)
# Relative widths of a camera's panel and the panel next to it, and relative heights of a camera's
# panel and the panel below it.
_CAMERA_WIDTH_RATIOS = (1.4, 1.0)
_CAMERA_HEIGHT_RATIOS = (0.6, 1.0)


@in_own_settings
def render_evaluation(
    dataset: Dataset,
    sample: RowArgument,
    prediction: Prediction | DetectedBoxes | Sequence[Any],
    *,
    task: str | None = None,
    protocol: Any = None,
    label: MotionLabels | None = None,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render a sample's truth next to a model's prediction, with a protocol's verdict.

    For motion, true instances are found or missed, and predicted ones right or false, frame by
    frame. For detections, boxes are matched, false or missed. For accidents, one panel shows the
    colliding pair in the camera (of any agent) that shows it best; the other shows, from above, the
    road, the actors, and the true and foreseen positions of the collision with their distances in
    metres. The true colliding pair is red. Other tasks, also of plug-ins, draw themselves
    (`Evaluator.drawing`): one panel shows their paths, boxes and alarms in the agent's camera, the
    other shows them from above.

    Args:
        dataset: The release.
        sample: Token or record.
        prediction: Motion, explicit accidents (a list, empty for none), detected boxes in any frame
            of the sample, or a list of plans or forecasts.
        task: Task that draws the prediction; None for the one that the prediction is for. Motion
            can be evaluated as motion, accident or warning.
        protocol: Protocol of the task, by name, or your own; None for `released`, for `boxes` for
            explicit accidents, or otherwise for the first of the task.
        label: Motion labels to compare motion with. None makes the labels that the protocol needs,
            on the prediction's grid and half a second apart.
        layers: For motion, any of `labels`, `trajectories`, `ids`, `grid`; for accidents, any of
            `image`, `bev`, `boxes`, `trajectories`, `ids`, `grid`; for detections, any of `boxes`,
            `ids`, `grid`. By default all except `ids`.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure: truth on the left, prediction on the right, verdict at the top. For accidents,
        the camera is on the left. In a paper's column, the left panel is above the right one.

    Raises:
        TokenError: No such sample.
        NotAvailableError: The sample has no label, or the task is `accident` and the scenario has
            no meta.
        ChoiceError: No such task, protocol or layer, or the prediction is for another task.
        EvaluationError: The protocol cannot evaluate such a prediction.
    """
    described_task = task_to_describe(prediction, task)
    if described_task:
        described = sample_drawing(
            dataset, sample, prediction, task=described_task, protocol=protocol
        )
        return _render_drawing(dataset, described, layers, fig)
    checked, task = check_judged_prediction(prediction, task)
    shown_layers = layers_without_ids(layers, _LAYERS_OF_TASK[task])
    verdict = sample_verdict(dataset, sample, checked, task=task, protocol=protocol, label=label)
    fig = figure_or_new(fig, figure_size(task), column=1.8)
    has_camera = task == "accident"
    if current_style().layout == "column":
        height_ratios = _CAMERA_HEIGHT_RATIOS if has_camera else None
        left_ax, right_ax = fig.subplots(2, 1, height_ratios=height_ratios)
    else:
        width_ratios = _CAMERA_WIDTH_RATIOS if has_camera else None
        left_ax, right_ax = fig.subplots(1, 2, width_ratios=width_ratios)
    if isinstance(verdict, DetectionVerdict):
        pair_ids = collider_ids(dataset, verdict.sample)
        _draw_detection(verdict, pair_ids, shown_layers, left_ax, right_ax)
    elif isinstance(verdict, MotionVerdict):
        draw_motion_side(verdict.outcome, "true", layers=shown_layers, ax=left_ax)
        draw_motion_side(verdict.outcome, "predicted", layers=shown_layers, ax=right_ax)
        if "labels" in shown_layers:
            _draw_pair_edges(verdict.label, collider_ids(dataset, verdict.sample), left_ax)
    else:
        _draw_accident(dataset, verdict, shown_layers, left_ax, right_ax)
    set_scene_title(fig, dataset, verdict.sample, below=verdict.words)
    return lay_out_figure(fig)


def figure_size(task: str) -> tuple[float, float]:
    """Return width and height of a task's figure, inches."""
    return _FIGURE_SIZES.get(task, _DRAWING_SIZE)


def _render_drawing(
    dataset: Dataset,
    described: SampleDrawing,
    layers: Iterable[Layer] | None,
    fig: Figure | None,
) -> Figure:
    """Render a drawing in the camera that shows most of it and, next to it, from above."""
    shown_layers = layers_without_ids(layers, DRAWING_LAYERS)
    fig = figure_or_new(fig, _DRAWING_SIZE, column=1.8)
    if current_style().layout == "column":
        camera_ax, above_ax = fig.subplots(2, 1, height_ratios=_CAMERA_HEIGHT_RATIOS)
    else:
        camera_ax, above_ax = fig.subplots(1, 2, width_ratios=_CAMERA_WIDTH_RATIOS)
    sample = described.sample
    drawing = described.drawing
    handles = draw_drawing_from_above(dataset, sample, drawing, shown_layers, above_ax)
    draw_legend(fig, handles)
    camera = best_camera_of_drawing(dataset, sample, drawing)
    has_image = "image" in shown_layers
    draw_drawing_in_camera(dataset, sample, drawing, camera, camera_ax, image=has_image)
    agent, _, channel = camera.rsplit("/", 3)[1:]
    camera_ax.set_title(f"{short_name(agent)}, {camera_name(channel)}", fontsize=text_size())
    set_scene_title(fig, dataset, sample, below=described.words)
    return lay_out_figure(fig)


def _draw_pair_edges(label: MotionLabels, ids: Collection[int], ax: Axes) -> None:
    """Draw red edges around the cells of actors (by label id) in the current frame."""
    maps = maps_of_labels(labels_at_present(label))
    for label_id in ids:
        actor = label_id
        if label_id == OWN_ACTOR_ID:
            actor = OWN_BOX_ID
        instance_id = label.id_map.get(actor, -1)
        draw_edge(maps, instance_id, ax, COLLIDER_COLOR)


def _draw_accident(
    dataset: Dataset,
    verdict: AccidentVerdict,
    layers: frozenset[Layer],
    left_ax: Axes,
    right_ax: Axes,
) -> None:
    """Draw the image that shows the pair best; and, from above, the road, actors and positions."""
    center, half = shown_square(verdict.compared, verdict.truth)
    view = BevView(agents=None, view_range=half, center=center, surroundings_shown=True)
    draw_bev(dataset, verdict.sample, view, layers - {"trajectories"}, right_ax)
    accident_layers = layers & {"trajectories", "grid"}
    handles = draw_accidents(verdict.compared, verdict.truth, accident_layers, right_ax)
    draw_legend(right_ax.figure, handles)
    camera = best_camera(dataset, verdict)
    draw_accidents_in_camera(dataset, verdict, camera, left_ax, image="image" in layers)
    agent, _, channel = camera.rsplit("/", 3)[1:]
    left_ax.set_title(f"{short_name(agent)}, {camera_name(channel)}", fontsize=text_size())


def best_camera(dataset: Dataset, verdict: AccidentVerdict) -> str:
    """Return the token of the image, of any agent, that shows an accident's pair best.

    The pair is the colliding one; without a collision, it is the one that the first alarm names. If
    no camera shows the pair, the image is from the front camera of the sample's agent.
    """
    boxes = boxes_of(dataset, verdict)
    frame_token = dataset.get("sample", verdict.sample)["frame_token"]
    samples = [record["token"] for record in dataset.samples_of(frame_token)]
    view = None
    if len(boxes):
        view = best_view(dataset, samples, boxes)
    if view is None:
        return f"{verdict.sample}/Camera_Front"
    return view.camera


def _draw_detection(
    verdict: DetectionVerdict,
    pair_ids: Collection[int],
    layers: frozenset[Layer],
    left_ax: Axes,
    right_ax: Axes,
) -> None:
    truth = verdict.truth
    matches = verdict.matches
    draw_detection_outcome(verdict.detected, truth, verdict.rules, layers=layers, ax=right_ax)
    if "boxes" in layers:
        draw_true(truth, matches, left_ax)
        pair = truth.select(np.isin(truth.actor_id, [*pair_ids]))
        for ax in (left_ax, right_ax):
            draw_boxes_from_above(pair, ax, [COLLIDER_COLOR] * len(pair), fill=0, linewidths=1.6)
    show_square(left_ax, (0, 0), VIEW_RANGE)
    title = f"true boxes: {len(matches.truth)} found, {len(matches.missed)} missed (dashed)"
    titled_from_above(left_ax, title, grid="grid" in layers)
