"""Warning results as pictures: how early, how often in time, how many false alarms, and a curve over the score."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.evaluation.metrics.warning import AnticipationResult, WarningResult
from deepaccident_devkit.render.axes import axes_or_new, with_light_grid
from deepaccident_devkit.render.chips import SMALLEST_TEXT, place_chips
from deepaccident_devkit.render.colors import ESTIMATE_COLOR, OUTCOME_COLORS, TRUE_PLACE_COLOR
from deepaccident_devkit.render.evaluation.panels import PANEL, Bar, draw_bars, draw_nothing
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.render.titles import set_title

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BIN: Final = 0.5
"""Seconds."""


@in_own_settings
def render_warning_times(result: WarningResult, *, ax: Axes | None = None) -> Axes:
    """Render a histogram of the seconds of warning, of the recordings of accidents with a right alarm.

    Args:
        result: of `WarningEvaluator.compute`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes; a line is at the mean, the title says how many recordings have no right alarm.
    """
    from matplotlib.ticker import MaxNLocator

    ax, seconds = axes_or_new(ax, PANEL), result.warning_seconds
    accidents = result.recordings.get("accident", 0)
    set_title(ax, f"{len(seconds):,} of {accidents:,} recordings of accidents have a right alarm", fontsize="medium")
    if not len(seconds):
        return draw_nothing(ax, "no recording has a right alarm")
    bins = max(1, math.ceil(float(seconds.max()) / _BIN + 1e-6))
    ax.hist(seconds, bins=bins, range=(0, bins * _BIN), color=ESTIMATE_COLOR, edgecolor="white", linewidth=0.5)
    ax.axvline(
        result.mean_warning, color="black", linestyle="--", linewidth=1, label=f"mean {result.mean_warning:.2f} s"
    )
    ax.set(xlabel="seconds from the first right alarm to the impact", ylabel="recordings", xlim=(0, bins * _BIN))
    ax.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    ax.legend(fontsize=SMALLEST_TEXT)
    return with_light_grid(ax, "y")


@in_own_settings
def render_predictors(result: AnticipationResult, *, ax: Axes | None = None) -> Axes:
    """Render how well accidents are distinguished from other recordings before they happen, and reference predictors.

    Args:
        result: of `WarningEvaluator("clean").compute`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, for the first group of recordings: one bar for each predictor, and a line at 0.5, which is chance.
    """
    ax, group = axes_or_new(ax, PANEL), next(iter(result.groups), None)
    if group is None:
        return draw_nothing(ax, "no recording")
    everyone = {"given": result.groups[group], **{name: each[group] for name, each in result.references.items()}}
    bars = [
        Bar(
            label=name,
            value=_known(each.auc_ahead),
            text=f"{each.auc_ahead:.3f}",
            color=ESTIMATE_COLOR if name == "given" else TRUE_PLACE_COLOR,
        )
        for name, each in everyone.items()
    ]
    ax = draw_bars(bars, ax, 1.0)
    ax.axvline(0.5, color="black", linestyle="--", linewidth=1)
    ax.set(xlabel="chance that an accident's score is above\nanother recording's at the same moment")
    set_title(ax, f"Accidents distinguished from other recordings\n{group}", fontsize="medium")
    return ax


@in_own_settings
def render_detection_rates(result: WarningResult, *, ax: Axes | None = None) -> Axes:
    """Render which share of accidents has a right alarm so many seconds before the impact, or earlier.

    Args:
        result: of `WarningEvaluator.compute`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes; each bar has its value and its number of recordings.
    """
    bars = [
        Bar(
            label=f"{seconds:g} s before",
            below=f"{result.detection_recordings[seconds]:,} recordings",
            value=_known(rate),
            text=f"{rate:.3f}",
        )
        for seconds, rate in result.detection_rate.items()
    ]
    ax = draw_bars(bars, axes_or_new(ax, PANEL), 1.0)
    ax.set(xlabel="share of the recordings of accidents")
    set_title(ax, "A right alarm is raised in time", fontsize="medium")
    return ax


@in_own_settings
def render_false_alarms(result: WarningResult, *, ax: Axes | None = None) -> Axes:
    """Render the false alarms a minute of each kind of recording.

    Args:
        result: of `WarningEvaluator.compute`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes; each bar has its value, and its alarms and minutes.
    """
    bars = [
        Bar(
            label=kind,
            below=f"{result.false_alarms[kind]:,} in {result.minutes[kind]:.3g} min",
            value=_known(rate),
            text=f"{rate:.2f}",
            color=OUTCOME_COLORS["false"],
        )
        for kind, rate in result.false_alarms_per_minute.items()
    ]
    ax = draw_bars(bars, axes_or_new(ax, PANEL))
    ax.set(xlabel="false alarms a minute")
    set_title(ax, "False alarms by kind of recording", fontsize="medium")
    return ax


@in_own_settings
def render_warning_curve(result: WarningResult, *, ax: Axes | None = None) -> Axes:
    """Render the detection rate over the false alarms a minute, one point for each least score of alarms.

    Args:
        result: of `WarningEvaluator.compute`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes; some points have their score beside them.
    """
    ax, curve = axes_or_new(ax, PANEL), result.curve
    set_title(ax, "Results if alarms need at least a score", fontsize="medium")
    known = np.isfinite(curve.detection_rate) & np.isfinite(curve.false_alarms_per_minute)
    if not known.any():
        return draw_nothing(ax, "needs alarms, accidents and normal scenarios")
    false, rate = curve.false_alarms_per_minute[known], curve.detection_rate[known]
    ax.plot(false, rate, color=ESTIMATE_COLOR, marker="o", markersize=4)
    score = curve.threshold[known]
    points = np.column_stack([false, rate])
    named = sorted({0, len(score) // 2, len(score) - 1})
    lines = np.stack([points[:-1], points[1:]], axis=1)
    place_chips(ax, [(f"≥ {score[row]:.2g}", points[row]) for row in named], avoid=lines)
    ax.set(xlabel="false alarms a minute, where nobody collides", ylabel="accidents detected in time", ylim=(0, 1.04))
    ax.set_xlim(0, 1.12 * max(float(false.max()), 0.1))
    return with_light_grid(ax, "both")


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value
