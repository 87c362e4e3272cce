"""Figures of a study: its rows with intervals, and rows over a number such as the latency."""

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

# Inches: the width of a panel.
_PANEL: Final = 2.7
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
    """The rows as dots with their intervals, and pale dots for single seeds; a panel for each main number.

    It is one for files (`render.figures.write_report_figure`); in a paper's column it has the first two numbers.
    """
    rows = summary["rows"]
    fig, panels = _panels(summary, beside=1.8, height=1.2 + 0.26 * len(rows), sharey=True)
    for number, ax in panels.items():
        _draw(
            ax,
            range(len(rows)),
            [each["groups"][ALL][number] for each in rows.values()],
            upright=False,
        )
        with_light_grid(ax, "x")
    first = next(iter(panels.values()))
    first.set_yticks(range(len(rows)), list(rows), fontsize=text_size())
    first.set_ylim(len(rows) - 0.4, -0.6)
    return fig


def curves_of(summary: Mapping[str, Any]) -> list[str]:
    """The keys over whose numbers rows vary."""
    return list(dict.fromkeys(each["over"][0] for each in summary["rows"].values() if each["over"]))


@in_own_settings
def curves_figure(summary: Mapping[str, Any], key: str) -> Figure:
    """The main numbers over one of `curves_of`, such as `latency`: a line for each series of rows; as `rows_figure`."""
    rows = [each for each in summary["rows"].values() if each["over"] and each["over"][0] == key]
    fig, panels = _panels(summary, beside=0.6, height=3.0)
    for number, ax in panels.items():
        for at, name in enumerate(dict.fromkeys(row["over"][2] for row in rows)):
            own = [row for row in rows if row["over"][2] == name]
            found = [row["groups"][ALL][number] for row in own]
            color = SERIES_COLORS[at % len(SERIES_COLORS)]
            _draw(ax, [row["over"][1] for row in own], found, upright=True, color=color, label=name)
        ax.set_xlabel(f"{key.replace('_', ' ')} ({_UNITS[key]})", fontsize=text_size())
        with_light_grid(ax, "both")
    fig.legend(
        *next(iter(panels.values())).get_legend_handles_labels(),
        loc="outside upper center",
        ncols=3,
        fontsize=text_size(),
    )
    return fig


def _panels(
    summary: Mapping[str, Any], *, beside: float, height: float, **shared: Any
) -> tuple[Figure, dict[str, Axes]]:
    """A figure with a panel for each main number; inches of the room beside them, and of its height."""
    numbers = main_numbers(summary)[: 2 if current_style().room == "column" else None]
    fig = report_figure((beside + _PANEL * len(numbers), height), column=1.1)
    panels = dict(
        zip(numbers, fig.subplots(1, len(numbers), squeeze=False, **shared)[0], strict=True)
    )
    for number, ax in panels.items():
        set_title(ax, NUMBERS[number][2], fontsize=text_size())
    fig.supxlabel(_NOTE, fontsize=text_size(), color=MUTED_COLOR)
    return fig, panels


def _draw(
    ax: Axes,
    places: Iterable[float],
    found: Sequence[Mapping[str, Any]],
    *,
    upright: bool,
    color: str = ESTIMATE_COLOR,
    label: str = "",
) -> None:
    """Numbers with intervals and seeds at some places, joined by a line if they stand upright; what is None not."""
    values, low, high = (
        np.array([each[name] for each in found], dtype=float) for name in ("value", "low", "high")
    )
    at = np.array(list(places), dtype=float)
    seeds = [
        (x, value) for x, each in zip(at, found, strict=True) for value in each["seeds"].values()
    ]
    alone = np.array(seeds, dtype=float).reshape(-1, 2).T
    (ax.vlines if upright else ax.hlines)(at, low, high, color=color, linewidth=1.4)
    ax.plot(
        *(alone if upright else alone[::-1]), "o", color=SERIES_COLORS[-1], markersize=3, zorder=1.5
    )
    ax.plot(
        *((at, values) if upright else (values, at)),
        "o-" if upright else "o",
        color=color,
        label=label,
        markersize=5,
        clip_on=False,  # the whole dot at the end of a range
    )
