"""Figures of a study: rows with intervals, and rows in a series over, for example, the latency."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.plugins.study.numbers import NUMBERS
from deepaccident_devkit.plugins.study.summary import ALL, Summary, main_numbers
from deepaccident_devkit.render.captions import draw_legend, set_note, set_title
from deepaccident_devkit.render.figures import figure_or_new, with_light_grid
from deepaccident_devkit.render.styles import (
    ESTIMATE_COLOR,
    SERIES_COLORS,
    current_style,
    in_own_settings,
    text_size,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANEL_WIDTH_INCHES = 2.7
# Key that can vary in a series of rows → its unit.
_UNITS = {
    "latency": "s",
    "pose_noise": "m",
    "packet_loss": "share",
    "budget": "bytes per frame",
    "horizon": "s",
}
_NOTE = "lines: 95 % intervals over scenario pairs; pale dots: seeds"
# Heights in lines of letters: a row, the words above and below the rows, and a figure of curves.
_ROW_LINES = 1.5
_FRAME_LINES = 8
_CURVE_LINES = 18


@in_own_settings
def rows_figure(summary: Summary) -> Figure:
    """Draw the rows as dots with intervals; single seeds are pale dots.

    Each main number has a panel; in a paper's column, only the first two have.
    """
    rows = summary["rows"]
    lines = _FRAME_LINES + _ROW_LINES * len(rows)
    fig, panels = _figure_with_panels(summary, margin=1.8, lines=lines, sharey=True)
    for number, ax in panels.items():
        estimates = [row["groups"][ALL][number] for row in rows.values()]
        _draw_estimates(ax, range(len(rows)), estimates, upright=False)
        with_light_grid(ax, "x")
    left_panel = next(iter(panels.values()))
    left_panel.set_yticks(range(len(rows)), list(rows), fontsize=text_size())
    left_panel.set_ylim(len(rows) - 0.4, -0.6)
    return fig


def series_keys(summary: Summary) -> list[str]:
    """Return the keys that vary in a series of rows, such as `latency`."""
    keys: dict[str, None] = {}
    for row in summary["rows"].values():
        if row["over"]:
            keys[row["over"][0]] = None
    return list(keys)


@in_own_settings
def curves_figure(summary: Summary, key: str) -> Figure:
    """Draw the main numbers against one of `series_keys`; each series of rows is a line.

    Panels are as for `rows_figure`.
    """
    series: dict[str, list[Any]] = {}
    for row in summary["rows"].values():
        if row["over"] and row["over"][0] == key:
            series.setdefault(row["over"][2], []).append(row)
    fig, panels = _figure_with_panels(summary, margin=0.6, lines=_CURVE_LINES)
    for number, ax in panels.items():
        for index, (name, rows) in enumerate(series.items()):
            positions = [row["over"][1] for row in rows]
            estimates = [row["groups"][ALL][number] for row in rows]
            color = SERIES_COLORS[index % len(SERIES_COLORS)]
            _draw_estimates(ax, positions, estimates, upright=True, color=color, label=name)
        ax.set_xlabel(f"{key.replace('_', ' ')} ({_UNITS[key]})", fontsize=text_size())
        with_light_grid(ax, "both")
    first_panel = next(iter(panels.values()))
    handles, _ = first_panel.get_legend_handles_labels()
    draw_legend(fig, handles, loc="outside upper center")
    return fig


def _figure_with_panels(
    summary: Summary, *, margin: float, lines: float, **shared_axes: Any
) -> tuple[Figure, dict[str, Axes]]:
    """Make a figure with a panel per main number; `margin` is in inches, the height in lines."""
    numbers = main_numbers(summary)
    if current_style().layout == "column":
        numbers = numbers[:2]
    size = (margin + _PANEL_WIDTH_INCHES * len(numbers), 0)
    fig = figure_or_new(None, size, lines=lines)
    axes = fig.subplots(1, len(numbers), squeeze=False, **shared_axes)[0]
    panels = dict(zip(numbers, axes, strict=True))
    for number, ax in panels.items():
        words = NUMBERS[number][2]
        if current_style().layout == "column":  # its panels are narrow
            words = words.replace(", ", ",\n").replace(" (", "\n(")
        set_title(ax, words, fontsize=text_size())
    set_note(fig, _NOTE)
    return fig, panels


def _draw_estimates(
    ax: Axes,
    positions: Iterable[float],
    estimates: Sequence[Summary],
    *,
    upright: bool,
    color: str = ESTIMATE_COLOR,
    label: str = "",
) -> None:
    """Draw numbers with their intervals and seeds at positions along an axis.

    If `upright`, positions are along the x axis, and a line joins the numbers. Missing values are
    not drawn.
    """
    arrays = {}
    for name in ("value", "low", "high"):
        arrays[name] = np.array([estimate[name] for estimate in estimates], dtype=float)
    coordinates = np.array(list(positions), dtype=float)
    seed_points = []
    for position, estimate in zip(coordinates, estimates, strict=True):
        for value in estimate["seeds"].values():
            seed_points.append((position, value))
    seed_positions, seed_values = np.array(seed_points, dtype=float).reshape(-1, 2).T
    if upright:
        ax.vlines(coordinates, arrays["low"], arrays["high"], color=color, linewidth=1.4)
        seed_xy = (seed_positions, seed_values)
        value_xy = (coordinates, arrays["value"])
        marker = "o-"
    else:
        ax.hlines(coordinates, arrays["low"], arrays["high"], color=color, linewidth=1.4)
        seed_xy = (seed_values, seed_positions)
        value_xy = (arrays["value"], coordinates)
        marker = "o"
    ax.plot(*seed_xy, "o", color=SERIES_COLORS[-1], markersize=3, zorder=1.5)
    ax.plot(
        *value_xy,
        marker,
        color=color,
        label=label,
        markersize=5,
        clip_on=False,  # draws a dot at the end of the range completely
    )
