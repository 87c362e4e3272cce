"""Small pictures of boxes, points and motion labels, which a notebook shows next to their text."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import SE3, Boxes, LidarPointCloud
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render.boxes import draw_boxes_from_above
from deepaccident_devkit.render.figures import detached_figure, label_axes, with_light_grid
from deepaccident_devkit.render.motion import draw_motion_trail
from deepaccident_devkit.render.styles import CATEGORY_COLORS, HEIGHT_COLORMAP, in_own_settings
from deepaccident_devkit.taxonomy import CAMERAS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FIGURE_SIZE_IN = (3.6, 3.2)
_DPI = 80
# Above these numbers, points and boxes are thinned out, so that a picture does not take long.
_MAX_POINTS = 20_000
_MAX_BOXES = 1_000
_LETTER_SIZE_PT = 7
_LEVEL_FROM_OPTICAL = SE3.from_rotation([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])


@in_own_settings
def png_of(thing: object) -> bytes:
    """Draw boxes, points or labels as a small PNG; raise ChoiceError if empty or anything else."""
    figure = detached_figure(_FIGURE_SIZE_IN)
    ax = figure.add_subplot()
    if isinstance(thing, Boxes) and len(thing):
        _draw_boxes(thing, ax)
    elif isinstance(thing, LidarPointCloud) and len(thing):
        _draw_points(thing, ax)
    elif isinstance(thing, MotionLabels):
        labels = thing if thing.at_present else thing.to_present()
        draw_motion_trail(labels, ax=ax)
    else:
        raise ChoiceError(f"nothing to render in {thing!r}; expected boxes, points or MotionLabels")
    ax.tick_params(labelsize=_LETTER_SIZE_PT)
    ax.xaxis.label.set_fontsize(_LETTER_SIZE_PT)
    ax.yaxis.label.set_fontsize(_LETTER_SIZE_PT)
    content = BytesIO()
    figure.savefig(content, format="png", dpi=_DPI)
    return content.getvalue()


def _draw_boxes(boxes: Boxes, ax: Axes) -> None:
    _name_axes(boxes.frame, ax)
    box_count = len(boxes)
    step = -(-box_count // _MAX_BOXES)
    shown_boxes = boxes[::step]
    if boxes.frame in CAMERAS:
        shown_boxes = shown_boxes.transform(_LEVEL_FROM_OPTICAL, "ego")
    colors = [CATEGORY_COLORS[name] for name in shown_boxes.category_names]
    draw_boxes_from_above(shown_boxes, ax, colors, linewidths=0.8)
    ax.autoscale_view()


def _draw_points(cloud: LidarPointCloud, ax: Axes) -> None:
    _name_axes(cloud.frame, ax)
    step = -(-len(cloud) // _MAX_POINTS)
    x, y, height = cloud.xyz[::step].T
    ax.scatter(x, y, s=0.5, c=height, cmap=HEIGHT_COLORMAP, linewidths=0)


def _name_axes(frame: str, ax: Axes) -> None:
    with_light_grid(ax, "both")
    label_axes(ax, frame)
    ax.set_aspect("equal", adjustable="datalim")
