"""Panels for any task: bars with intervals, numbers by attribute, differences of evaluations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.evaluation.breakdowns import Breakdown, Group
from deepaccident_devkit.evaluation.intervals import MIN_CLUSTERS
from deepaccident_devkit.evaluation.runs import ComparedNumber, Comparison
from deepaccident_devkit.evaluation.task import LIMITS, Headline, headlines
from deepaccident_devkit.render.captions import set_note, set_title
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
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.support.human_names import human_name, metric_name, with_unit
from deepaccident_devkit.support.text import counted, distinct_names, number_text, with_minus

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Width and height of one panel in inches: a page of a printed report has two rows of two.
PANEL: Final = (5.2, 3.0)
# Length of the axis divided by the length of the longest bar, so that the words next to the bars
# fit.
_AXIS_LENGTH_RATIO = 1.3
# Number of letters above which words around bars are broken into two lines.
_MAX_LETTERS = 34
# Width of a comparison in inches.
_COMPARISON_WIDTH_IN = 7.2
# Height of a row, of the title, and of the ticks and the label of a panel, in lines of letters.
_ROW_LINES = 2.2
_TITLE_LINES = 1.5
_AXIS_LINES = 3.2
# Unit of differences → smallest half of the axis, so that tiny differences look tiny.
_MIN_SPANS = {"share": 0.05, "%": 5, "m": 0.5, "s": 0.1}
_DIRECTION_MARKS = {True: " ↑", False: " ↓", None: ""}
_DIRECTION_TEXTS = {
    True: "↑ higher is better",
    False: "↓ lower is better",
}
# Rows of one panel of a comparison: a number and its difference.
_ComparedRows = Sequence[tuple[ComparedNumber, float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Bar:
    """One bar of `draw_bars`.

    Attributes:
        label: Text at the axis.
        below: Smaller line below the label; empty for none.
        value: Length of the bar; None if there is nothing to count.
        interval: Low and high end; None for no interval.
        text: Text at the end of the bar.
        color: Colour of the bar.
    """

    label: str
    below: str = ""
    value: float | None = None
    interval: tuple[float, float] | None = None
    text: str = ""
    color: str = ESTIMATE_COLOR


def draw_bars(bars: Sequence[Bar], ax: Axes, limit: float | None = None) -> Axes:
    """Render bars from the top down; an unknown value is shown as a dash.

    `limit` is the largest possible value, or None if there is none.
    """
    from matplotlib.ticker import MaxNLocator

    if not bars:
        return draw_nothing(ax)
    ends = [0.0]
    for row, bar in enumerate(bars):
        ends += _draw_bar(bar, row, ax)
    low_end = min(ends)
    if low_end < 0:
        limit = None  # the limit applies to shares only, and these values are not shares
    high_end = max(ends) if limit is None else limit
    ax.set(xlim=(low_end, _AXIS_LENGTH_RATIO * (high_end or 1.0)))
    if limit is not None:
        ax.set_xticks([limit * part / 5 for part in range(6)])
    else:
        ax.xaxis.set_major_locator(MaxNLocator(nbins=5))
    labels = [f"{bar.label}\n{bar.below}".strip() for bar in bars]
    ax.set_yticks(range(len(bars)), labels, fontsize=text_size(), linespacing=1.15)
    ax.set_ylim(len(bars) - 0.4, -0.6)
    return with_light_grid(ax, "x")


def _draw_bar(bar: Bar, row: int, ax: Axes) -> list[float]:
    """Draw one bar with its interval and text; return the values that the axis must contain."""
    ends = [0.0]
    text = "–"
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


def title_panel(ax: Axes, words: str) -> None:
    """Title the only panel of a figure, unless the current style has no titles."""
    if current_style().titled:
        set_title(ax, words, fontsize="medium")


def draw_nothing(ax: Axes, reason: str = "nothing to count") -> Axes:
    """Write into an empty panel why it is empty, and return its axes."""
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
        The axes; each bar states its value and how many samples and scenarios it covers.
    """
    ax = axes_or_new(ax, PANEL)
    bars = []
    known_headline = None
    for group in broken.groups:
        matches = (item for item in headlines(group.result) if item.path == number)
        headline = next(matches, None)
        known_headline = headline or known_headline
        bars.append(_group_bar(group, headline))
    limit = None
    name = number
    label = ""
    if known_headline is not None:
        limit = LIMITS.get(known_headline.unit)
        name = metric_name(known_headline.name)
        label = with_unit(name, known_headline.unit)
    draw_bars(bars, ax, limit)
    attribute = human_name(broken.by, "attributes")
    title = f"{name} by {attribute}"
    if len(title) > _MAX_LETTERS:
        title = f"{_broken_name(name)}\nby {attribute}"
    title_panel(ax, title)
    ax.set_xlabel(_broken_name(label))
    return ax


def _broken_name(name: str) -> str:
    """Break a long name after its first comma, since labels of bars leave it little room."""
    if len(name) > _MAX_LETTERS:
        return name.replace(", ", ",\n", 1)
    return name


def _group_bar(group: Group[Any], headline: Headline | None) -> Bar:
    """Make the bar of a group; `headline` is its number, or None if it has none."""
    value = None
    text = ""
    interval = None
    if headline is not None:
        value = headline.value
        text = with_minus(headline.text())
        low, high = group.intervals.get(headline.path, (math.nan, math.nan))
        if not math.isnan(low):
            interval = (low, high)
    return Bar(
        label=human_name(group.value),
        below=f"{counted(group.samples, 'sample')}, {counted(group.scenarios, 'scenario')}",
        value=value,
        interval=interval,
        text=text,
        color=AGENT_COLORS.get(group.value or "", ESTIMATE_COLOR),
    )


