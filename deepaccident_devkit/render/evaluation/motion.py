"""Motion results as pictures: quality by time ahead."""

from __future__ import annotations

import math
from itertools import cycle
from typing import TYPE_CHECKING

from deepaccident_devkit.evaluation.instances import panoptic_quality
from deepaccident_devkit.evaluation.motion import RANGES, MotionEvaluator
from deepaccident_devkit.render.axes import axes_or_new, with_light_grid
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.colors import SERIES_COLORS
from deepaccident_devkit.render.evaluation.panels import PANEL, draw_nothing
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.render.titles import set_title

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@in_own_settings
def render_quality_by_time(evaluator: MotionEvaluator, step: float = 0.5, *, ax: Axes | None = None) -> Axes:
    """Render the panoptic quality of each future frame, one line for each range.

    Args:
        evaluator: with samples counted.
        step: seconds from frame to frame.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, in percent over seconds from the present. The quality in the result is computed from the sums over
        all frames.
    """
    ax, counts = axes_or_new(ax, PANEL), evaluator.counts.values()
    set_title(ax, "Panoptic quality by time ahead", fontsize="medium")
    frames = max((each["frames"] for each in counts), default=0)
    if not frames:
        return draw_nothing(ax)
    given = [each["vpq"] for each in counts]
    for index, (name, color) in enumerate(zip(RANGES, cycle(SERIES_COLORS[1:]), strict=False)):
        quality = [_quality([each[index] for each in given], frame) for frame in range(frames)]
        ax.plot([step * frame for frame in range(frames)], quality, marker="o", color=color, label=f"{name} m")
    ax.set(xlabel="seconds from the present", ylabel="PQ (%)", ylim=(0, 104))
    ax.set_xticks([step * frame for frame in range(frames)])
    ax.legend(fontsize=SMALLEST_TEXT, loc="lower left")
    return with_light_grid(ax, "y")


def _quality(samples: list[list[list[float]]], frame: int) -> float:
    """PQ in percent of one frame, from the four lists by frame of each sample; NaN without any instance."""
    there = [[values[frame] for values in each] for each in samples if frame < len(each[0])]
    overlap, *numbers = (math.fsum(each[kind] for each in there) for kind in range(4))
    found, false, missed = map(int, numbers)
    if not found + false + missed:
        return math.nan
    return 100 * panoptic_quality(overlap, found, false, missed).pq
