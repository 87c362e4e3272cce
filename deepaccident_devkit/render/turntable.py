"""The fused point cloud of several agents in three dimensions, from a camera that circles it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.render.boxes import EDGES, role_colors
from deepaccident_devkit.render.captions import set_scene_title
from deepaccident_devkit.render.styles import AGENT_COLORS
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS
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
# Enlargement that fills the figure, since there are no axes around the scene.
_ZOOM = 1.9


def draw_turntable(dataset: Dataset, frame: str, *, agents: Sequence[str], fig: Figure) -> None:
    """Draw the points of the agents, in their colours, and all boxes on an empty figure.

    The camera goes around the middle of the agents once, from the scenario's first frame to
    its last one.
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
    edge_colors = np.repeat(role_colors(dataset, sample, shown_boxes), len(EDGES))
    lines = Line3DCollection(edges, colors=edge_colors, linewidths=1.2)
    ax: Any = fig.add_subplot(projection="3d")
    # the scene fills the figure, which is wider than the axes
    look: Any = {"s": 1.2, "linewidths": 0, "depthshade": False, "clip_on": False}
    ax.scatter(*points[rows].T, c=colors[rows], **look)
    ax.add_collection3d(lines)
    lines.set_clip_on(False)
    sides = (-_REACH_M, _REACH_M)
    ax.set(xlim=sides, ylim=sides, zlim=(-2, _HEIGHT_M - 2))
    ax.set_box_aspect((2 * _REACH_M, 2 * _REACH_M, _HEIGHT_M), zoom=_ZOOM)
    ax.view_init(_ELEVATION_DEG, 360 * record["index"] / scenario["num_frames"])
    ax.set_axis_off()
    set_scene_title(fig, dataset, frame, fontsize=12)
