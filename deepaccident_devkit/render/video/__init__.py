"""A scenario as a video: any of the views, frame by frame, one view or several side by side."""

from deepaccident_devkit.render.video.scenario import render_scenario_video
from deepaccident_devkit.render.video.views import VIEWS, Moment, View
from deepaccident_devkit.render.video.writers import SUFFIXES

__all__ = ["SUFFIXES", "VIEWS", "Moment", "View", "render_scenario_video"]
