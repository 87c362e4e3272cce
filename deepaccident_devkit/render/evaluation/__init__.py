"""Figures of an evaluation, and the report with all of them. A panel's function takes `ax=` and returns the Axes."""

from typing import Any

from deepaccident_devkit.render.evaluation.figures import draw_motion_outcome
from deepaccident_devkit.render.evaluation.panels import render_breakdown, render_comparison
from deepaccident_devkit.render.evaluation.report import save_report
from deepaccident_devkit.render.evaluation.tasks import (
    render_accuracy,
    render_alarms,
    render_errors,
    render_precision_recall,
    render_predictors,
    render_quality_by_time,
)
from deepaccident_devkit.rooms import added_name

__all__ = [
    "draw_motion_outcome",
    "render_accuracy",
    "render_alarms",
    "render_breakdown",
    "render_comparison",
    "render_errors",
    "render_precision_recall",
    "render_predictors",
    "render_prevention",
    "render_quality_by_time",
    "save_report",
]


def __getattr__(name: str) -> Any:
    """What the room `safety` adds, imported when it is asked for."""
    return added_name(__name__, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
