"""`render_over_bytes`: accuracy over the bytes that partners send, a panel for each headline number."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from deepaccident_devkit.evaluation.runs import BytesPoint, OverBytes
from deepaccident_devkit.render.captions import set_title
from deepaccident_devkit.render.chips import keep_free, place_chips
from deepaccident_devkit.render.evaluation.panels import PANEL
from deepaccident_devkit.render.figures import figure_or_new, with_light_grid
from deepaccident_devkit.render.styles import ESTIMATE_COLOR, MUTED_COLOR, current_style, in_own_settings, text_size

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BESIDE: Final = 2
"""How far nothing is to the left of the first power of 2."""


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
    narrow = current_style().room == "column"
    names = list(dict.fromkeys(each.headline for each in report.points))[: 2 if narrow else None]
    columns = 1 if narrow or len(names) < 2 else 2
    rows = -(-len(names) // columns) or 1
    fig = figure_or_new(fig, (PANEL[0] * columns, PANEL[1] * rows + 0.7), column=0.75 * rows)
    set_title(fig, f"{report.task}, protocol {report.protocol}: {report.samples:,} samples")
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
    """One panel."""
    powers = [math.log2(each.bytes) for each in points if each.bytes]
    first, last = math.floor(min(powers, default=0)), math.ceil(max(powers, default=0))
    ticks = {first - _BESIDE: "none"} if len(powers) < len(points) else {}
    ticks |= {power: str(power) for power in range(first, last + 1, max((last - first) // 4, 1)) if powers}
    x = [math.log2(each.bytes) if each.bytes else first - _BESIDE for each in points]
    values = [each.value for each in points]
    low = [each.value if each.low is None else each.low for each in points]
    high = [each.value if each.high is None else each.high for each in points]
    ax.vlines(x, low, high, color=ESTIMATE_COLOR, linewidth=1.4)
    ax.plot(x, values, "o", color=ESTIMATE_COLOR, markersize=6.5)
    keep_free(
        ax, [[(at, start), (at, end)] for at, start, end in zip(x, low, high, strict=True)], margin=(-4, -4, 4, 4)
    )
    place_chips(ax, [(each.evaluation, place) for each, *place in zip(points, x, values, strict=True)])
    ax.set(
        xticks=list(ticks),
        xticklabels=list(ticks.values()),
        ylabel=points[0].headline + ("" if points[0].unit == "share" else f" ({points[0].unit})"),
        xmargin=0.2,
        ymargin=0.2,
    )
    with_light_grid(ax, "both")
