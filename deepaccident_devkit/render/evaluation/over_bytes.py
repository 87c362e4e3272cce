"""`render_over_bytes`: accuracy over the bytes that partners send, a panel for each headline number."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from deepaccident_devkit.evaluation.runs import BytesPoint, OverBytes
from deepaccident_devkit.render.captions import set_title
from deepaccident_devkit.render.chips import keep_free, place_chips
from deepaccident_devkit.render.evaluation.panels import PANEL
from deepaccident_devkit.render.figures import figure_or_new, with_light_grid
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
    """Render headline numbers over the bytes a sample that partners send, with intervals as whiskers.

    Args:
        report: of `evaluation.runs.over_bytes`.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure, with a panel for each headline (two at most in a paper's column), in which evaluations are named at
        their dots. Where partners send nothing they are at the left edge.
    """
    columns = 1 if current_style().room == "column" else 2
    names = list(dict.fromkeys(each.headline for each in report.points))[: 2 * columns]
    rows = -(-len(names) // columns) or 1
    fig = figure_or_new(fig, (PANEL[0] * columns, PANEL[1] * rows + 0.7), column=0.75 * rows)
    set_title(
        fig, f"{report.task}, protocol {report.protocol}: {counted(report.samples, 'sample')}"
    )
    fig.supxlabel(
        f"bytes a sample, as powers of 2\nwhiskers: {100 * report.resampling.confidence:g} % intervals",
        fontsize=text_size(),
        color=MUTED_COLOR,
    )
    axes = fig.subplots(rows, columns, squeeze=False).ravel()
    for ax, name in zip(axes, names, strict=False):
        _draw([each for each in report.points if each.headline == name], ax)
    for ax in axes[len(names) :]:
        ax.set_axis_off()
    return fig


def _draw(points: Sequence[BytesPoint], ax: Axes) -> None:
    """One panel; the evaluations without bytes stand two powers of 2 to the left of the others."""
    powers = [math.log2(each.bytes) for each in points if each.bytes]
    first, last = math.floor(min(powers, default=0)), math.ceil(max(powers, default=0))
    shown = range(first, last + 1, max((last - first) // 4, 1)) if powers else ()
    edge = [first - 2] if len(powers) < len(points) else []
    for each in points:
        x = math.log2(each.bytes) if each.bytes else edge[0]
        low, high = (each.value if end is None else end for end in (each.low, each.high))
        ax.plot(
            (x, x, x),
            (low, each.value, high),
            "o-",
            markevery=[1],
            markersize=6.5,
            color=ESTIMATE_COLOR,
        )
        keep_free(ax, [[(x, low), (x, high)]], margin=(-4, -4, 4, 4))
        place_chips(ax, [(each.evaluation, (x, each.value))])
    ax.set(
        xticks=[*edge, *shown],
        xticklabels=[*("none" for _ in edge), *map(str, shown)],
        ylabel=points[0].headline + ("" if points[0].unit == "share" else f" ({points[0].unit})"),
        xmargin=0.2,
        ymargin=0.2,
    )
    with_light_grid(ax, "both")
