"""The lead-time ledger as a figure: mean lead times of sets of agents, and the partners' Shapley values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.render.axes import figure_or_new, with_light_grid
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.colors import AGENT_COLORS, CASING_COLOR, MUTED_COLOR, OWN_COLOR, SERIES_COLORS
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.safety import COALITIONS, PARTNERS, LeadTimeLedger, MeanTime
from deepaccident_devkit.safety.lead_times import CAVEAT
from deepaccident_devkit.taxonomy import AGENTS, short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEAD_TIME_SIZE: Final = (10.7, 5.6)
"""Inches: the width of a page of A4 in landscape."""
_DOT: Final = 5.5
"""Points."""


@in_own_settings
def render_lead_times(ledger: LeadTimeLedger, *, fig: Figure | None = None) -> Figure:
    """Render the mean lead time of each of the sixteen sets of agents, and the partners' mean Shapley values.

    Lines are intervals of 95 % (bootstrap over accidents). Which agents belong to a set show the dots beside it.

    Args:
        ledger: of `lead_time_ledger`.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure.

    Raises:
        NotAvailableError: the ledger has no accident.
    """
    if not ledger.accidents:
        raise NotAvailableError(f"{ledger.dataroot}: no accident whose lead times can be told, so nothing to render")
    fig = figure_or_new(fig, LEAD_TIME_SIZE)
    members, leads, shapley = fig.subplots(1, 3, width_ratios=(1.2, 4, 3))
    order = sorted(range(len(COALITIONS)), key=lambda number: (len(COALITIONS[number]), number))
    _draw_members(members, order)
    _draw_leads(leads, [ledger.mean_leads[number] for number in order], order)
    _draw_shapley(shapley, ledger.mean_shapley)
    fig.suptitle(f"{len(ledger.accidents)} accidents; observed: {ledger.rule.text}")
    fig.supxlabel(CAVEAT, fontsize=SMALLEST_TEXT, color=MUTED_COLOR)
    return fig


def _draw_members(ax: Axes, order: Sequence[int]) -> None:
    """A dot in the colour of each agent of a set, a row a set."""
    for row, number in enumerate(order):
        for column, agent in enumerate(AGENTS):
            there = agent in COALITIONS[number]
            ax.plot(column, row, "o", color=AGENT_COLORS[agent] if there else "none", markersize=_DOT)
    ax.set(xlim=(-0.6, len(AGENTS) - 0.4), ylim=(len(order) - 0.4, -0.6), yticks=[])
    ax.set_xticks(range(len(AGENTS)), [short_name(agent) for agent in AGENTS], rotation=90, fontsize=SMALLEST_TEXT)
    ax.set_title("set of agents", fontsize=SMALLEST_TEXT)
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0)


def _draw_leads(ax: Axes, means: Sequence[MeanTime], order: Sequence[int]) -> None:
    shades = [SERIES_COLORS[::-1][min(len(COALITIONS[number]), len(SERIES_COLORS)) - 1] for number in order]
    _draw_bars(ax, means, shades)
    ax.set(ylim=(len(order) - 0.4, -0.6), yticks=[], xlim=(0, None), xlabel="mean lead time (s)")
    ax.set_title("both colliders observed before the impact", fontsize=SMALLEST_TEXT)
    with_light_grid(ax, "x")


def _draw_shapley(ax: Axes, means: Sequence[MeanTime]) -> None:
    _draw_bars(ax, means, [AGENT_COLORS[agent] for agent in PARTNERS])
    total = sum(mean.mean or 0.0 for mean in means)
    words = [short_name(agent) + _share_text(mean.mean, total) for agent, mean in zip(PARTNERS, means, strict=True)]
    ax.set_yticks(range(len(words)), words, fontsize=SMALLEST_TEXT)
    ax.set(ylim=(len(words) - 0.4, -0.6), xlim=(0, None), xlabel="mean Shapley value (s)")
    ax.set_title("what each partner adds to the ego", fontsize=SMALLEST_TEXT)
    with_light_grid(ax, "x")


def _draw_bars(ax: Axes, means: Sequence[MeanTime], colors: Sequence[str]) -> None:
    """Bars that lie, the first on top, with their intervals; nothing where there is no mean."""
    ax.barh(np.arange(len(means)), [mean.mean or 0.0 for mean in means], height=0.72, color=list(colors))
    for row, mean in enumerate(means):
        if mean.low is not None and mean.high is not None:
            for color, width in ((CASING_COLOR, 2.5), (OWN_COLOR, 1.0)):
                ax.plot([mean.low, mean.high], [row, row], color=color, linewidth=width)


def _share_text(value: float | None, total: float) -> str:
    return f"\n{100 * value / total:.0f} %" if value is not None and total > 0 else ""
