"""Rows of the annotation table for several agents and frames: faster than sample by sample."""

from collections.abc import Iterable

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.geometry.conventions import stored_transforms
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    IntArray,
    concatenate_ranges,
)
from deepaccident_devkit.tables import visible_mask
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, CHANNELS, INFRASTRUCTURE, LIDAR, OWN_ACTOR_ID


def label_rows(
    dataset: Dataset, scenario: str, agents: Iterable[str], index: IntArray
) -> tuple[IntArray, IntArray]:
    """Return the boxes of tracked actors in several agents' labels at several moments.

    Args:
        dataset: The release.
        scenario: Token of the scenario.
        agents: Names of agents of the scenario.
        index: Frame numbers of the moments, shape (T,); those outside of the recording have no
            boxes.

    Returns:
        Rows of the annotation table, shape (M,), and positions in `index`, shape (M,). The rows
            are sorted by agent, in the order of `agents`, then by moment, then as in the label.
    """
    samples = dataset.columns("sample")
    num_frames = dataset.get("scenario", scenario)["num_frames"]
    steps = np.flatnonzero((index >= 1) & (index <= num_frames))
    first_rows = [dataset.getind("sample", sample_token(scenario, name, 1)) for name in agents]
    sample_rows = np.add.outer(first_rows, index[steps] - 1).ravel()
    counts = samples["num_annotations"][sample_rows]
    # The boxes of a label are consecutive rows.
    rows = concatenate_ranges(samples["first_annotation_row"][sample_rows], counts)
    is_tracked = dataset.columns("annotation")["instance_row"][rows] >= 0
    box_steps = np.tile(steps, len(first_rows)).repeat(counts)
    return rows[is_tracked], box_steps[is_tracked]


def seen_mask(dataset: Dataset, rows: IntArray, agents: AnyArray) -> BoolArray:
    """Mark the rows (M,) that the agents (M,) of their labels see under the released rule.

    Agents' own rows do not count; `agents` are indices into `taxonomy.AGENTS`.
    """
    boxes = dataset.columns("annotation")
    names = ("category", "num_lidar_pts", "camera_visible")
    is_visible = visible_mask(
        boxes["translation"][rows, :2],
        *[boxes[name][rows] for name in names],
        infrastructure=agents == AGENTS.index(INFRASTRUCTURE),
    )
    is_other: BoolArray = boxes["actor_id"][rows] != OWN_ACTOR_ID
    return is_visible & is_other


def world_vectors(dataset: Dataset, rows: IntArray) -> FloatArray:
    """Return three vectors (3, …) of the box in each row (…) in world, shape (3, …, 3).

    They are the centre, metres; the direction of the box's x axis; and the velocity, m/s.
    """
    boxes = dataset.columns("annotation")
    sample_rows = boxes["sample_row"][rows]
    world_from_ego = stored_transforms(dataset.columns("ego_pose")["matrix"][sample_rows])
    sensor_rows = sample_rows * len(CHANNELS) + CHANNELS.index(LIDAR)
    ego_from_lidar = stored_transforms(dataset.columns("sample_data")["matrix"][sensor_rows])
    world_from_lidar = world_from_ego @ ego_from_lidar
    directions = quaternions.to_matrix(boxes["rotation"][rows])[..., 0]
    columns = [boxes["translation"][rows], directions, boxes["velocity"][rows]]
    vectors = world_from_lidar[..., :3, :3] @ np.stack(columns, axis=-1)
    vectors[..., 0] += world_from_lidar[..., :3, 3]
    return np.moveaxis(vectors, -1, 0)
