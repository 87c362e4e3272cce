"""Figures of accidents: the effect of a warning, and when agents observe both colliders."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

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
from deepaccident_devkit.render.captions import set_note, set_title
from deepaccident_devkit.render.figures import figure_or_new, with_light_grid
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    ESTIMATE_COLOR,
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.support.text import choice, counted
from deepaccident_devkit.taxonomy import AGENTS, short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

# Sizes in inches, as wide as a landscape A4 page.
_AVOIDABILITY_SIZE = (10.7, 6.4)
_LEAD_TIME_SIZE = (10.7, 0)
# Heights in lines of letters: a set of agents, and the words above and below all sets.
_SET_LINES = 1.6
_FRAME_LINES = 14
# Colour map for shares: darker is better.
_SHARE_COLORMAP = "Greys"
# Height of the cells in a paper's column, as a multiple of the figure's width.
_COLUMN_HEIGHT = 0.9
# Longest warning time shown.
_MAX_LEAD_S = 5.0
_TITLES = {
    "first": "only actor 1 brakes",
    "second": "only actor 2 brakes",
    "both": "both actors brake",
    "ego": "only the ego brakes",
}
# Label of a row of panels → values, shape (L, K).
_ROWS: Mapping[str, Callable[[OutcomeShares], FloatArray]] = {
    "share of accidents avoided": lambda shares: shares.shares[..., OUTCOMES.index("avoided")],
    "mean relative speed\nat the contact (m/s)": lambda shares: shares.relative_speed,
}
# Dot diameter in points.
_DOT_SIZE = 5.5


@in_own_settings
def render_avoidability(
    report: AvoidabilityReport, group: str = ACCIDENT_GROUPS[0], *, fig: Figure | None = None
) -> Figure:
    """Plot the share of avoided accidents and the remaining speed against the warning time.

    Each column of panels warns other drivers, and each row of cells is one way to brake. Darker
    cells are better. Rows end where less than half of the recordings are long enough. In a paper's
    column, the figure only shows the share that is avoided if both drivers brake.

    Args:
        report: Report returned by `avoidability_report`.
        group: One of `ACCIDENT_GROUPS`: `vehicles`, `head-on` or `pedestrians`.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure.

    Raises:
        ChoiceError: If `group` is not one of `ACCIDENT_GROUPS`.
        NotAvailableError: If the report has no accident of that group.
    """
    group = choice("group", group, ACCIDENT_GROUPS)
    columns = [shares for shares in report.shares if shares.group == group]
    if not columns:
        raise NotAvailableError(
            f"{report.dataroot}: no accident of the group {group!r}, so there is nothing to render"
        )
    fig = figure_or_new(fig, _AVOIDABILITY_SIZE, column=_COLUMN_HEIGHT)
    rows = list(_ROWS.items())
    if current_style().layout == "column":
        rows = rows[:1]
        columns = [shares for shares in columns if shares.warned == "both"]
    panels = fig.subplots(len(rows), len(columns), squeeze=False, sharex="col", sharey=True)
    for row, (label, values_of) in enumerate(rows):
        images = []
        for ax, shares in zip(panels[row], columns, strict=True):
            images.append(_draw_cells(ax, shares, values_of(shares)))
        _color_cells(images, lower_is_better=row > 0)
        fig.colorbar(images[-1], ax=list(panels[row]), label=label, pad=0.01)
        panels[row, 0].set_ylabel("reaction time, deceleration")
    for ax, shares in zip(panels[0], columns, strict=True):
        set_title(ax, f"{_TITLES[shares.warned]} (n = {shares.accidents.max()})")
    for ax in panels[-1]:
        ax.set_xlabel("warning time (s)")
    if current_style().titled:
        title = "Effect of braking after a warning, by reaction time and deceleration"
        set_title(fig, f"{title}: {group}")
    notes = ["Darker is better."]
    if len(columns) > 1:
        notes.append("Actors 1 and 2 are the first and the second collider in the meta file.")
    set_note(fig, " ".join(notes))
    return fig


def _color_cells(images: Sequence[AxesImage], *, lower_is_better: bool) -> None:
    """Give the cells of a row of panels one scale, in which darker is better."""
    highest = 1.0
    colormap = _SHARE_COLORMAP
    if lower_is_better:
        colormap = f"{_SHARE_COLORMAP}_r"
        for image in images:
            highest = max(highest, float(np.nanmax(np.asarray(image.get_array()))))
    for image in images:
        image.set(clim=(0, highest), cmap=colormap)


def _draw_cells(ax: Axes, shares: OutcomeShares, values: FloatArray) -> AxesImage:
    """Draw one row of cells per way to brake; each cell is one warning time."""
    is_common = 2 * shares.accidents >= shares.accidents.max()
    is_shown = is_common & (shares.leads <= _MAX_LEAD_S + 1e-9)
    step = float(shares.leads[1]) if len(shares.leads) > 1 else 1.0
    rows = len(shares.brakings)
    left = shares.leads[0] - step / 2
    right = shares.leads[is_shown].max(initial=0.0) + step / 2
    labels = [
        f"{braking.reaction:g} s, {braking.deceleration:g} m/s²" for braking in shares.brakings
    ]
    ax.set_yticks(range(rows), labels)
    ax.tick_params(labelsize=text_size())
    extent = (left, right, rows - 0.5, -0.5)
    return ax.imshow(values[is_shown].T, aspect="auto", extent=extent, interpolation="nearest")


@in_own_settings
def render_lead_times(ledger: LeadTimeLedger, *, fig: Figure | None = None) -> Figure:
    """Plot the mean lead times of sets of agents, and the partners' mean Shapley values.

    Both are drawn as dots with 95 % intervals from a bootstrap over accidents. The sets are the ego
    without partners, the ego with one partner (four sets), and the best sets of three, four and
    five agents; the tables list all sets. The dots to the left of a set show its members. In a
    paper's column, the Shapley values are left out.

    Args:
        ledger: Ledger returned by `lead_time_ledger`.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure.

    Raises:
        NotAvailableError: If the ledger contains no accident.
    """
    if not ledger.accidents:
        raise NotAvailableError(
            f"{ledger.dataroot}: no accident has lead times that can be computed, so "
            "there is nothing to render"
        )
    width_ratios: tuple[float, ...] = (1.2, 4, 3)
    if current_style().layout == "column":
        width_ratios = (1.2, 3)
    order = _best_sets(ledger.mean_leads)
    lines = _SET_LINES * len(order) + _FRAME_LINES
    fig = figure_or_new(fig, _LEAD_TIME_SIZE, lines=lines)
    member_ax, lead_ax, *shapley_axes = fig.subplots(
        1, len(width_ratios), width_ratios=width_ratios
    )
    _draw_members(member_ax, order)
    _draw_leads(lead_ax, [ledger.mean_leads[number] for number in order])
    for ax in shapley_axes:
        _draw_shapley(ax, ledger.mean_shapley)
    if current_style().titled:
        accidents = counted(len(ledger.accidents), "accident")
        set_title(fig, f"Lead times of {accidents}; observed: {ledger.rule.text}")
    marks = "Whiskers: 95 % intervals."
    if shapley_axes:
        marks += " Percentages: shares of the lead time that all partners add."
    set_note(fig, f"{CAVEAT}\n{marks}")
    return fig


def _best_sets(means: Sequence[MeanTime]) -> list[int]:
    """Return the indices of all sets of one or two agents and of the best set per larger size."""
    numbers_by_size: dict[int, list[int]] = {}
    for number, members in enumerate(COALITIONS):
        numbers_by_size.setdefault(len(members), []).append(number)
    order = []
    for size, numbers in sorted(numbers_by_size.items()):
        if size <= 2:
            order += numbers
        else:
            order.append(max(numbers, key=lambda number: means[number].mean or 0.0))
    return order


def _draw_members(ax: Axes, order: Sequence[int]) -> None:
    """Draw each set as a row of dots, one per member, in the agents' colours."""
    for row, number in enumerate(order):
        for column, agent in enumerate(AGENTS):
            color = AGENT_COLORS[agent] if agent in COALITIONS[number] else "none"
            ax.plot(column, row, "o", color=color, markersize=_DOT_SIZE)
    ax.set(xlim=(-0.6, len(AGENTS) - 0.4), ylim=(len(order) - 0.4, -0.6), yticks=[])
    names = [short_name(agent) for agent in AGENTS]
    ax.set_xticks(range(len(AGENTS)), names, rotation=90, fontsize=text_size())
    set_title(ax, "agents", fontsize=text_size())
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0)


