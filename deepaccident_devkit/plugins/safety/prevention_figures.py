"""Figures of prevented accidents: the share avoided over the braking seconds a minute, by group."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.evaluation.warning.recordings import GIVEN
from deepaccident_devkit.plugins.safety.prevention_result import (
    BUDGET,
    NOMINAL,
    SETTINGS,
    PreventedResult,
)
from deepaccident_devkit.render.captions import draw_legend, set_title
from deepaccident_devkit.render.chips import place_chips
from deepaccident_devkit.render.evaluation.figures import RunFigure, listed
from deepaccident_devkit.render.evaluation.panels import PANEL, draw_nothing
from deepaccident_devkit.render.figures import axes_or_new, with_light_grid
from deepaccident_devkit.render.styles import (
    ESTIMATE_COLOR,
    GRID_COLOR,
    MUTED_COLOR,
    TRUE_PLACE_COLOR,
    in_own_settings,
)
from deepaccident_devkit.support.arrays import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Braking seconds a minute at the end of the x axis, before its margin.
_MAX_COST: Final = 60.0


def prevention_figures(result: PreventedResult) -> Iterator[RunFigure]:
    """Yield the figures of a run: one for each group."""
    for name in result.groups:
        avoided = listed([("avoided", result.avoided(name))])
        yield RunFigure(
            name=f"prevention_{name.replace(', ', '_')}",
            caption="Share of the accidents that braking after the alarm avoids, against the "
            f"braking for false alarms, as the threshold falls: {name}. The upright line is at one "
            "braking second a minute.",
            alt=f"Share avoided over braking seconds a minute; {avoided}.",
            draw=partial(render_prevention, result, name),
        )


@in_own_settings
def render_prevention(
    result: PreventedResult, group: str | None = None, *, ax: Axes | None = None
) -> Axes:
    """Render the share of accidents avoided over the braking seconds a minute.

    There is one line for each way of braking.

    Args:
        result: Result of `prevented_accidents`.
        group: One of its groups; None for the first.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes. The line of the nominal setting is thick, with its operating point and the
        operating points of the reference predictors; the dashed line adds the accidents that are
        milder; the upright line is the headline's cost.
    """
    ax = axes_or_new(ax, PANEL)
    name = group if group is not None else next(iter(result.groups), "no recording")
    set_title(ax, f"Accidents prevented by braking: {name}", fontsize="medium")
    curve = result.curves.get(name)
    if (
        curve is None
        or not np.isfinite(curve.avoided).any()
        or not np.isfinite(curve.braking_seconds_per_minute).any()
    ):
        return draw_nothing(ax, "needs accidents and recordings without one")
    nominal = SETTINGS.index(NOMINAL)
    costs = curve.braking_seconds_per_minute
    for setting in range(len(SETTINGS)):
        if setting != nominal:
            avoided = curve.avoided[:, setting]
            _draw_steps(ax, costs[:, setting], avoided, color=GRID_COLOR, linewidth=1)
    nominal_costs, nominal_avoided = costs[:, nominal], curve.avoided[:, nominal]
    avoided_or_milder = nominal_avoided + curve.mitigated[:, nominal]
    draw_estimate = partial(_draw_steps, ax, nominal_costs, color=ESTIMATE_COLOR)
    draw_estimate(avoided_or_milder, linewidth=1, linestyle="--", label="or milder")
    draw_estimate(nominal_avoided, linewidth=2, label=f"at {NOMINAL}")
    ax.plot([], [], color=GRID_COLOR, linewidth=1, label="other ways of braking")
    ax.axvline(BUDGET, color=MUTED_COLOR, linewidth=0.8, linestyle=":")
    _draw_operating_points(ax, result, name)
    ax.set_xscale("symlog", linthresh=1.0)
    ticks = [0, 0.5, 1, 2, 5, 10, 20, 40]
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.set_xticks([], minor=True)
    ax.set(
        xlabel="← better: braking seconds a minute without an accident",
        ylabel="share of the accidents, better →",
    )
    ax.set(xlim=(-0.03, 1.4 * _MAX_COST), ylim=(-0.03, 1.05))
    handles, _ = ax.get_legend_handles_labels()
    # The legend stands below the axes, since points may lie anywhere in them.
    draw_legend(ax, handles, columns=3, loc="upper center", bbox_to_anchor=(0.5, -0.22))
    return with_light_grid(ax, "both")


def _draw_steps(ax: Axes, costs: FloatArray, shares: FloatArray, **style: Any) -> None:
    ax.plot(costs, shares, drawstyle="steps-post", **style)


def _draw_operating_points(ax: Axes, result: PreventedResult, group: str) -> None:
    """Draw the operating points with their names, reference predictors in grey."""
    figures_by_predictor = {GIVEN: result.groups[group]}
    for name, groups in result.references.items():
        figures_by_predictor[name] = groups[group]
    chips = []
    for name, figures in figures_by_predictor.items():
        by_latency = getattr(figures, result.alarms)
        nominal = next(iter(by_latency.values()))[NOMINAL]
        x, y = nominal.braking_seconds_per_minute, nominal.shares["avoided"]
        if math.isnan(x) or math.isnan(y):
            continue
        color = ESTIMATE_COLOR if name == GIVEN else TRUE_PLACE_COLOR
        ax.plot([x], [y], "o", color=color, markersize=5, zorder=3)
        chips.append((name, (x, y)))
    place_chips(ax, chips)
