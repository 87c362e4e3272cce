"""Several panels of one moment: of all sensors, of all agents, and proofs of the transforms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.geometry import Boxes, LidarPointCloud
from deepaccident_devkit.render.bev import BEV_DEFAULT, BEV_LAYERS, BevView, draw_bev
from deepaccident_devkit.render.boxes import in_drawing_order, simultaneous_sample
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
    handles_from_above,
    has_cloud,
    missing_clouds_text,
    set_scene_title,
    write_missing,
)
from deepaccident_devkit.render.figures import LAYERS, Layer, figure_or_new, hide_axes, layers_of
from deepaccident_devkit.render.hidden import hiding
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    current_style,
    in_own_settings,
    text_size,
)
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
# The same in a figure of about 16 to 9.
_TALL_GRID: Final = (
    ("Camera_Front", "Camera_Back"),
    ("Camera_FrontLeft", "Camera_FrontRight"),
    ("Camera_BackLeft", "Camera_BackRight"),
)
# Least width by height of a figure in which three cameras and a view from above fit side by side.
_MIN_WIDE_RATIO: Final = 2.1
# Metres of a view that agents share: its least range, and its margin around them.
_MIN_SHARED_RANGE_M, _SHARED_MARGIN_M = 30.0, 12.0
# Maximum share of the width for cameras beside a shared view.
_MAX_CAMERAS_SHARE: Final = 0.66
# Inches of words above and below panels, beside them, and of a panel's title, for letters of one
# point.
_WORDS_HEIGHT_IN, _WORDS_WIDTH_IN, _TITLE_HEIGHT_IN = 0.178, 0.08, 0.02
# Maximum width by height of a view that agents share.
_MAX_SHARED_RATIO: Final = 2.2
MOMENT_LAYERS: Final = tuple(layer for layer in LAYERS if layer in {*CAMERA_LAYERS, *BEV_LAYERS})
CALIBRATION_LAYERS: Final[tuple[Layer, ...]] = ("image", "points", "boxes", "ids")
_DEFAULT_CALIBRATION_LAYERS: Final[tuple[Layer, ...]] = ("image", "points", "boxes")
# Metres from the camera up to which boxes are rendered: more distant ones are as small as the
# errors to be found.
_MAX_BOX_DISTANCE_M: Final = 60.0
_COLUMN_COUNT: Final = 3


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
        agents: Agents with points and boxes from above (`render_bev`); by default only the sample's
            own agent.
        layers: Each panel renders the layers that it has: cameras as in `render_sample_data`, the
            panel from above as in `render_bev`. By default each panel has its own default.
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
    for channel in CAMERAS:
        camera = dataset.get("sample_data", f"{record['token']}/{channel}")
        draw_camera(dataset, camera, camera_layers, axes[channel])
    view = BevView(agents=names, link=link)
    colors, cloud_agents = draw_bev(dataset, record, view, bev_layers, axes["bev"])
    draw_legend(fig, handles_from_above(colors, cloud_agents))
    set_scene_title(fig, dataset, record["token"])
    return fig


def _sample_panels(fig: Figure) -> dict[str, Axes]:
    """Return the axes of the six cameras by channel, and of the view from above as `bev`."""
    width, height = fig.bbox.size
    if height > width:
        mosaic: list[Any] = [*map(list, CAMERA_GRID), ["bev"] * 3]
        return fig.subplot_mosaic(mosaic, height_ratios=(1, 1, 16 / 3))
    grid: Any = _TALL_GRID
    ratios: tuple[float, ...] = (4, 4, 8)
    if width > _MIN_WIDE_RATIO * height:
        grid, ratios = CAMERA_GRID, (4, 4, 4, 4.5)
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
    """Render the front views of a moment's agents beside one view from above, in world.

    The colliding pair is red, other recording vehicles have their agents' hues, and the remaining
    actors a shade for their category.

    Args:
        dataset: The release.
        frame: Token or record.
        agents: Agents, or None for all present ones; a configuration is from the view of the first
            present agent. Their order is always that of `taxonomy.AGENTS`.
        layers: Each panel renders the layers that it has: cameras as in `render_sample_data`, the
            panel from above as in `render_bev`. By default each panel has its own default.
        fig: Empty figure to render on; a new one if None. The view from above is as wide as the
            agents need, and in a figure that is higher than wide below the cameras.

    Returns:
        The figure. An image that was not downloaded is a grey panel.

    Raises:
        TokenError: No such frame.
        ChoiceError: No such layer, agent or configuration.
        NotAvailableError: An agent is not in this (partial) release.
    """
    names = cooperating_agents(dataset, dataset.samples_of(dataset.get("frame", frame))[0], agents)
    panel_layers(layers)  # refused before a figure is made
    fig = figure_or_new(fig, (14.5, 6.0), page=0.62, column=1.5)
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
    """Render the front views of agents beside one view from above that they share, in world.

    The view is as wide as they need. The figure is an empty one of about 16 to 9, or wider.
    """
    camera_layers, bev_layers = panel_layers(layers)
    record = dataset.get("frame", frame)
    names = in_drawing_order(agents)
    first_sample = dataset.samples_of(record)[0]
    samples = [simultaneous_sample(first_sample, agent) for agent in names]
    bev_ax, wide, camera_axes = _moment_panels(fig, len(names))
    for agent, sample, ax in zip(names, samples, camera_axes, strict=True):
        camera = dataset.get("sample_data", f"{sample}/Camera_Front")
        draw_camera(dataset, camera, camera_layers, ax)
        ax.set_title(short_name(agent), fontsize="medium")
    positions = np.array([dataset.world_from(sample, "ego").translation[:2] for sample in samples])
    low, high = positions.min(axis=0), positions.max(axis=0)
    view_range = float((high - low).max()) / 2 + _SHARED_MARGIN_M
    x, y = ((low + high) / 2).tolist()
    view = BevView(
        view_range=max(_MIN_SHARED_RANGE_M, view_range),
        frame="world",
        agents=tuple(names),
        center=(x, y),
        wide=wide,
    )
    colors, cloud_agents = draw_bev(dataset, samples[0], view, bev_layers, bev_ax)
    bev_ax.set_anchor("C")
    draw_legend(fig, handles_from_above(colors, cloud_agents))
    set_scene_title(fig, dataset, record["token"])


def panel_layers(layers: Iterable[Layer] | None) -> tuple[frozenset[Layer], frozenset[Layer]]:
    """Return the requested layers of the cameras, and of the panels from above.

    Raises ChoiceError.
    """
    if layers is None:
        return frozenset(CAMERA_DEFAULT), frozenset(BEV_DEFAULT)
    requested = layers_of(layers, (), MOMENT_LAYERS)
    return requested.intersection(CAMERA_LAYERS), requested.intersection(BEV_LAYERS)


def _moment_panels(fig: Figure, agents: int) -> tuple[Axes, float, list[Axes]]:
    """Return the panel from above, its width by height, and one for each agent's camera beside it.

    In a figure that is higher than wide, and in a paper, cameras are above it.
    """
    width, height = fig.bbox.width / fig.dpi, fig.bbox.height / fig.dpi
    bev_height = height - _WORDS_HEIGHT_IN * text_size()
    if height > width or current_style().room == "page":
        columns = agents if width > height else min(_COLUMN_COUNT, agents)
        rows = -(-agents // columns)
        camera_height = width / columns * 9 / 16
        bev_height -= rows * (camera_height + _TITLE_HEIGHT_IN * text_size())
        height_ratios = (*[camera_height] * rows, bev_height)
        grid = fig.add_gridspec(rows + 1, columns, height_ratios=height_ratios)
        camera_axes = _filled_grid(fig, grid, agents, first_column=0)
        bev_ax, bev_width = fig.add_subplot(grid[rows, :]), width
    else:
        rows = min(2 if width > _MIN_WIDE_RATIO * height else 3, agents)
        columns = -(-agents // rows)
        cameras_width = min(columns * bev_height / rows * 16 / 9, _MAX_CAMERAS_SHARE * width)
        bev_width = width - cameras_width
        width_ratios = (bev_width, *[cameras_width / columns] * columns)
        grid = fig.add_gridspec(rows, columns + 1, width_ratios=width_ratios)
        camera_axes = _filled_grid(fig, grid, agents, first_column=1)
        bev_ax = fig.add_subplot(grid[:, 0])
    ratio = max(1.0, (bev_width - _WORDS_WIDTH_IN * text_size()) / bev_height)
    return bev_ax, min(ratio, _MAX_SHARED_RATIO), camera_axes


def _filled_grid(fig: Figure, grid: Any, count: int, *, first_column: int) -> list[Axes]:
    """Return `count` axes in a grid, from a first column on, row by row."""
    columns = grid.ncols - first_column
    axes = []
    for number in range(count):
        row, column = divmod(number, columns)
        axes.append(fig.add_subplot(grid[row, first_column + column]))
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
    """Render all agents' LiDAR points and boxes in camera images, to prove the calibration.

    Each agent's points have its colour. If the transforms are right, they lie on the kerbs, walls
    and cars of the image. If an agent's pose or a sensor's pose is wrong, all points of its colour
    are displaced. Points of other agents are left out where the camera's own cloud has something in
    front of them (`render.hidden`); boxes are rendered even if other things hide them.

    Args:
        dataset: The release.
        frame_or_sample: Token or record: a sample shows its six cameras, a frame the front cameras
            of the agents.
        agents: Agents with points and boxes (and, for a frame, cameras); None for all present
            agents.
        layers: Some of `image`, `points`, `boxes` (up to 60 m) and `ids`; by default all except
            ids.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure, three panels in a row. An image that was not downloaded is a grey panel; the
        title names the agents without downloaded points.

    Raises:
        TokenError: No such sample or frame.
        ChoiceError: No such layer, agent or configuration.
        NotAvailableError: An agent is not in this (partial) release.
    """
    shown_layers = layers_of(layers, _DEFAULT_CALIBRATION_LAYERS, CALIBRATION_LAYERS)
    sample, is_frame = _present_sample(dataset, frame_or_sample)
    names = in_drawing_order(cooperating_agents(dataset, sample, agents))
    record = dataset.get("sample", sample)
    cameras = [f"{sample}/{channel}" for row in CAMERA_GRID for channel in row]
    title_token = record["token"]
    if is_frame:
        cameras = [f"{simultaneous_sample(record, agent)}/Camera_Front" for agent in names]
        title_token = record["frame_token"]
    clouds: dict[str, LidarPointCloud] = {}
    missing_agents: list[str] = []
    if "points" in shown_layers:
        clouds, missing_agents = _clouds(dataset, record, names)
    boxes = cooperative_boxes(dataset, sample, agents=names)
    fig, axes = _calibration_panels(fig, len(cameras))
    for camera, ax in zip(cameras, axes.flat, strict=False):
        _draw_panel(dataset, camera, clouds, boxes, shown_layers, ax)
        if is_frame:
            ax.set_title(f"{short_name(camera.rsplit('/', 3)[1])}, front")
    if len(cameras) < axes.size:
        draw_legend(axes.flat[-1], agent_handles(clouds), columns=1, loc="center")
    else:
        draw_legend(fig, agent_handles(clouds))
    write_missing(axes[0, 0], missing_clouds_text(missing_agents))
    owner = "each agent" if len(names) > 1 else short_name(names[0])
    set_scene_title(fig, dataset, title_token, f"LiDAR of {owner}")
    return fig


def _clouds(
    dataset: Dataset, record: Mapping[str, Any], agents: Sequence[str]
) -> tuple[dict[str, LidarPointCloud], list[str]]:
    """Return the clouds of agents at a sample's moment, and the agents without a file."""
    clouds, missing_agents = {}, []
    for agent in agents:
        sample = simultaneous_sample(record, agent)
        if has_cloud(dataset, sample):
            clouds[agent] = dataset.load_point_cloud(sample)
        else:
            missing_agents.append(agent)
    return clouds, missing_agents


