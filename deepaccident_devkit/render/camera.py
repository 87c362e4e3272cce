"""A camera's image with boxes and points, or another sensor's view from above; and which camera shows boxes best."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import MissingFileError
from deepaccident_devkit.geometry import Boxes, PinholeCamera
from deepaccident_devkit.geometry.boxes import CORNER_SIGNS
from deepaccident_devkit.geometry.camera import IN_FRONT_DEPTH
from deepaccident_devkit.render.bev import BEV_LAYERS, BevView, draw_bev
from deepaccident_devkit.render.boxes import (
    bounds_in_image,
    camera_name,
    draw_boxes_in_image,
    draw_ids_in_image,
    draw_velocities_in_image,
    role_colors,
)
from deepaccident_devkit.render.captions import (
    agent_handles,
    box_handles,
    draw_legend,
    draw_legend_outside,
    draw_missing_image,
    has_cloud,
    is_there,
    missing_clouds_text,
    moment_words,
    set_scene_title,
    write_missing,
)
from deepaccident_devkit.render.figures import Layer, axes_or_new, layers_of, widening
from deepaccident_devkit.render.hidden import hiding
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    DEPTH_COLORMAP,
    HEIGHT_COLORMAP,
    in_own_settings,
)
from deepaccident_devkit.support.arrays import FloatArray, as_floats
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import CAMERAS, LIDAR, OWN_ACTOR_ID
from deepaccident_devkit.v2x import map_pointcloud_to_image, project_to_image
from deepaccident_devkit.v2x.poses import ImagePoints, camera_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection

    from deepaccident_devkit.tables.records import SampleRecord

_STEPS: Final = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 3), axis=-1).reshape(-1, 1, 3)
# (125, 8) weights of a box's corners, of points spread evenly over it.
_LATTICE: Final = ((1 + CORNER_SIGNS * _STEPS) / 2).prod(axis=2)
CAMERA_LAYERS: Final[tuple[Layer, ...]] = ("image", "points", "boxes", "ids", "velocities")
CAMERA_DEFAULT: Final[tuple[Layer, ...]] = ("image", "boxes")
_Seen = Callable[[ImagePoints], ImagePoints]
ColorBy = Literal["depth", "height", "agent"]
# Metres from the camera at which the colours of depth begin and end.
_DEPTHS: Final = (0.0, 50.0)
# Metres above the origin of the camera's agent at which the colours of height begin and end.
_HEIGHTS: Final = (-1.0, 6.0)


@in_own_settings
def render_sample_data(
    dataset: Dataset,
    sample_data: RowArgument,
    *,
    layers: Iterable[Layer] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Render what a sensor recorded: a camera's image, or the LiDAR or the BEV camera from above.

    Colours of boxes are those of `render_bev`; a legend says what they mean.

    Args:
        dataset: the release.
        sample_data: token or record of a sensor file.
        layers: for a camera: `image`, `points` (of the agent's LiDAR, coloured by depth up to 50 m), `boxes` (those
            that any of the agent's cameras sees, without its own), `ids` and `velocities` (a line for one second); by
            default image and boxes. From above the layers of `render_bev`: by default points and boxes for the LiDAR,
            in its frame, and the picture and boxes for the BEV camera, in the ego frame.
        ax: axes to render on; new ones if None.

    Returns:
        The axes: pixels for a camera, metres for other sensors.

    Raises:
        TokenError: no such sensor file.
        ChoiceError: the sensor has no such layer.
        MissingFileError: there is nothing to render: of the layers only files could be, and none was downloaded.
            Beside other layers, a grey panel takes the place of a missing image, and words that of points.
    """
    record = dataset.get("sample_data", sample_data)
    if record["modality"] == "camera":
        chosen = layers_of(layers, CAMERA_DEFAULT, CAMERA_LAYERS)
        there = {
            "image": is_there(dataset, record["token"]),
            "points": has_cloud(dataset, record["sample_token"]),
        }
        if chosen and not any(there.get(layer, True) for layer in chosen):
            raise MissingFileError(
                f"{dataset.sensor_path(record)}: no such file, and nothing else to render; unpack the archive "
                "that holds it, or choose other layers, such as boxes"
            )
        ax = axes_or_new(ax, (8, 5.4))
        colors = draw_camera(dataset, record, chosen, ax)
    else:
        lidar = record["channel"] == LIDAR
        chosen = layers_of(layers, ("points" if lidar else "bev", "boxes", "grid"), BEV_LAYERS)
        view = BevView(frame="lidar" if lidar else "ego", wide=widening(ax))
        ax = axes_or_new(ax, (6, 7.2))
        colors = draw_bev(dataset, record["sample_token"], view, chosen, ax)[0]
    set_scene_title(ax, dataset, record["token"], camera_name(record["channel"]))
    if record["modality"] == "camera":
        draw_legend(ax, box_handles(colors), loc="upper center", bbox_to_anchor=(0.5, 0))
    else:
        draw_legend_outside(ax, box_handles(colors))
    return ax


