"""Figures of accidents: what a warning changes, since when who sees them, and an accident over its normal twin."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, IntArray, as_floats
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.geometry import Boxes, quaternions
from deepaccident_devkit.render.axes import axis_words, figure_or_new, with_light_grid
from deepaccident_devkit.render.boxes import draw_boxes_from_above
from deepaccident_devkit.render.chips import SMALLEST_TEXT, keep_free, place_chips
from deepaccident_devkit.render.colors import AGENT_COLORS, CASING_COLOR, MUTED_COLOR, OWN_COLOR, SERIES_COLORS
from deepaccident_devkit.render.legends import draw_legend
from deepaccident_devkit.render.roles import actor_color
from deepaccident_devkit.render.styles import current_style, in_own_settings
from deepaccident_devkit.safety import (
    COALITIONS,
    OUTCOMES,
    PARTNERS,
    AvoidabilityReport,
    LeadTimeLedger,
    MeanTime,
    OutcomeShares,
    TwinDiff,
)
from deepaccident_devkit.safety.avoidability import GROUPS
from deepaccident_devkit.safety.lead_times import CAVEAT
from deepaccident_devkit.taxonomy import AGENTS, CATEGORIES, frame_timestamp, short_name
from deepaccident_devkit.text import choice

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
TWINS_SIZE: Final = (10.7, 8.6)
"""Inches: the width of a page of A4 in landscape."""
_DASHED: Final = (0, (3, 2))
_LEAST, _MOST = 15.0, 60.0
"""Metres that are shown to each side of the middle of the colliders' places, at least and at most."""
_MARGIN: Final = 6.0
"""Metres around them."""


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
    fig.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=SMALLEST_TEXT)
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


@in_own_settings
def render_twins(diff: TwinDiff, *, fig: Figure | None = None) -> Figure:
    """Render an accident (filled boxes, solid lines) over its twin (dashed).

    Args:
        diff: of `twin_diff`.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure: both from above, in world, at the frame at which they part (if they do not, at the first one) and
        at the impact; below, the colliders' speeds over time.
    """
    fig = figure_or_new(fig, TWINS_SIZE)
    axes = fig.subplot_mosaic([["parting", "impact"], ["speeds", "speeds"]], height_ratios=(2.2, 1))
    parting, impact = diff.parting_frame, diff.num_frames[0]
    _draw_from_above(diff, parting or 1, axes["parting"])
    _draw_from_above(diff, impact, axes["impact"])
    when = f"they part: {frame_timestamp(parting):.1f} s" if parting else "they never part: 0.0 s"
    axes["parting"].set_title(when, fontsize=SMALLEST_TEXT)
    axes["impact"].set_title(f"impact: {frame_timestamp(impact):.1f} s", fontsize=SMALLEST_TEXT)
    _draw_speeds(diff, axes["speeds"])
    words = "filled and solid: the accident; dashed: its normal twin"
    fig.suptitle(f"{diff.accident}\n{words}" if current_style().tokens else words, fontsize=SMALLEST_TEXT)
    draw_legend(fig, axes["speeds"].get_legend_handles_labels()[0])
    return fig


def _draw_from_above(diff: TwinDiff, frame: int, ax: Axes) -> None:
    """All actors of a frame (number from 1) of both recordings, and where the colliders came from."""
    for at in (1, 0):
        rows = np.flatnonzero(~np.isnan(_poses_at(diff, at, frame)[:, 0]))
        colors = [_color(diff, row) for row in rows.tolist()]
        how = {"linestyle": _DASHED} if at else {}
        draw_boxes_from_above(_boxes(diff, at, frame, rows), ax, colors, fill=0.0 if at else 0.35, **how)
        for row in diff.pair:
            path = diff.poses[at, row, :frame, :2]
            ax.plot(*path.T, color=_color(diff, row), linewidth=1, linestyle=_DASHED if at else "-", zorder=1)
    _aim(diff, frame, ax)
    xlabel, ylabel = axis_words("world")
    ax.set(aspect="equal", xlabel=xlabel, ylabel=ylabel)
    with_light_grid(ax, "both")
    for at in (0, 1):
        places = {f"{_name(diff, row)}{' (twin)' * at}": _poses_at(diff, at, frame)[row, :2] for row in diff.pair}
        there = {words: place.tolist() for words, place in places.items() if not np.isnan(place[0])}
        place_chips(ax, there.items())
        keep_free(ax, [[place] for place in there.values()])


def _aim(diff: TwinDiff, frame: int, ax: Axes) -> None:
    """Show the colliders of both recordings."""
    places = np.concatenate([_poses_at(diff, at, frame)[list(diff.pair), :2] for at in (0, 1)])
    places = places[~np.isnan(places[:, 0])]
    if not len(places):
        return
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    reach = float(np.clip(np.abs(places - middle).max() + _MARGIN, _LEAST, _MOST))
    ax.set(xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[1] - reach, middle[1] + reach))


def _draw_speeds(diff: TwinDiff, ax: Axes) -> None:
    time = np.array([frame_timestamp(index + 1) for index in range(diff.speeds.shape[-1])])
    for place, row in enumerate(diff.pair):
        for at in (0, 1):
            words = f"{_name(diff, row)}{', in the twin' * at}"
            ax.plot(time, diff.speeds[at, row], color=SERIES_COLORS[2 * place], linestyle=("-", "--")[at], label=words)
    marks = [("impact", diff.num_frames[0]), *([("they part", diff.parting_frame)] if diff.parting_frame else [])]
    for words, frame in marks:
        ax.axvline(frame_timestamp(frame), color=MUTED_COLOR, linewidth=0.8)
        ax.annotate(
            words,
            (frame_timestamp(frame), 1.01),
            xycoords=("data", "axes fraction"),
            ha="center",
            fontsize=SMALLEST_TEXT,
            color=OWN_COLOR,
        )
    ax.set(xlabel="time (s)", ylabel="speed (m/s)", ylim=(0, None))
    with_light_grid(ax, "both")


def _boxes(diff: TwinDiff, at: int, frame: int, rows: IntArray) -> Boxes:
    """The boxes of some actors at a frame, at height 0, in the accident (0) or in the twin (1)."""
    poses, count = _poses_at(diff, at, frame)[rows], len(rows)
    return Boxes(
        frame="world",
        center=np.column_stack([poses[:, :2], np.zeros(count)]),
        size=diff.sizes[at, rows],
        rotation=quaternions.from_yaw(poses[:, 2]),
        velocity=np.full((count, 3), np.nan),
        category=np.array([CATEGORIES.index(diff.categories[row]) for row in rows.tolist()], dtype=np.int8),
        actor_id=diff.actor_ids[rows, at],
        num_lidar_pts=np.zeros(count, dtype=np.int64),
        camera_visible=np.zeros(count, dtype=bool),
        row=np.arange(count),
    )


def _poses_at(diff: TwinDiff, at: int, frame: int) -> FloatArray:
    return as_floats(diff.poses[at, :, frame - 1])


def _color(diff: TwinDiff, row: int) -> str:
    return actor_color(diff.categories[row], diff.agents[row], collides=row in diff.pair)


def _name(diff: TwinDiff, row: int) -> str:
    agent = diff.agents[row]
    return f"{diff.categories[row]} {diff.actor_ids[row, 0]}" if agent is None else short_name(agent)
