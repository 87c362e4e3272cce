"""Figures of a study: rows with intervals, and series of rows over a number such as the latency."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.plugins.study.numbers import NUMBERS
from deepaccident_devkit.plugins.study.summary import ALL, main_numbers
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

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANEL_WIDTH_INCHES: Final = 2.7
_UNITS: Final = {
    "latency": "s",
    "pose_noise": "m",
    "packet_loss": "share",
    "budget": "bytes a frame",
    "horizon": "s",
}
_NOTE: Final = "lines: intervals of 95 % over pairs; pale dots: seeds"


@in_own_settings
def rows_figure(summary: Mapping[str, Any]) -> Figure:
    """Draw the rows as dots with intervals, and pale dots for single seeds.

    There is a panel for each main number; a figure for a paper's column has only the first two.
    Save it with `render.figures.write_report_figure`.
    """
    rows = summary["rows"]
    height = 1.2 + 0.26 * len(rows)
    fig, panels = _figure_with_panels(summary, margin=1.8, height=height, sharey=True)
    for number, ax in panels.items():
        estimates = [row["groups"][ALL][number] for row in rows.values()]
        _draw_estimates(ax, range(len(rows)), estimates, upright=False)
        with_light_grid(ax, "x")
    left_panel = next(iter(panels.values()))
    left_panel.set_yticks(range(len(rows)), list(rows), fontsize=text_size())
    left_panel.set_ylim(len(rows) - 0.4, -0.6)
    return fig


def series_keys(summary: Mapping[str, Any]) -> list[str]:
    """Return the keys with a series of rows, such as `latency`."""
    keys = [row["over"][0] for row in summary["rows"].values() if row["over"]]
    return list(dict.fromkeys(keys))


@in_own_settings
def curves_figure(summary: Mapping[str, Any], key: str) -> Figure:
    """Draw the main numbers over one of `series_keys`: a line for each series of rows.

    Its panels and its file are as of `rows_figure`.
    """
    rows = [row for row in summary["rows"].values() if row["over"] and row["over"][0] == key]
    fig, panels = _figure_with_panels(summary, margin=0.6, height=3.0)
    series_names = list(dict.fromkeys(row["over"][2] for row in rows))
    for number, ax in panels.items():
        for index, name in enumerate(series_names):
            series = [row for row in rows if row["over"][2] == name]
            positions = [row["over"][1] for row in series]
            estimates = [row["groups"][ALL][number] for row in series]
            color = SERIES_COLORS[index % len(SERIES_COLORS)]
            _draw_estimates(ax, positions, estimates, upright=True, color=color, label=name)
        ax.set_xlabel(f"{key.replace('_', ' ')} ({_UNITS[key]})", fontsize=text_size())
        with_light_grid(ax, "both")
    handles, labels = next(iter(panels.values())).get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=text_size())
    return fig


def _figure_with_panels(
    summary: Mapping[str, Any], *, margin: float, height: float, **shared_axes: Any
) -> tuple[Figure, dict[str, Axes]]:
    """Return a figure with a panel for each main number; its margin and height are in inches."""
    numbers = main_numbers(summary)
    if current_style().room == "column":
        numbers = numbers[:2]
    fig = report_figure((margin + _PANEL_WIDTH_INCHES * len(numbers), height), column=1.1)
    axes = fig.subplots(1, len(numbers), squeeze=False, **shared_axes)[0]
    panels = dict(zip(numbers, axes, strict=True))
    for number, ax in panels.items():
        set_title(ax, NUMBERS[number][2], fontsize=text_size())
    fig.supxlabel(_NOTE, fontsize=text_size(), color=MUTED_COLOR)
    return fig, panels


def _draw_estimates(
    ax: Axes,
    positions: Iterable[float],
    estimates: Sequence[Mapping[str, Any]],
    *,
    upright: bool,
    color: str = ESTIMATE_COLOR,
    label: str = "",
) -> None:
    """Draw numbers with intervals and seeds at positions along an axis.

    Upright numbers stand over the x axis and are joined by a line. Missing values are not drawn.
    """
    values, lows, highs = (
        np.array([estimate[name] for estimate in estimates], dtype=float)
        for name in ("value", "low", "high")
    )
    coordinates = np.array(list(positions), dtype=float)
    seed_points = []
    for position, estimate in zip(coordinates, estimates, strict=True):
        for value in estimate["seeds"].values():
            seed_points.append((position, value))
    seed_positions, seed_values = np.array(seed_points, dtype=float).reshape(-1, 2).T
    if upright:
        ax.vlines(coordinates, lows, highs, color=color, linewidth=1.4)
        seed_xy, value_xy, marker = (seed_positions, seed_values), (coordinates, values), "o-"
    else:
        ax.hlines(coordinates, lows, highs, color=color, linewidth=1.4)
        seed_xy, value_xy, marker = (seed_values, seed_positions), (values, coordinates), "o"
    ax.plot(*seed_xy, "o", color=SERIES_COLORS[-1], markersize=3, zorder=1.5)
    ax.plot(
        *value_xy,
        marker,
        color=color,
        label=label,
        markersize=5,
        clip_on=False,  # so that a dot at the end of the range is drawn completely
    )
