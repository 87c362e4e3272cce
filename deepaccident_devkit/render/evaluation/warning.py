"""Warning results as pictures: how well accidents are distinguished."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from deepaccident_devkit.evaluation.warning import AnticipationResult
from deepaccident_devkit.render.axes import axes_or_new
from deepaccident_devkit.render.colors import ESTIMATE_COLOR, TRUE_PLACE_COLOR
from deepaccident_devkit.render.evaluation.panels import PANEL, Bar, draw_bars, draw_nothing
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.render.titles import set_title

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@in_own_settings
def render_predictors(result: AnticipationResult, *, ax: Axes | None = None) -> Axes:
    """Render how well accidents are distinguished from other recordings before they happen, and reference predictors.

    Args:
        result: of `WarningEvaluator("clean").compute`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, for the first group of recordings: one bar for each predictor, and a line at 0.5, which is chance.
    """
    ax, group = axes_or_new(ax, PANEL), next(iter(result.groups), None)
    if group is None:
        return draw_nothing(ax, "no recording")
    everyone = {"given": result.groups[group], **{name: each[group] for name, each in result.references.items()}}
    bars = [
        Bar(
            label=name,
            value=None if math.isnan(each.auc_ahead) else each.auc_ahead,
            text=f"{each.auc_ahead:.3f}",
            color=ESTIMATE_COLOR if name == "given" else TRUE_PLACE_COLOR,
        )
        for name, each in everyone.items()
    ]
    ax = draw_bars(bars, ax, 1.0)
    ax.axvline(0.5, color="black", linestyle="--", linewidth=1)
    ax.set(xlabel="chance that an accident's score is above\nanother recording's at the same moment")
    set_title(ax, f"Accidents distinguished from other recordings\n{group}", fontsize="medium")
    return ax
