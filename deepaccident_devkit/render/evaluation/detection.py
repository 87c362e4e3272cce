"""Detection results as pictures: precision over recall."""

from __future__ import annotations

import math
from itertools import cycle
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.detection import DetectionResult
from deepaccident_devkit.render.captions import set_title
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.evaluation.panels import PANEL, draw_nothing
from deepaccident_devkit.render.figures import axes_or_new, with_light_grid
from deepaccident_devkit.render.styles import SERIES_COLORS, in_own_settings
from deepaccident_devkit.support.text import choice

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_DASHES: Final = ("-", "--", "-.", ":")
"""Styles that distinguish lines even in print without colours."""


@in_own_settings
def render_precision_recall(result: DetectionResult, name: str, *, ring: int = 0, ax: Axes | None = None) -> Axes:
    """Render precision over recall of one class, one line for each threshold.

    Args:
        result: of `DetectionEvaluator.compute`.
        name: one of its classes.
        ring: which of its ranges.
        ax: axes to render on; new ones if None.

    Returns:
        The axes; a line ends where the recall does, and its label says the average precision.

    Raises:
        ChoiceError: no such class, or no such range.
    """
    name = choice("name", name, result.classes)
    if ring not in range(len(result.ranges)):
        raise ChoiceError(f"ring: expected 0 to {len(result.ranges) - 1}, found {ring!r}")
    ax, row = axes_or_new(ax, PANEL), result.classes.index(name)
    truths, found = int(result.truths[row, ring]), int(result.detections[row, ring])
    set_title(ax, f"{name}: {truths:,} true, {found:,} detected{_ring_text(result, ring)}", fontsize="medium")
    if not truths:
        return draw_nothing(ax, "none in the truth")
    count = result.thresholds.shape[1]
    styles = zip(cycle(SERIES_COLORS), cycle(_DASHES))
    for level, (threshold, (color, dash)) in enumerate(zip(result.thresholds[row].tolist(), styles, strict=False)):
        precision, recall = result.precision[row, ring, level], result.recall[row, ring, level]
        reached = np.isfinite(recall) & (precision > 0)
        average = float(result.average_precision[row, ring, level])
        label = f"{threshold:g}: AP {average:.1f} %" if math.isfinite(average) else f"{threshold:g}: –"
        width = 1.2 + 0.8 * (count - 1 - level)  # so that all of several equal curves are seen
        ax.plot(recall[reached], precision[reached], dash, color=color, label=label, linewidth=width)
    ax.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="recall", ylabel="precision")
    ax.legend(title="threshold", fontsize=SMALLEST_TEXT, title_fontsize=SMALLEST_TEXT, loc="best")
    return with_light_grid(ax, "both")


def _ring_text(result: DetectionResult, ring: int) -> str:
    """Which range it is, where there are several."""
    if len(result.ranges) == 1:
        return ""
    low, high = result.ranges[ring].tolist()
    return f", {low:g} to {high:g} m"
