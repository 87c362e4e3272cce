"""Several panels of one moment: of all sensors, of all agents, and such that prove the transforms."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.geometry import Boxes, LidarPointCloud
from deepaccident_devkit.render.bev import BEV_DEFAULT, BEV_LAYERS, BevView, draw_bev
from deepaccident_devkit.render.boxes import at_once, in_drawing_order
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
from deepaccident_devkit.render.figures import LAYERS, Layer, figure_or_new, layers_of
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

# The places of the six cameras in a picture of all of them.
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
# The least width by height of a figure with room for three cameras and a view from above side by side.
_WIDE: Final = 2.1
# Metres: the least reach of a view that agents share, and what it shows around them.
_LEAST_SHARED, _AROUND_SHARED = 30.0, 12.0
# Of the width, for cameras beside a shared view.
_MOST_CAMERAS: Final = 0.66
# Inches of room for words above and below panels, beside them, and for a panel's title, for letters of one point.
_ABOUT, _BESIDE, _TITLE = 0.178, 0.08, 0.02
# Width by height at most of a view that agents share.
_WIDEST: Final = 2.2
MOMENT_LAYERS: Final = tuple(layer for layer in LAYERS if layer in {*CAMERA_LAYERS, *BEV_LAYERS})
CALIBRATION_LAYERS: Final[tuple[Layer, ...]] = ("image", "points", "boxes", "ids")
_DEFAULT: Final[tuple[Layer, ...]] = ("image", "points", "boxes")
# Metres from the camera up to which boxes are rendered: farther ones are as small as the errors to be found.
_FARTHEST: Final = 60.0
_COLUMNS: Final = 3


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
    """Render a sample: its six cameras at their places around the agent, and boxes and LiDAR from above.

    Args:
        dataset: the release.
        sample: token or record.
        agents: whose points and boxes are rendered from above (`render_bev`); by default only the sample's own agent.
        layers: each panel renders those of them that it has: cameras have those of `render_sample_data`, the panel from
            above those of `render_bev`. By default each panel has its own default.
        link: what happens to the partners' data; None for nothing.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure. An image that was not downloaded is a grey panel.

    Raises:
        TokenError: no such sample.
        ChoiceError: no such layer, agent or configuration.
        NotAvailableError: an agent is not in this (partial) release.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
    """
    in_cameras, from_above = panel_layers(layers)
    record = dataset.get("sample", sample)
    names = cooperating_agents(dataset, record, agents)
    fig = figure_or_new(fig, (16, 5.6), page=0.42, column=1.6)
    width, height = fig.bbox.size
    if height > width:
        mosaic: list[Any] = [*map(list, CAMERA_GRID), ["bev"] * 3]
        axes = fig.subplot_mosaic(mosaic, height_ratios=(1, 1, 16 / 3))
    else:
        grid, ratios = (
            (CAMERA_GRID, (4, 4, 4, 4.5)) if width > _WIDE * height else (_TALL_GRID, (4, 4, 8))
        )
        axes = fig.subplot_mosaic([[*row, "bev"] for row in grid], width_ratios=ratios)
    for channel in CAMERAS:
        draw_camera(
            dataset,
            dataset.get("sample_data", f"{record['token']}/{channel}"),
            in_cameras,
            axes[channel],
        )
    shown = draw_bev(dataset, record, BevView(agents=names, link=link), from_above, axes["bev"])
    draw_legend(fig, handles_from_above(*shown))
    set_scene_title(fig, dataset, record["token"])
    return fig


@in_own_settings
def render_frame(
    dataset: Dataset,
    frame: RowArgument,
    *,
    agents: Agents = None,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render the front views of a moment's agents beside one view of all of them from above, in world.

    The colliding pair is red, other recording vehicles have their agents' hues, all others a shade for their category.

    Args:
        dataset: the release.
        frame: token or record.
        agents: which agents, or None for all that are there; a configuration is as seen from the first that is there.
            Their order is always that of `taxonomy.AGENTS`.
        layers: each panel renders those of them that it has: cameras have those of `render_sample_data`, the panel from
            above those of `render_bev`. By default each panel has its own default.
        fig: an empty figure to render on; a new one if None. The view from above is as wide as the agents need, and in
            a figure that is higher than wide below the cameras.

    Returns:
        The figure. An image that was not downloaded is a grey panel.

    Raises:
        TokenError: no such frame.
        ChoiceError: no such layer, agent or configuration.
        NotAvailableError: an agent is not in this (partial) release.
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
    """Render the front views of agents beside one view from above that they share, in world, as wide as they need.

    The figure is an empty one of about 16 to 9, or wider.
    """
    in_cameras, from_above = panel_layers(layers)
    record = dataset.get("frame", frame)
    names = in_drawing_order(agents)
    moments = [at_once(dataset.samples_of(record)[0], agent) for agent in names]
    above, wide, cameras = _moment_panels(fig, len(names))
    for agent, moment, ax in zip(names, moments, cameras, strict=True):
        draw_camera(dataset, dataset.get("sample_data", f"{moment}/Camera_Front"), in_cameras, ax)
        ax.set_title(short_name(agent), fontsize="medium")
    places = np.array([dataset.world_from(moment, "ego").translation[:2] for moment in moments])
    low, high = places.min(axis=0), places.max(axis=0)
    reach = max(_LEAST_SHARED, float((high - low).max()) / 2 + _AROUND_SHARED)
    x, y = ((low + high) / 2).tolist()
    view = BevView(view_range=reach, frame="world", agents=tuple(names), center=(x, y), wide=wide)
    shown = draw_bev(dataset, moments[0], view, from_above, above)
    above.set_anchor("C")
    draw_legend(fig, handles_from_above(*shown))
    set_scene_title(fig, dataset, record["token"])


def panel_layers(layers: Iterable[Layer] | None) -> tuple[frozenset[Layer], frozenset[Layer]]:
    """The requested layers of the cameras, and of the panels from above; raises ChoiceError."""
    if layers is None:
        return frozenset(CAMERA_DEFAULT), frozenset(BEV_DEFAULT)
    chosen = layers_of(layers, (), MOMENT_LAYERS)
    return chosen.intersection(CAMERA_LAYERS), chosen.intersection(BEV_LAYERS)


def _moment_panels(fig: Figure, agents: int) -> tuple[Axes, float, list[Axes]]:
    """The panel from above, how wide by high it is, and one for each agent's camera beside it.

    In a figure that is higher than wide, and in a paper, cameras are above it.
    """
    width, height = fig.bbox.width / fig.dpi, fig.bbox.height / fig.dpi
    room = height - _ABOUT * text_size()
    if height > width or current_style().room == "page":
        columns = agents if width > height else min(_COLUMNS, agents)
        rows = -(-agents // columns)
        room -= rows * (width / columns * 9 / 16 + _TITLE * text_size())
        tall = fig.add_gridspec(
            rows + 1, columns, height_ratios=(*[width / columns * 9 / 16] * rows, room)
        )
        cameras, above, broad = (
            _filled(fig, tall, agents, first=0),
            fig.add_subplot(tall[rows, :]),
            width,
        )
    else:
        rows = min(2 if width > _WIDE * height else 3, agents)
        columns = -(-agents // rows)
        share = min(columns * room / rows * 16 / 9, _MOST_CAMERAS * width)
        grid = fig.add_gridspec(
            rows, columns + 1, width_ratios=(width - share, *[share / columns] * columns)
        )
        cameras, above, broad = (
            _filled(fig, grid, agents, first=1),
            fig.add_subplot(grid[:, 0]),
            width - share,
        )
    return above, min(max(1.0, (broad - _BESIDE * text_size()) / room), _WIDEST), cameras


def _filled(fig: Figure, grid: Any, number: int, *, first: int) -> list[Axes]:
    """So many axes in a grid, from a first column on, row by row."""
    columns = grid.ncols - first
    return [
        fig.add_subplot(grid[each // columns, first + each % columns]) for each in range(number)
    ]


@in_own_settings
def render_calibration(
    dataset: Dataset,
    frame_or_sample: RowArgument,
    *,
    agents: Agents = None,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render the LiDAR points of all agents and all agents' boxes in camera images, to prove the calibration.

    Each agent's points have its colour. If the transforms are right, they lie on the kerbs, walls and cars of the
    image. If an agent's pose or a sensor's place is wrong, all points of its colour are in wrong places. Points of
    other agents are left out where the camera's own cloud has something in front of them (`render.hidden`); boxes are
    rendered even if other things hide them.

    Args:
        dataset: the release.
        frame_or_sample: token or record: a sample shows its six cameras, a frame the front cameras of the agents.
        agents: whose points and boxes (and, for a frame, whose cameras); None for all that are there.
        layers: some of `image`, `points`, `boxes` (up to 60 m) and `ids`; by default all except ids.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure, three panels in a row. An image that was not downloaded is a grey panel; the title names the agents
        whose points were not.

    Raises:
        TokenError: no such sample or frame.
        ChoiceError: no such layer, agent or configuration.
        NotAvailableError: an agent is not in this (partial) release.
    """
    chosen = layers_of(layers, _DEFAULT, CALIBRATION_LAYERS)
    sample, is_frame = _present(dataset, frame_or_sample)
    names = in_drawing_order(cooperating_agents(dataset, sample, agents))
    record = dataset.get("sample", sample)
    cameras = [f"{sample}/{channel}" for row in CAMERA_GRID for channel in row]
    if is_frame:
        cameras = [f"{at_once(record, agent)}/Camera_Front" for agent in names]
    lookers = names if "points" in chosen else []
    clouds = {
        agent: dataset.load_point_cloud(at_once(record, agent))
        for agent in lookers
        if has_cloud(dataset, at_once(record, agent))
    }
    boxes = cooperative_boxes(dataset, sample, agents=names)
    columns = 2 if current_style().room == "column" else _COLUMNS
    rows = -(-len(cameras) // columns)
    fig = figure_or_new(
        fig, (15, 3.1 * rows + 0.8), page=0.2 * rows + 0.06, column=0.33 * rows + 0.12
    )
    axes = fig.subplots(rows, min(columns, len(cameras)), squeeze=False)
    for ax in axes.flat[len(cameras) :]:
        ax.set_axis_off()
    for camera, ax in zip(cameras, axes.flat, strict=False):
        _draw_panel(dataset, camera, clouds, boxes, chosen, ax)
        if is_frame:
            ax.set_title(f"{short_name(camera.rsplit('/', 3)[1])}, front")
    if len(cameras) < axes.size:
        draw_legend(axes.flat[-1], agent_handles(clouds), columns=1, loc="center")
    else:
        draw_legend(fig, agent_handles(clouds))
    write_missing(
        axes[0, 0], missing_clouds_text([agent for agent in lookers if agent not in clouds])
    )
    whose = "each agent" if len(names) > 1 else short_name(names[0])
    set_scene_title(
        fig, dataset, record["frame_token"] if is_frame else record["token"], f"LiDAR of {whose}"
    )
    return fig


def _present(dataset: Dataset, row: RowArgument) -> tuple[str, bool]:
    """The token of a sample (of a frame's first one), and whether the row is a frame."""
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
    sample = dataset.get("sample", record["sample_token"])
    draw_image(dataset, record, ax, image="image" in layers)
    seen = hiding(dataset, record)
    for agent, cloud in clouds.items():
        points = seen(project_to_image(dataset, cloud, sample, record, colors=False))
        draw_points_in_image(points.pixels[points.mask], ax, size=1.2, color=AGENT_COLORS[agent])
    own = dataset.get("agent", sample["agent_token"])["actor_id"]
    optical = boxes.transform(
        dataset.world_from(sample, record["channel"]).inverse(), record["channel"]
    )
    near = np.linalg.norm(optical.center, axis=1) < _FARTHEST
    draw_camera_boxes(dataset, record, optical.select(near & (optical.actor_id != own)), layers, ax)
