"""What a warning so many seconds before the impact changes, for nine ways to brake, as a figure."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.render.axes import figure_or_new, with_light_grid
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.colors import SERIES_COLORS
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.safety import OUTCOMES, AvoidabilityReport, OutcomeShares
from deepaccident_devkit.safety.avoidability import GROUPS
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
