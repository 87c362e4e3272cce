"""A number by the values of an attribute: time to impact, visibility, agent and so on."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.evaluation.metrics.breakdowns import Breakdown, Group
from deepaccident_devkit.evaluation.metrics.numbers import LIMITS, Headline, headlines
from deepaccident_devkit.render.axes import axes_or_new
from deepaccident_devkit.render.colors import AGENT_COLORS, ESTIMATE_COLOR
from deepaccident_devkit.render.evaluation.panels import PANEL, Bar, draw_bars
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.render.titles import set_title

if TYPE_CHECKING:
    from matplotlib.axes import Axes

UNKNOWN: Final = "not known"


@in_own_settings
def render_breakdown(task: str, broken: Breakdown[Any], number: str, *, ax: Axes | None = None) -> Axes:
    """Render one headline number of each group as a bar, with its interval as a whisker.

    Args:
        task: whose headline numbers they are.
        broken: the result of `breakdown`.
        number: path of the number, as in `Headline`: `apa`, `ranges/30x30/iou`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes; each bar has its value and its numbers of samples and scenarios.
    """
    ax, bars, shown = axes_or_new(ax, PANEL), [], None
    for group in broken.groups:
        headline = next((each for each in headlines(task, group.result) if each.path == number), None)
        shown = headline or shown
        bars.append(_bar(group, headline, AGENT_COLORS.get(group.value or "", ESTIMATE_COLOR)))
    draw_bars(bars, ax, None if shown is None else LIMITS.get(shown.unit))
    set_title(ax, f"{number if shown is None else shown.name} by {broken.by.replace('_', ' ')}", fontsize="medium")
    ax.set_xlabel("" if shown is None else _with_unit(shown))
    return ax


def _bar(group: Group[Any], headline: Headline | None, color: str) -> Bar:
    value = None if headline is None else headline.value
    low, high = group.intervals.get("" if headline is None else headline.path, (math.nan, math.nan))
    return Bar(
        label=UNKNOWN if group.value is None else group.value,
        below=f"{group.samples:,} sample{'s' * (group.samples != 1)}, {group.scenarios:,} scen.",
        value=value,
        interval=None if math.isnan(low) else (low, high),
        text="" if headline is None else headline.text(),
        color=color,
    )


def _with_unit(headline: Headline) -> str:
    """What an axis says of a headline number: `position_error (m)`."""
    return headline.name if headline.unit == "share" else f"{headline.name} ({headline.unit})"