@in_own_settings
def render_comparison(comparison: Comparison, *, fig: Figure | None = None) -> Figure:
    """Render the difference B − A of each headline number, with its interval as a whisker.

    There is one panel for each unit.

    Args:
        comparison: Result of `compare_bundles`.
        fig: Empty figure to render on; if None, a new one that is tall enough for all numbers.

    Returns:
        The figure. Below each number's name are its values A → B. A dot is filled if the
        difference is statistically significant; the better evaluation is then named next to it.
    """
    panels: dict[str | None, list[tuple[ComparedNumber, float]]] = {}
    for number in comparison.numbers:
        if number.headline is not None and number.difference is not None:
            panels.setdefault(number.unit, []).append((number, number.difference))
    columns = _comparison_columns(list(panels.values()))
    notes = _comparison_notes(comparison)
    heights = [sum(map(_panel_lines, column)) for column in columns]
    lines = max(heights) + len(notes) + _TITLE_LINES
    fig = figure_or_new(fig, (_COMPARISON_WIDTH_IN, 0), lines=lines)
    _title_comparison(fig, comparison)
    set_note(fig, "\n".join(notes))
    grid = fig.add_gridspec(1, len(columns), wspace=0.06)
    for place, column in enumerate(columns):
        height_ratios = list(map(_panel_lines, column))
        rows = grid[place].subgridspec(len(column), 1, height_ratios=height_ratios)
        for row, numbers in enumerate(column):
            _draw_differences(fig.add_subplot(rows[row]), numbers)
    return fig


def _comparison_columns(panels: list[_ComparedRows]) -> list[list[_ComparedRows]]:
    """Arrange panels in a column or, on a slide (which is wide), in two."""
    if current_style().layout == "slide" and len(panels) > 1:
        return [panels[:1], panels[1:]]
    return [panels or [[]]]


def _panel_lines(rows: _ComparedRows) -> float:
    """Return the height of a panel of a comparison, including its axis, in lines."""
    return _AXIS_LINES + _ROW_LINES * len(rows)


def _title_comparison(fig: Figure, comparison: Comparison) -> None:
    """Name what is compared, and warn of missing samples."""
    lines = list(comparison.partial)
    color = WARNING_COLOR if lines else None
    if current_style().titled:
        lines.insert(0, comparison.title)
    if lines:
        set_title(fig, "\n".join(lines), color=color)


def _comparison_notes(comparison: Comparison) -> list[str]:
    """Return the lines that explain a comparison's names and marks."""
    names = distinct_names([comparison.a, comparison.b])
    notes = [f"{letter}: {name}" for letter, name in zip("AB", names, strict=True)]
    numbers = [number for number in comparison.numbers if number.headline is not None]
    if any(number.low is not None for number in numbers):
        percent = 100 * comparison.resampling.confidence
        notes.append(f"filled: significant; whiskers: {percent:g} % intervals")
    directions = {number.higher_is_better for number in numbers}
    texts = [text for key, text in _DIRECTION_TEXTS.items() if key in directions]
    if texts:
        notes.append("; ".join(texts))
    if any(number.low is None and number.difference is not None for number in numbers):
        notes.append(_missing_whisker_text(comparison))
    return notes


def _missing_whisker_text(comparison: Comparison) -> str:
    """Return why numbers of a comparison have no interval."""
    if not comparison.resampling.resamples:
        return "no whiskers: computed without resamples"
    if comparison.clusters < MIN_CLUSTERS:
        pairs = counted(comparison.clusters, "scenario pair")
        return f"no whiskers: {pairs}, at least {MIN_CLUSTERS} needed"
    return f"no whisker: fewer than {MIN_CLUSTERS} scenario pairs have or change the number"


def _draw_differences(ax: Axes, rows: _ComparedRows) -> None:
    """Draw a row for each number and its difference, from the top down."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    if not rows:
        draw_nothing(ax, "the two have no number in common")
        return
    ax.axvline(0, color=MUTED_COLOR, linewidth=1)
    labels = []
    for row, (number, difference) in enumerate(rows):
        _draw_difference(ax, row, number, difference)
        name = metric_name(str(number.headline))
        direction = _DIRECTION_MARKS[number.higher_is_better]
        values = f"{_number_text(number.a, number)} → {_number_text(number.b, number)}"
        labels.append(f"{name}{direction}\n{values}")
    ax.set_yticks(range(len(rows)), labels, fontsize=text_size(), linespacing=1.15)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    unit = rows[0][0].unit or "share"
    span = _MIN_SPANS.get(unit, 0.1)
    ax.update_datalim([(-span, 0), (span, 0)])
    ax.margins(x=0.08)
    ax.xaxis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 2, 5, 10]))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: with_minus(f"{value:g}")))
    ax.set_xlabel(with_unit("difference B − A", "in points" if unit == "%" else unit))
    with_light_grid(ax, "x")


def _draw_difference(ax: Axes, row: int, number: ComparedNumber, difference: float) -> None:
    """Draw one number's difference as a dot, with its interval, and write it at the right."""
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
    text = _number_text(difference, number, "+")
    if number.better:
        text += f"\n{number.better.upper()} is better"
    ax.annotate(
        text,
        (1.015, row),
        xycoords=("axes fraction", "data"),
        va="center",
        fontsize=text_size(),
        linespacing=1.15,
    )


def _number_text(value: float | None, number: ComparedNumber, sign: str = "") -> str:
    """Format a value with a compared number's decimals; `sign="+"` also writes positive signs."""
    return number_text(value, 2 if number.unit == "%" else 3, sign)
