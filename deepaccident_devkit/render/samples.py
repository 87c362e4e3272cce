"""Several panels of one moment: all sensors, all agents, and checks of the transforms."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.geometry import Boxes, LidarPointCloud
from deepaccident_devkit.render.bev import BEV_DEFAULT, BEV_LAYERS, BevView, draw_bev
from deepaccident_devkit.render.boxes import camera_name, in_drawing_order, simultaneous_sample
from deepaccident_devkit.render.camera import (
    CAMERA_DEFAULT,
    CAMERA_LAYERS,
    draw_camera,
    draw_camera_boxes,
    draw_image,
    draw_points_in_image,
)
from deepaccident_devkit.render.captions import (
    agent_handles,
    draw_legend,
    handles_of_scene,
    has_cloud,
    has_sensor_file,
    missing_clouds_text,
    set_scene_title,
    write_missing,
)
from deepaccident_devkit.render.figures import (
    LAYERS,
    Layer,
    Layers,
    figure_or_new,
    hide_axes,
    layers_of,
    square_around,
)
from deepaccident_devkit.render.hidden import hidden_points_filter
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.support.values import ReadOnlyValues
from deepaccident_devkit.taxonomy import CAMERAS, short_name
from deepaccident_devkit.v2x import (
    Agents,
    Link,
    cooperating_agents,
    cooperative_boxes,
    project_to_image,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The six cameras in a picture of all of them, by row.
CAMERA_GRID: Final = (
    ("Camera_FrontLeft", "Camera_Front", "Camera_FrontRight"),
    ("Camera_BackLeft", "Camera_Back", "Camera_BackRight"),
)
# The same in a figure of about 16:9.
TALL_CAMERA_GRID: Final = (
    ("Camera_FrontLeft", "Camera_BackLeft"),
    ("Camera_Front", "Camera_Back"),
    ("Camera_FrontRight", "Camera_BackRight"),
)
# Minimum width over height of a figure in which three cameras and a view from above fit in a row.
_MIN_WIDE_RATIO = 2.1
# Minimum range to each side of a view that agents share, and the margin around them, in metres.
_MIN_SHARED_RANGE_M = 30.0
_SHARED_MARGIN_M = 12.0
# Maximum share of a figure's width for cameras next to a shared view.
_MAX_CAMERAS_SHARE = 0.66
# Inches that words take above and below panels, next to them, and in a panel's title, per point of
# letter size.
_WORDS_HEIGHT_IN = 0.178
_WORDS_WIDTH_IN = 0.08
_TITLE_HEIGHT_IN = 0.02
# Maximum width over height of a view that agents share.
_MAX_SHARED_RATIO = 2.2
MOMENT_LAYERS: Final = tuple(layer for layer in LAYERS if layer in {*CAMERA_LAYERS, *BEV_LAYERS})
CALIBRATION_LAYERS: Final[Layers] = ("image", "points", "boxes", "ids")
_DEFAULT_CALIBRATION_LAYERS: Layers = ("image", "points", "boxes")
# Metres from the camera up to which boxes are rendered: more distant ones are no larger than the
# errors that the picture should reveal.
_MAX_BOX_DISTANCE_M = 60.0
_COLUMN_COUNT = 3


@in_own_settings
def render_sample(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = "single",
    layers: Iterable[Layer] | None = None,
    link: Link | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render a sample: its six cameras around the agent, and boxes and LiDAR from above.

    Args:
        dataset: The release.
        sample: Token or record.
        agents: Agents whose points and boxes the view from above shows, as in `render_bev`; by
            default only the sample's agent.
        layers: Each panel renders the layers that it supports: cameras as in
            `render_sample_data`, the view from above as in `render_bev`. None means each panel's
            default.
        link: Effects on the partners' data; None for none.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure. An image that was not downloaded is a grey panel.

    Raises:
        TokenError: No such sample.
        ChoiceError: No such layer, agent or configuration.
        NotAvailableError: An agent is not in this (partial) release.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
    """
    camera_layers, bev_layers = panel_layers(layers)
    record = dataset.get("sample", sample)
    names = cooperating_agents(dataset, record, agents)
    fig = figure_or_new(fig, (16, 5.6), page=0.42, column=1.6)
    axes = _sample_panels(fig)
    camera_colors: frozenset[str] = frozenset()
    for channel in CAMERAS:
        camera = dataset.get("sample_data", f"{record['token']}/{channel}")
        camera_colors |= draw_camera(dataset, camera, camera_layers, axes[channel])
    view = BevView(agents=names, link=link)
    colors, cloud_agents = draw_bev(dataset, record, view, bev_layers, axes["bev"])
    draw_legend(fig, handles_of_scene(colors, cloud_agents, camera_colors))
    set_scene_title(fig, dataset, record["token"])
    return fig


