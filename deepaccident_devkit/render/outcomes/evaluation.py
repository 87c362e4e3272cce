"""`render_evaluation`: a sample's prediction and its truth, with the outcome in words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.drawing import Drawing
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.render.boxes import camera_name
from deepaccident_devkit.render.captions import draw_legend, set_scene_title, set_title
from deepaccident_devkit.render.figures import Layer, figure_or_new, lay_out_figure, layers_of
from deepaccident_devkit.render.outcomes.described import SampleDrawing, sample_drawing
from deepaccident_devkit.render.outcomes.drawings import (
    DRAWING_LAYERS,
    best_camera_of_drawing,
    draw_drawing_from_above,
    draw_drawing_in_camera,
)
from deepaccident_devkit.render.styles import current_style, in_own_settings, text_size
from deepaccident_devkit.taxonomy import short_name

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FIGURE_SIZE_IN: Final = (12.4, 6.4)
"""Width and height of the figure, inches."""
# Relative widths of a camera's panel and the panel next to it, and relative heights of a camera's
# panel and the panel below it.
_CAMERA_WIDTH_RATIOS = (1.4, 1.0)
_CAMERA_HEIGHT_RATIOS = (0.6, 1.0)
_DEFAULT_LAYERS = tuple(layer for layer in DRAWING_LAYERS if layer != "ids")


@in_own_settings
def render_evaluation(
    dataset: Dataset,
    sample: RowArgument,
    prediction: MotionOutput | DetectedBoxes | Sequence[Any],
    *,
    task: str | None = None,
    protocol: Any = None,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render a sample's prediction with its truth, and the outcome by a protocol.

    A task describes what is drawn (`Evaluator.drawing`), also a task of a plug-in. If it judges
    boxes or motion, the truth (found or missed, which is dashed) is next to the prediction (right
    or false), both from above; later motion is paler. Otherwise, paths, boxes, places and alarms
    are shown in a camera's image and from above. For alarms, it is the image of any agent that
    shows the colliding pair best. The pair is red.

    Args:
        dataset: The release.
        sample: Token or record.
        prediction: Motion, detected boxes in any frame of the sample, or a list of explicit
            accidents (empty for none), plans or forecasts.
        task: Task that draws the prediction; None for the one that the prediction is for. Motion
            can be evaluated as motion, accident or warning.
        protocol: Protocol of the task, by name, or your own; None for `boxes` for explicit
            accidents, otherwise for the first of the task.
        layers: Any of `image`, `bev`, `boxes`, `trajectories`, `labels` (cells of motion), `ids`
            and `grid`; by default all except `ids`.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure, with the outcome at the top. In a paper's column, the left panel is above the
        right one.

    Raises:
        TokenError: No such sample.
        NotAvailableError: The release lacks the truth that the task needs.
        ChoiceError: No such task, protocol or layer, or the prediction is for another task.
        EvaluationError: The protocol cannot evaluate such a prediction.
    """
    shown_layers = drawing_layers(layers)
    described = sample_drawing(dataset, sample, prediction, task=task, protocol=protocol)
    fig = figure_or_new(fig, FIGURE_SIZE_IN, column=1.8)
    if described.drawing.is_judged:
        handles = _draw_sides(dataset, described, shown_layers, _two_panels(fig))
    else:
        panels = _two_panels(fig, _CAMERA_WIDTH_RATIOS, _CAMERA_HEIGHT_RATIOS)
        handles = _draw_with_camera(dataset, described, shown_layers, panels)
    draw_legend(fig, handles)
    set_scene_title(fig, dataset, described.sample, below=described.words)
    return lay_out_figure(fig)


def drawing_layers(layers: Iterable[Layer] | None) -> frozenset[Layer]:
    """Return the layers to render, by default all except `ids`; raise ChoiceError if impossible."""
    return layers_of(layers, _DEFAULT_LAYERS, DRAWING_LAYERS)


def _two_panels(
    fig: Figure,
    width_ratios: Sequence[float] | None = None,
    height_ratios: Sequence[float] | None = None,
) -> Sequence[Axes]:
    """Make two panels side by side or, in a paper's column, one above the other."""
    if current_style().layout == "column":
        panels = fig.subplots(2, 1, height_ratios=height_ratios)
    else:
        panels = fig.subplots(1, 2, width_ratios=width_ratios)
    return list(panels)


def _draw_sides(
    dataset: Dataset, described: SampleDrawing, layers: frozenset[Layer], panels: Sequence[Axes]
) -> list[Artist]:
    """Draw the truth and the prediction from above, and return the handles for a legend."""
    drawing = described.drawing
    sides = (
        ("truth", drawing.truth, ("truth", "missed")),
        ("prediction", drawing.prediction, ("predicted", "right", "false")),
    )
    handles: dict[Any, Artist] = {}
    for (name, side, counted_roles), ax in zip(sides, panels, strict=True):
        for handle in draw_drawing_from_above(
            dataset, described.sample, side, layers, ax, shown=drawing
        ):
            handles.setdefault(handle.get_label(), handle)
        words = f"{name}: {_count_words(side, counted_roles)}"
        set_title(ax, words, fontsize=text_size(), y=None)
    return list(handles.values())


def _count_words(drawing: Drawing, roles: Sequence[str]) -> str:
    """State how many boxes of some roles are drawn, and instances over all frames."""
    counts = [f"{len(drawn.boxes)} {drawn.label}" for drawn in drawing.boxes if drawn.role in roles]
    for cells in drawing.cells:
        if cells.role in roles:
            count = sum(len(np.unique(ids[ids > 0])) for ids in cells.instance)
            counts.append(f"{count} {cells.label}")
    return ", ".join(counts)


def _draw_with_camera(
    dataset: Dataset, described: SampleDrawing, layers: frozenset[Layer], panels: Sequence[Axes]
) -> list[Artist]:
    """Draw everything in an image and from above, and return the handles for a legend."""
    camera_ax, above_ax = panels
    sample = described.sample
    drawing = described.drawing
    handles = draw_drawing_from_above(dataset, sample, drawing, layers, above_ax)
    camera = best_camera_of_drawing(dataset, sample, drawing)
    draw_drawing_in_camera(dataset, sample, drawing, camera, camera_ax, image="image" in layers)
    agent, _, channel = camera.rsplit("/", 3)[1:]
    camera_ax.set_title(f"{short_name(agent)}, {camera_name(channel)}", fontsize=text_size())
    return handles
