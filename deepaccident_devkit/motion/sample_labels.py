"""Motion labels of samples of a release."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.geometry import conventions
from deepaccident_devkit.geometry.conventions import inverses, stored_transforms
from deepaccident_devkit.motion.box_polygons import BoxRows, polygons_of
from deepaccident_devkit.motion.config import MotionLabelConfig, resolved_label_config
from deepaccident_devkit.motion.drawing import labels_of
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.warping import egomotion
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.tables import visible_mask
from deepaccident_devkit.tables.tables import token_of
from deepaccident_devkit.tables.tokens import agent_token
from deepaccident_devkit.taxonomy import (
    AGENTS,
    CHANNELS,
    INFRASTRUCTURE,
    LIDAR,
    OWN_ACTOR_ID,
    UNTRACKED_ID,
)
from deepaccident_devkit.v2x import cooperating_agents

_LIDAR_INDEX: Final = CHANNELS.index(LIDAR)
_INFRASTRUCTURE_INDEX: Final = AGENTS.index(INFRASTRUCTURE)
# Labels of a moment's agents are made together. More samples take more memory, and no less time.
_SAMPLES_AT_ONCE: Final = 5


def motion_labels(
    dataset: Dataset,
    sample: RowArgument,
    config: MotionLabelConfig | str | None = None,
    *,
    id_map: Mapping[int, int] | None = None,
) -> MotionLabels:
    """Return the motion labels of a sample, each frame in its own ego frame.

    `MotionLabels.to_present` warps them. The agent's own row (−100) shows only as the ego's own
    box, and not at all with `draw_ego=False`. The released code does the same, since no agent ever
    sees that row; but with `filter_invisible=False` that code would rasterise it again, over the
    ego's box and under an id of its own. Here this never happens.

    Args:
        dataset: The release.
        sample: Token or record of the present.
        config: Configuration of the labels, or the name of a preset; None for the released labels
            in the devkit's orientation.
        id_map: Actor id → its id in an earlier sample. The released code keeps ids while a worker
            reads samples of one scenario and agent, so that they depend on the samples that the
            worker read before. With None ids start at 1.

    Returns:
        Labels of `config.label_frames` frames; frames beyond the recording are not valid.

    Raises:
        TokenError: No such sample.
        NotAvailableError: The sample has no label, or an agent with a view that counts is not in
            this (partial) release.
        ChoiceError: No such agent or configuration of agents.
    """
    return next(_labels(dataset, [sample], resolved_label_config(config), id_map))


def motion_labels_of(
    dataset: Dataset, samples: Iterable[RowArgument], config: MotionLabelConfig | str | None = None
) -> Iterator[MotionLabels]:
    """Return `motion_labels` of many samples, in their order.

    Several are made at once, in half the time.

    Args:
        dataset: The release.
        samples: Tokens or records of any samples, such as the samples of a moment's five agents
            (`DeepAccident.samples_of`).
        config: Configuration, as in `motion_labels`.

    Raises:
        ChoiceError: `samples` is a single sample.
        DeepAccidentError: As in `motion_labels`, raised while iterating.
    """
    if isinstance(samples, str | Mapping):
        raise ChoiceError(
            f"samples: expected tokens or records of samples, found {samples!r}; put it into a list"
        )
    label_config = resolved_label_config(config)
    remaining = iter(samples)
    groups = iter(lambda: list(islice(remaining, _SAMPLES_AT_ONCE)), [])
    return (labels for group in groups for labels in _labels(dataset, group, label_config, None))


def _labels(
    dataset: Dataset,
    group: Sequence[RowArgument],
    config: MotionLabelConfig,
    id_map: Mapping[int, int] | None,
) -> Iterator[MotionLabels]:
    """Return the labels of S samples; the ids of each sample continue the map."""
    if config.rules.sight == "camera":
        dataset = dataset.with_ignored
    row = np.array([dataset.getind("sample", sample) for sample in group])
    samples = dataset.columns("sample")
    unlabelled = row[~samples["labelled"][row]]
    if len(unlabelled):
        raise NotAvailableError(
            f"{dataset.sample[unlabelled.item(0)]['token']} has no label (the test split has none)"
        )
    agent = samples["agent_row"][row]
    num_frames = dataset.columns("scenario")["num_frames"][samples["scenario_row"][row]]
    first_row = dataset.columns("agent")["first_sample_row"][agent]
    offsets = np.array([*config.offsets, config.offsets[-1] + config.step])
    index: IntArray = (row - first_row)[:, None] + offsets
    exists = (index >= 0) & (index < num_frames[:, None])
    pose_rows = (row[:, None] + offsets)[exists]
    world_from_ego = np.tile(np.eye(4), (*index.shape, 1, 1))
    world_from_ego[exists] = stored_transforms(dataset.columns("ego_pose")["matrix"][pose_rows])
    motion = egomotion(world_from_ego.reshape(-1, 4, 4), exists.reshape(-1), config.rules)
    # Leave out the rows from the last moment of a sample to the first moment of the next one.
    motion = motion[np.arange(index.size).reshape(index.shape)[:, :-1]]
    label_frames = slice(config.receptive_field - 1, -1)
    boxes = _box_rows(
        dataset, group, agent, index[:, label_frames], exists[:, label_frames], config
    )
    return labels_of(polygons_of(boxes, config), motion, exists[:, :-1], config, id_map)


def _box_rows(
    dataset: Dataset,
    group: Sequence[RowArgument],
    agent: IntArray,
    index: IntArray,
    exists: BoolArray,
    config: MotionLabelConfig,
) -> BoxRows:
    """Return the boxes of S samples at their T label frames.

    Args:
        dataset: The release.
        group: Tokens or records of the samples.
        agent: Rows of the samples' agents, shape (S,).
        index: Frames of the recordings from 0, shape (S, T).
        exists: Whether each frame is in the recording, shape (S, T).
        config: Configuration of the labels.
    """
    boxes = dataset.columns("annotation")
    agents = dataset.columns("agent")
    sample_rows = (agents["first_sample_row"][agent][:, None] + index)[exists]
    row, count = _annotations(dataset, sample_rows)
    frame = np.repeat(np.flatnonzero(exists), count)
    actor = boxes["actor_id"][row]
    visible = np.ones(len(row), dtype=bool)
    if config.filter_invisible:
        visible_pairs = _visible_pairs(dataset, group, agent, index, exists, config)
        visible = np.isin(_actor_frame_pairs(actor, row, frame, exists.size), visible_pairs)
    ego_from_lidar = np.tile(np.eye(4), (exists.size, 1, 1))
    ego_from_lidar[exists.reshape(-1)] = _ego_from_lidar(dataset, sample_rows, config)
    is_vehicle = agents["name"][agent] != _INFRASTRUCTURE_INDEX
    return BoxRows(
        frame=frame,
        center=boxes["translation"][row],
        size=boxes["size"][row],
        yaw=boxes["yaw"][row],
        actor_id=actor,
        category=boxes["category"][row],
        visible=visible,
        ego_from_lidar=ego_from_lidar,
        has_own=exists & is_vehicle[:, None],
    )


def _ego_from_lidar(dataset: Dataset, rows: IntArray, config: MotionLabelConfig) -> FloatArray:
    """Return `FrameBoxes.ego_from_lidar` of samples, shape (K, 4, 4)."""
    lidar_rows = rows * len(CHANNELS) + _LIDAR_INDEX
    ego_from_lidar = stored_transforms(dataset.columns("sample_data")["matrix"][lidar_rows])
    if config.rules.pose != "yaw":
        return ego_from_lidar
    world_from_ego = stored_transforms(dataset.columns("ego_pose")["matrix"][rows])
    level_vectors = conventions.six_vectors_of(world_from_ego) * (1, 1, 1, 0, 0, 1)
    level_from_world = inverses(conventions.matrices_of_six(level_vectors))
    return np.asarray(level_from_world @ world_from_ego @ ego_from_lidar)


def _visible_pairs(
    dataset: Dataset,
    group: Sequence[RowArgument],
    agent: IntArray,
    index: IntArray,
    exists: BoolArray,
    config: MotionLabelConfig,
) -> IntArray:
    """Return the `_actor_frame_pairs` that are visible to an agent that counts for the sample.

    Arguments are as in `_box_rows`. See docs/released_code.md, Visibility and attributes.
    """
    boxes = dataset.columns("annotation")
    agents = dataset.columns("agent")
    sample_of_agent = dict(zip(agent.tolist(), group, strict=True))
    observers_of_agent = {}
    for agent_row, agent_sample in sample_of_agent.items():
        observers_of_agent[agent_row] = _observers(dataset, agent_sample, config)
    observers = [observers_of_agent[agent_row] for agent_row in agent.tolist()]
    observer = np.concatenate(observers)
    sample = np.repeat(np.arange(len(agent)), [len(rows) for rows in observers])
    known = exists[sample]
    observed_rows = agents["first_sample_row"][observer][:, None] + index[sample]
    row, count = _annotations(dataset, observed_rows[known])
    frame_numbers = np.arange(exists.size).reshape(exists.shape)
    frame = np.repeat(frame_numbers[sample][known], count)
    actor = boxes["actor_id"][row]
    visible = boxes["camera_visible"][row]
    if config.rules.sight != "camera":
        observation = np.repeat(np.nonzero(known)[0], count)
        is_infrastructure = agents["name"][observer] == _INFRASTRUCTURE_INDEX
        by_points = visible_mask(
            boxes["translation"][row, :2],
            boxes["category"][row],
            boxes["num_lidar_pts"][row],
            visible,
            infrastructure=is_infrastructure[observation],
        )
        visible = by_points & (actor != UNTRACKED_ID)
    pairs = _actor_frame_pairs(actor, row, frame, exists.size)
    return np.asarray(pairs[visible & (actor != OWN_ACTOR_ID)])


def _observers(dataset: Dataset, sample: RowArgument, config: MotionLabelConfig) -> list[int]:
    """Return the rows of the agents with views that count for a sample's agent."""
    scenario = token_of(sample).rsplit("/", 2)[0]
    names = cooperating_agents(dataset, sample, config.agents)
    return [dataset.getind("agent", agent_token(scenario, name)) for name in names]


def _annotations(dataset: Dataset, rows: IntArray) -> tuple[IntArray, IntArray]:
    """Return the annotation rows of samples, one sample after another, and their numbers."""
    samples = dataset.columns("sample")
    count: IntArray = samples["num_annotations"][rows].astype(np.int64)
    first = samples["first_annotation_row"][rows] - np.cumsum(count) + count
    rows_of_boxes: IntArray = np.repeat(first, count) + np.arange(count.sum())
    return rows_of_boxes, count


def _actor_frame_pairs(actor: AnyArray, row: IntArray, frame: IntArray, frames: int) -> IntArray:
    """Return a number for the pair of actor and frame of each row of the annotation table.

    An untracked row is an actor of its own.
    """
    distinct_actor = np.where(actor == UNTRACKED_ID, OWN_ACTOR_ID - 1 - row, actor)
    return np.asarray(distinct_actor * frames + frame)
