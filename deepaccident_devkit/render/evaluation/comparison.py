"""Two evaluations as a picture: the differences of their headline numbers, with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from deepaccident_devkit.evaluation.runs import ComparedNumber, Comparison
from deepaccident_devkit.render.axes import figure_or_new, with_light_grid
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.colors import ESTIMATE_COLOR, MUTED_COLOR, WARNING_COLOR
from deepaccident_devkit.render.evaluation.panels import draw_nothing
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.render.titles import set_title

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH: Final = 7.2
"""Inches, as the heights below."""
_ROW: Final = 0.42
_AXIS: Final = 0.6
"""Of the ticks and the label of a panel."""
_TITLE: Final = 0.9


@in_own_settings
def render_comparison(comparison: Comparison, *, fig: Figure | None = None) -> Figure:
    """Render the difference b − a of each headline number, with its interval as a whisker; one panel for each unit.

    Args:
        comparison: of `compare_bundles`.
        fig: an empty figure to render on; a new one if None, which is higher for more numbers.

    Returns:
        The figure. Below a number's name are its values a → b. A dot is full if the difference is statistically
        significant; who is better is then beside it.
    """
    panels: dict[str | None, list[tuple[ComparedNumber, float]]] = {}
    for each in comparison.numbers:
        if each.headline is not None and each.difference is not None:
            panels.setdefault(each.unit, []).append((each, each.difference))
    heights = [_AXIS + _ROW * len(rows) for rows in panels.values()] or [_AXIS]
    fig = figure_or_new(fig, (_WIDTH, _TITLE + sum(heights)))
    title = (
        f"{comparison.task}, protocol {comparison.protocol}: {comparison.samples:,} samples of "
        f"{comparison.scenarios:,} scenarios"
    )
    color = WARNING_COLOR if comparison.partial else None
    set_title(fig, "\n".join([title, *comparison.partial]), fontsize=11, color=color)
    interval = f"whiskers: {100 * comparison.resampling.confidence:g} % intervals; full dots: significant"
    names = f"a: {comparison.a.name}; b: {comparison.b.name}"
    fig.supxlabel(f"{names}\n{interval}", fontsize=SMALLEST_TEXT, color=MUTED_COLOR)
    axes = fig.subplots(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    for ax, (unit, rows) in zip(axes, panels.items(), strict=False):
        _draw_differences(ax, rows)
        ax.set_xlabel("b − a" if unit in (None, "share") else f"b − a ({unit})")
    if not panels:
        draw_nothing(axes[0], "no number of both")
    return fig


def _draw_differences(ax: Axes, rows: Sequence[tuple[ComparedNumber, float]]) -> None:
    """A row for each number and its difference, the first on top."""
    from matplotlib.ticker import MaxNLocator

    ax.axvline(0, color=MUTED_COLOR, linewidth=1)
    for row, (each, difference) in enumerate(rows):
        if each.low is not None and each.high is not None:
            ax.plot((each.low, each.high), (row, row), color=ESTIMATE_COLOR, linewidth=1.4, marker="|", markersize=7)
        face = ESTIMATE_COLOR if each.real else "white"
        ax.plot(difference, row, "o", markersize=6.5, markerfacecolor=face, markeredgecolor=ESTIMATE_COLOR)
        text = _text(difference, each, "+") + (f", {each.better} is better" if each.better else "")
        ax.annotate(text, (1.015, row), xycoords=("axes fraction", "data"), va="center", fontsize=SMALLEST_TEXT)
        least = 10.0 ** -_decimals(each)  # smaller differences are none to the reader
        ax.update_datalim([(-least, row), (least, row)])
    labels = [f"{each.headline}\n{_text(each.a, each)} → {_text(each.b, each)}" for each, _ in rows]
    ax.set_yticks(range(len(rows)), labels, fontsize=SMALLEST_TEXT, linespacing=1.15)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.margins(x=0.08)
    ax.xaxis.set_major_locator(MaxNLocator(nbins=6))
    with_light_grid(ax, "x")


def _text(value: float | None, number: ComparedNumber, sign: str = "") -> str:
    return "–" if value is None else f"{value:{sign}.{_decimals(number)}f}".replace("-", "−")


def _decimals(number: ComparedNumber) -> int:
    return 2 if number.unit == "%" else 3
