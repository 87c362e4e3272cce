"""`render_over_bytes`: accuracy over the bytes that partners send, one panel per headline."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from typing import TYPE_CHECKING

from deepaccident_devkit.evaluation.runs import BytesPoint, OverBytes
from deepaccident_devkit.render.captions import set_note, set_title
from deepaccident_devkit.render.chips import DOT_MARGIN_PT, keep_free, place_chips
from deepaccident_devkit.render.evaluation.panels import PANEL
from deepaccident_devkit.render.figures import figure_or_new, hide_axes, with_light_grid
from deepaccident_devkit.render.styles import (
    ESTIMATE_COLOR,
    current_style,
    in_own_settings,
)
from deepaccident_devkit.support.human_names import metric_name, rules_name, with_unit
from deepaccident_devkit.support.text import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@in_own_settings
def render_over_bytes(report: OverBytes, *, fig: Figure | None = None) -> Figure:
    """Render headline numbers over the bytes per sample that partners send, with intervals.

    Args:
        report: Result of `evaluation.runs.over_bytes`.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure, with a panel for each headline (at most two in a paper's column). Each
        evaluation is a dot with its name; runs whose partners send nothing are at the left edge.
    """
    columns = 2
    if current_style().layout == "column":
        columns = 1
    all_names = dict.fromkeys(point.headline for point in report.points)
    names = list(all_names)[: 2 * columns]
    rows = -(-len(names) // columns) or 1
    width, height = PANEL
    fig = figure_or_new(fig, (width * columns, height * rows + 0.7), column=0.75 * rows)
    if current_style().titled:
        samples = counted(report.samples, "sample")
        set_title(fig, f"{rules_name(report.task, report.protocol)}; {samples}")
    percent = 100 * report.resampling.confidence
    set_note(fig, f"bytes per sample, of all partners; whiskers: {percent:g} % intervals")
    axes = fig.subplots(rows, columns, squeeze=False).ravel()
    for ax, name in zip(axes, names, strict=False):
        _draw([point for point in report.points if point.headline == name], ax)
    hide_axes(axes[len(names) :])
    return fig


def _draw(points: Sequence[BytesPoint], ax: Axes) -> None:
    """Draw one panel; evaluations that send nothing are two doublings left of the others."""
    sizes = [point.bytes for point in points if point.bytes]
    ticks = _byte_ticks(sizes)
    position_of_none = min(ticks, default=2.0) - 2
    if len(sizes) < len(points):
        ticks[position_of_none] = "none"
    for point in points:
        x = position_of_none
        if point.bytes:
            x = math.log2(point.bytes)
        low = point.value if point.low is None else point.low
        high = point.value if point.high is None else point.high
        ax.plot(
            (x, x, x),
            (low, point.value, high),
            "o-",
            markevery=[1],
            markersize=6.5,
            color=ESTIMATE_COLOR,
        )
        keep_free(ax, [[(x, low), (x, high)]], margin=DOT_MARGIN_PT)
        place_chips(ax, [(point.evaluation, (x, point.value))])
    ax.set_xticks(list(ticks), list(ticks.values()))
    label = with_unit(metric_name(points[0].headline), points[0].unit)
    ax.set(ylabel=label, xmargin=0.2, ymargin=0.2)
    with_light_grid(ax, "both")


def _byte_ticks(sizes: Sequence[float]) -> dict[float, str]:
    """Return the positions and labels of five ticks at most, such as 1 kB, 2 kB and 4 kB."""
    if not sizes:
        return {}
    ticks = {}
    for factor, unit in ((1.0, "B"), (1e3, "kB"), (1e6, "MB"), (1e9, "GB")):
        for power in range(10):
            ticks[2**power * factor] = f"{2**power} {unit}"
    values = list(ticks)
    first = max(bisect_right(values, min(sizes)) - 1, 0)
    last = min(bisect_left(values, max(sizes)), len(values) - 1)
    step = max(math.ceil((last - first) / 4), 1)
    return {math.log2(value): ticks[value] for value in values[first : last + 1 : step]}