def _draw_leads(ax: Axes, means: Sequence[MeanTime]) -> None:
    """Draw the mean lead time of each set of agents."""
    _draw_means(ax, means, [ESTIMATE_COLOR] * len(means))
    ax.set(yticks=[], xlabel="mean lead time (s), higher is better")
    set_title(ax, "both colliders observed", fontsize=text_size())


def _draw_shapley(ax: Axes, means: Sequence[MeanTime]) -> None:
    """Draw the mean Shapley value of each partner, labelled with its share of the sum."""
    _draw_means(ax, means, [AGENT_COLORS[agent] for agent in PARTNERS])
    total = sum(mean.mean or 0.0 for mean in means)
    labels = [
        short_name(agent) + _share_text(mean.mean, total)
        for agent, mean in zip(PARTNERS, means, strict=True)
    ]
    ax.set_yticks(range(len(labels)), labels, fontsize=text_size())
    ax.set(xlabel="mean Shapley value (s), higher is better")
    set_title(ax, "lead time that each partner adds", fontsize=text_size())


def _draw_means(ax: Axes, means: Sequence[MeanTime], colors: Sequence[str]) -> None:
    """Draw each mean as a dot and its interval as a line, from top to bottom."""
    highest = max(mean.high or mean.mean or 0.0 for mean in means)
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
            ax.plot(mean.mean, row, "o", color=color, markersize=_DOT_SIZE, clip_on=False)
    ax.set(ylim=(len(means) - 0.4, -0.6), xlim=(0, 1.06 * highest or 1.0))
    with_light_grid(ax, "x")


def _share_text(value: float | None, total: float) -> str:
    """Return the share in percent as a second line of text; empty if it is unknown."""
    if value is not None and total > 0:
        return f"\n{100 * value / total:.0f} %"
    return ""
