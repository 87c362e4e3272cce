"""Panels of any task: bars with intervals, numbers by attribute, differences of evaluations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.evaluation.breakdowns import Breakdown, Group
from deepaccident_devkit.evaluation.runs import ComparedNumber, Comparison
from deepaccident_devkit.evaluation.task import LIMITS, Headline, headlines
from deepaccident_devkit.render.captions import set_title
from deepaccident_devkit.render.figures import (
    axes_or_new,
    figure_or_new,
    with_light_grid,
    write_in_middle,
)
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    ESTIMATE_COLOR,
    MUTED_COLOR,
    WARNING_COLOR,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.support.text import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Width and height of one panel in inches: a page of a printed report has two rows of two.
PANEL: Final = (5.2, 3.0)
# Length of the axis in lengths of the longest bar, so that the words beside the bars fit.
_AXIS_LENGTH_RATIO: Final = 1.3
UNKNOWN: Final = "not known"
# Inches of a comparison: its width, the height of a row, and the height of the title.
_COMPARISON_WIDTH_IN, _ROW_HEIGHT_IN, _TITLE_HEIGHT_IN = 7.2, 0.42, 0.9
# Inches of the ticks and the label of a panel.
_AXIS_HEIGHT_IN: Final = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class Bar:
    """One bar of `draw_bars`.

    Attributes:
        label: Text beside the axis.
        below: Smaller line below the label; empty for none.
        value: Length of the bar; None if there is nothing to count.
        interval: Low and high end; None for none.
        text: Text beside the bar.
        color: Colour of the bar.
    """

    label: str
    below: str = ""
    value: float | None = None
    interval: tuple[float, float] | None = None
    text: str = ""
    color: str = ESTIMATE_COLOR


def draw_bars(bars: Sequence[Bar], ax: Axes, limit: float | None = None) -> Axes:
    """Render bars from the top down; unknown values are dashes.

    The limit is the largest possible value, if known.
    """
    if not bars:
        return draw_nothing(ax)
    ends = [0.0]
    for row, bar in enumerate(bars):
        ends += _draw_bar(bar, row, ax)
    if min(ends) < 0:
        limit = None  # it is a limit of shares, which these are not
    axis_end = limit
    if axis_end is None:
        axis_end = max(ends)
    ax.set(xlim=(min(ends), _AXIS_LENGTH_RATIO * (axis_end or 1.0)))
    if limit is not None:
        ax.set_xticks([limit * part / 5 for part in range(6)])
    labels = [f"{bar.label}\n{bar.below}".strip() for bar in bars]
    ax.set_yticks(range(len(bars)), labels, fontsize=text_size(), linespacing=1.15)
    ax.set_ylim(len(bars) - 0.4, -0.6)
    return with_light_grid(ax, "x")


def _draw_bar(bar: Bar, row: int, ax: Axes) -> list[float]:
    """Draw one bar with its interval and text, and return the ends that the axis must contain."""
    ends, text = [0.0], "–"
    if bar.value is not None:
        ax.barh(row, bar.value, height=0.66, color=bar.color)
        ends.append(bar.value)
        text = bar.text
        if bar.interval is not None and all(map(math.isfinite, bar.interval)):
            ax.plot(
                bar.interval, (row, row), color="black", linewidth=1.2, marker="|", markersize=7
            )
            ends += bar.interval
    # the text may lie over a line that marks a value
    background = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
    ax.annotate(
        text,
        (max(ends), row),
        (5, 0),
        textcoords="offset points",
        va="center",
        fontsize=text_size(),
        bbox=background,
    )
    return ends


def draw_nothing(ax: Axes, reason: str = "nothing to count") -> Axes:
    """Write the reason why a panel is empty into it, and return the axes."""
    write_in_middle(ax, reason, color=MUTED_COLOR)
    ax.set(xticks=[], yticks=[])
    return ax


@in_own_settings
def render_breakdown(broken: Breakdown[Any], number: str, *, ax: Axes | None = None) -> Axes:
    """Render one headline number of each group as a bar, with its interval as a whisker.

    Args:
        broken: Result of `breakdown`.
        number: Path of the number, as in `Headline`: `apa`, `ranges/30x30/iou`.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes; each bar has its value and its numbers of samples and scenarios.
    """
    ax, bars, known_headline = axes_or_new(ax, PANEL), [], None
    for group in broken.groups:
        matches = (item for item in headlines(group.result) if item.path == number)
        headline = next(matches, None)
        known_headline = headline or known_headline
        bars.append(_bar(group, headline, AGENT_COLORS.get(group.value or "", ESTIMATE_COLOR)))
    limit, name, label = None, number, ""
    if known_headline is not None:
        limit, name = LIMITS.get(known_headline.unit), known_headline.name
        label = name
        if known_headline.unit != "share":
            label += f" ({known_headline.unit})"
    draw_bars(bars, ax, limit)
    set_title(ax, f"{name} by {broken.by.replace('_', ' ')}", fontsize="medium")
    ax.set_xlabel(label)
    return ax


def _bar(group: Group[Any], headline: Headline | None, color: str) -> Bar:
    value, text, path = None, "", ""
    if headline is not None:
        value, text, path = headline.value, headline.text(), headline.path
    low, high = group.intervals.get(path, (math.nan, math.nan))
    return Bar(
        label=UNKNOWN if group.value is None else group.value,
        below=f"{group.samples:,} sample{'s' * (group.samples != 1)}, {group.scenarios:,} scen.",
        value=value,
        interval=None if math.isnan(low) else (low, high),
        text=text,
        color=color,
    )


@in_own_settings
def render_comparison(comparison: Comparison, *, fig: Figure | None = None) -> Figure:
    """Render the difference b − a of each headline number, with its interval as a whisker.

    There is one panel for each unit.

    Args:
        comparison: Result of `compare_bundles`.
        fig: Empty figure to render on; a new one if None, which is higher for more numbers.

    Returns:
        The figure. Below a number's name are its values a → b. A dot is full if the difference is
        statistically significant; the name of the better evaluation is then beside it.
    """
    panels: dict[str | None, list[tuple[ComparedNumber, float]]] = {}
    for number in comparison.numbers:
        if number.headline is not None and number.difference is not None:
            panels.setdefault(number.unit, []).append((number, number.difference))
    heights = [_AXIS_HEIGHT_IN + _ROW_HEIGHT_IN * len(rows) for rows in panels.values()]
    heights = heights or [_AXIS_HEIGHT_IN]
    fig = figure_or_new(fig, (_COMPARISON_WIDTH_IN, _TITLE_HEIGHT_IN + sum(heights)))
    title = (
        f"{comparison.task}, protocol {comparison.protocol}: "
        f"{counted(comparison.samples, 'sample')} of {counted(comparison.scenarios, 'scenario')}"
    )
    color = None
    if comparison.partial:
        color = WARNING_COLOR
    set_title(fig, "\n".join([title, *comparison.partial]), fontsize=11, color=color)
    percent = 100 * comparison.resampling.confidence
    interval = f"whiskers: {percent:g} % intervals; full dots: significant"
    names = f"a: {comparison.a.name}; b: {comparison.b.name}"
    fig.supxlabel(f"{names}\n{interval}", fontsize=text_size(), color=MUTED_COLOR)
    axes = fig.subplots(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    for ax, (unit, rows) in zip(axes, panels.items(), strict=False):
        _draw_differences(ax, rows)
        ax.set_xlabel("b − a" if unit in (None, "share") else f"b − a ({unit})")
    if not panels:
        draw_nothing(axes[0], "no number of both")
    return fig


def _draw_differences(ax: Axes, rows: Sequence[tuple[ComparedNumber, float]]) -> None:
    """Draw a row for each number and its difference, from the top down."""
    from matplotlib.ticker import MaxNLocator

    ax.axvline(0, color=MUTED_COLOR, linewidth=1)
    labels = []
    for row, (number, difference) in enumerate(rows):
        if number.low is not None and number.high is not None:
            ax.plot(
                (number.low, number.high),
                (row, row),
                color=ESTIMATE_COLOR,
                linewidth=1.4,
                marker="|",
                markersize=7,
            )
        ax.plot(
            difference,
            row,
            "o",
            markersize=6.5,
            markerfacecolor=ESTIMATE_COLOR if number.real else "white",
            markeredgecolor=ESTIMATE_COLOR,
        )
        text = _text(difference, number, "+")
        if number.better:
            text += f", {number.better} is better"
        ax.annotate(
            text,
            (1.015, row),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=text_size(),
        )
        precision = 10.0 ** -_decimals(number)  # the text does not show smaller differences
        ax.update_datalim([(-precision, row), (precision, row)])
        values = f"{_text(number.a, number)} → {_text(number.b, number)}"
        labels.append(f"{number.headline}\n{values}")
    ax.set_yticks(range(len(rows)), labels, fontsize=text_size(), linespacing=1.15)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.margins(x=0.08)
    ax.xaxis.set_major_locator(MaxNLocator(nbins=6))
    with_light_grid(ax, "x")


def _text(value: float | None, number: ComparedNumber, sign: str = "") -> str:
    if value is None:
        return "–"
    return f"{value:{sign}.{_decimals(number)}f}".replace("-", "−")


def _decimals(number: ComparedNumber) -> int:
    if number.unit == "%":
        return 2
    return 3
