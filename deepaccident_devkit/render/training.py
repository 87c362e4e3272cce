"""Curves of a training run: losses by step, and scores on the validation split. They take plain numbers."""

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

_PANEL: Final = (3.4, 2.4)
_COLUMNS: Final = 3
_DPI: Final = 120
# Steps are averaged in at most so many groups, so that a curve shows its way and not its noise.
_MEANS: Final = 60


@in_own_settings
def render_curve(
    steps: Sequence[int], values: Sequence[float], title: str, *, ax: Axes | None = None
) -> Axes:
    """Render one number by the optimizer's step: each value as a dot, and means of groups of steps as a line."""
    ax = axes_or_new(ax, _PANEL)
    crowded = len(values) > _MEANS
    ax.plot(
        steps,
        values,
        ".",
        color=MUTED_COLOR if crowded else PREDICTED_COLOR,
        markersize=2 if crowded else 6,
    )
    groups = [
        np.array_split(np.asarray(each, dtype=float), min(_MEANS, len(values)) or 1)
        for each in (steps, values)
    ]
    with catch_warnings():
        simplefilter("ignore", RuntimeWarning)  # a group of gaps alone is a gap
        means = [[np.nanmean(group) for group in each] for each in groups]
    ax.plot(*means, color=OWN_COLOR if crowded else PREDICTED_COLOR)
    ax.set_title(title, fontsize=text_size())
    ax.set_ylim(bottom=0)
    return with_light_grid(ax, "both")


@in_own_settings
def render_training(
    rows: Sequence[Mapping[str, Any]], title: str, *, fig: Figure | None = None
) -> Figure:
    """Render the curves of a run by the rows of its log: a `step`, and numbers by name, also below `validation`."""
    curves = _curves(rows)
    fig = figure_or_new(fig, _size(len(curves)))
    axes = fig.subplots(_lines(len(curves)), _COLUMNS, squeeze=False).ravel()
    for ax, (name, points) in zip(axes, curves.items(), strict=False):
        render_curve([step for step, _ in points], [value for _, value in points], name, ax=ax)
    for ax in axes[len(curves) :]:
        ax.set_axis_off()
    for ax in axes[max(len(curves) - _COLUMNS, 0) : len(curves)]:
        ax.set_xlabel("step")
    fig.suptitle(title)
    return fig


def save_training(rows: Sequence[Mapping[str, Any]], title: str, path: Path) -> None:
    """Write `render_training` into a PNG file, as `write_report_figure` does. Raises OSError."""
    write_report_figure(
        render_training(rows, title, fig=report_figure(_size(len(_curves(rows))))), path, dpi=_DPI
    )


def _curves(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[tuple[int, float]]]:
    """Name → (step, value): losses first, their total before them, then scores.

    A loss of exactly 0 was computed of nothing, and is a gap (NaN).
    """
    losses: dict[str, list[tuple[int, float]]] = {}
    scores: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        parts = row.get("losses") or {}
        total = {"total": row["loss"]} if "loss" in row and parts else {}
        for name, value in (total | parts).items():
            losses.setdefault(name, []).append((row["step"], value or math.nan))
        for name, value in (row.get("validation") or {}).items():
            scores.setdefault(f"validation: {name}", []).append((row["step"], value))
    return losses | scores


def _size(curves: int) -> tuple[float, float]:
    return _PANEL[0] * _COLUMNS, _PANEL[1] * _lines(curves) + 0.4


def _lines(curves: int) -> int:
    """Rows of panels; one, though empty, of a log without any numbers."""
    return max(-(-curves // _COLUMNS), 1)
