"""Pictures of what `deepaccident_devkit.safety` computes."""

from deepaccident_devkit.render.safety.figures import render_avoidability, render_lead_times
from deepaccident_devkit.render.safety.report import save_safety_report

__all__ = ["render_avoidability", "render_lead_times", "save_safety_report"]
