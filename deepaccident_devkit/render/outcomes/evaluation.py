"""`render_evaluation`: a sample's truth beside a prediction, with the verdict of a protocol."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.predictions import Prediction, labels_at_present
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabels
from deepaccident_devkit.render.bev import BevView, draw_bev
from deepaccident_devkit.render.boxes import camera_name, collider_ids, draw_boxes_from_above
from deepaccident_devkit.render.camera import best_view
from deepaccident_devkit.render.captions import draw_legend, set_scene_title
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.figures import (
    Layer,
    figure_or_new,
    settled,
    show_square,
    titled_from_above,
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
    layers_but_ids,
    shown_square,
)
from deepaccident_devkit.render.outcomes.cameras import draw_accidents_in_camera
from deepaccident_devkit.render.outcomes.verdicts import (
    AccidentVerdict,
    DetectionVerdict,
    MotionVerdict,
    boxes_of,
    judged_as,
    sample_verdict,
)
from deepaccident_devkit.render.styles import COLLIDER_COLOR, in_own_settings
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID, short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LAYERS_OF_TASK: Final[Mapping[str, tuple[Layer, ...]]] = {
    "motion": MOTION_LAYERS,
    "accident": ("image", "bev", *ACCIDENT_LAYERS),
    "detection": DETECTION_LAYERS,
}
# Inches.
FIGURE_SIZES: Final = {"motion": (12.4, 6.9), "accident": (12.4, 5.9), "detection": (12.4, 6.9)}
# Widths of a camera's panel and the panel beside it.
_CAMERA_WIDTH_RATIOS: Final = (1.4, 1.0)


@in_own_settings
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
    """Render a sample's truth beside a model's prediction, with a protocol's verdict.

    Motion: true instances are found or missed, predicted ones right or false, frame by frame.
    Detections: matched, false and missed boxes. Accidents: the colliding pair in the camera, of any
    agent, that shows it best, and from above the road, the actors, and the positions where two
    collide, with the metres between foreseen and true positions. The true colliding pair is red.

    Args:
        dataset: The release.
        sample: Token or record.
        prediction: Motion, explicit accidents (a list, empty for none), or detected boxes in any
            frame of the sample.
        task: `motion`, `accident` or `detection`; None for the prediction's. Motion can be
            evaluated as motion or as accident.
        protocol: Protocol of the task, by name, or your own; None for `released`, or `boxes` for
            explicit accidents.
        label: Motion labels to compare motion with; None makes the labels that the protocol needs,
            on the prediction's cells and half a second apart.
        layers: For motion `labels`, `trajectories`, `ids`, `grid`; for accidents `image`,
            `bev`, `boxes`, `trajectories`, `ids`, `grid`; for detections `boxes`, `ids`, `grid`.
            All except `ids` are the default.
        fig: An empty figure to render on; a new one if None.

    Returns:
        The figure: truth to the left, prediction to the right, the verdict above; for accidents the
        camera to the left.

    Raises:
        TokenError: No such sample.
        NotAvailableError: The sample has no label, or its scenario no meta that an accident needs.
        ChoiceError: No such task, protocol or layer, or the prediction is not of this task.
        EvaluationError: The protocol cannot evaluate such a prediction.
    """
    checked, task = judged_as(prediction, task)
    shown_layers = layers_but_ids(layers, _LAYERS_OF_TASK[task])
    verdict = sample_verdict(dataset, sample, checked, task=task, protocol=protocol, label=label)
    fig = figure_or_new(fig, FIGURE_SIZES[task])
    width_ratios = _CAMERA_WIDTH_RATIOS if task == "accident" else None
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
    set_scene_title(fig, dataset, verdict.sample, below=verdict.words, fontsize=11)
    return settled(fig)


def _draw_pair_edges(label: MotionLabels, ids: Collection[int], ax: Axes) -> None:
    """Draw red edges around the present cells of the actors with these label ids."""
    maps = maps_of_labels(labels_at_present(label))
    for actor in ids:
        key = OWN_BOX_ID if actor == OWN_ACTOR_ID else actor
        draw_edge(maps, label.id_map.get(key, -1), ax, COLLIDER_COLOR)


def _draw_accident(
    dataset: Dataset,
    verdict: AccidentVerdict,
    layers: frozenset[Layer],
    left_ax: Axes,
    right_ax: Axes,
) -> None:
    """Draw the camera that shows the pair best, and from above the road, agents and positions."""
    center, half = shown_square(verdict.compared, verdict.truth)
    view = BevView(agents=None, view_range=half, center=center, beside=True)
    draw_bev(dataset, verdict.sample, view, layers - {"trajectories"}, right_ax)
    accident_layers = layers & {"trajectories", "grid"}
    handles = draw_accidents(verdict.compared, verdict.truth, accident_layers, right_ax)
    draw_legend(right_ax.figure, handles)
    camera = best_camera(dataset, verdict)
    draw_accidents_in_camera(dataset, verdict, camera, left_ax, image="image" in layers)
    agent, _, channel = camera.rsplit("/", 3)[1:]
    left_ax.set_title(f"{short_name(agent)}, {camera_name(channel)}", fontsize=SMALLEST_TEXT)


def best_camera(dataset: Dataset, verdict: AccidentVerdict) -> str:
    """Return the token of the image, of any agent, that shows the pair of an accident best.

    The pair is the colliding one, or otherwise the one that the first alarm names. If no camera
    shows it, the image is that of the front camera of the sample's agent.
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
    truth, matches = verdict.truth, verdict.matches
    draw_detection_outcome(verdict.detected, truth, verdict.rules, layers=layers, ax=right_ax)
    if "boxes" in layers:
        draw_true(truth, matches, left_ax)
        pair = truth.select(np.isin(truth.actor_id, [*pair_ids]))
        for ax in (left_ax, right_ax):
            draw_boxes_from_above(pair, ax, [COLLIDER_COLOR] * len(pair), fill=0, linewidths=1.6)
    show_square(left_ax, (0, 0), VIEW_RANGE)
    title = f"true boxes: {len(matches.truth)} found, {len(matches.missed)} missed (dashed)"
    titled_from_above(left_ax, title, grid="grid" in layers)
