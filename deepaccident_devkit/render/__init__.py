"""All that draws. One panel takes `ax=` and returns the Axes; nothing here shows a window."""

from deepaccident_devkit.render.axes import detached_figure
from deepaccident_devkit.render.bev import render_bev
from deepaccident_devkit.render.boxes import draw_box
from deepaccident_devkit.render.camera import render_sample_data
from deepaccident_devkit.render.moments import render_frame, render_sample
from deepaccident_devkit.render.motion import draw_motion_labels, draw_motion_map, render_motion_labels

__all__ = [
    "detached_figure",
    "draw_box",
    "draw_motion_labels",
    "draw_motion_map",
    "render_bev",
    "render_frame",
    "render_motion_labels",
    "render_sample",
    "render_sample_data",
]
