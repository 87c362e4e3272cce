"""Figures of a study: its rows with intervals, and rows over a number such as the latency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.render.captions import set_title
from deepaccident_devkit.render.figures import report_figure, with_light_grid
from deepaccident_devkit.render.styles import (
    ESTIMATE_COLOR,
    MUTED_COLOR,
    SERIES_COLORS,
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.study.numbers import NUMBERS
from deepaccident_devkit.study.summary import ALL, main_numbers

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANEL: Final = (2.7, 0.26)
"""Inches: the width of a panel, and the height of a row."""
_LINES: Final = ("o-", "s--", "^:", "D-.")
_NOTE: Final = "lines: intervals of 95 % over pairs of scenarios; pale dots: single seeds"
_AXES: Final[Mapping[str, str]] = {
    "latency": "latency (s)",
    "pose_noise": "error of partners' poses (m)",
    "packet_loss": "share of messages that are lost",
    "budget": "bytes a frame for all partners",
    "horizon": "seconds ahead",
}
"""Keys of which rows can have several numbers → what the axis is called."""


@in_own_settings
def rows_figure(summary: Mapping[str, Any]) -> Figure:
    """The rows as dots with their intervals, and pale dots for single seeds; a panel for each main number.

    It is one for files (`render.figures.write_report_figure`); in a paper's column it has the first two numbers.
    """
    numbers, rows = _shown(summary), summary["rows"]
    fig = report_figure((1.8 + _PANEL[0] * len(numbers), 1.2 + _PANEL[1] * len(rows)), column=1.1)
    panels = fig.subplots(1, len(numbers), sharey=True, squeeze=False)[0]
    for ax, number in zip(panels, numbers, strict=True):
        for at, each in enumerate(rows.values()):
            _draw_estimate(ax, each["groups"][ALL][number], at)
        set_title(ax, NUMBERS[number][2], fontsize=text_size())
        with_light_grid(ax, "x")
    panels[0].set_yticks(range(len(rows)), list(rows), fontsize=text_size())
    panels[0].set_ylim(len(rows) - 0.4, -0.6)
    fig.supxlabel(_NOTE, fontsize=text_size(), color=MUTED_COLOR)
    return fig


def _draw_estimate(ax: Axes, found: Mapping[str, Any], at: int) -> None:
    """A dot with its interval; nothing where there is no number."""
    for value in found["seeds"].values():
        if value is not None:
            ax.plot(value, at, "o", color=SERIES_COLORS[-1], markersize=3)
    if found["low"] is not None:
        ax.plot([found["low"], found["high"]], [at, at], color=ESTIMATE_COLOR, linewidth=1.4)
    if found["value"] is not None:
        ax.plot(found["value"], at, "o", color=ESTIMATE_COLOR, markersize=5.5)


def curves_of(summary: Mapping[str, Any]) -> list[str]:
    """The keys over whose numbers rows vary."""
    return list(dict.fromkeys(each["over"][0] for each in summary["rows"].values() if each["over"]))


@in_own_settings
def curves_figure(summary: Mapping[str, Any], key: str) -> Figure:
    """The main numbers over one of `curves_of`, such as `latency`: a line for each series of rows; as `rows_figure`."""
    series: dict[str, list[tuple[float, Mapping[str, Any]]]] = {}
    for row in summary["rows"].values():
        if row["over"] and row["over"][0] == key:
            series.setdefault(row["over"][2], []).append((row["over"][1], row["groups"][ALL]))
    numbers = _shown(summary)
    fig = report_figure((0.6 + _PANEL[0] * len(numbers), 3.0), column=0.9)
    panels = fig.subplots(1, len(numbers), squeeze=False)[0]
    for ax, number in zip(panels, numbers, strict=True):
        for at, (name, points) in enumerate(series.items()):
            _draw_curve(ax, name, at, [(x, numbers_of_row[number]) for x, numbers_of_row in points])
        ax.set_xlabel(_AXES[key], fontsize=text_size())
        set_title(ax, NUMBERS[number][2], fontsize=text_size())
        with_light_grid(ax, "both")
    panels[0].legend(fontsize=text_size())
    fig.supxlabel(_NOTE, fontsize=text_size(), color=MUTED_COLOR)
    return fig


def _draw_curve(ax: Axes, name: str, at: int, points: Sequence[tuple[float, Mapping[str, Any]]]) -> None:
    color, known = SERIES_COLORS[at % len(SERIES_COLORS)], [each for each in points if each[1]["value"] is not None]
    for x, found in known:
        if found["low"] is not None:
            ax.plot([x, x], [found["low"], found["high"]], color=color, linewidth=1.0)
        for value in found["seeds"].values():
            if value is not None:
                ax.plot(x, value, ".", color=color, alpha=0.5, markersize=3)
    ax.plot(
        [x for x, _ in known], [found["value"] for _, found in known], _LINES[at % len(_LINES)], color=color, label=name
    )


def _shown(summary: Mapping[str, Any]) -> list[str]:
    numbers = main_numbers(summary)
    return numbers[:2] if current_style().room == "column" else numbers