def draw_camera(
    dataset: Dataset, record: Any, layers: Collection[Layer], ax: Axes
) -> frozenset[str]:
    """Render a camera's panel of `render_sample_data`; returns the colours of the boxes in its image."""
    sample = record["sample_token"]
    draw_image(dataset, record, ax, image="image" in layers)
    if "points" in layers and has_cloud(dataset, sample):
        points = map_pointcloud_to_image(dataset, record, colors=False)
        _draw_numbers(points, points.depth, _DEPTHS, DEPTH_COLORMAP, ax)
    elif "points" in layers:
        write_missing(ax, missing_clouds_text([sample.rsplit("/", 2)[1]]))
    boxes = dataset.boxes(sample, frame=record["channel"], visible="camera")
    return draw_camera_boxes(
        dataset, record, boxes.select(boxes.actor_id != OWN_ACTOR_ID), layers, ax
    )


def draw_image(dataset: Dataset, camera: Any, ax: Axes, *, image: bool = True) -> None:
    """Render a camera's image, or an empty place for it, in pixels of its calib, without ticks.

    If the image was not downloaded, its place is grey and says so. Every camera image of a picture is rendered here.
    """
    lens = camera_of(dataset, camera)
    if image and not is_there(dataset, camera["token"]):
        draw_missing_image(dataset, camera["token"], ax)
    elif image:
        ax.imshow(dataset.load_image(camera), extent=(0, lens.width, lens.height, 0))
    ax.set(
        xlim=(0, lens.width),
        ylim=(lens.height, 0),
        aspect="equal",
        anchor="N",
        title=camera_name(camera["channel"]),
    )
    for scale in (ax.xaxis, ax.yaxis, *ax.spines.values()):
        scale.set_visible(False)


def draw_points_in_image(
    pixels: FloatArray, ax: Axes, *, size: float = 2.0, **colors: Any
) -> PathCollection:
    """Render points at pixels (P, 2), (u, v), of a size in points²: of one `color`, or by numbers `c` and a `cmap`."""
    return ax.scatter(pixels[:, 0], pixels[:, 1], s=size, linewidths=0, rasterized=True, **colors)


def draw_camera_boxes(
    dataset: Dataset, camera: Any, boxes: Boxes, layers: Collection[Layer], ax: Axes
) -> frozenset[str]:
    """Render layers of boxes of a camera's (a record's) optical frame; returns the colours of those in the image."""
    lens = camera_of(dataset, camera)
    boxes = boxes.select(np.argsort(-boxes.center[:, 2]))  # the nearest are on top
    colors = role_colors(dataset, camera["sample_token"], boxes)
    drawn: frozenset[str] = frozenset()
    if "boxes" in layers:
        seen = draw_boxes_in_image(boxes, lens, ax, colors).tolist()
        drawn = frozenset(color for color, inside in zip(colors, seen, strict=True) if inside)
    if "velocities" in layers:
        draw_velocities_in_image(boxes, lens, ax, colors)
    if "ids" in layers:
        draw_ids_in_image(boxes, lens, ax, colors)
    return drawn


