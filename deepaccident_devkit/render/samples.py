"""Several panels of one moment: of all sensors, of all agents, and such that prove the transforms."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Final

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
    box_handles,
    draw_legend,
    handles_from_above,
    has_cloud,
    missing_clouds_text,
    set_scene_title,
    write_missing,
)
from deepaccident_devkit.render.figures import LAYERS, Layer, figure_or_new, layers_of
from deepaccident_devkit.render.hidden import hiding
from deepaccident_devkit.render.styles import AGENT_COLORS, in_own_settings
from deepaccident_devkit.taxonomy import CAMERAS, short_name
from deepaccident_devkit.v2x import Agents, Link, cooperating_agents, cooperative_boxes, project_to_image

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CAMERA_GRID: Final = (
    ("Camera_FrontLeft", "Camera_Front", "Camera_FrontRight"),
    ("Camera_BackLeft", "Camera_Back", "Camera_BackRight"),
)
"""The places of the six cameras in a picture of all of them."""
_TALL_GRID: Final = (
    ("Camera_Front", "Camera_Back"),
    ("Camera_FrontLeft", "Camera_FrontRight"),
    ("Camera_BackLeft", "Camera_BackRight"),
)
"""The same in a figure of about 16 to 9."""
_WIDE: Final = 2.1
"""The least width by height of a figure with room for three cameras and a view from above side by side."""
_VIEW_RANGE: Final = 50.0
"""Metres to each side of an agent if there are several; in a tall figure more to its left and right."""
_TALLEST: Final = 2.0
_LEAST_SHARED, _AROUND_SHARED = 30.0, 12.0
"""Metres: the least reach of a view that agents share, and what it shows around them."""
_MOST_CAMERAS: Final = 0.66
"""Of the width, for cameras beside a shared view."""
_BESIDE, _ABOUT = 0.9, 1.6
"""Inches of room for words beside panels, and above and below them."""
MOMENT_LAYERS: Final = tuple(layer for layer in LAYERS if layer in {*CAMERA_LAYERS, *BEV_LAYERS})
CALIBRATION_LAYERS: Final[tuple[Layer, ...]] = ("image", "points", "boxes", "ids")
_DEFAULT: Final[tuple[Layer, ...]] = ("image", "points", "boxes")
_FARTHEST: Final = 60.0
"""Metres from the camera up to which boxes are rendered: farther ones are as small as the errors to be found."""
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
    fig = figure_or_new(fig, (16, 5.6))
    wide = fig.bbox.width > _WIDE * fig.bbox.height
    grid, ratios = (CAMERA_GRID, (4, 4, 4, 4.5)) if wide else (_TALL_GRID, (4, 4, 8))
    axes = fig.subplot_mosaic([[*row, "bev"] for row in grid], width_ratios=ratios)
    for channel in CAMERAS:
        draw_camera(dataset, dataset.get("sample_data", f"{record['token']}/{channel}"), in_cameras, axes[channel])
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
    """Render the front views of a moment's agents, and each one's boxes and LiDAR from above, side by side.

    The colliding pair is red, other recording vehicles have their agents' hues, all others a shade for their category.

    Args:
        dataset: the release.
        frame: token or record.
        agents: which agents, or None for all that are there; a configuration is as seen from the first that is there.
            Their order is always that of `taxonomy.AGENTS`.
        layers: each panel renders those of them that it has: cameras have those of `render_sample_data`, panels from
            above those of `render_bev`. By default each panel has its own default.
        fig: an empty figure to render on; a new one if None. Panels from above show 50 m in front of and behind the
            agent, and in a tall figure more to its left and right.

    Returns:
        The figure, one column for each agent. An image that was not downloaded is a grey panel.

    Raises:
        TokenError: no such frame.
        ChoiceError: no such layer, agent or configuration.
        NotAvailableError: an agent is not in this (partial) release.
    """
    in_cameras, from_above = panel_layers(layers)
    record = dataset.get("frame", frame)
    first = dataset.samples_of(record)[0]
    names = in_drawing_order(cooperating_agents(dataset, first, agents))
    fig = figure_or_new(fig, (3.6 * len(names), 6.9))
    tall = _tallness(fig, len(names))
    view = BevView(view_range=_VIEW_RANGE * tall)
    axes = fig.subplots(2, len(names), squeeze=False, height_ratios=(9 / 16, tall))
    drawn: set[str] = set()
    for column, agent in enumerate(names):
        sample = at_once(first, agent)
        draw_camera(dataset, dataset.get("sample_data", f"{sample}/Camera_Front"), in_cameras, axes[0, column])
        axes[0, column].set_title(short_name(agent))
        above = axes[1, column]
        drawn |= draw_bev(dataset, sample, view, from_above, above)[0]
        above.set_xlim(-_VIEW_RANGE, _VIEW_RANGE)
        if column:
            above.set_ylabel("")
            above.tick_params(labelleft=False)
    if fig.figure is fig:  # a part of a figure is laid out with it
        fig.set_layout_engine("compressed")
    draw_legend(fig, box_handles(drawn))
    set_scene_title(fig, dataset, record["token"])
    return fig


def draw_shared_moment(
    dataset: Dataset, frame: RowArgument, *, agents: Sequence[str], layers: Iterable[Layer] | None, fig: Figure
) -> None:
    """Render the front views of agents beside one view from above that they share, in world, as wide as they need.

    The figure is an empty one of about 16 to 9, or wider.
    """
    in_cameras, from_above = panel_layers(layers)
    record = dataset.get("frame", frame)
    names = in_drawing_order(agents)
    moments = [at_once(dataset.samples_of(record)[0], agent) for agent in names]
    width, height = fig.bbox.width / fig.dpi, fig.bbox.height / fig.dpi
    rows = min(2 if width > _WIDE * height else 3, len(names))
    columns = -(-len(names) // rows)
    camera_width = (height - _ABOUT) / rows * 16 / 9
    share = min(columns * camera_width, _MOST_CAMERAS * width)
    grid = fig.add_gridspec(rows, columns + 1, width_ratios=(width - share, *[share / columns] * columns))
    for number, (agent, moment) in enumerate(zip(names, moments, strict=True)):
        ax = fig.add_subplot(grid[number // columns, 1 + number % columns])
        draw_camera(dataset, dataset.get("sample_data", f"{moment}/Camera_Front"), in_cameras, ax)
        ax.set_title(short_name(agent), fontsize="medium")
    places = np.array([dataset.world_from(moment, "ego").translation[:2] for moment in moments])
    low, high = places.min(axis=0), places.max(axis=0)
    reach = max(_LEAST_SHARED, float((high - low).max()) / 2 + _AROUND_SHARED)
    x, y = ((low + high) / 2).tolist()
    view = BevView(view_range=reach, frame="world", agents=tuple(names), center=(x, y))
    above = fig.add_subplot(grid[:, 0])
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


def _tallness(fig: Figure, columns: int) -> float:
    """Height by width, at least 1, of panels from above that fill the figure below cameras of 16 to 9."""
    width = (fig.bbox.width / fig.dpi - _BESIDE) / columns
    height = fig.bbox.height / fig.dpi - _ABOUT
    return min(max(height / width - 9 / 16, 1.0), _TALLEST)


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
        The figure, three panels in a row. An image that was not downloaded is a grey panel; words in the first panel
        name the agents whose points were not.

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
    rows = -(-len(cameras) // _COLUMNS)
    fig = figure_or_new(fig, (15, 3.1 * rows + 0.8))
    axes = fig.subplots(rows, min(_COLUMNS, len(cameras)), squeeze=False)
    for ax in axes.flat[len(cameras) :]:
        ax.set_axis_off()
    for camera, ax in zip(cameras, axes.flat, strict=False):
        _draw_panel(dataset, camera, clouds, boxes, chosen, ax)
        if is_frame:
            ax.set_title(f"{short_name(camera.rsplit('/', 3)[1])}, front")
    draw_legend(fig, agent_handles(clouds))
    whose = "each agent" if len(names) > 1 else short_name(names[0])
    where = record["frame_token"] if is_frame else record["token"]
    set_scene_title(fig, dataset, where, f"LiDAR of {whose}")
    write_missing(axes[0, 0], missing_clouds_text([agent for agent in lookers if agent not in clouds]))
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
    optical = boxes.transform(dataset.world_from(sample, record["channel"]).inverse(), record["channel"])
    near = np.linalg.norm(optical.center, axis=1) < _FARTHEST
    draw_camera_boxes(dataset, record, optical.select(near & (optical.actor_id != own)), layers, ax)
