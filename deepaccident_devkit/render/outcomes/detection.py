"""Detections against the true boxes: matched, false and missed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.arrays import IntArray
from deepaccident_devkit.evaluation.metrics.detection import (
    DetectedBoxes,
    DetectionMatches,
    DetectionProtocol,
    detection_matches,
    detection_protocol,
)
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render.axes import axes_or_new, titled_from_above
from deepaccident_devkit.render.boxes import draw_boxes_from_above, draw_ids_from_above
from deepaccident_devkit.render.colors import OUTCOME_COLORS
from deepaccident_devkit.render.layers import Layer, layers_of
from deepaccident_devkit.render.legends import draw_legend_of_fills
from deepaccident_devkit.render.styles import in_own_settings

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DETECTION_LAYERS: Final[tuple[Layer, ...]] = ("boxes", "ids", "grid")
_SHOWN: Final[tuple[Layer, ...]] = ("boxes", "grid")
WINDOW: Final = 50.0
"""Metres around the agent that are shown."""
DASHED: Final = (0, (2, 1))
"""The lines around true boxes and instances that are missed."""


@in_own_settings
def draw_detection_outcome(
    prediction: DetectedBoxes,
    truth: Boxes,
    protocol: str | DetectionProtocol = "released",
    *,
    threshold: float | None = None,
    layers: Iterable[Layer] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Render detections over true boxes: matched ones with a line to their true box, false ones, and missed boxes.

    Args:
        prediction: in the protocol's coordinate frame.
        truth: the true boxes in that frame, as `detection_truth` gives them.
        protocol: name, or a protocol: its matching decides.
        threshold: one of the protocol's; None for the threshold of its errors or, if it has none, the middle one.
        layers: `boxes` and `grid` are the default; also `ids`, those of the true boxes.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, in metres of that frame; the title has the counts. Boxes that do not count, such as those outside the
        protocol's area, are not rendered.

    Raises:
        ChoiceError: no such protocol, threshold or layer.
    """
    shown = layers_of(layers, _SHOWN, DETECTION_LAYERS)
    matches = detection_matches(prediction, truth, protocol, threshold)
    ax = axes_or_new(ax, (6, 6.4))
    if "boxes" in shown:
        draw_true(truth, matches, ax)
        _draw(prediction.boxes, matches.detection, OUTCOME_COLORS["right"], ax)
        _draw(prediction.boxes, matches.false, OUTCOME_COLORS["false"], ax)
        _draw_offsets(prediction.boxes, truth, matches, ax)
    if "ids" in shown:
        true = truth.select(np.concatenate([matches.truth, matches.missed]))
        draw_ids_from_above(true, ax, ["black"] * len(true))
    ax.set(xlim=(-WINDOW, WINDOW), ylim=(-WINDOW, WINDOW))
    names = {"right": "detected", "false": "false", "missed": "missed"}
    draw_legend_of_fills(ax, {words: OUTCOME_COLORS[kind] for kind, words in names.items()})
    return titled_from_above(ax, detection_words(prediction, truth, matches, protocol), grid="grid" in shown)


def draw_true(truth: Boxes, matches: DetectionMatches, ax: Axes) -> None:
    """Render the true boxes that count; missed ones are dashed."""
    found, missed = truth.select(matches.truth), truth.select(matches.missed)
    draw_boxes_from_above(found, ax, ["black"] * len(found), fill=0, linewidths=0.7)
    colors = [OUTCOME_COLORS["missed"]] * len(missed)
    draw_boxes_from_above(missed, ax, colors, fill=0.3, linestyle=DASHED, linewidths=1.6)


def detection_words(
    prediction: DetectedBoxes, truth: Boxes, matches: DetectionMatches, protocol: str | DetectionProtocol
) -> str:
    """The threshold, how many boxes are right, false and missed, and how far off the right ones are."""
    metres = detection_protocol(protocol).measure.startswith("distance")
    limit = f"{matches.threshold:g} m" if metres else f"overlap {matches.threshold:g}"
    counts = f"at {limit}: {len(matches.detection)} TP, {len(matches.false)} FP, {len(matches.missed)} FN"
    if not len(matches.detection):
        return counts
    apart = prediction.boxes.center[matches.detection, :2] - truth.center[matches.truth, :2]
    return f"{counts};\ncentres off by {np.linalg.norm(apart, axis=1).mean():.2f} m on average"


def _draw(boxes: Boxes, rows: IntArray, color: str, ax: Axes) -> None:
    chosen = boxes.select(rows)
    draw_boxes_from_above(chosen, ax, [color] * len(chosen))


def _draw_offsets(detected: Boxes, truth: Boxes, matches: DetectionMatches, ax: Axes) -> None:
    from matplotlib.collections import LineCollection

    ends = detected.center[matches.detection, :2], truth.center[matches.truth, :2]
    ax.add_collection(LineCollection(list(np.stack(ends, axis=1)), colors="black", linewidths=1.0, zorder=4))
