"""Figures of prevented accidents: the share avoided against braking seconds per minute."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from deepaccident_devkit.evaluation.warning.recordings import GIVEN_SCORES
from deepaccident_devkit.plugins.safety.prevention_result import (
    BUDGET,
    NOMINAL,
    SETTINGS,
    PreventedResult,
    PreventionCurve,
)
from deepaccident_devkit.render.captions import draw_legend_outside
from deepaccident_devkit.render.chips import DOT_MARGIN_PT, keep_free, place_chips
from deepaccident_devkit.render.evaluation.figures import RunFigure, listed
from deepaccident_devkit.render.evaluation.panels import PANEL, draw_nothing, title_panel
from deepaccident_devkit.render.figures import axes_or_new, with_light_grid
from deepaccident_devkit.render.styles import (
    ESTIMATE_COLOR,
    GRID_COLOR,
    MUTED_COLOR,
    TRUE_PLACE_COLOR,
    in_own_settings,
)
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.support.human_names import human_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Right end of the x axis in braking seconds per minute, before its margin.
_MAX_COST = 60.0
# Minimum height of the figure in lines of letters.
_LINES = 22


def prevention_figures(result: PreventedResult) -> Iterator[RunFigure]:
    """Yield the figures of a run, one per group."""
    for name in result.groups:
        avoided = listed([("avoided", result.avoided(name))])
        yield RunFigure(
            name=f"prevention_{name.replace(', ', '_')}",
            caption="Share of the accidents that braking after an alarm avoids, over the braking "
            f"for false alarms, as the threshold falls: {human_name(name)}. The vertical line is "
            "at one braking second per minute.",
            alt=f"Share avoided over braking seconds per minute; {avoided}.",
            draw=partial(render_prevention, result, name),
            lines=_LINES,
        )


@in_own_settings
def render_prevention(
    result: PreventedResult, group: str | None = None, *, ax: Axes | None = None
) -> Axes:
    """Plot the share of accidents avoided against the braking seconds per minute.

    Each way of braking is one line.

    Args:
        result: Result returned by `prevented_accidents`.
        group: Group of the result to plot; None for the first.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes. The line of the nominal setting is thick, and marks the predictions' operating
        point and the reference predictors'. The dashed line also counts accidents that
        become milder. The vertical line is the cost that the headline allows.
    """
    ax = axes_or_new(ax, PANEL, lines=_LINES)
    name = group if group is not None else next(iter(result.groups), "no recording")
    title_panel(ax, f"Accidents prevented by braking after an alarm: {human_name(name)}")
    curve = result.curves.get(name)
    if not _is_known(curve):
        return draw_nothing(ax, "needs accidents and recordings without one")
    nominal = SETTINGS.index(NOMINAL)
    costs = curve.braking_seconds_per_minute
    for setting in range(len(SETTINGS)):
        if setting != nominal:
            avoided = curve.avoided[:, setting]
            _draw_steps(ax, costs[:, setting], avoided, color=GRID_COLOR, linewidth=1)
    nominal_costs = costs[:, nominal]
    nominal_avoided = curve.avoided[:, nominal]
    avoided_or_milder = nominal_avoided + curve.mitigated[:, nominal]
    draw_estimate = partial(_draw_steps, ax, nominal_costs, color=ESTIMATE_COLOR)
    draw_estimate(avoided_or_milder, linewidth=1, linestyle="--", label="avoided or milder")
    draw_estimate(nominal_avoided, linewidth=2, label=f"avoided by braking at {NOMINAL}")
    ax.plot([], [], color=GRID_COLOR, linewidth=1, label="other reactions and decelerations")
    ax.axvline(BUDGET, color=MUTED_COLOR, linewidth=0.8, linestyle=":")
    _draw_operating_points(ax, result, name)
    ax.set_xscale("symlog", linthresh=1.0)
    ticks = [0, 0.5, 1, 2, 5, 10, 20, 40]
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.set_xticks([], minor=True)
    ax.set(
        xlabel="seconds of false braking per minute (← better)",
        ylabel="share of accidents (better →)",
    )
    ax.set(xlim=(-0.03, 1.4 * _MAX_COST), ylim=(-0.03, 1.05))
    draw_legend_outside(ax, ax.get_legend_handles_labels()[0])
    return with_light_grid(ax, "both")


def _is_known(curve: PreventionCurve | None) -> TypeGuard[PreventionCurve]:
    """Return whether a curve exists and has known shares and costs."""
    if curve is None:
        return False
    has_shares = np.isfinite(curve.avoided).any()
    has_costs = np.isfinite(curve.braking_seconds_per_minute).any()
    return bool(has_shares and has_costs)


def _draw_steps(ax: Axes, costs: FloatArray, shares: FloatArray, **style: Any) -> None:
    """Draw the shares against the costs as a step function."""
    ax.plot(costs, shares, drawstyle="steps-post", **style)


def _draw_operating_points(ax: Axes, result: PreventedResult, group: str) -> None:
    """Mark the operating points and their names; reference predictors are grey."""
    figures_by_predictor = {GIVEN_SCORES: result.groups[group]}
    for name, figures_by_group in result.references.items():
        figures_by_predictor[name] = figures_by_group[group]
    chips = []
    for name, figures in figures_by_predictor.items():
        by_latency = getattr(figures, result.alarms)
        nominal = next(iter(by_latency.values()))[NOMINAL]
        cost = nominal.braking_seconds_per_minute
        avoided = nominal.shares["avoided"]
        if math.isnan(cost) or math.isnan(avoided):
            continue
        if name == GIVEN_SCORES:
            color = ESTIMATE_COLOR
        else:
            color = TRUE_PLACE_COLOR
        ax.plot([cost], [avoided], "o", color=color, markersize=5, zorder=3)
        keep_free(ax, [[(cost, avoided)]], margin=DOT_MARGIN_PT)
        chips.append((human_name(name), (cost, avoided)))
    place_chips(ax, chips)
