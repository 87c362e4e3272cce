"""Pictures of what `deepaccident_devkit.safety` computes."""

from deepaccident_devkit.render.safety.lead_time import render_lead_times

__all__ = ["render_lead_times"]