@in_own_settings
def render_pointcloud_in_image(
    dataset: Dataset,
    camera: RowArgument,
    sample: RowArgument | None = None,
    *,
    color_by: ColorBy = "depth",
    ax: Axes | None = None,
) -> Axes:
    """Render a camera's image with LiDAR points on it.

    Points of other agents are left out where the camera's own cloud has something in front of them (`render.hidden`).

    Args:
        dataset: the release.
        camera: token or record of the image (sample data).
        sample: token or record of the sample whose points are rendered: any agent and moment of the scenario. By
            default the camera's own sample, and with `color_by="agent"` the samples of all agents at its moment.
        color_by: `depth` along the camera's axis, up to 50 m; `height` above the ground under the camera's agent; or
            `agent`, a colour for each.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, in pixels.

    Raises:
        TokenError: no such sample or sensor file.
        ChoiceError: the sensor is no camera, the two are of different scenarios, or there is no such way to colour.
        MissingFileError: neither the image nor a cloud was downloaded. If one of them is there, words name the other.
    """
    color_by = choice("color_by", color_by, get_args(ColorBy))
    record = dataset.get("sample_data", camera)
    own = dataset.sample.get(record["sample_token"])
    sources = [own if sample is None else dataset.sample[dataset.getind("sample", sample)]]
    whose = "this agent" if sample is None else moment_words(dataset, sources[0]["token"])
    if color_by == "agent" and sample is None:
        sources, whose = dataset.samples_of(own["frame_token"]), "all agents"
    absent = [source["agent"] for source in sources if not has_cloud(dataset, source["token"])]
    sources = [source for source in sources if source["agent"] not in absent]
    if not (sources or is_there(dataset, record["token"])):
        raise MissingFileError(
            f"{dataset.sensor_path(record)}: no such file, and {missing_clouds_text(absent)}; unpack the "
            "archives of the camera or of the LiDAR"
        )
    ax = axes_or_new(ax, (8, 5))
    draw_image(dataset, record, ax)
    write_missing(ax, missing_clouds_text(absent))
    seen: _Seen = lambda points: points  # noqa: E731 - the camera's own cloud hides nothing of itself
    if any(source["token"] != own["token"] for source in sources):
        seen = hiding(dataset, record)
    if color_by == "agent":
        for source in sources:
            _draw_agent(dataset, source, record, seen, ax)
        handles = agent_handles([source["agent"] for source in sources])
        draw_legend(ax, handles, loc="upper center", bbox_to_anchor=(0.5, 0))
    elif sources:
        _draw_metres(dataset, sources[0], record, seen, color_by, ax)
    set_scene_title(
        ax, dataset, record["token"], camera_name(record["channel"]), below=f"LiDAR: {whose}"
    )
    return ax


def _draw_agent(
    dataset: Dataset, source: SampleRecord, camera: RowArgument, seen: _Seen, ax: Axes
) -> None:
    cloud = dataset.load_point_cloud(source, "lidar")
    points = seen(project_to_image(dataset, cloud, source, camera, colors=False))
    draw_points_in_image(points.pixels[points.mask], ax, color=AGENT_COLORS[source["agent"]])


def _draw_metres(
    dataset: Dataset,
    source: SampleRecord,
    camera: RowArgument,
    seen: _Seen,
    color_by: Literal["depth", "height"],
    ax: Axes,
) -> None:
    """Points coloured by depth or height, and a colour bar."""
    cloud = dataset.load_point_cloud(source, "world")
    points = seen(project_to_image(dataset, cloud, source, camera, colors=False))
    values, limits, colormap = points.depth, _DEPTHS, DEPTH_COLORMAP
    if color_by == "height":
        ego_from_world = dataset.world_from(
            dataset.get("sample_data", camera)["sample_token"], "ego"
        ).inverse()
        values, limits, colormap = ego_from_world.apply(cloud.xyz)[:, 2], _HEIGHTS, HEIGHT_COLORMAP
    drawn = _draw_numbers(points, values, limits, colormap, ax)
    ax.figure.colorbar(drawn, ax=ax, label=f"{color_by} (m)", fraction=0.03, pad=0.01)


