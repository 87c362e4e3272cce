"""All that draws. One panel takes `ax=` and returns the Axes; nothing here shows a window."""

from deepaccident_devkit.render.axes import detached_figure
from deepaccident_devkit.render.bev import render_bev
from deepaccident_devkit.render.boxes import draw_box
from deepaccident_devkit.render.camera import render_sample_data
from deepaccident_devkit.render.moments import render_frame, render_sample

__all__ = ["detached_figure", "draw_box", "render_bev", "render_frame", "render_sample", "render_sample_data"]