def _sample_panels(fig: Figure) -> dict[str, Axes]:
    """Make axes for the six cameras, by channel, and for the view from above, as `bev`."""
    width, height = fig.bbox.size
    if height > width:
        mosaic: list[Any] = [*map(list, CAMERA_GRID), ["bev"] * 3]
        return fig.subplot_mosaic(mosaic, height_ratios=(1, 1, 16 / 3))
    grid: Any = TALL_CAMERA_GRID
    ratios: tuple[float, ...] = (5, 5, 8)
    if width > _MIN_WIDE_RATIO * height:
        grid = CAMERA_GRID
        ratios = (4, 4, 4, 4.5)
    return fig.subplot_mosaic([[*row, "bev"] for row in grid], width_ratios=ratios)


@in_own_settings
def render_frame(
    dataset: Dataset,
    frame: RowArgument,
    *,
    agents: Agents = None,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render the agents' front cameras next to one view from above, in the world frame.

    The colliding pair is red, other recording vehicles have their agents' hues, and the remaining
    actors have a shade for their category.

    Args:
        dataset: The release.
        frame: Token or record.
        agents: Agents, or None for all present ones; the first present agent is the ego of a
            configuration. They are always shown in the order of `taxonomy.AGENTS`.
        layers: Each panel renders the layers that it supports: cameras as in
            `render_sample_data`, the view from above as in `render_bev`. None means each panel's
            default.
        fig: Empty figure to render on; a new one if None. The view from above is wide enough to
            show all agents; in a figure that is taller than wide, it is below the cameras.

    Returns:
        The figure. An image that was not downloaded is a grey panel.

    Raises:
        TokenError: No such frame.
        ChoiceError: No such layer, agent or configuration.
        NotAvailableError: An agent is not in this (partial) release.
    """
    first_sample = dataset.samples_of(dataset.get("frame", frame))[0]
    names = cooperating_agents(dataset, first_sample, agents)
    panel_layers(layers)  # refused before a figure is made
    fig = figure_or_new(fig, (14.5, 5.3), page=0.62, column=1.5)
    draw_shared_moment(dataset, frame, agents=names, layers=layers, fig=fig)
    return fig


def draw_shared_moment(
    dataset: Dataset,
    frame: RowArgument,
    *,
    agents: Sequence[str],
    layers: Iterable[Layer] | None,
    fig: Figure,
) -> None:
    """Render agents' front cameras next to a view from above that they share, in the world frame.

    The view is wide enough to show all agents. The figure must be empty, with an aspect ratio of
    about 16:9 or wider.
    """
    camera_layers, bev_layers = panel_layers(layers)
    record = dataset.get("frame", frame)
    names = in_drawing_order(agents)
    first_sample = dataset.samples_of(record)[0]
    samples = [simultaneous_sample(first_sample, agent) for agent in names]
    bev_ax, wide, camera_axes = _moment_panels(fig, len(names))
    camera_colors: frozenset[str] = frozenset()
    for agent, sample, ax in zip(names, samples, camera_axes, strict=True):
        camera = dataset.get("sample_data", f"{sample}/Camera_Front")
        camera_colors |= draw_camera(dataset, camera, camera_layers, ax)
        ax.set_title(short_name(agent), fontsize="medium")
    poses = [dataset.world_from(sample, "ego") for sample in samples]
    positions = np.array([pose.translation[:2] for pose in poses])
    center, view_range = square_around(positions, _SHARED_MARGIN_M)
    x, y = center.tolist()
    view = BevView(
        view_range=max(_MIN_SHARED_RANGE_M, view_range),
        frame="world",
        agents=tuple(names),
        center=(x, y),
        wide=wide,
    )
    colors, cloud_agents = draw_bev(dataset, samples[0], view, bev_layers, bev_ax)
    bev_ax.set_anchor("C")
    draw_legend(fig, handles_of_scene(colors, cloud_agents, camera_colors))
    set_scene_title(fig, dataset, record["token"])


def panel_layers(layers: Iterable[Layer] | None) -> tuple[frozenset[Layer], frozenset[Layer]]:
    """Split the requested layers into camera layers and layers of views from above.

    A layer may belong to both. Raises ChoiceError for a layer that neither of them supports.
    """
    if layers is None:
        return frozenset(CAMERA_DEFAULT), frozenset(BEV_DEFAULT)
    requested = layers_of(layers, (), MOMENT_LAYERS)
    return requested.intersection(CAMERA_LAYERS), requested.intersection(BEV_LAYERS)


def _moment_panels(fig: Figure, agents: int) -> tuple[Axes, float, list[Axes]]:
    """Make the panel from above and one for each agent's camera; also return width over height.

    The ratio describes the panel from above. Cameras are next to this panel; in a paper, or in a
    figure that is taller than wide, they are above it.
    """
    width = fig.bbox.width / fig.dpi
    height = fig.bbox.height / fig.dpi
    bev_width = width
    bev_height = height - _WORDS_HEIGHT_IN * text_size()
    if height > width or current_style().layout == "page":
        columns = agents if width > height else min(_COLUMN_COUNT, agents)
        rows = -(-agents // columns)
        camera_height = width / columns * 9 / 16
        title_height = _TITLE_HEIGHT_IN * text_size()
        bev_height -= rows * (camera_height + title_height)
        height_ratios = (*[camera_height] * rows, bev_height)
        grid = fig.add_gridspec(rows + 1, 2 * columns, height_ratios=height_ratios)
        camera_axes = _fill_grid(fig, grid, agents, first_column=0)
        bev_ax = fig.add_subplot(grid[rows, :])
    else:
        max_rows = 2 if width > _MIN_WIDE_RATIO * height else 3
        rows = min(max_rows, agents)
        columns = -(-agents // rows)
        cameras_width = min(columns * bev_height / rows * 16 / 9, _MAX_CAMERAS_SHARE * width)
        bev_width -= cameras_width
        half_columns = 2 * columns
        width_ratios = (bev_width, *[cameras_width / half_columns] * half_columns)
        grid = fig.add_gridspec(rows, half_columns + 1, width_ratios=width_ratios)
        camera_axes = _fill_grid(fig, grid, agents, first_column=1)
        bev_ax = fig.add_subplot(grid[:, 0])
    ratio = (bev_width - _WORDS_WIDTH_IN * text_size()) / bev_height
    ratio = min(max(1.0, ratio), _MAX_SHARED_RATIO)
    return bev_ax, ratio, camera_axes


def _fill_grid(fig: Figure, grid: Any, count: int, *, first_column: int) -> list[Axes]:
    """Add `count` axes to a grid, row by row, each two columns wide; the last row is centred.

    Columns before `first_column` stay empty.
    """
    places = (grid.ncols - first_column) // 2
    axes = []
    for number in range(count):
        row, place = divmod(number, places)
        free_places = max(0, (row + 1) * places - count)
        column = first_column + free_places + 2 * place
        axes.append(fig.add_subplot(grid[row, column : column + 2]))
    return axes


@in_own_settings
def render_calibration(
    dataset: Dataset,
    frame_or_sample: RowArgument,
    *,
    agents: Agents = None,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render all agents' LiDAR points and boxes in camera images, to check the calibration.

    Each agent's points have its colour. If the transforms are right, the points lie on the kerbs,
    walls and cars in the image. If an agent's pose or a sensor's pose is wrong, all points of that
    agent's colour are displaced. Points of other agents are left out where the cloud of the
    camera's agent has something in front of them (`render.hidden`). Boxes are rendered even if
    they are occluded.

    Args:
        dataset: The release.
        frame_or_sample: Token or record. For a sample, its six cameras are shown; for a frame, the
            front cameras of the agents, or if only one of them has an image, this agent's six.
        agents: Agents whose points and boxes (and, for a frame, cameras) are shown; None for all
            present agents.
        layers: Any of `image`, `points`, `boxes` (up to 60 m) and `ids`; by default all except
            ids.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure, with three panels in each row. An image that was not downloaded is a grey panel;
        the title names the agents whose points were not downloaded.

    Raises:
        TokenError: No such sample or frame.
        ChoiceError: No such layer, agent or configuration.
        NotAvailableError: An agent is not in this (partial) release.
    """
    shown_layers = layers_of(layers, _DEFAULT_CALIBRATION_LAYERS, CALIBRATION_LAYERS)
    is_frame = False
    try:
        sample = dataset.get("sample", frame_or_sample)["token"]
    except TokenError:
        sample = dataset.samples_of(frame_or_sample)[0]["token"]
        is_frame = True
    names = in_drawing_order(cooperating_agents(dataset, sample, agents))
    record = dataset.get("sample", sample)
    cameras = [f"{sample}/{channel}" for row in CAMERA_GRID for channel in row]
    title_token = record["token"]
    if is_frame:
        samples = [simultaneous_sample(record, agent) for agent in names]
        front_cameras = [f"{each}/Camera_Front" for each in samples]
        with_image = [camera for camera in front_cameras if has_sensor_file(dataset, camera)]
        title_token = record["frame_token"]
        cameras = front_cameras
        if len(with_image) == 1:
            pictured_sample = with_image[0].rsplit("/", 1)[0]
            cameras = [f"{pictured_sample}/{channel}" for row in CAMERA_GRID for channel in row]
    clouds: dict[str, LidarPointCloud] = {}
    missing_agents: list[str] = []
    if "points" in shown_layers:
        clouds, missing_agents = _load_clouds(dataset, record, names)
    boxes = cooperative_boxes(dataset, sample, agents=names)
    columns = 2 if current_style().layout == "column" else _COLUMN_COUNT
    rows = -(-len(cameras) // columns)
    page_height = 0.2 * rows + 0.06
    column_height = 0.33 * rows + 0.12
    fig = figure_or_new(fig, (15, 3.1 * rows + 0.8), page=page_height, column=column_height)
    axes = fig.subplots(rows, min(columns, len(cameras)), squeeze=False)
    hide_axes(axes.flat[len(cameras) :])
    for camera, ax in zip(cameras, axes.flat, strict=False):
        _draw_panel(dataset, camera, clouds, boxes, shown_layers, ax)
        if is_frame:
            agent, _, channel = camera.rsplit("/", 3)[1:]
            ax.set_title(f"{short_name(agent)}, {camera_name(channel)}")
    if len(cameras) < axes.size:
        draw_legend(axes.flat[-1], agent_handles(clouds), columns=1, loc="center")
    else:
        draw_legend(fig, agent_handles(clouds))
    write_missing(axes[0, 0], missing_clouds_text(missing_agents))
    owner = "each agent" if len(names) > 1 else short_name(names[0])
    set_scene_title(fig, dataset, title_token, f"LiDAR of {owner}")
    return fig


def _load_clouds(
    dataset: Dataset, record: ReadOnlyValues, agents: Sequence[str]
) -> tuple[dict[str, LidarPointCloud], list[str]]:
    """Load the agents' clouds in a sample's frame; also return the agents without a file."""
    clouds = {}
    missing_agents = []
    for agent in agents:
        sample = simultaneous_sample(record, agent)
        if has_cloud(dataset, sample):
            clouds[agent] = dataset.load_point_cloud(sample)
        else:
            missing_agents.append(agent)
    return clouds, missing_agents


def _draw_panel(
    dataset: Dataset,
    camera: str,
    clouds: dict[str, LidarPointCloud],
    boxes: Boxes,
    layers: frozenset[Layer],
    ax: Axes,
) -> None:
    """Draw clouds (in their agents' frames) and boxes (in world) in a camera's image (a token)."""
    record = dataset.get("sample_data", camera)
    sample = dataset.get("sample", record["sample_token"])
    channel = record["channel"]
    draw_image(dataset, record, ax, image="image" in layers)
    point_filter = hidden_points_filter(dataset, record)
    for agent, cloud in clouds.items():
        points = point_filter(project_to_image(dataset, cloud, sample, record, colors=False))
        draw_points_in_image(points.pixels[points.mask], ax, size=1.2, color=AGENT_COLORS[agent])
    own_actor = dataset.get("agent", sample["agent_token"])["actor_id"]
    optical_from_world = dataset.world_from(sample, channel).inverse()
    optical = boxes.transform(optical_from_world, channel)
    is_near = np.linalg.norm(optical.center, axis=1) < _MAX_BOX_DISTANCE_M
    is_other = optical.actor_id != own_actor
    shown_boxes = optical.select(is_near & is_other)
    draw_camera_boxes(dataset, record, shown_boxes, layers, ax)
