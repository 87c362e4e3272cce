"""`render_evaluation`: a sample's truth beside a model's prediction, with the verdict of a protocol."""

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
from deepaccident_devkit.render.figures import Layer, figure_or_new, settled, titled_from_above
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

_POSSIBLE: Final[Mapping[str, tuple[Layer, ...]]] = {
    "motion": MOTION_LAYERS,
    "accident": ("image", "bev", *ACCIDENT_LAYERS),
    "detection": DETECTION_LAYERS,
}
# Inches.
FIGURE_SIZES: Final = {"motion": (12.4, 6.9), "accident": (12.4, 5.9), "detection": (12.4, 6.9)}
# How wide a camera and what is beside it are.
_CAMERA_BESIDE: Final = (1.4, 1.0)


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
    """Render a sample's truth and beside it a model's prediction, with a protocol's verdict in numbers.

    Motion: true instances are found or missed, predicted ones right or false, frame by frame. Detections: matched,
    false and missed boxes. Accidents: who collides in the camera, of any agent, that shows them best, and from above
    the road, the actors, and the places where two collide, with the metres between foreseen and true places. The true
    pair that collides is red.

    Args:
        dataset: the release.
        sample: token or record.
        prediction: motion, explicit accidents (a list, empty for none), or detected boxes in any frame of the sample.
        task: `motion`, `accident` or `detection`; None for the prediction's. Motion can be evaluated as motion or as
            accident.
        protocol: of the task, by name, or your own; None for `released`, or `boxes` for explicit accidents.
        label: the motion labels that motion is compared with; None makes the labels that the protocol needs, on the
            prediction's cells and half a second apart.
        layers: for motion `labels`, `trajectories`, `ids`, `grid`; for accidents `image`, `bev`, `boxes`,
            `trajectories`, `ids`, `grid`; for detections `boxes`, `ids`, `grid`. All except `ids` are the default.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure: truth to the left, prediction to the right, the verdict above; of accidents the camera to the left.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label, or its scenario no meta that an accident needs.
        ChoiceError: no such task, protocol or layer, or the prediction is not of this task.
        EvaluationError: the protocol cannot evaluate such a prediction.
    """
    given, chosen = judged_as(prediction, task)
    shown = layers_but_ids(layers, _POSSIBLE[chosen])
    verdict = sample_verdict(dataset, sample, given, task=chosen, protocol=protocol, label=label)
    fig = figure_or_new(fig, FIGURE_SIZES[chosen])
    left, right = fig.subplots(1, 2, width_ratios=_CAMERA_BESIDE if chosen == "accident" else None)
    if isinstance(verdict, DetectionVerdict):
        _draw_detection(verdict, collider_ids(dataset, verdict.sample), shown, left, right)
    elif isinstance(verdict, MotionVerdict):
        draw_motion_side(verdict.outcome, "true", layers=shown, ax=left)
        draw_motion_side(verdict.outcome, "predicted", layers=shown, ax=right)
        if "labels" in shown:
            _edge_pair(verdict.label, collider_ids(dataset, verdict.sample), left)
    else:
        _draw_accident(dataset, verdict, shown, left, right)
    set_scene_title(fig, dataset, verdict.sample, below=verdict.words, fontsize=11)
    return settled(fig)


def _edge_pair(label: MotionLabels, ids: Collection[int], ax: Axes) -> None:
    """Render red edges around the present cells of the actors with these label ids."""
    maps = maps_of_labels(labels_at_present(label))
    for actor in ids:
        draw_edge(
            maps,
            label.id_map.get(OWN_BOX_ID if actor == OWN_ACTOR_ID else actor, -1),
            ax,
            COLLIDER_COLOR,
        )


def _draw_accident(
    dataset: Dataset, verdict: AccidentVerdict, shown: frozenset[Layer], left: Axes, right: Axes
) -> None:
    """The camera that shows the pair best, and from above the road, the agents and the places."""
    middle, half = shown_square(verdict.compared, verdict.truth)
    view = BevView(agents=None, view_range=half, center=middle, beside=True)
    draw_bev(dataset, verdict.sample, view, shown - {"trajectories"}, right)
    draw_legend(
        right.figure,
        draw_accidents(verdict.compared, verdict.truth, shown & {"trajectories", "grid"}, right),
    )
    camera = best_camera(dataset, verdict)
    draw_accidents_in_camera(dataset, verdict, camera, left, image="image" in shown)
    agent, _, channel = camera.rsplit("/", 3)[1:]
    left.set_title(f"{short_name(agent)}, {camera_name(channel)}", fontsize=SMALLEST_TEXT)


def best_camera(dataset: Dataset, verdict: AccidentVerdict) -> str:
    """The token of the image, of any agent, that shows best who collides, or whom the first alarm names.

    The front camera of the sample's agent, if no camera shows them.
    """
    boxes = boxes_of(dataset, verdict)
    samples = [
        each["token"]
        for each in dataset.samples_of(dataset.get("sample", verdict.sample)["frame_token"])
    ]
    view = best_view(dataset, samples, boxes) if len(boxes) else None
    return f"{verdict.sample}/Camera_Front" if view is None else view.camera


def _draw_detection(
    verdict: DetectionVerdict,
    pair_ids: Collection[int],
    shown: frozenset[Layer],
    left: Axes,
    right: Axes,
) -> None:
    truth, matches = verdict.truth, verdict.matches
    draw_detection_outcome(verdict.detected, truth, verdict.rules, layers=shown, ax=right)
    if "boxes" in shown:
        draw_true(truth, matches, left)
        pair = truth.select(np.isin(truth.actor_id, [*pair_ids]))
        for ax in (left, right):
            draw_boxes_from_above(pair, ax, [COLLIDER_COLOR] * len(pair), fill=0, linewidths=1.6)
    left.set(xlim=(-VIEW_RANGE, VIEW_RANGE), ylim=(-VIEW_RANGE, VIEW_RANGE))
    titled_from_above(
        left,
        f"true boxes: {len(matches.truth)} found, {len(matches.missed)} missed (dashed)",
        grid="grid" in shown,
    )
