"""Figures of an evaluation, and the report that contains all of them.

Functions that render one panel take `ax=` and return the Axes.
"""

from deepaccident_devkit.render.evaluation.figures import draw_motion_outcome
from deepaccident_devkit.render.evaluation.over_bytes import render_over_bytes
from deepaccident_devkit.render.evaluation.panels import render_breakdown, render_comparison
from deepaccident_devkit.render.evaluation.report import save_report
from deepaccident_devkit.render.evaluation.tasks import (
    render_accuracy,
    render_alarms,
    render_errors,
    render_plans,
    render_precision_recall,
    render_predictors,
    render_quality_by_time,
)

__all__ = [
    "draw_motion_outcome",
    "render_accuracy",
    "render_alarms",
    "render_breakdown",
    "render_comparison",
    "render_errors",
    "render_over_bytes",
    "render_plans",
    "render_precision_recall",
    "render_predictors",
    "render_quality_by_time",
    "save_report",
]
