"""A sample's prediction next to or on top of its label: right, false and missed parts."""

from deepaccident_devkit.render.outcomes.above import (
    MotionOutcome,
    draw_accident_outcome,
    draw_detection_outcome,
    draw_motion_side,
    motion_outcome,
)
from deepaccident_devkit.render.outcomes.cameras import (
    draw_outcome_in_camera,
    render_outcome_in_cameras,
)
from deepaccident_devkit.render.outcomes.evaluation import render_evaluation
from deepaccident_devkit.render.outcomes.results_grid import render_results
from deepaccident_devkit.render.outcomes.verdicts import Verdict, sample_verdict

__all__ = [
    "MotionOutcome",
    "Verdict",
    "draw_accident_outcome",
    "draw_detection_outcome",
    "draw_motion_side",
    "draw_outcome_in_camera",
    "motion_outcome",
    "render_evaluation",
    "render_outcome_in_cameras",
    "render_results",
    "sample_verdict",
]
