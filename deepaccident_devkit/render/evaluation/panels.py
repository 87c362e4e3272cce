"""Shared parts of an evaluation's panels: their size, labelled bars with intervals, and words in empty ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from deepaccident_devkit.render.axes import with_light_grid
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.colors import ESTIMATE_COLOR, MUTED_COLOR

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PANEL: Final = (5.2, 3.0)
"""Width and height of one panel in inches: a page of a printed report has two rows of two."""
_BESIDE: Final = 1.3
"""The axis' length in lengths of the longest bar, so that the words beside the bars have room."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bar:
    """One bar of `draw_bars`.

    Attributes:
        label: beside the axis.
        below: a smaller line below the label; empty for none.
        value: None if there is nothing to count.
        interval: low and high; None for none.
        text: beside the bar.
        color: of the bar.
    """

    label: str
    below: str = ""
    value: float | None = None
    interval: tuple[float, float] | None = None
    text: str = ""
    color: str = ESTIMATE_COLOR


def draw_bars(bars: Sequence[Bar], ax: Axes, limit: float | None = None) -> Axes:
    """Render horizontal bars, the first on top, with their intervals as whiskers and their texts to the right.

    Args:
        bars: an unknown value has a dash in place of a bar.
        ax: the axes to render on.
        limit: the largest possible value; None for the largest of the bars.

    Returns:
        The axes.
    """
    if not bars:
        return draw_nothing(ax)
    ends = [0.0]
    for row, bar in enumerate(bars):
        end = 0.0
        if bar.value is not None:
            ax.barh(row, bar.value, height=0.66, color=bar.color)
            end = max(end, bar.value)
        if bar.value is not None and bar.interval is not None and all(map(math.isfinite, bar.interval)):
            low, high = bar.interval
            ax.plot((low, high), (row, row), color="black", linewidth=1.2, marker="|", markersize=7)
            end = max(end, high)
        ax.annotate(
            "–" if bar.value is None else bar.text,
            (end, row),
            (5, 0),
            textcoords="offset points",
            va="center",
            fontsize=SMALLEST_TEXT,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},  # over a line that marks a value
        )
        ends.append(end)
    reach = max(ends) if limit is None else limit
    ax.set(xlim=(min([0.0, *(bar.value or 0.0 for bar in bars)]), _BESIDE * (reach or 1.0)))
    if limit is not None:
        ax.set_xticks([limit * part / 5 for part in range(6)])
    labels = [f"{bar.label}\n{bar.below}".strip() for bar in bars]
    ax.set_yticks(range(len(bars)), labels, fontsize=SMALLEST_TEXT, linespacing=1.15)
    ax.set_ylim(len(bars) - 0.4, -0.6)
    return with_light_grid(ax, "x")


def draw_nothing(ax: Axes, why: str = "nothing to count") -> Axes:
    """Write into a panel why it is empty; returns the axes."""
    ax.text(0.5, 0.5, why, ha="center", va="center", transform=ax.transAxes, color=MUTED_COLOR)
    ax.set(xticks=[], yticks=[])
    return ax