def _draw_numbers(
    points: ImagePoints, values: FloatArray, limits: tuple[float, float], colormap: str, ax: Axes
) -> PathCollection:
    """Points coloured by one number each (P,), the far points first."""
    shown = np.flatnonzero(points.mask)
    shown = shown[np.argsort(-points.depth[shown])]
    low, high = limits
    return draw_points_in_image(
        points.pixels[shown], ax, c=values[shown], cmap=colormap, vmin=low, vmax=high
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class BestView:
    """The image in which some boxes are largest, even if other things hide them.

    Attributes:
        camera: token of the image (sample data).
        shown: sum of the shares of the boxes that are in the image, rounded to hundredths.
        area: pixels² of the image that their bounds cover.
        bounds: left, top, right and bottom of what is in the image of those boxes, pixels.
    """

    camera: str
    shown: float
    area: float
    bounds: tuple[float, float, float, float]


def best_view(
    dataset: Dataset, samples: Iterable[str], boxes: Boxes, channels: Sequence[str] = CAMERAS
) -> BestView | None:
    """The view of boxes (any number, in world) that shows most of them, and of equal ones shows them largest.

    The samples, by token, are those of the boxes' moment. A view whose image was not downloaded only counts if there
    is no other. None if no camera has any part of a box in its image.
    """
    views = [
        _view(dataset, f"{sample}/{channel}", boxes) for sample in samples for channel in channels
    ]
    there = [view for view in views if view is not None]
    return max(
        there,
        key=lambda view: (is_there(dataset, view.camera), view.shown, view.area),
        default=None,
    )


def _view(dataset: Dataset, camera: str, boxes: Boxes) -> BestView | None:
    sample, channel = camera.rsplit("/", 1)
    lens = camera_of(dataset, camera)
    optical = boxes.transform(dataset.world_from(sample, channel).inverse(), channel)
    shown = _shares_in_image(optical, lens)
    seen = shown > 0
    if not seen.any():
        return None
    bounds = bounds_in_image(optical.select(seen), lens)
    (left, top), (right, bottom) = (
        bounds[:, :2].min(axis=0).tolist(),
        bounds[:, 2:].max(axis=0).tolist(),
    )
    return BestView(
        camera=camera,
        shown=round(float(shown.sum()), 2),
        area=float((bounds[:, 2:] - bounds[:, :2]).prod(axis=1).sum()),
        bounds=(left, top, right, bottom),
    )


def _shares_in_image(optical: Boxes, lens: PinholeCamera) -> FloatArray:
    """Which share (N,) of the volume of each box of the camera's frame is in its image."""
    points = _LATTICE @ optical.corners()
    pixels, depth = lens.project(points.reshape(-1, 3))
    inside = lens.in_image(pixels, depth, min_depth=IN_FRONT_DEPTH)
    return as_floats(inside.reshape(points.shape[:2]).mean(axis=1))


def crop_about(
    bounds: tuple[float, float, float, float], *, width: int, height: int, share: float = 0.25
) -> tuple[float, float, float, float]:
    """Left, top, right and bottom of the part of an image, of the image's shape, that has the bounds in its middle.

    If possible it is twice as wide and high as the bounds (pixels), and at least a `share` of the image.
    """
    left, top, right, bottom = bounds
    scale = min(1.0, max(share, 2 * (right - left) / width, 2 * (bottom - top) / height))
    half = scale * width / 2, scale * height / 2
    u = min(max((left + right) / 2, half[0]), width - half[0])
    v = min(max((top + bottom) / 2, half[1]), height - half[1])
    return u - half[0], v - half[1], u + half[0], v + half[1]
