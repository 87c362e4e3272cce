"""A sample's prediction beside its label: what is right, false and missed."""

from deepaccident_devkit.render.outcomes.accident import draw_accident_outcome
from deepaccident_devkit.render.outcomes.detection import draw_detection_outcome
from deepaccident_devkit.render.outcomes.evaluation import render_evaluation
from deepaccident_devkit.render.outcomes.motion import MotionOutcome, draw_motion_side, motion_outcome

__all__ = [
    "MotionOutcome",
    "draw_accident_outcome",
    "draw_detection_outcome",
    "draw_motion_side",
    "motion_outcome",
    "render_evaluation",
]
