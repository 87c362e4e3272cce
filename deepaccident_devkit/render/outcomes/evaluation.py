"""`render_evaluation`: a sample's label, a model's prediction, and the verdict of a protocol."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.evaluation.metrics.accident import ComparedAccidents
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes
from deepaccident_devkit.evaluation.metrics.predictions import Prediction, labels_at_present
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabels
from deepaccident_devkit.render.axes import figure_or_new, settled, titled_from_above
from deepaccident_devkit.render.boxes import draw_boxes_from_above
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.colors import COLLIDER_COLOR
from deepaccident_devkit.render.layers import Layer, layers_of
from deepaccident_devkit.render.motion_cells import draw_edge
from deepaccident_devkit.render.motion_maps import maps_of_labels
from deepaccident_devkit.render.outcomes.accident import ACCIDENT_LAYERS, coming_words, draw_accident_outcome
from deepaccident_devkit.render.outcomes.detection import DETECTION_LAYERS, WINDOW, draw_detection_outcome, draw_true
from deepaccident_devkit.render.outcomes.motion import MOTION_LAYERS, draw_motion_side
from deepaccident_devkit.render.outcomes.verdicts import (
    AccidentVerdict,
    DetectionVerdict,
    MotionVerdict,
    judged_as,
    sample_verdict,
)
from deepaccident_devkit.render.roles import collider_ids
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.render.titles import set_scene_title
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_POSSIBLE: Final[Mapping[str, tuple[Layer, ...]]] = {
    "motion": MOTION_LAYERS,
    "accident": ACCIDENT_LAYERS,
    "detection": DETECTION_LAYERS,
}
_SIZE: Final = (12.4, 6.9)


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
    given, chosen = judged_as(prediction, task)
    possible = _POSSIBLE[chosen]
    shown = layers_of(layers, [layer for layer in possible if layer != "ids"], possible)
    verdict = sample_verdict(dataset, sample, given, task=chosen, protocol=protocol, label=label)
    fig = figure_or_new(fig, _SIZE)
    left, right = fig.subplots(1, 2)
    if isinstance(verdict, DetectionVerdict):
        _draw_detection(verdict, collider_ids(dataset, verdict.sample), shown, left, right)
    elif isinstance(verdict, MotionVerdict):
        draw_motion_side(verdict.outcome, "true", layers=shown, ax=left)
        draw_motion_side(verdict.outcome, "predicted", layers=shown, ax=right)
        if "labels" in shown:
            _edge_pair(verdict.label, collider_ids(dataset, verdict.sample), left)
    else:
        _draw_accident(verdict, shown, left, right)
    set_scene_title(fig, dataset, verdict.sample, below=verdict.words, fontsize=11)
    return settled(fig)


def _edge_pair(label: MotionLabels, ids: Collection[int], ax: Axes) -> None:
    """Render red edges around the present cells of the actors with these label ids."""
    maps = maps_of_labels(labels_at_present(label))
    for actor in ids:
        draw_edge(maps, label.id_map.get(OWN_BOX_ID if actor == OWN_ACTOR_ID else actor, -1), ax, COLLIDER_COLOR)


def _draw_accident(verdict: AccidentVerdict, shown: frozenset[Layer], left: Axes, right: Axes) -> None:
    true = verdict.compared.true
    draw_accident_outcome(verdict.compared, verdict.truth, layers=shown, ax=right)
    limits = right.get_xlim(), right.get_ylim()
    draw_accident_outcome(ComparedAccidents(true=true, predicted=()), verdict.truth, layers=shown, ax=left)
    left.set(xlim=limits[0], ylim=limits[1])
    left.set_title("truth" if true else f"truth: {coming_words(verdict.compared)}", fontsize=SMALLEST_TEXT)


def _draw_detection(
    verdict: DetectionVerdict, pair_ids: Collection[int], shown: frozenset[Layer], left: Axes, right: Axes
) -> None:
    truth, matches = verdict.truth, verdict.matches
    draw_detection_outcome(verdict.detected, truth, verdict.rules, layers=shown, ax=right)
    if "boxes" in shown:
        draw_true(truth, matches, left)
        pair = truth.select(np.isin(truth.actor_id, [*pair_ids]))
        for ax in (left, right):
            draw_boxes_from_above(pair, ax, [COLLIDER_COLOR] * len(pair), fill=0, linewidths=1.6)
    left.set(xlim=(-WINDOW, WINDOW), ylim=(-WINDOW, WINDOW))
    titled_from_above(
        left, f"true boxes: {len(matches.truth)} found, {len(matches.missed)} missed (dashed)", grid="grid" in shown
    )
