"""Figures of accidents: what a warning changes, and when agents observe the colliders."""

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
# Colour map of shares: the darker, the better.
_SHARE_COLORMAP: Final = "Greys"
COLUMN_HEIGHT: Final = 0.85
"""Height of a figure in a paper's column, in widths."""
# Longest warning in the figure.
_MAX_LEAD_S: Final = 5.0
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
# Diameter of a dot in points.
_DOT_SIZE: Final = 5.5


@in_own_settings
def render_avoidability(
    report: AvoidabilityReport, group: str = ACCIDENT_GROUPS[0], *, fig: Figure | None = None
) -> Figure:
    """Render the share of avoided accidents and the remaining speed over the seconds of warning.

    There is a column of panels for each way to choose the warned drivers, and a row of cells for
    each way to brake: the darker, the better. Cells end where fewer than half of the accidents are
    recorded that long. In a paper's column the figure only has the share avoided if both brake.

    Args:
        report: Report of `avoidability_report`.
        group: One of `ACCIDENT_GROUPS`: `vehicles`, `head-on` or `pedestrians`.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure.

    Raises:
        ChoiceError: There is no such group.
        NotAvailableError: The report has no accident of that group.
    """
    group = choice("group", group, ACCIDENT_GROUPS)
    columns = [shares for shares in report.shares if shares.group == group]
    if not columns:
        raise NotAvailableError(
            f"{report.dataroot}: no accident of the group {group!r}, so nothing to render"
        )
    fig = figure_or_new(fig, AVOIDABILITY_SIZE, column=COLUMN_HEIGHT)
    rows = list(_ROWS.items())
    if current_style().room == "column":
        rows = rows[:1]
        columns = [shares for shares in columns if shares.warned == "both"]
    panels = fig.subplots(len(rows), len(columns), squeeze=False, sharex="col", sharey=True)
    for row, (label, values_of) in enumerate(rows):
        images = [
            _draw_cells(ax, shares, values_of(shares))
            for ax, shares in zip(panels[row], columns, strict=True)
        ]
        highest, colormap = 1.0, _SHARE_COLORMAP
        if row > 0:
            maxima = [float(np.nanmax(np.asarray(image.get_array()))) for image in images]
            highest, colormap = max(1.0, *maxima), f"{_SHARE_COLORMAP}_r"
        for image in images:
            image.set(clim=(0, highest), cmap=colormap)
        fig.colorbar(images[-1], ax=list(panels[row]), label=label, pad=0.01)
        panels[row, 0].set_ylabel("reaction, deceleration")
    for ax, shares in zip(panels[0], columns, strict=True):
        set_title(ax, f"{_TITLES[shares.warned]} ({shares.accidents.max()})")
    for ax in panels[-1]:
        ax.set_xlabel("seconds of warning")
    set_title(fig, f"{group}: what braking after a warning changes, by the way to brake")
    return fig


def _draw_cells(ax: Axes, shares: OutcomeShares, values: FloatArray) -> AxesImage:
    """Draw a row of cells for each way to brake."""
    is_common = 2 * shares.accidents >= shares.accidents.max()
    columns = is_common & (shares.leads <= _MAX_LEAD_S + 1e-9)
    step = float(shares.leads[1]) if len(shares.leads) > 1 else 1.0
    rows = len(shares.brakings)
    sides = shares.leads[0] - step / 2, shares.leads[columns].max(initial=0.0) + step / 2
    labels = [
        f"{braking.reaction:g} s, {braking.deceleration:g} m/s²" for braking in shares.brakings
    ]
    ax.set_yticks(range(rows), labels)
    ax.tick_params(labelsize=text_size())
    extent = (*sides, rows - 0.5, -0.5)
    return ax.imshow(values[columns].T, aspect="auto", extent=extent, interpolation="nearest")


@in_own_settings
def render_lead_times(ledger: LeadTimeLedger, *, fig: Figure | None = None) -> Figure:
    """Render the mean lead times of sets of agents, and the partners' mean Shapley values.

    Both are dots with intervals of 95 %, from a bootstrap over accidents. The sets are the ego
    without partners and with each partner, and the best ones of three, four and five agents (the
    tables have all); dots beside them show their members. In a paper's column there are no Shapley
    values.

    Args:
        ledger: Ledger of `lead_time_ledger`.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure.

    Raises:
        NotAvailableError: The ledger has no accident.
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
    caveat = CAVEAT.replace("; ", ";\n") if column else CAVEAT
    fig.supxlabel(caveat, fontsize=text_size(), color=MUTED_COLOR)
    return fig


def _best_sets(means: Sequence[MeanTime]) -> list[int]:
    """Return the numbers of the sets of one and two agents, and of the best of each larger size."""
    best = []
    for size in range(3, 1 + len(AGENTS)):
        numbers = [number for number, names in enumerate(COALITIONS) if len(names) == size]
        best.append(max(numbers, key=lambda number: means[number].mean or 0.0))
    small = [(len(names), number) for number, names in enumerate(COALITIONS) if len(names) < 3]
    return [*(number for _, number in sorted(small)), *best]


def _draw_members(ax: Axes, order: Sequence[int]) -> None:
    """Draw a dot in the colour of each agent of a set, a row for each set."""
    for row, number in enumerate(order):
        for column, agent in enumerate(AGENTS):
            color = AGENT_COLORS[agent] if agent in COALITIONS[number] else "none"
            ax.plot(column, row, "o", color=color, markersize=_DOT_SIZE)
    ax.set(xlim=(-0.6, len(AGENTS) - 0.4), ylim=(len(order) - 0.4, -0.6), yticks=[])
    names = [short_name(agent) for agent in AGENTS]
    ax.set_xticks(range(len(AGENTS)), names, rotation=90, fontsize=text_size())
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
    labels = [
        short_name(agent) + _share_text(mean.mean, total)
        for agent, mean in zip(PARTNERS, means, strict=True)
    ]
    ax.set_yticks(range(len(labels)), labels, fontsize=text_size())
    ax.set(xlabel="mean Shapley value (s) →")
    set_title(ax, "what each partner adds to the ego", fontsize=text_size())


def _draw_means(ax: Axes, means: Sequence[MeanTime], colors: Sequence[str]) -> None:
    """Draw a dot for each mean from the top down, with its interval; nothing for a missing mean."""
    for row, (mean, color) in enumerate(zip(means, colors, strict=True)):
        if mean.low is not None and mean.high is not None:
            ax.plot(
                [mean.low, mean.high],
                [row, row],
                color=color,
                linewidth=1.4,
                marker="|",
                markersize=_DOT_SIZE,
            )
        if mean.mean is not None:
            ax.plot(mean.mean, row, "o", color=color, markersize=_DOT_SIZE)
    ax.set(ylim=(len(means) - 0.4, -0.6), xlim=(0, None))
    with_light_grid(ax, "x")


def _share_text(value: float | None, total: float) -> str:
    if value is not None and total > 0:
        return f"\n{100 * value / total:.0f} %"
    return ""
