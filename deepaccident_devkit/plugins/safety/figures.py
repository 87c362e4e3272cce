"""Figures of accidents: what a warning changes, and since when who sees them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.collisions import OUTCOMES
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.plugins.safety import (
    COALITIONS,
    PARTNERS,
    AvoidabilityReport,
    LeadTimeLedger,
    MeanTime,
    OutcomeShares,
)
from deepaccident_devkit.plugins.safety.avoidability_report import ACCIDENT_GROUPS
from deepaccident_devkit.plugins.safety.lead_times import CAVEAT
from deepaccident_devkit.render.captions import set_title
from deepaccident_devkit.render.figures import figure_or_new, with_light_grid
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    ESTIMATE_COLOR,
    MUTED_COLOR,
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import AGENTS, short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

AVOIDABILITY_SIZE: Final = (10.7, 6.4)
"""Inches: the width of a page of A4 in landscape."""
# The darker, the better.
_BETTER: Final = "Greys"
COLUMN_HEIGHT: Final = 0.85
"""Of a figure in a paper's column, in widths."""
# Seconds of warning that are shown at most.
_LONGEST: Final = 5.0
_TITLES: Final = {
    "first": "the first brakes",
    "second": "the second brakes",
    "both": "both brake",
    "ego": "the ego brakes",
}
# Label of a row of panels → (L, K) values.
_ROWS: Final[Mapping[str, Callable[[OutcomeShares], FloatArray]]] = {
    "share avoided": lambda shares: shares.shares[..., OUTCOMES.index("avoided")],
    "mean speed between the\ntwo at the contact (m/s)": lambda shares: shares.relative_speed,
}
LEAD_TIME_SIZE: Final = (10.7, 5.6)
"""Inches: the width of a page of A4 in landscape."""
# Points.
_DOT: Final = 5.5


@in_own_settings
def render_avoidability(
    report: AvoidabilityReport, group: str = ACCIDENT_GROUPS[0], *, fig: Figure | None = None
) -> Figure:
    """Render over the seconds of warning which share of accidents is avoided, and how fast the two still collide.

    A column for each who brakes, a row of cells for each way to brake: the darker, the better. Cells end where fewer
    than half of the accidents are recorded for so long. In a paper's column there is only the share avoided if both
    brake.

    Args:
        report: of `avoidability_report`.
        group: one of `ACCIDENT_GROUPS`: `vehicles`, `head-on` or `pedestrians`.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure.

    Raises:
        ChoiceError: no such group.
        NotAvailableError: the report has no accident of that group.
    """
    group = choice("group", group, ACCIDENT_GROUPS)
    shares = [each for each in report.shares if each.group == group]
    if not shares:
        raise NotAvailableError(
            f"{report.dataroot}: no accident of the group {group!r}, so nothing to render"
        )
    fig = figure_or_new(fig, AVOIDABILITY_SIZE, column=COLUMN_HEIGHT)
    rows = list(_ROWS.items())
    if current_style().room == "column":
        rows, shares = rows[:1], [each for each in shares if each.warned == "both"]
    panels = fig.subplots(len(rows), len(shares), squeeze=False, sharex="col", sharey=True)
    for row, (label, values_of) in enumerate(rows):
        drawn = [
            _draw(ax, each, values_of(each)) for ax, each in zip(panels[row], shares, strict=True)
        ]
        highest = (
            1.0
            if row == 0
            else max(1.0, *(float(np.nanmax(np.asarray(image.get_array()))) for image in drawn))
        )
        for image in drawn:
            image.set(clim=(0, highest), cmap=_BETTER if row == 0 else f"{_BETTER}_r")
        fig.colorbar(drawn[-1], ax=list(panels[row]), label=label, pad=0.01)
        panels[row, 0].set_ylabel("reaction, deceleration")
    for ax, each in zip(panels[0], shares, strict=True):
        set_title(ax, f"{_TITLES[each.warned]} ({each.accidents.max()})")
    for ax in panels[-1]:
        ax.set_xlabel("seconds of warning")
    set_title(fig, f"{group}: what braking after a warning changes, by the way to brake")
    return fig


def _draw(ax: Axes, shares: OutcomeShares, values: FloatArray) -> AxesImage:
    """A row of cells for each way to brake."""
    enough = (2 * shares.accidents >= shares.accidents.max()) & (shares.leads <= _LONGEST + 1e-9)
    step, rows = float(shares.leads[1]) if len(shares.leads) > 1 else 1.0, len(shares.brakings)
    sides = shares.leads[0] - step / 2, shares.leads[enough].max(initial=0.0) + step / 2
    ax.set_yticks(
        range(rows),
        [f"{each.reaction:g} s, {each.deceleration:g} m/s²" for each in shares.brakings],
    )
    ax.tick_params(labelsize=text_size())
    return ax.imshow(
        values[enough].T, aspect="auto", extent=(*sides, rows - 0.5, -0.5), interpolation="nearest"
    )


