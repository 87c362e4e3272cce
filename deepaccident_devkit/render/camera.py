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
from deepaccident_devkit.geometry import Boxes, LidarPointCloud, PinholeCamera
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
    draw_legend_outside,
    draw_missing_image,
    has_cloud,
    has_sensor_file,
    is_callers,
    missing_clouds_text,
    moment_words,
    set_scene_title,
    write_missing,
)
from deepaccident_devkit.render.figures import (
    Layer,
    Layers,
    axes_or_new,
    layers_of,
    width_to_height,
)
from deepaccident_devkit.render.hidden import hidden_points_filter
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    DEPTH_COLORMAP,
    HEIGHT_COLORMAP,
    in_own_settings,
)
from deepaccident_devkit.support.arrays import FloatArray, as_floats
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import CAMERAS, LIDAR, OWN_ACTOR_ID, short_name
from deepaccident_devkit.v2x import map_pointcloud_to_image, project_to_image
from deepaccident_devkit.v2x.poses import ImagePoints, camera_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection

    from deepaccident_devkit.tables.records import SampleRecord

_LATTICE = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 3), axis=-1).reshape(-1, 1, 3)
# Weights of a box's corners that give 125 points spread evenly over the box, shape (125, 8).
_CORNER_WEIGHTS = ((1 + CORNER_SIGNS * _LATTICE) / 2).prod(axis=2)
CAMERA_LAYERS: Final[Layers] = ("image", "points", "boxes", "ids", "velocities")
CAMERA_DEFAULT: Final[Layers] = ("image", "boxes")
# Function that removes hidden points from the mask of visible points.
_PointFilter = Callable[[ImagePoints], ImagePoints]
ColorBy = Literal["depth", "height", "agent"]
# Metres from the camera at which the colours of depth begin and end.
_DEPTH_LIMITS_M = (0.0, 50.0)
# Metres above the origin of the camera's agent at which the colours of height begin and end.
_HEIGHT_LIMITS_M = (-1.0, 6.0)


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
        layers: For a camera, any of `image`, `points` (of the agent's LiDAR, coloured by depth up
            to 50 m), `boxes` (the ones that any of the agent's cameras sees, except its own box),
            `ids` and `velocities` (a line to the position in 1 s); by default image and boxes. For
            the LiDAR and the BEV camera, the layers of `render_bev`: by default points and boxes,
            in the LiDAR's frame, or the picture and boxes, in the ego frame.
        ax: Axes to render on, new ones if None. In a figure of your own, the title is yours.

    Returns:
        The axes: pixels for a camera, metres for other sensors.

    Raises:
        TokenError: No such sensor file.
        ChoiceError: The sensor has no such layer.
        MissingFileError: There is nothing to render: all layers need files, and none was
            downloaded. If other layers are rendered, a grey panel replaces a missing image, and
            words replace missing points.
    """
    record = dataset.get("sample_data", sample_data)
    is_camera = record["modality"] == "camera"
    if is_camera:
        shown_layers = layers_of(layers, CAMERA_DEFAULT, CAMERA_LAYERS)
        _check_files(dataset, record, shown_layers)
        ax = axes_or_new(ax, (8, 5.4))
        handles = box_handles((), draw_camera(dataset, record, shown_layers, ax))
    else:
        source: Layer = "bev"
        frame = "ego"
        if record["channel"] == LIDAR:
            source = "points"
            frame = "lidar"
        shown_layers = layers_of(layers, (source, "boxes", "grid"), BEV_LAYERS)
        view = BevView(frame=frame, wide=width_to_height(ax))
        ax = axes_or_new(ax, (6, 7.2), is_map=True)
        colors, _ = draw_bev(dataset, record["sample_token"], view, shown_layers, ax)
        handles = box_handles(colors)
    set_scene_title(ax, dataset, record["token"], camera_name(record["channel"]))
    draw_legend_outside(ax, handles)
    return ax


def _check_files(dataset: Dataset, record: Any, layers: frozenset[Layer]) -> None:
    """Raise MissingFileError if all of a camera's layers need files, and none is present."""
    present = {
        "image": has_sensor_file(dataset, record["token"]),
        "points": has_cloud(dataset, record["sample_token"]),
    }
    if layers and not any(present.get(layer, True) for layer in layers):
        raise MissingFileError(
            f"{dataset.sensor_path(record)}: no such file, and nothing else to render; "
            "unpack the archive that contains it, or choose other layers, such as boxes"
        )


def draw_camera(
    dataset: Dataset, record: Any, layers: Collection[Layer], ax: Axes
) -> frozenset[str]:
    """Render the camera panel of `render_sample_data`, and return the colours of its boxes."""
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
    """Render a camera's image without ticks, in pixels of its intrinsics.

    If `image` is False, the panel stays empty. If the image was not downloaded, the panel is grey
    and states the reason. All pictures render their camera images with this function.
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
    )
    if not is_callers(ax):
        ax.set_title(camera_name(camera["channel"]))
    for scale in (ax.xaxis, ax.yaxis, *ax.spines.values()):
        scale.set_visible(False)


def draw_points_in_image(
    pixels: FloatArray, ax: Axes, *, size: float = 2.0, **colors: Any
) -> PathCollection:
    """Render points at pixels (P, 2: u, v); `size` is their area in points².

    `colors` is either one `color`, or values `c` and a `cmap`.
    """
    u, v = pixels.T
    return ax.scatter(u, v, s=size, linewidths=0, rasterized=True, **colors)


def draw_camera_boxes(
    dataset: Dataset, camera: Any, boxes: Boxes, layers: Collection[Layer], ax: Axes
) -> frozenset[str]:
    """Render the layers that show boxes, and return the colours of the boxes in the image.

    Args:
        dataset: The release.
        camera: Record of the image (sample data).
        boxes: Boxes in the optical frame of the camera.
        layers: The layers `boxes`, `velocities` and `ids`; others are ignored.
        ax: Axes of the image.
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

    Points of other agents are left out where the cloud of the camera's agent has something in front
    of them (`render.hidden`).

    Args:
        dataset: The release.
        camera: Token or record of the image (sample data).
        sample: Token or record of the sample whose points are shown; it may be of any agent and
            frame of the scenario. Default: the camera's own sample or, with `color_by="agent"`, the
            samples of all agents in the same frame.
        color_by: `depth` along the camera's axis, up to 50 m; `height` above the ground under the
            camera's agent; or `agent`, one colour for each agent.
        ax: Axes to render on, new ones if None. In a figure of your own, the title is yours.

    Returns:
        The axes, in pixels.

    Raises:
        TokenError: No such sample or sensor file.
        ChoiceError: The sensor is not a camera, the image and the sample are of different
            scenarios, or `color_by` is unknown.
        MissingFileError: Neither the image nor a cloud was downloaded. If only one of them is
            missing, the picture mentions it in words.
    """
    color_by = choice("color_by", color_by, get_args(ColorBy))
    record = dataset.get("sample_data", camera)
    own_sample = dataset.sample.get(record["sample_token"])
    if sample is not None:
        sources = [dataset.sample[dataset.getind("sample", sample)]]
        source_words = f"LiDAR: {moment_words(dataset, sources[0]['token'])}"
    elif color_by == "agent":
        sources = dataset.samples_of(own_sample["frame_token"])
        source_words = "all agents' LiDARs"
    else:
        sources = [own_sample]
        source_words = f"{short_name(own_sample['agent'])}'s LiDAR"
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
    point_filter: _PointFilter | None = None  # the camera's own cloud hides nothing of itself
    if any(source["token"] != own_sample["token"] for source in sources):
        point_filter = hidden_points_filter(dataset, record)
    if color_by == "agent":
        for source in sources:
            cloud = dataset.load_point_cloud(source, "lidar")
            points = _project(dataset, cloud, source, record, point_filter)
            agent_color = AGENT_COLORS[source["agent"]]
            draw_points_in_image(points.pixels[points.mask], ax, color=agent_color)
        handles = agent_handles([source["agent"] for source in sources])
        draw_legend_outside(ax, handles)
    elif sources:
        _draw_colored_points(dataset, sources[0], record, point_filter, color_by, ax)
    name = camera_name(record["channel"])
    set_scene_title(ax, dataset, record["token"], name, below=source_words)
    return ax


def _project(
    dataset: Dataset,
    cloud: LidarPointCloud,
    source: SampleRecord,
    camera: RowArgument,
    point_filter: _PointFilter | None,
) -> ImagePoints:
    """Project a sample's cloud into an image, and remove hidden points if there is a filter."""
    points = project_to_image(dataset, cloud, source, camera, colors=False)
    if point_filter is None:
        return points
    return point_filter(points)


def _draw_colored_points(
    dataset: Dataset,
    source: SampleRecord,
    camera: RowArgument,
    point_filter: _PointFilter | None,
    color_by: Literal["depth", "height"],
    ax: Axes,
) -> None:
    """Draw points coloured by depth or height, and a colour bar."""
    cloud = dataset.load_point_cloud(source, "world")
    points = _project(dataset, cloud, source, camera, point_filter)
    values = points.depth
    limits = _DEPTH_LIMITS_M
    colormap = DEPTH_COLORMAP
    if color_by == "height":
        sample = dataset.get("sample_data", camera)["sample_token"]
        ego_from_world = dataset.world_from(sample, "ego").inverse()
        values = ego_from_world.apply(cloud.xyz)[:, 2]
        limits = _HEIGHT_LIMITS_M
        colormap = HEIGHT_COLORMAP
    collection = _draw_values(points, values, limits, colormap, ax)
    bar_ax = ax.inset_axes((1.01, 0, 0.02, 1))  # as high as the image
    extend: Any = "max" if color_by == "depth" else "both"
    ax.figure.colorbar(collection, cax=bar_ax, label=f"{color_by} (m)", extend=extend)


def _draw_values(
    points: ImagePoints, values: FloatArray, limits: tuple[float, float], colormap: str, ax: Axes
) -> PathCollection:
    """Draw points coloured by their values, shape (P,); the most distant are drawn first."""
    visible_rows = np.flatnonzero(points.mask)
    visible_depth = points.depth[visible_rows]
    farthest_first = np.argsort(-visible_depth)
    rows = visible_rows[farthest_first]
    low, high = limits
    return draw_points_in_image(
        points.pixels[rows], ax, c=values[rows], cmap=colormap, vmin=low, vmax=high
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class BestView:
    """The image in which some boxes are largest, even if other things hide them.

    Attributes:
        camera: Token of the image (sample data).
        total_share: Sum over the boxes of the share of each that is in the image, rounded to
            hundredths.
        area: Area of `bounds`, pixels².
        bounds: Left, top, right and bottom of the visible parts of all boxes, pixels.
    """

    camera: str
    total_share: float
    area: float
    bounds: tuple[float, float, float, float]


def best_view(
    dataset: Dataset, samples: Iterable[str], boxes: Boxes, channels: Sequence[str] = CAMERAS
) -> BestView | None:
    """Return the view that shows most of some boxes; ties go to the one that shows them largest.

    A view without a downloaded image only counts if there is no other.

    Args:
        dataset: The release.
        samples: Tokens of the samples whose cameras to choose from, in the frame of the boxes.
        boxes: Boxes in the world frame.
        channels: Cameras to choose from.

    Returns:
        The view; None if no camera has any part of a box in its image.
    """
    views = []
    for sample in samples:
        for channel in channels:
            view = _view(dataset, f"{sample}/{channel}", boxes)
            if view is not None:
                views.append(view)

    def quality(view: BestView) -> tuple[bool, float, float]:
        has_image = has_sensor_file(dataset, view.camera)
        return has_image, view.total_share, view.area

    return max(views, key=quality, default=None)


def _view(dataset: Dataset, camera: str, boxes: Boxes) -> BestView | None:
    """Return an image's view of boxes in the world frame; None if no part of them is in it."""
    sample, channel = camera.rsplit("/", 1)
    lens = camera_of(dataset, camera)
    optical_from_world = dataset.world_from(sample, channel).inverse()
    optical = boxes.transform(optical_from_world, channel)
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
    """Return the share of each box's volume that is in the image, shape (N,).

    Boxes are in the optical frame.
    """
    points = _CORNER_WEIGHTS @ optical.corners()
    box_count, point_count, _ = points.shape
    pixels, depth = lens.project(points.reshape(-1, 3))
    in_image = lens.in_image(pixels, depth, min_depth=IN_FRONT_DEPTH)
    return as_floats(in_image.reshape(box_count, point_count).mean(axis=1))


def crop_about(
    bounds: tuple[float, float, float, float], *, width: int, height: int, share: float = 0.25
) -> tuple[float, float, float, float]:
    """Return left, top, right and bottom of a crop of an image around bounds, all in pixels.

    The crop has the image's aspect ratio, and is centred on the bounds if possible. It is at least
    twice as wide and high as the bounds, and at least `share` of the image's width, but never
    larger than the image.
    """
    left, top, right, bottom = bounds
    width_share = 2 * (right - left) / width
    height_share = 2 * (bottom - top) / height
    scale = min(1.0, max(share, width_share, height_share))
    half_width = scale * width / 2
    half_height = scale * height / 2
    u = max((left + right) / 2, half_width)
    u = min(u, width - half_width)
    v = max((top + bottom) / 2, half_height)
    v = min(v, height - half_height)
    return u - half_width, v - half_height, u + half_width, v + half_height
