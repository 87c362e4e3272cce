"""A camera's image with boxes and points, or another sensor's view from above.

`best_view` returns the camera that shows boxes best.
"""

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
    has_sensor_file,
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

_LATTICE: Final = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 3), axis=-1).reshape(-1, 1, 3)
# Weights of a box's corners for points spread evenly over it, shape (125, 8).
_CORNER_WEIGHTS: Final = ((1 + CORNER_SIGNS * _LATTICE) / 2).prod(axis=2)
CAMERA_LAYERS: Final[tuple[Layer, ...]] = ("image", "points", "boxes", "ids", "velocities")
CAMERA_DEFAULT: Final[tuple[Layer, ...]] = ("image", "boxes")
# A function that removes hidden points from the mask.
_PointFilter = Callable[[ImagePoints], ImagePoints]
ColorBy = Literal["depth", "height", "agent"]
# Metres from the camera at which the colours of depth begin and end.
_DEPTH_LIMITS_M: Final = (0.0, 50.0)
# Metres above the origin of the camera's agent at which the colours of height begin and end.
_HEIGHT_LIMITS_M: Final = (-1.0, 6.0)


@in_own_settings
def render_sample_data(
    dataset: Dataset,
    sample_data: RowArgument,
    *,
    layers: Iterable[Layer] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Render a sensor's data: a camera's image, or the LiDAR or the BEV camera from above.

    Colours of boxes are as in `render_bev`; a legend explains them.

    Args:
        dataset: The release.
        sample_data: Token or record of a sensor file.
        layers: For a camera `image`, `points` (of the agent's LiDAR, coloured by depth up
            to 50 m), `boxes` (that any of the agent's cameras sees, without its own), `ids` and
            `velocities` (a line for one second); by default image and boxes. From above the layers
            of `render_bev`: by default points and boxes for the LiDAR, in its frame, and the
            picture and boxes for the BEV camera, in the ego frame.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes: pixels for a camera, metres for other sensors.

    Raises:
        TokenError: No such sensor file.
        ChoiceError: The sensor has no such layer.
        MissingFileError: There is nothing to render: the layers need files, and none was
            downloaded. With other layers, a grey panel replaces a missing image, and words replace
            missing points.
    """
    record = dataset.get("sample_data", sample_data)
    is_camera = record["modality"] == "camera"
    if is_camera:
        shown_layers = layers_of(layers, CAMERA_DEFAULT, CAMERA_LAYERS)
        _check_files(dataset, record, shown_layers)
        ax = axes_or_new(ax, (8, 5.4))
        colors = draw_camera(dataset, record, shown_layers, ax)
    else:
        source: Layer = "bev"
        frame = "ego"
        if record["channel"] == LIDAR:
            source, frame = "points", "lidar"
        shown_layers = layers_of(layers, (source, "boxes", "grid"), BEV_LAYERS)
        view = BevView(frame=frame, wide=widening(ax))
        ax = axes_or_new(ax, (6, 7.2))
        colors, _ = draw_bev(dataset, record["sample_token"], view, shown_layers, ax)
    set_scene_title(ax, dataset, record["token"], camera_name(record["channel"]))
    if is_camera:
        draw_legend(ax, box_handles(colors), loc="upper center", bbox_to_anchor=(0.5, 0))
    else:
        draw_legend_outside(ax, box_handles(colors))
    return ax


def _check_files(dataset: Dataset, record: Any, layers: frozenset[Layer]) -> None:
    """Raise MissingFileError if the layers of a camera need files, and none is present."""
    present = {
        "image": has_sensor_file(dataset, record["token"]),
        "points": has_cloud(dataset, record["sample_token"]),
    }
    if layers and not any(present.get(layer, True) for layer in layers):
        raise MissingFileError(
            f"{dataset.sensor_path(record)}: no such file, and nothing else to render; "
            "unpack the archive that holds it, or choose other layers, such as boxes"
        )


def draw_camera(
    dataset: Dataset, record: Any, layers: Collection[Layer], ax: Axes
) -> frozenset[str]:
    """Render a camera's panel of `render_sample_data`, and return the colours of its boxes."""
    sample = record["sample_token"]
    draw_image(dataset, record, ax, image="image" in layers)
    if "points" in layers and has_cloud(dataset, sample):
        points = map_pointcloud_to_image(dataset, record, colors=False)
        _draw_values(points, points.depth, _DEPTH_LIMITS_M, DEPTH_COLORMAP, ax)
    elif "points" in layers:
        write_missing(ax, missing_clouds_text([sample.rsplit("/", 2)[1]]))
    boxes = dataset.boxes(sample, frame=record["channel"], visible="camera")
    other_boxes = boxes.select(boxes.actor_id != OWN_ACTOR_ID)
    return draw_camera_boxes(dataset, record, other_boxes, layers, ax)


def draw_image(dataset: Dataset, camera: Any, ax: Axes, *, image: bool = True) -> None:
    """Render a camera's image, or an empty panel for it, in pixels of its calib, without ticks.

    If the image was not downloaded, the panel is grey with words on its absence. Every camera image
    of a picture is rendered here.
    """
    lens = camera_of(dataset, camera)
    if image and not has_sensor_file(dataset, camera["token"]):
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
    """Render points at pixels (P, 2), (u, v), of a size in points².

    They have one `color`, or numbers `c` and a `cmap`.
    """
    return ax.scatter(pixels[:, 0], pixels[:, 1], s=size, linewidths=0, rasterized=True, **colors)


def draw_camera_boxes(
    dataset: Dataset, camera: Any, boxes: Boxes, layers: Collection[Layer], ax: Axes
) -> frozenset[str]:
    """Render layers of boxes of a camera's (a record's) optical frame.

    Returns the colours of the boxes in the image.
    """
    lens = camera_of(dataset, camera)
    boxes = boxes.select(np.argsort(-boxes.center[:, 2]))  # the nearest are on top
    colors = role_colors(dataset, camera["sample_token"], boxes)
    drawn_colors: frozenset[str] = frozenset()
    if "boxes" in layers:
        in_image = draw_boxes_in_image(boxes, lens, ax, colors)
        drawn_colors = frozenset(colors[row] for row in np.flatnonzero(in_image).tolist())
    if "velocities" in layers:
        draw_velocities_in_image(boxes, lens, ax, colors)
    if "ids" in layers:
        draw_ids_in_image(boxes, lens, ax, colors)
    return drawn_colors


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

    Points of other agents are left out where the camera's own cloud has something in front of them
    (`render.hidden`).

    Args:
        dataset: The release.
        camera: Token or record of the image (sample data).
        sample: Token or record of the sample with the points: any agent and moment of the scenario.
            By default the camera's own sample, and with `color_by="agent"` the samples of all
            agents at its moment.
        color_by: `depth` along the camera's axis, up to 50 m; `height` above the ground under the
            camera's agent; or `agent`, a colour for each.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, in pixels.

    Raises:
        TokenError: No such sample or sensor file.
        ChoiceError: The sensor is no camera, the two are of different scenarios, or there is no
            such way to colour.
        MissingFileError: Neither the image nor a cloud was downloaded. If one of them is present,
            words name the other.
    """
    color_by = choice("color_by", color_by, get_args(ColorBy))
    record = dataset.get("sample_data", camera)
    own_sample = dataset.sample.get(record["sample_token"])
    if sample is not None:
        sources = [dataset.sample[dataset.getind("sample", sample)]]
        source_words = moment_words(dataset, sources[0]["token"])
    elif color_by == "agent":
        sources, source_words = dataset.samples_of(own_sample["frame_token"]), "all agents"
    else:
        sources, source_words = [own_sample], "this agent"
    absent = [source["agent"] for source in sources if not has_cloud(dataset, source["token"])]
    sources = [source for source in sources if source["agent"] not in absent]
    if not (sources or has_sensor_file(dataset, record["token"])):
        raise MissingFileError(
            f"{dataset.sensor_path(record)}: no such file, and {missing_clouds_text(absent)}; "
            "unpack the archives of the camera or of the LiDAR"
        )
    ax = axes_or_new(ax, (8, 5))
    draw_image(dataset, record, ax)
    write_missing(ax, missing_clouds_text(absent))
    point_filter: _PointFilter = _all_points  # the camera's own cloud hides nothing of itself
    if any(source["token"] != own_sample["token"] for source in sources):
        point_filter = hiding(dataset, record)
    if color_by == "agent":
        for source in sources:
            _draw_agent_points(dataset, source, record, point_filter, ax)
        handles = agent_handles([source["agent"] for source in sources])
        draw_legend(ax, handles, loc="upper center", bbox_to_anchor=(0.5, 0))
    elif sources:
        _draw_colored_points(dataset, sources[0], record, point_filter, color_by, ax)
    name = camera_name(record["channel"])
    set_scene_title(ax, dataset, record["token"], name, below=f"LiDAR: {source_words}")
    return ax


def _all_points(points: ImagePoints) -> ImagePoints:
    return points


def _draw_agent_points(
    dataset: Dataset,
    source: SampleRecord,
    camera: RowArgument,
    point_filter: _PointFilter,
    ax: Axes,
) -> None:
    cloud = dataset.load_point_cloud(source, "lidar")
    points = point_filter(project_to_image(dataset, cloud, source, camera, colors=False))
    draw_points_in_image(points.pixels[points.mask], ax, color=AGENT_COLORS[source["agent"]])


def _draw_colored_points(
    dataset: Dataset,
    source: SampleRecord,
    camera: RowArgument,
    point_filter: _PointFilter,
    color_by: Literal["depth", "height"],
    ax: Axes,
) -> None:
    """Draw points coloured by depth or height, and a colour bar."""
    cloud = dataset.load_point_cloud(source, "world")
    points = point_filter(project_to_image(dataset, cloud, source, camera, colors=False))
    values, limits, colormap = points.depth, _DEPTH_LIMITS_M, DEPTH_COLORMAP
    if color_by == "height":
        sample = dataset.get("sample_data", camera)["sample_token"]
        ego_from_world = dataset.world_from(sample, "ego").inverse()
        values = ego_from_world.apply(cloud.xyz)[:, 2]
        limits, colormap = _HEIGHT_LIMITS_M, HEIGHT_COLORMAP
    collection = _draw_values(points, values, limits, colormap, ax)
    ax.figure.colorbar(collection, ax=ax, label=f"{color_by} (m)", fraction=0.03, pad=0.01)


def _draw_values(
    points: ImagePoints, values: FloatArray, limits: tuple[float, float], colormap: str, ax: Axes
) -> PathCollection:
    """Draw points coloured by one value each, shape (P,), the far points first."""
    visible = np.flatnonzero(points.mask)
    rows = visible[np.argsort(-points.depth[visible])]
    low, high = limits
    return draw_points_in_image(
        points.pixels[rows], ax, c=values[rows], cmap=colormap, vmin=low, vmax=high
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class BestView:
    """The image in which some boxes are largest, even if other things hide them.

    Attributes:
        camera: Token of the image (sample data).
        total_share: Sum of the shares of the boxes in the image, rounded to hundredths.
        area: Area that their bounds cover, pixels² of the image.
        bounds: Left, top, right and bottom of their parts in the image, pixels.
    """

    camera: str
    total_share: float
    area: float
    bounds: tuple[float, float, float, float]


def best_view(
    dataset: Dataset, samples: Iterable[str], boxes: Boxes, channels: Sequence[str] = CAMERAS
) -> BestView | None:
    """Return the view that shows most of some boxes in world, and of equal views the largest.

    The samples, by token, are of the boxes' moment. A view without a downloaded image only counts
    if there is no other. None if no camera has any part of a box in its image.
    """
    views = []
    for sample in samples:
        for channel in channels:
            view = _view(dataset, f"{sample}/{channel}", boxes)
            if view is not None:
                views.append(view)

    def quality(view: BestView) -> tuple[bool, float, float]:
        return has_sensor_file(dataset, view.camera), view.total_share, view.area

    return max(views, key=quality, default=None)


def _view(dataset: Dataset, camera: str, boxes: Boxes) -> BestView | None:
    sample, channel = camera.rsplit("/", 1)
    lens = camera_of(dataset, camera)
    optical = boxes.transform(dataset.world_from(sample, channel).inverse(), channel)
    shares = _shares_in_image(optical, lens)
    in_image = shares > 0
    if not in_image.any():
        return None
    bounds = bounds_in_image(optical.select(in_image), lens)
    left, top = bounds[:, :2].min(axis=0).tolist()
    right, bottom = bounds[:, 2:].max(axis=0).tolist()
    sizes = bounds[:, 2:] - bounds[:, :2]
    return BestView(
        camera=camera,
        total_share=round(float(shares.sum()), 2),
        area=float(sizes.prod(axis=1).sum()),
        bounds=(left, top, right, bottom),
    )


def _shares_in_image(optical: Boxes, lens: PinholeCamera) -> FloatArray:
    """Return the share of the volume of each box of the camera's frame in its image, shape (N,)."""
    points = _CORNER_WEIGHTS @ optical.corners()
    pixels, depth = lens.project(points.reshape(-1, 3))
    in_image = lens.in_image(pixels, depth, min_depth=IN_FRONT_DEPTH)
    return as_floats(in_image.reshape(points.shape[:2]).mean(axis=1))


def crop_about(
    bounds: tuple[float, float, float, float], *, width: int, height: int, share: float = 0.25
) -> tuple[float, float, float, float]:
    """Return left, top, right and bottom of the part of an image around bounds (pixels).

    The part has the image's shape, and the bounds in its middle. If possible it is twice as wide
    and high as the bounds, and at least a `share` of the image.
    """
    left, top, right, bottom = bounds
    scale = min(1.0, max(share, 2 * (right - left) / width, 2 * (bottom - top) / height))
    half_width, half_height = scale * width / 2, scale * height / 2
    u = min(max((left + right) / 2, half_width), width - half_width)
    v = min(max((top + bottom) / 2, half_height), height - half_height)
    return u - half_width, v - half_height, u + half_width, v + half_height
