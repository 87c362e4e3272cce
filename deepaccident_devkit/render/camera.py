"""A camera's image with what it may see; of the other sensors, the matching view from above."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render.axes import axes_or_new
from deepaccident_devkit.render.bev import BEV_LAYERS, BevView, draw_bev
from deepaccident_devkit.render.boxes import draw_boxes_in_image, draw_ids_in_image, draw_velocities_in_image
from deepaccident_devkit.render.layers import Layer, layers_of
from deepaccident_devkit.render.points import draw_depths
from deepaccident_devkit.render.roles import role_colors
from deepaccident_devkit.taxonomy import LIDAR, OWN_ACTOR_ID
from deepaccident_devkit.v2x import map_pointcloud_to_image
from deepaccident_devkit.v2x.projection import camera_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CAMERA_LAYERS: Final[tuple[Layer, ...]] = ("image", "points", "boxes", "ids", "velocities")
CAMERA_DEFAULT: Final[tuple[Layer, ...]] = ("image", "boxes")


def render_sample_data(
    dataset: Dataset, sample_data: RowArgument, *, layers: Iterable[Layer] | None = None, ax: Axes | None = None
) -> Axes:
    """Draw what a sensor recorded: a camera's image, or the LiDAR or the BEV camera from above.

    Colours of boxes are those of `render_bev`.

    Args:
        dataset: the release.
        sample_data: token or record of a sensor file.
        layers: of a camera: `image`, `points` (of the agent's LiDAR, coloured by depth up to 50 m), `boxes` (those that
            any of the agent's cameras sees, without its own), `ids` and `velocities` (a line of a second); by default
            image and boxes. From above those of `render_bev`; by default points and boxes of the LiDAR, in its frame,
            and the picture and boxes of the BEV camera, in the ego frame.
        ax: axes to draw on; new ones if None.

    Returns:
        The axes drawn on: pixels of a camera, else metres.

    Raises:
        TokenError: no such sensor file.
        ChoiceError: the sensor has no such layer.
        MissingFileError: the image, or the points asked for in it, were not downloaded.
    """
    record = dataset.get("sample_data", sample_data)
    if record["modality"] != "camera":
        lidar = record["channel"] == LIDAR
        default: tuple[Layer, ...] = ("points" if lidar else "bev", "boxes", "grid")
        chosen = layers_of(layers, default, BEV_LAYERS)
        ax = axes_or_new(ax, (6, 6))
        draw_bev(dataset, record["sample_token"], BevView(frame="lidar" if lidar else "ego"), chosen, ax)
        ax.title.set_text(f"{record['channel']}, {ax.get_title()}")
        return ax
    chosen = layers_of(layers, CAMERA_DEFAULT, CAMERA_LAYERS)
    ax = axes_or_new(ax, (8, 4.6))
    draw_image(dataset, record, ax, image="image" in chosen)
    if "points" in chosen:
        points = map_pointcloud_to_image(dataset, record, colors=False)
        draw_depths(points.pixels[points.mask], points.depth[points.mask], ax)
    boxes = dataset.boxes(record["sample_token"], frame=record["channel"], visible="camera")
    draw_camera_boxes(dataset, record, boxes.select(boxes.actor_id != OWN_ACTOR_ID), chosen, ax)
    return ax


def draw_image(dataset: Dataset, camera: Any, ax: Axes, *, image: bool = True) -> None:
    """Draw a camera's image in pixels of its calib, without ticks, or leave its place empty.

    Args:
        dataset: the release.
        camera: record of its sensor file.
        ax: axes to draw on.
        image: whether to draw it.

    Raises:
        MissingFileError: the image was not downloaded.
    """
    lens = camera_of(dataset, camera)
    if image:
        ax.imshow(dataset.load_image(camera), extent=(0, lens.width, lens.height, 0))
    ax.set(xlim=(0, lens.width), ylim=(lens.height, 0), aspect="equal", anchor="N", title=camera["channel"])
    ax.set(xticks=(), yticks=())
    ax.spines[:].set_visible(False)


def draw_camera_boxes(dataset: Dataset, camera: Any, boxes: Boxes, layers: Collection[Layer], ax: Axes) -> None:
    """Draw the layers of boxes, given in the optical frame of a camera (a record), in its image."""
    lens = camera_of(dataset, camera)
    colors = role_colors(dataset, camera["sample_token"], boxes)
    if "boxes" in layers:
        draw_boxes_in_image(boxes, lens, ax, colors)
    if "velocities" in layers:
        draw_velocities_in_image(boxes, lens, ax, colors)
    if "ids" in layers:
        draw_ids_in_image(boxes, lens, ax, colors)
