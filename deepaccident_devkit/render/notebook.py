"""Small pictures of boxes, points and motion labels, which a notebook shows beside their text."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING, Final

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import SE3, Boxes, LidarPointCloud
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render.boxes import draw_boxes_from_above
from deepaccident_devkit.render.figures import axis_words, detached_figure, with_light_grid
from deepaccident_devkit.render.motion import draw_motion_trail
from deepaccident_devkit.render.styles import CATEGORY_COLORS, HEIGHT_COLORMAP, in_own_settings
from deepaccident_devkit.taxonomy import CAMERAS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_INCHES: Final = (3.6, 3.2)
_DPI: Final = 80
_MOST_POINTS: Final = 20_000
# More are thinned out: a picture must not take long.
_MOST_BOXES: Final = 1_000
# Points.
_LETTERS: Final = 7
_LEVEL_FROM_OPTICAL: Final = SE3.from_rotation([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])


@in_own_settings
def png_of(thing: object) -> bytes:
    """A small picture as PNG; raises ChoiceError for other things, and for what is empty."""
    figure = detached_figure(_INCHES)
    ax = figure.add_subplot()
    _draw(thing, ax)
    ax.tick_params(labelsize=_LETTERS)
    ax.xaxis.label.set_fontsize(_LETTERS)
    ax.yaxis.label.set_fontsize(_LETTERS)
    content = BytesIO()
    figure.savefig(content, format="png", dpi=_DPI)
    return content.getvalue()


def _draw(thing: object, ax: Axes) -> None:
    if isinstance(thing, Boxes) and len(thing):
        _draw_boxes(thing, ax)
    elif isinstance(thing, LidarPointCloud) and len(thing):
        _draw_points(thing, ax)
    elif isinstance(thing, MotionLabels):
        draw_motion_trail(thing if thing.at_present else thing.to_present(), ax=ax)
    else:
        raise ChoiceError(
            f"there is nothing to render in {thing!r}; expected boxes, points or MotionLabels"
        )


def _draw_boxes(boxes: Boxes, ax: Axes) -> None:
    _name_axes(boxes.frame, ax)
    shown = boxes[:: -(-len(boxes) // _MOST_BOXES)]
    if boxes.frame in CAMERAS:
        shown = shown.transform(_LEVEL_FROM_OPTICAL, "ego")
    draw_boxes_from_above(
        shown, ax, [CATEGORY_COLORS[name] for name in shown.category_names], linewidths=0.8
    )
    ax.autoscale_view()


def _draw_points(cloud: LidarPointCloud, ax: Axes) -> None:
    _name_axes(cloud.frame, ax)
    xyz = cloud.xyz[:: -(-len(cloud) // _MOST_POINTS)]
    ax.scatter(xyz[:, 0], xyz[:, 1], s=0.5, c=xyz[:, 2], cmap=HEIGHT_COLORMAP, linewidths=0)


def _name_axes(frame: str, ax: Axes) -> None:
    words = axis_words(frame)
    with_light_grid(ax, "both").set(xlabel=words[0], ylabel=words[1])
    ax.set_aspect("equal", adjustable="datalim")
