"""`render_over_bytes`: accuracy over the bytes that partners send, one panel per headline."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from deepaccident_devkit.evaluation.runs import BytesPoint, OverBytes
from deepaccident_devkit.render.captions import set_title
from deepaccident_devkit.render.chips import keep_free, place_chips
from deepaccident_devkit.render.evaluation.panels import PANEL
from deepaccident_devkit.render.figures import figure_or_new, hide_axes, with_light_grid
from deepaccident_devkit.render.styles import (
    ESTIMATE_COLOR,
    MUTED_COLOR,
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.support.text import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@in_own_settings
def render_over_bytes(report: OverBytes, *, fig: Figure | None = None) -> Figure:
    """Render headline numbers over the bytes per sample that partners send, with intervals.

    Whiskers are the intervals.

    Args:
        report: Result of `evaluation.runs.over_bytes`.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure, with a panel for each headline (at most two in a paper's column), in which
        evaluations are named at their dots. Where partners send nothing they are at the left edge.
    """
    columns = 2
    if current_style().room == "column":
        columns = 1
    names = list(dict.fromkeys(point.headline for point in report.points))[: 2 * columns]
    rows = -(-len(names) // columns) or 1
    fig = figure_or_new(fig, (PANEL[0] * columns, PANEL[1] * rows + 0.7), column=0.75 * rows)
    samples = counted(report.samples, "sample")
    set_title(fig, f"{report.task}, protocol {report.protocol}: {samples}")
    percent = 100 * report.resampling.confidence
    fig.supxlabel(
        f"bytes a sample, as powers of 2\nwhiskers: {percent:g} % intervals",
        fontsize=text_size(),
        color=MUTED_COLOR,
    )
    axes = fig.subplots(rows, columns, squeeze=False).ravel()
    for ax, name in zip(axes, names, strict=False):
        _draw([point for point in report.points if point.headline == name], ax)
    hide_axes(axes[len(names) :])
    return fig


def _draw(points: Sequence[BytesPoint], ax: Axes) -> None:
    """Draw one panel; evaluations without bytes are two powers of 2 to the left of the others."""
    powers = [math.log2(point.bytes) for point in points if point.bytes]
    low_power, high_power = math.floor(min(powers, default=0)), math.ceil(max(powers, default=0))
    ticks, labels = [], []
    if len(powers) < len(points):
        ticks.append(low_power - 2)
        labels.append("none")
    if powers:
        step = max((high_power - low_power) // 4, 1)
        shown_powers = range(low_power, high_power + 1, step)
        ticks += shown_powers
        labels += map(str, shown_powers)
    for point in points:
        x: float = low_power - 2
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
        keep_free(ax, [[(x, low), (x, high)]], margin=(-4, -4, 4, 4))
        place_chips(ax, [(point.evaluation, (x, point.value))])
    unit = ""
    if points[0].unit != "share":
        unit = f" ({points[0].unit})"
    ax.set(
        xticks=ticks,
        xticklabels=labels,
        ylabel=points[0].headline + unit,
        xmargin=0.2,
        ymargin=0.2,
    )
    with_light_grid(ax, "both")
