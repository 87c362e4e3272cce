"""Curves of a training run, from plain numbers: losses by step, and validation scores."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from warnings import catch_warnings, simplefilter

import numpy as np

from deepaccident_devkit.render.figures import (
    axes_or_new,
    figure_or_new,
    hide_axes,
    report_figure,
    with_light_grid,
    write_report_figure,
)
from deepaccident_devkit.render.styles import (
    MUTED_COLOR,
    OWN_COLOR,
    PREDICTED_COLOR,
    in_own_settings,
    text_size,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANEL_SIZE_IN: Final = (3.4, 2.4)
_COLUMN_COUNT: Final = 3
_DPI: Final = 120
# Maximum number of groups of averaged steps, so that a curve shows its trend and not its noise.
_MAX_GROUPS: Final = 60


@in_own_settings
def render_curve(
    steps: Sequence[int], values: Sequence[float], title: str, *, ax: Axes | None = None
) -> Axes:
    """Render one number by the optimizer's step.

    Each value is a dot, and means of groups of steps are a line.
    """
    ax = axes_or_new(ax, _PANEL_SIZE_IN)
    dot_color, dot_size, line_color = PREDICTED_COLOR, 6, PREDICTED_COLOR
    if len(values) > _MAX_GROUPS:
        dot_color, dot_size, line_color = MUTED_COLOR, 2, OWN_COLOR
    ax.plot(steps, values, ".", color=dot_color, markersize=dot_size)
    count = min(_MAX_GROUPS, len(values)) or 1
    ax.plot(_group_means(steps, count), _group_means(values, count), color=line_color)
    ax.set_title(title, fontsize=text_size())
    ax.set_ylim(bottom=0)
    return with_light_grid(ax, "both")


def _group_means(values: Sequence[float], count: int) -> list[Any]:
    groups = np.array_split(np.asarray(values, dtype=float), count)
    with catch_warnings():
        simplefilter("ignore", RuntimeWarning)  # a group of gaps only is a gap
        return [np.nanmean(group) for group in groups]


@in_own_settings
def render_training(
    rows: Sequence[Mapping[str, Any]], title: str, *, fig: Figure | None = None
) -> Figure:
    """Render the curves of a run by the rows of its log.

    A row has a `step`, and numbers by name, also below `validation`.
    """
    curves = _curves(rows)
    fig = figure_or_new(fig, _size(len(curves)))
    axes = fig.subplots(_lines(len(curves)), _COLUMN_COUNT, squeeze=False).ravel()
    for ax, (name, points) in zip(axes, curves.items(), strict=False):
        steps = [step for step, _ in points]
        render_curve(steps, [value for _, value in points], name, ax=ax)
    hide_axes(axes[len(curves) :])
    for ax in axes[max(len(curves) - _COLUMN_COUNT, 0) : len(curves)]:
        ax.set_xlabel("step")
    fig.suptitle(title)
    return fig


def save_training(rows: Sequence[Mapping[str, Any]], title: str, path: Path) -> None:
    """Write `render_training` into a PNG file, as `write_report_figure` does. Raises OSError."""
    fig = report_figure(_size(len(_curves(rows))))
    write_report_figure(render_training(rows, title, fig=fig), path, dpi=_DPI)


def _curves(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[tuple[int, float]]]:
    """Return name → (step, value): losses first, their total before them, then scores.

    A loss of exactly 0 was computed from nothing, and is a gap (NaN).
    """
    losses: dict[str, list[tuple[int, float]]] = {}
    scores: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        parts = row.get("losses") or {}
        if "loss" in row and parts:
            total = {"total": row["loss"]}
        else:
            total = {}
        for name, value in (total | parts).items():
            losses.setdefault(name, []).append((row["step"], value or math.nan))
        for name, value in (row.get("validation") or {}).items():
            scores.setdefault(f"validation: {name}", []).append((row["step"], value))
    return losses | scores


def _size(curves: int) -> tuple[float, float]:
    return _PANEL_SIZE_IN[0] * _COLUMN_COUNT, _PANEL_SIZE_IN[1] * _lines(curves) + 0.4


def _lines(curves: int) -> int:
    """Return the number of rows of panels; one, though empty, for a log without any numbers."""
    return max(-(-curves // _COLUMN_COUNT), 1)