def _calibration_panels(fig: Figure | None, cameras: int) -> tuple[Figure, Any]:
    columns = 2 if current_style().room == "column" else _COLUMN_COUNT
    rows = -(-cameras // columns)
    size = (15, 3.1 * rows + 0.8)
    fig = figure_or_new(fig, size, page=0.2 * rows + 0.06, column=0.33 * rows + 0.12)
    axes = fig.subplots(rows, min(columns, cameras), squeeze=False)
    hide_axes(axes.flat[cameras:])
    return fig, axes


def _present_sample(dataset: Dataset, row: RowArgument) -> tuple[str, bool]:
    """Return the token of a sample, or of a frame's first one, and whether it is a frame."""
    try:
        return dataset.get("sample", row)["token"], False
    except TokenError:
        return dataset.samples_of(row)[0]["token"], True


def _draw_panel(
    dataset: Dataset,
    camera: str,
    clouds: dict[str, LidarPointCloud],
    boxes: Boxes,
    layers: frozenset[Layer],
    ax: Axes,
) -> None:
    record = dataset.get("sample_data", camera)
    sample, channel = dataset.get("sample", record["sample_token"]), record["channel"]
    draw_image(dataset, record, ax, image="image" in layers)
    point_filter = hiding(dataset, record)
    for agent, cloud in clouds.items():
        points = point_filter(project_to_image(dataset, cloud, sample, record, colors=False))
        draw_points_in_image(points.pixels[points.mask], ax, size=1.2, color=AGENT_COLORS[agent])
    own_actor = dataset.get("agent", sample["agent_token"])["actor_id"]
    optical = boxes.transform(dataset.world_from(sample, channel).inverse(), channel)
    is_near = np.linalg.norm(optical.center, axis=1) < _MAX_BOX_DISTANCE_M
    shown_boxes = optical.select(is_near & (optical.actor_id != own_actor))
    draw_camera_boxes(dataset, record, shown_boxes, layers, ax)
