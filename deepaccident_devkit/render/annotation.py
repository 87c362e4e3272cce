"""One box: its picture, its place, and its facts."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render.axes import figure_or_new
from deepaccident_devkit.render.best_view import BestView, best_view, crop_about
from deepaccident_devkit.render.bev import BEV_LAYERS, BevView, draw_bev
from deepaccident_devkit.render.boxes import draw_boxes_from_above, draw_boxes_in_image
from deepaccident_devkit.render.camera import draw_image
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.layers import LAYERS, Layer, layers_of
from deepaccident_devkit.render.roles import role_colors
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.render.titles import set_scene_title
from deepaccident_devkit.taxonomy import short_name
from deepaccident_devkit.v2x.projection import camera_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_POSSIBLE: Final = tuple(layer for layer in LAYERS if layer in {"image", *BEV_LAYERS})
_LETTERS_AN_INCH: Final = 12
_DEFAULT: Final[tuple[Layer, ...]] = ("image", "bev", "points", "boxes", "grid")


@in_own_settings
def render_annotation(
    dataset: Dataset,
    annotation: RowArgument,
    *,
    margin: float = 15.0,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render a box in the camera of its agent that shows it largest, from above, and in words.

    Of the cameras, those whose images were downloaded come first; if there is none, the image's place is grey.

    Args:
        dataset: the release.
        annotation: token or record.
        margin: metres shown from above to each side of the box's centre.
        layers: `image`, `boxes` (this box in the camera, all boxes from above) and, from above, the other layers of
            `render_bev`; by default image, bev, points, boxes and grid. Without `boxes` only the box itself is
            rendered.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure: the part of the camera's image around the box, the box from above in the agent's ego frame, words.

    Raises:
        TokenError: no such annotation.
        ChoiceError: no such layer.
    """
    chosen = layers_of(layers, _DEFAULT, _POSSIBLE)
    record = dataset.get("annotation", annotation)
    sample = record["sample_token"]
    row = int(record["token"].rsplit("/", 1)[1])
    box = dataset.boxes(sample, "world").select([row])
    color = role_colors(dataset, sample, box)
    fig = figure_or_new(fig, (10, 4.9))
    axes = fig.subplot_mosaic([["camera", "above"], ["words", "words"]], width_ratios=(16, 10), height_ratios=(4, 0.7))
    _draw_in_camera(dataset, best_view(dataset, [sample], box), box, color, axes["camera"], image="image" in chosen)

    own = box.transform(dataset.world_from(sample, "ego").inverse(), "ego")
    x, y = own.center[0, :2].tolist()
    view = BevView(view_range=margin, center=(x, y))
    draw_bev(dataset, sample, view, chosen - {"image"}, axes["above"])
    draw_boxes_from_above(own, axes["above"], color, fill=0.5, linewidths=2.5)
    axes["above"].set_title("ego frame of the agent", fontsize="medium")

    axes["words"].set_axis_off()
    columns = _facts(dataset, record, own)
    letters = int(_LETTERS_AN_INCH * fig.bbox.width / fig.dpi / len(columns))
    for column, facts in enumerate(columns):
        lines = [textwrap.fill(fact, letters, subsequent_indent="  ") for fact in facts]
        place = column / len(columns)
        axes["words"].text(
            place, 1, "\n".join(lines), va="top", fontsize=SMALLEST_TEXT, transform=axes["words"].transAxes
        )
    set_scene_title(fig, dataset, record["token"], record["category"])
    return fig


def _draw_in_camera(
    dataset: Dataset, view: BestView | None, box: Boxes, color: list[str], ax: Axes, *, image: bool
) -> None:
    if view is None:
        ax.set_axis_off()
        ax.text(0.5, 0.5, "in no image of its agent's cameras", ha="center", va="center", transform=ax.transAxes)
        return
    draw_view(dataset, view, box, color, ax, image=image)


def draw_view(
    dataset: Dataset, view: BestView, boxes: Boxes, colors: list[str], ax: Axes, *, image: bool = True
) -> None:
    """Render the part of a best view's image around boxes, in world, and their edges; the title is the camera."""
    camera = dataset.get("sample_data", view.camera)
    lens = camera_of(dataset, camera)
    draw_image(dataset, camera, ax, image=image)
    optical_from_world = dataset.world_from(camera["sample_token"], camera["channel"]).inverse()
    draw_boxes_in_image(boxes.transform(optical_from_world, camera["channel"]), lens, ax, colors)
    left, top, right, bottom = crop_about(view.bounds, width=lens.width, height=lens.height)
    ax.set(xlim=(left, right), ylim=(bottom, top))


def _facts(dataset: Dataset, record: dict[str, Any], own: Boxes) -> list[list[str]]:
    """The facts about a box, in columns of lines; `own` has only this box, in the ego frame."""
    length, width, height = record["size"]
    speed = float(np.linalg.norm(record["velocity"]))
    countdown = "none" if record["time_to_impact"] is None else f"in {record['time_to_impact']:.1f} s"
    agents = []
    if record["instance_token"] is not None:
        scenario, _, number, _ = record["token"].rsplit("/", 3)
        actor = record["instance_token"].rsplit("/", 1)[1]
        agents = dataset.track.get(f"{scenario}/{number}/actor/{actor}")["agents"]
    return [
        [
            f"category: {record['category']}",
            f"label id: {record['actor_id']}",
            f"size: {length:.2f} × {width:.2f} × {height:.2f} m",
        ],
        [
            f"speed: {'unknown' if np.isnan(speed) else f'{speed:.1f} m/s'}",
            f"distance: {np.linalg.norm(own.center[0, :2]):.1f} m from the agent",
            f"LiDAR points: {record['num_lidar_pts']}",
        ],
        [
            f"visible to the agent's cameras: {'yes' if record['camera_visible'] else 'no'}",
            f"annotated by: {', '.join(map(short_name, agents)) or 'this agent'}",
            f"impact: {countdown}{', with this actor' if record['is_collider'] else ''}",
        ],
    ]
