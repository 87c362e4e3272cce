"""Figures of accidents: what a warning changes, and since when who sees them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.render.figures import figure_or_new, with_light_grid
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    CASING_COLOR,
    MUTED_COLOR,
    OWN_COLOR,
    SERIES_COLORS,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.safety import (
    COALITIONS,
    OUTCOMES,
    PARTNERS,
    AvoidabilityReport,
    LeadTimeLedger,
    MeanTime,
    OutcomeShares,
)
from deepaccident_devkit.safety.avoidability_report import GROUPS
from deepaccident_devkit.safety.lead_times import CAVEAT
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import AGENTS, short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AVOIDABILITY_SIZE: Final = (10.7, 6.4)
"""Inches: the width of a page of A4 in landscape."""
_LINES: Final = ("-", "--", ":", "-.")
_LONGEST: Final = 5.0
"""Seconds of warning that are shown at most."""
_TITLES: Final = {
    "first": "the first brakes",
    "second": "the second brakes",
    "both": "both brake",
    "ego": "the ego brakes",
}
_ROWS: Final[Mapping[str, Callable[[OutcomeShares], FloatArray]]] = {
    "share avoided": lambda shares: shares.shares[..., OUTCOMES.index("avoided")],
    "mean speed between the\ntwo at the contact (m/s)": lambda shares: shares.relative_speed,
}
"""Label of a row of panels → (L, K) values."""
LEAD_TIME_SIZE: Final = (10.7, 5.6)
"""Inches: the width of a page of A4 in landscape."""
_DOT: Final = 5.5
"""Points."""


@in_own_settings
def render_avoidability(report: AvoidabilityReport, group: str = GROUPS[0], *, fig: Figure | None = None) -> Figure:
    """Render over the seconds of warning which share of accidents is avoided, and how fast the two still collide.

    A column for each who brakes; colours are decelerations, kinds of lines reactions. A line ends where fewer than
    half of the accidents are recorded for so long.

    Args:
        report: of `avoidability_report`.
        group: one of `GROUPS`: `vehicles`, `head-on` or `pedestrians`.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure.

    Raises:
        ChoiceError: no such group.
        NotAvailableError: the report has no accident of that group.
    """
    group = choice("group", group, GROUPS)
    shares = [each for each in report.shares if each.group == group]
    if not shares:
        raise NotAvailableError(f"{report.dataroot}: no accident of the group {group!r}, so nothing to render")
    fig = figure_or_new(fig, AVOIDABILITY_SIZE)
    panels = fig.subplots(len(_ROWS), len(shares), squeeze=False, sharex=True, sharey="row")
    for row, (label, values_of) in enumerate(_ROWS.items()):
        for column, each in enumerate(shares):
            _draw(panels[row, column], each, values_of(each))
        panels[row, 0].set_ylabel(label)
    for ax, each in zip(panels[0], shares, strict=True):
        ax.set_title(f"{_TITLES[each.warned]} ({each.accidents.max()})", fontsize="medium")
        ax.set_ylim(-0.02, 1.02)
    panels[1, 0].set_ylim(bottom=0)
    for ax in panels[-1]:
        ax.set_xlabel("seconds of warning")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=text_size())
    fig.suptitle(f"{group}: braking after a warning, for each of nine ways to brake")
    return fig


def _draw(ax: Axes, shares: OutcomeShares, values: FloatArray) -> None:
    """A line for each way to brake."""
    reactions = sorted({each.reaction for each in shares.brakings})
    decelerations = sorted({each.deceleration for each in shares.brakings})
    enough = (2 * shares.accidents >= shares.accidents.max()) & (shares.leads <= _LONGEST + 1e-9)
    for column, each in enumerate(shares.brakings):
        ax.plot(
            shares.leads[enough],
            values[enough, column],
            color=SERIES_COLORS[decelerations.index(each.deceleration) % len(SERIES_COLORS)],
            linestyle=_LINES[reactions.index(each.reaction) % len(_LINES)],
            linewidth=1.4,
            label=f"reaction {each.reaction:g} s, {each.deceleration:g} m/s²",
        )
    ax.set_xlim(0, float(np.max(shares.leads[enough], initial=0.1)))
    with_light_grid(ax, "both")


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
    fig.supxlabel(CAVEAT, fontsize=text_size(), color=MUTED_COLOR)
    return fig


def _draw_members(ax: Axes, order: Sequence[int]) -> None:
    """A dot in the colour of each agent of a set, a row a set."""
    for row, number in enumerate(order):
        for column, agent in enumerate(AGENTS):
            there = agent in COALITIONS[number]
            ax.plot(column, row, "o", color=AGENT_COLORS[agent] if there else "none", markersize=_DOT)
    ax.set(xlim=(-0.6, len(AGENTS) - 0.4), ylim=(len(order) - 0.4, -0.6), yticks=[])
    ax.set_xticks(range(len(AGENTS)), [short_name(agent) for agent in AGENTS], rotation=90, fontsize=text_size())
    ax.set_title("set of agents", fontsize=text_size())
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0)


def _draw_leads(ax: Axes, means: Sequence[MeanTime], order: Sequence[int]) -> None:
    shades = [SERIES_COLORS[::-1][min(len(COALITIONS[number]), len(SERIES_COLORS)) - 1] for number in order]
    _draw_bars(ax, means, shades)
    ax.set(ylim=(len(order) - 0.4, -0.6), yticks=[], xlim=(0, None), xlabel="mean lead time (s)")
    ax.set_title("both colliders observed before the impact", fontsize=text_size())
    with_light_grid(ax, "x")


def _draw_shapley(ax: Axes, means: Sequence[MeanTime]) -> None:
    _draw_bars(ax, means, [AGENT_COLORS[agent] for agent in PARTNERS])
    total = sum(mean.mean or 0.0 for mean in means)
    words = [short_name(agent) + _share_text(mean.mean, total) for agent, mean in zip(PARTNERS, means, strict=True)]
    ax.set_yticks(range(len(words)), words, fontsize=text_size())
    ax.set(ylim=(len(words) - 0.4, -0.6), xlim=(0, None), xlabel="mean Shapley value (s)")
    ax.set_title("what each partner adds to the ego", fontsize=text_size())
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
