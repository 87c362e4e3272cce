"""Pictures of a sample's prediction and its truth: right, false and missed parts."""

from deepaccident_devkit.render.outcomes.cameras import render_outcome_in_cameras
from deepaccident_devkit.render.outcomes.evaluation import render_evaluation
from deepaccident_devkit.render.outcomes.results_grid import render_results

__all__ = ["render_evaluation", "render_outcome_in_cameras", "render_results"]
