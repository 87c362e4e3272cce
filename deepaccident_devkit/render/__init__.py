"""All pictures.

Functions that render one panel take `ax=` and return the Axes; none of them opens a window.
"""

from typing import TYPE_CHECKING

from deepaccident_devkit.render.accident import render_accident
from deepaccident_devkit.render.actors import render_annotation, render_instance
from deepaccident_devkit.render.bev import render_bev
from deepaccident_devkit.render.boxes import draw_box
from deepaccident_devkit.render.camera import render_pointcloud_in_image, render_sample_data
from deepaccident_devkit.render.figures import LAYERS, Layer, detached_figure
from deepaccident_devkit.render.link import render_link
from deepaccident_devkit.render.motion import (
    draw_motion_labels,
    draw_motion_map,
    draw_motion_output,
    draw_motion_trail,
    render_motion_labels,
)
from deepaccident_devkit.render.outcomes import render_evaluation
from deepaccident_devkit.render.replay import render_replay
from deepaccident_devkit.render.samples import render_calibration, render_frame, render_sample
from deepaccident_devkit.render.styles import style
from deepaccident_devkit.render.teaser import render_teaser
from deepaccident_devkit.render.town_map import render_town_map
from deepaccident_devkit.render.video import render_scenario_video
from deepaccident_devkit.render.visibility import render_visibility, render_visibility_matrix
from deepaccident_devkit.support.nuscenes_names import with_keywords_named

__all__ = [
    "LAYERS",
    "Layer",
    "detached_figure",
    "draw_box",
    "draw_motion_labels",
    "draw_motion_map",
    "draw_motion_output",
    "draw_motion_trail",
    "render_accident",
    "render_annotation",
    "render_bev",
    "render_calibration",
    "render_evaluation",
    "render_frame",
    "render_instance",
    "render_link",
    "render_motion_labels",
    "render_pointcloud_in_image",
    "render_replay",
    "render_sample",
    "render_sample_data",
    "render_scenario_video",
    "render_teaser",
    "render_town_map",
    "render_visibility",
    "render_visibility_matrix",
    "style",
]

if not TYPE_CHECKING:  # type checkers see the functions themselves
    for _name in __all__:
        if _name.startswith("render_") and _name in globals():
            globals()[_name] = with_keywords_named(globals()[_name], __name__)
