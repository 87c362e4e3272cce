"""Panels of any task: bars with intervals, a number by an attribute, and the differences of two evaluations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.evaluation.breakdowns import Breakdown, Group
from deepaccident_devkit.evaluation.runs import ComparedNumber, Comparison
from deepaccident_devkit.evaluation.task import LIMITS, Headline, headlines
from deepaccident_devkit.render.captions import set_title
from deepaccident_devkit.render.figures import axes_or_new, figure_or_new, with_light_grid
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
# The axis' length in lengths of the longest bar, so that the words beside the bars have room.
_BESIDE: Final = 1.3
UNKNOWN: Final = "not known"
_WIDTH, _ROW, _TITLE = 7.2, 0.42, 0.9  # inches
# Inches of the ticks and the label of a panel.
_AXIS: Final = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class Bar:
    """One bar of `draw_bars`.

    Attributes:
        label: beside the axis.
        below: a smaller line below the label; empty for none.
        value: None if there is nothing to count.
        interval: low and high; None for none.
        text: beside the bar.
        color: of the bar.
    """

    label: str
    below: str = ""
    value: float | None = None
    interval: tuple[float, float] | None = None
    text: str = ""
    color: str = ESTIMATE_COLOR


def draw_bars(bars: Sequence[Bar], ax: Axes, limit: float | None = None) -> Axes:
    """Render bars, the first on top, unknown values as dashes; the limit is the largest possible value, if known."""
    if not bars:
        return draw_nothing(ax)
    reached = [0.0]
    for row, bar in enumerate(bars):
        own = [0.0]
        if bar.value is not None:
            ax.barh(row, bar.value, height=0.66, color=bar.color)
            own.append(bar.value)
        if (
            bar.value is not None
            and bar.interval is not None
            and all(map(math.isfinite, bar.interval))
        ):
            ax.plot(
                bar.interval, (row, row), color="black", linewidth=1.2, marker="|", markersize=7
            )
            own += bar.interval
        ax.annotate(
            "–" if bar.value is None else bar.text,
            (max(own), row),
            (5, 0),
            textcoords="offset points",
            va="center",
            fontsize=text_size(),
            bbox={
                "facecolor": "white",
                "edgecolor": "none",
                "pad": 0.5,
            },  # over a line that marks a value
        )
        reached += own
    if min(reached) < 0:
        limit = None  # of shares, which these are not
    reach = max(reached) if limit is None else limit
    ax.set(xlim=(min(reached), _BESIDE * (reach or 1.0)))
    if limit is not None:
        ax.set_xticks([limit * part / 5 for part in range(6)])
    labels = [f"{bar.label}\n{bar.below}".strip() for bar in bars]
    ax.set_yticks(range(len(bars)), labels, fontsize=text_size(), linespacing=1.15)
    ax.set_ylim(len(bars) - 0.4, -0.6)
    return with_light_grid(ax, "x")


def draw_nothing(ax: Axes, why: str = "nothing to count") -> Axes:
    """Write into a panel why it is empty; returns the axes."""
    ax.text(0.5, 0.5, why, ha="center", va="center", transform=ax.transAxes, color=MUTED_COLOR)
    ax.set(xticks=[], yticks=[])
    return ax


@in_own_settings
def render_breakdown(broken: Breakdown[Any], number: str, *, ax: Axes | None = None) -> Axes:
    """Render one headline number of each group as a bar, with its interval as a whisker.

    Args:
        broken: the result of `breakdown`.
        number: path of the number, as in `Headline`: `apa`, `ranges/30x30/iou`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes; each bar has its value and its numbers of samples and scenarios.
    """
    ax, bars, shown = axes_or_new(ax, PANEL), [], None
    for group in broken.groups:
        headline = next((each for each in headlines(group.result) if each.path == number), None)
        shown = headline or shown
        bars.append(_bar(group, headline, AGENT_COLORS.get(group.value or "", ESTIMATE_COLOR)))
    draw_bars(bars, ax, None if shown is None else LIMITS.get(shown.unit))
    set_title(
        ax,
        f"{number if shown is None else shown.name} by {broken.by.replace('_', ' ')}",
        fontsize="medium",
    )
    unit = "" if shown is None or shown.unit == "share" else f" ({shown.unit})"
    ax.set_xlabel("" if shown is None else f"{shown.name}{unit}")
    return ax


def _bar(group: Group[Any], headline: Headline | None, color: str) -> Bar:
    value = None if headline is None else headline.value
    low, high = group.intervals.get("" if headline is None else headline.path, (math.nan, math.nan))
    return Bar(
        label=UNKNOWN if group.value is None else group.value,
        below=f"{group.samples:,} sample{'s' * (group.samples != 1)}, {group.scenarios:,} scen.",
        value=value,
        interval=None if math.isnan(low) else (low, high),
        text="" if headline is None else headline.text(),
        color=color,
    )


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
        f"{comparison.task}, protocol {comparison.protocol}: {counted(comparison.samples, 'sample')} of "
        f"{counted(comparison.scenarios, 'scenario')}"
    )
    color = WARNING_COLOR if comparison.partial else None
    set_title(fig, "\n".join([title, *comparison.partial]), fontsize=11, color=color)
    interval = (
        f"whiskers: {100 * comparison.resampling.confidence:g} % intervals; full dots: significant"
    )
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
    """A row for each number and its difference, the first on top."""
    from matplotlib.ticker import MaxNLocator

    ax.axvline(0, color=MUTED_COLOR, linewidth=1)
    for row, (each, difference) in enumerate(rows):
        if each.low is not None and each.high is not None:
            ax.plot(
                (each.low, each.high),
                (row, row),
                color=ESTIMATE_COLOR,
                linewidth=1.4,
                marker="|",
                markersize=7,
            )
        face = ESTIMATE_COLOR if each.real else "white"
        ax.plot(
            difference,
            row,
            "o",
            markersize=6.5,
            markerfacecolor=face,
            markeredgecolor=ESTIMATE_COLOR,
        )
        text = _text(difference, each, "+") + (f", {each.better} is better" if each.better else "")
        ax.annotate(
            text,
            (1.015, row),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=text_size(),
        )
        least = 10.0 ** -_decimals(each)  # smaller differences are none to the reader
        ax.update_datalim([(-least, row), (least, row)])
    labels = [f"{each.headline}\n{_text(each.a, each)} → {_text(each.b, each)}" for each, _ in rows]
    ax.set_yticks(range(len(rows)), labels, fontsize=text_size(), linespacing=1.15)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.margins(x=0.08)
    ax.xaxis.set_major_locator(MaxNLocator(nbins=6))
    with_light_grid(ax, "x")


def _text(value: float | None, number: ComparedNumber, sign: str = "") -> str:
    return "–" if value is None else f"{value:{sign}.{_decimals(number)}f}".replace("-", "−")


def _decimals(number: ComparedNumber) -> int:
    return 2 if number.unit == "%" else 3
