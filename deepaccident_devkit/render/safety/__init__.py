"""Pictures of what `deepaccident_devkit.safety` computes."""

from deepaccident_devkit.render.safety.avoidability import render_avoidability
from deepaccident_devkit.render.safety.lead_time import render_lead_times
from deepaccident_devkit.render.safety.report import save_safety_report
from deepaccident_devkit.render.safety.twins import render_twins

__all__ = ["render_avoidability", "render_lead_times", "render_twins", "save_safety_report"]