@in_own_settings
def render_lead_times(ledger: LeadTimeLedger, *, fig: Figure | None = None) -> Figure:
    """Render mean lead times of sets of agents, and the partners' mean Shapley values, as dots with intervals of 95 %.

    The sets are the ego alone and with each partner, and the best ones of three, four and five agents (the tables have
    all); dots beside them show whose they are. In a paper's column there are no Shapley values. Intervals are a
    bootstrap over accidents.

    Args:
        ledger: of `lead_time_ledger`.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure.

    Raises:
        NotAvailableError: the ledger has no accident.
    """
    if not ledger.accidents:
        raise NotAvailableError(
            f"{ledger.dataroot}: no accident whose lead times can be told, so nothing to render"
        )
    column = current_style().room == "column"
    fig = figure_or_new(fig, LEAD_TIME_SIZE, column=COLUMN_HEIGHT)
    ratios = (1.2, 3) if column else (1.2, 4, 3)
    members, leads, *shapley = fig.subplots(1, len(ratios), width_ratios=ratios)
    order = _best_sets(ledger.mean_leads)
    _draw_members(members, order)
    _draw_leads(leads, [ledger.mean_leads[number] for number in order])
    for ax in shapley:
        _draw_shapley(ax, ledger.mean_shapley)
    set_title(fig, f"{len(ledger.accidents)} accidents; observed: {ledger.rule.text}")
    fig.supxlabel(
        CAVEAT.replace("; ", ";\n") if column else CAVEAT, fontsize=text_size(), color=MUTED_COLOR
    )
    return fig


def _best_sets(means: Sequence[MeanTime]) -> list[int]:
    """The numbers of the sets of one and two agents, and of the best of each larger size."""
    sizes = range(3, 1 + len(AGENTS))
    of_size = [
        [number for number, names in enumerate(COALITIONS) if len(names) == size] for size in sizes
    ]
    best = [max(numbers, key=lambda number: means[number].mean or 0.0) for numbers in of_size]
    small = [(len(names), number) for number, names in enumerate(COALITIONS) if len(names) < 3]
    return [*(number for _, number in sorted(small)), *best]


def _draw_members(ax: Axes, order: Sequence[int]) -> None:
    """A dot in the colour of each agent of a set, a row a set."""
    for row, number in enumerate(order):
        for column, agent in enumerate(AGENTS):
            ax.plot(
                column,
                row,
                "o",
                color=AGENT_COLORS[agent] if agent in COALITIONS[number] else "none",
                markersize=_DOT,
            )
    ax.set(xlim=(-0.6, len(AGENTS) - 0.4), ylim=(len(order) - 0.4, -0.6), yticks=[])
    ax.set_xticks(
        range(len(AGENTS)),
        [short_name(agent) for agent in AGENTS],
        rotation=90,
        fontsize=text_size(),
    )
    set_title(ax, "set of agents", fontsize=text_size())
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0)


def _draw_leads(ax: Axes, means: Sequence[MeanTime]) -> None:
    _draw_means(ax, means, [ESTIMATE_COLOR] * len(means))
    ax.set(yticks=[], xlabel="mean lead time (s), more is better →")
    set_title(ax, "both colliders observed", fontsize=text_size())


def _draw_shapley(ax: Axes, means: Sequence[MeanTime]) -> None:
    _draw_means(ax, means, [AGENT_COLORS[agent] for agent in PARTNERS])
    total = sum(mean.mean or 0.0 for mean in means)
    words = [
        short_name(agent) + _share_text(mean.mean, total)
        for agent, mean in zip(PARTNERS, means, strict=True)
    ]
    ax.set_yticks(range(len(words)), words, fontsize=text_size())
    ax.set(xlabel="mean Shapley value (s) →")
    set_title(ax, "what each partner adds to the ego", fontsize=text_size())


def _draw_means(ax: Axes, means: Sequence[MeanTime], colors: Sequence[str]) -> None:
    """A dot for each mean, the first on top, with its interval; nothing where there is no mean."""
    for row, (each, color) in enumerate(zip(means, colors, strict=True)):
        if each.low is not None and each.high is not None:
            ax.plot(
                [each.low, each.high],
                [row, row],
                color=color,
                linewidth=1.4,
                marker="|",
                markersize=_DOT,
            )
        if each.mean is not None:
            ax.plot(each.mean, row, "o", color=color, markersize=_DOT)
    ax.set(ylim=(len(means) - 0.4, -0.6), xlim=(0, None))
    with_light_grid(ax, "x")


def _share_text(value: float | None, total: float) -> str:
    return f"\n{100 * value / total:.0f} %" if value is not None and total > 0 else ""
