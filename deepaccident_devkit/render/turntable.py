"""The fused point cloud of several agents in three dimensions, from a camera that circles it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.boxes import EDGES, role_colors
from deepaccident_devkit.render.captions import (
    draw_legend,
    handles_of_scene,
    has_cloud,
    has_sensor_file,
    set_scene_title,
)
from deepaccident_devkit.render.styles import AGENT_COLORS, BEV_COLORS
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA
from deepaccident_devkit.v2x.clouds import aggregate_point_cloud
from deepaccident_devkit.v2x.cooperation import cooperative_boxes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Shown part around the middle, metres: to each side, and from the ground up.
_REACH_M = 50.0
_HEIGHT_M = 12.0
# Maximum number of points, spread over the cloud.
_MAX_POINTS = 40_000
_ELEVATION_DEG = 30
# Distance between the squares that cover the road, metres, and their area, square points.
_ROAD_STEP_M = 0.8
_ROAD_SIZE_PT2 = 30.0
# Enlargement that fills the figure, since there are no axes around the scene.
_ZOOM = 1.9


def draw_turntable(dataset: Dataset, frame: str, *, agents: Sequence[str], fig: Figure) -> None:
    """Draw the points of the agents, in their colours, and all boxes on an empty figure.

    The road is as the first agent with a picture of the BEV camera saw it. The camera goes around
    the middle of the agents once, from the scenario's first frame to its last one.
    """
    from mpl_toolkits.mplot3d.art3d import Line3DCollection  # type: ignore[import-untyped]

    record = dataset.get("frame", frame)
    scenario = dataset.get("scenario", record["scenario_token"])
    samples = [sample_token(scenario["token"], agent, record["index"]) for agent in agents]
    positions = [dataset.world_from(sample, "ego").translation for sample in samples]
    middle = np.mean(positions, axis=0)
    sample = samples[0]
    boxes = cooperative_boxes(dataset, sample, agents=agents)
    cloud = aggregate_point_cloud(dataset, sample, agents=agents, on_missing="skip")
    points = cloud.xyz - middle
    rows = np.flatnonzero((np.abs(points) < (_REACH_M, _REACH_M, _HEIGHT_M)).all(axis=1))
    rows = rows[:: 1 + len(rows) // _MAX_POINTS]
    colors = np.array([AGENT_COLORS[agent] for agent in AGENTS])[cloud.agent]
    is_shown = (np.abs(boxes.center - middle)[:, :2] < _REACH_M).all(axis=1)
    shown_boxes = boxes.select(is_shown)
    edges = (shown_boxes.corners() - middle)[:, EDGES].reshape(-1, 2, 3)
    box_colors = role_colors(dataset, sample, shown_boxes)
    lines = Line3DCollection(edges, colors=np.repeat(box_colors, len(EDGES)), linewidths=1.2)
    ax: Any = fig.add_subplot(projection="3d", computed_zorder=False)
    # the scene fills the figure, which is wider than the axes
    look: Any = {"s": 1.2, "linewidths": 0, "depthshade": False, "clip_on": False}
    ax.scatter(*points[rows].T, c=colors[rows], **look)
    ax.add_collection3d(lines)
    lines.set_clip_on(False)
    pictured = [one for one in samples if has_sensor_file(dataset, f"{one}/{BEV_CAMERA}")]
    if pictured:
        _draw_road(dataset, pictured[0], middle, ax)
    sides = (-_REACH_M, _REACH_M)
    ax.set(xlim=sides, ylim=sides, zlim=(-2, _HEIGHT_M - 2))
    ax.set_box_aspect((2 * _REACH_M, 2 * _REACH_M, _HEIGHT_M), zoom=_ZOOM)
    ax.view_init(_ELEVATION_DEG, 360 * record["index"] / scenario["num_frames"])
    ax.set_axis_off()
    set_scene_title(fig, dataset, frame, fontsize=12)
    present = zip(agents, samples, strict=True)
    clouds = [agent for agent, own_sample in present if has_cloud(dataset, own_sample)]
    draw_legend(fig, handles_of_scene(set(box_colors), clouds))


def _draw_road(dataset: Dataset, sample: str, middle: FloatArray, ax: Any) -> None:
    """Draw the road that a sample's BEV camera sees beneath all else, relative to the middle."""
    image = dataset.load_bev(sample)
    # rows of cells are along y, left, and columns along x, forward
    cells = np.argwhere(TAGS["road"] == image.semantic[::-1, ::-1].T)
    is_spread = (cells % round(_ROAD_STEP_M / image.resolution) == 0).all(axis=1)
    offsets = (cells[is_spread, ::-1] - len(image.semantic) / 2) * image.resolution
    points = np.column_stack([offsets, np.zeros(len(offsets))])
    world_from_ego = dataset.world_from(sample, "ego")
    road = world_from_ego.apply(points) - middle
    road[:, 2] = world_from_ego.translation[2] - middle[2]  # without the agent's tilt
    is_near = (np.abs(road[:, :2]) < _REACH_M).all(axis=1)
    style: Any = {"s": _ROAD_SIZE_PT2, "linewidths": 0, "depthshade": False, "clip_on": False}
    ax.scatter(*road[is_near].T, c=BEV_COLORS["road"], marker="s", zorder=-1, **style)
