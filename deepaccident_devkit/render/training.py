"""Curves of a training run, drawn from plain numbers: losses by step, and validation scores."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from warnings import catch_warnings, simplefilter

import numpy as np

from deepaccident_devkit.render.captions import set_title
from deepaccident_devkit.render.figures import (
    axes_or_new,
    figure_or_new,
    hide_axes,
    with_light_grid,
    write_report_figure,
)
from deepaccident_devkit.render.styles import (
    MUTED_COLOR,
    OWN_COLOR,
    PREDICTED_COLOR,
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.support.human_names import human_name, metric_name
from deepaccident_devkit.support.values import ReadOnlyValues

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANEL_SIZE_IN = (3.4, 2.4)
# Minimum height of a panel in lines of letters.
_PANEL_LINES = 8.5
# Number of columns by layout.
_COLUMN_COUNTS = {"column": 2, "slide": 4}
_DEFAULT_COLUMN_COUNT = 3
_RANGE_SEPARATOR = re.compile(r"_(?=\d)")
_DPI = 120
# Maximum number of groups of averaged steps, so that a curve shows its trend and not its noise.
_MAX_GROUPS = 60


@in_own_settings
def render_curve(
    steps: Sequence[int], values: Sequence[float], title: str, *, ax: Axes | None = None
) -> Axes:
    """Render one number over the optimizer's steps.

    Each value is a dot, and a line joins the means of groups of steps, also across gaps (NaN).
    """
    ax = axes_or_new(ax, _PANEL_SIZE_IN)
    dot_color = PREDICTED_COLOR
    dot_size = 6
    line_color = PREDICTED_COLOR
    if len(values) > _MAX_GROUPS:
        dot_color = MUTED_COLOR
        dot_size = 2
        line_color = OWN_COLOR
    ax.plot(steps, values, ".", color=dot_color, markersize=dot_size)
    group_count = min(_MAX_GROUPS, len(values)) or 1
    mean_steps = np.array(_group_means(steps, group_count))
    mean_values = np.array(_group_means(values, group_count))
    is_known = np.isfinite(mean_values)
    ax.plot(mean_steps[is_known], mean_values[is_known], color=line_color)
    set_title(ax, title, fontsize=text_size())
    if not (mean_values < 0).any():
        ax.set_ylim(bottom=0)
    return with_light_grid(ax, "both")


def _group_means(values: Sequence[float], count: int) -> list[Any]:
    groups = np.array_split(np.asarray(values, dtype=float), count)
    with catch_warnings():
        simplefilter("ignore", RuntimeWarning)  # a group of nothing but gaps (NaN) is a gap
        return [np.nanmean(group) for group in groups]


@in_own_settings
def render_training(
    rows: Sequence[ReadOnlyValues], title: str, *, fig: Figure | None = None
) -> Figure:
    """Render the curves of a training run from the rows of its log.

    A row has a `step`, and maps names to numbers in `losses` and `validation`.
    """
    curves = _curves(rows)
    curve_count = len(curves)
    columns = _COLUMN_COUNTS.get(current_style().layout, _DEFAULT_COLUMN_COUNT)
    row_count = -(-curve_count // columns) or 1  # a log without numbers has one empty row
    width, height = _PANEL_SIZE_IN
    size = (width * _DEFAULT_COLUMN_COUNT, height * row_count + 0.4)
    fig = figure_or_new(fig, size, lines=_PANEL_LINES * row_count + 2)
    axes = fig.subplots(row_count, columns, squeeze=False).ravel()
    for ax, (name, points) in zip(axes, curves.items(), strict=False):
        steps, values = zip(*points, strict=True)
        render_curve(steps, values, name, ax=ax)
    hide_axes(axes[curve_count:])
    lowest_axes = axes[max(curve_count - columns, 0) : curve_count]
    for ax in lowest_axes:
        ax.set_xlabel("step")
    if current_style().titled:
        set_title(fig, title)
    return fig


def save_training(rows: Sequence[ReadOnlyValues], title: str, path: Path) -> None:
    """Write `render_training` into a PNG file, as `write_report_figure` does. Raises OSError."""
    write_report_figure(partial(render_training, rows, title), path, dpi=_DPI)


def _curves(rows: Sequence[ReadOnlyValues]) -> dict[str, list[tuple[int, float]]]:
    """Return the steps and values of each curve by its name.

    The total loss comes first, then its parts, then the validation scores. A loss of exactly 0
    means that there was nothing to compute it from; it is a gap (NaN), also in the total.
    """
    used_losses: set[str] = set()
    for row in rows:
        used_losses.update(name for name, value in (row.get("losses") or {}).items() if value)
    losses: dict[str, list[tuple[int, float]]] = {}
    scores: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        step = row["step"]
        parts = row.get("losses") or {}
        if "loss" in row and parts:
            is_complete = all(value or name not in used_losses for name, value in parts.items())
            parts = {"total": row["loss"] if is_complete else math.nan} | parts
        for name, value in parts.items():
            losses.setdefault(human_name(name), []).append((step, value or math.nan))
        validation = row.get("validation") or {}
        for name, value in validation.items():
            metric = _RANGE_SEPARATOR.sub(" ", name)  # such as iou_30x30
            scores.setdefault(f"validation: {metric_name(metric)}", []).append((step, value))
    return losses | scores
