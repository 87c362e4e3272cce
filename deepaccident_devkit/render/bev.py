"""A moment from above."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.render.axes import axes_or_new
from deepaccident_devkit.render.boxes import box_colors, draw_boxes_from_above
from deepaccident_devkit.render.colors import GRID_COLOR
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def render_bev(
    dataset: Dataset, sample: RowArgument, *, view_range: float = 50.0, points: bool = True, ax: Axes | None = None
) -> Axes:
    """Draw a sample's boxes and LiDAR points from above, in the agent's ego frame with forward to the right.

    The colliding pair is red, the recording agent green, the others coloured by category.

    Args:
        dataset: the release.
        sample: token or record.
        view_range: metres shown to each side of the agent.
        points: whether to draw the LiDAR points, where their file is there.
        ax: axes to draw on; new ones if None.

    Returns:
        The axes drawn on, in metres of the ego frame.

    Raises:
        TokenError: no such sample.
    """
    ax = axes_or_new(ax)
    record = dataset.get("sample", sample)
    if points and dataset.get_sample_data_path(f"{record['token']}/lidar01").is_file():
        cloud = dataset.load_point_cloud(record, frame="ego").xyz
        near = (np.abs(cloud[:, :2]) < view_range).all(axis=1)
        ax.scatter(cloud[near, 0], cloud[near, 1], s=0.6, c="#9a9a9a", linewidths=0, rasterized=True)
    boxes = dataset.boxes(record, frame="ego")
    draw_boxes_from_above(boxes, ax, box_colors(boxes, collider_ids(dataset, record)))
    ax.set(xlim=(-view_range, view_range), ylim=(-view_range, view_range), aspect="equal")
    ax.set(xlabel="x forward (m)", ylabel="y left (m)", title=f"{record['agent']}, t = {record['timestamp']:.1f} s")
    ax.grid(color=GRID_COLOR, linewidth=0.4)
    return ax


def collider_ids(dataset: Dataset, sample: RowArgument) -> set[int]:
    """The label ids, in this sample, of the pair that meta says collided: −100 where the agent is one of them."""
    record = dataset.get("sample", sample)
    collision = dataset.get("scenario", record["scenario_token"])["collision"]
    if collision is None:
        return set()
    agent_id = dataset.get("agent", record["agent_token"])["actor_id"]
    return {OWN_ACTOR_ID if actor_id == agent_id else actor_id for actor_id in collision["ids"]}
