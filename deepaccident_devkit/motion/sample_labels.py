"""The motion labels of samples of a release."""

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

_LIDAR: Final = CHANNELS.index(LIDAR)
_POLE: Final = AGENTS.index(INFRASTRUCTURE)
# Samples whose labels are made together: a moment's agents. More take more memory, and no less time.
_AT_ONCE: Final = 5


def motion_labels(
    dataset: Dataset,
    sample: RowArgument,
    config: MotionLabelConfig | str | None = None,
    *,
    id_map: Mapping[int, int] | None = None,
) -> MotionLabels:
    """The motion labels of a sample, each frame in its own ego frame; `MotionLabels.to_present` warps them.

    The agent's own row (−100) shows only as the ego's own box, and not at all with `draw_ego=False`. The released code
    does the same, since no agent ever sees that row; but with `filter_invisible=False` that code would rasterise it
    again, over the ego's box and under an id of its own. Here this never happens.

    Args:
        dataset: the release.
        sample: token or record of the present.
        config: what labels show, or the name of a preset; None for the released ones in the devkit's orientation.
        id_map: actor id → its id in an earlier sample. The released code keeps ids while a worker reads samples of one
            scenario and agent, so they depend on what the worker read before. With None ids start at 1.

    Returns:
        Labels of `config.label_frames` frames; those beyond the recording are not valid.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label, or an agent whose sight counts is not in this (partial) release.
        ChoiceError: no such agent or configuration of agents.
    """
    return next(_labels(dataset, [sample], resolved_label_config(config), id_map))


def motion_labels_of(
    dataset: Dataset, samples: Iterable[RowArgument], config: MotionLabelConfig | str | None = None
) -> Iterator[MotionLabels]:
    """`motion_labels` of each of many samples, in their order; several are made at once, in half the time.

    Args:
        dataset: the release.
        samples: tokens or records of any samples, such as those of a moment's five agents (`DeepAccident.samples_of`).
        config: as of `motion_labels`.

    Raises:
        ChoiceError: `samples` is one alone.
        DeepAccidentError: as of `motion_labels`, when the labels are asked for.
    """
    if isinstance(samples, str | Mapping):
        raise ChoiceError(
            f"samples: expected tokens or records of samples, found {samples!r}; put it into a list"
        )
    chosen, left = resolved_label_config(config), iter(samples)
    groups = iter(lambda: list(islice(left, _AT_ONCE)), [])
    return (labels for group in groups for labels in _labels(dataset, group, chosen, None))


def _labels(
    dataset: Dataset,
    group: Sequence[RowArgument],
    config: MotionLabelConfig,
    id_map: Mapping[int, int] | None,
) -> Iterator[MotionLabels]:
    """The labels of S samples; the ids of each continue the map."""
    if config.rules.sight == "camera":
        dataset = dataset.with_ignored
    row, columns = (
        np.array([dataset.getind("sample", sample) for sample in group]),
        dataset.columns("sample"),
    )
    bare = row[~columns["labelled"][row]]
    if len(bare):
        raise NotAvailableError(
            f"{dataset.sample[bare.item(0)]['token']} has no label (the test split has none)"
        )
    length = dataset.columns("scenario")["num_frames"][columns["scenario_row"][row]]
    first_row = dataset.columns("agent")["first_sample_row"][columns["agent_row"][row]]
    offsets = np.array([*config.offsets, config.offsets[-1] + config.step])
    index: IntArray = (row - first_row)[:, None] + offsets
    there = (index >= 0) & (index < length[:, None])
    world_from_ego = np.tile(np.eye(4), (*index.shape, 1, 1))
    world_from_ego[there] = stored_transforms(
        dataset.columns("ego_pose")["matrix"][(row[:, None] + offsets)[there]]
    )
    # the rows from the last moment of a sample to the first of the next are left out
    motion = egomotion(world_from_ego.reshape(-1, 4, 4), there.reshape(-1), config.rules)
    motion = motion[np.arange(index.size).reshape(index.shape)[:, :-1]]
    shown = slice(config.receptive_field - 1, -1)
    boxes = _box_rows(
        dataset, group, columns["agent_row"][row], index[:, shown], there[:, shown], config
    )
    return labels_of(polygons_of(boxes, config), motion, there[:, :-1], config, id_map)


def _box_rows(
    dataset: Dataset,
    group: Sequence[RowArgument],
    agent: IntArray,
    index: IntArray,
    there: BoolArray,
    config: MotionLabelConfig,
) -> BoxRows:
    """The boxes of samples, whose agents are the rows (S,), at the frames `index` (S, T) that are there, from 0."""
    boxes, agents = dataset.columns("annotation"), dataset.columns("agent")
    rows = (agents["first_sample_row"][agent][:, None] + index)[there]
    row, count = _annotations(dataset, rows)
    frame, actor = np.repeat(np.flatnonzero(there), count), boxes["actor_id"][row]
    visible = np.ones(len(row), dtype=bool)
    if config.filter_invisible:
        seen = _seen(dataset, group, agent, index, there, config)
        visible = np.isin(_pairs(actor, row, frame, there.size), seen)
    ego_from_lidar = np.tile(np.eye(4), (there.size, 1, 1))
    ego_from_lidar[there.reshape(-1)] = _ego_from_lidar(dataset, rows, config)
    return BoxRows(
        frame=frame,
        center=boxes["translation"][row],
        size=boxes["size"][row],
        yaw=boxes["yaw"][row],
        actor_id=actor,
        category=boxes["category"][row],
        visible=visible,
        ego_from_lidar=ego_from_lidar,
        has_own=there & (agents["name"][agent] != _POLE)[:, None],
    )


def _ego_from_lidar(dataset: Dataset, rows: IntArray, config: MotionLabelConfig) -> FloatArray:
    """(K, 4, 4) of samples, as `FrameBoxes` has it."""
    ego_from_lidar = stored_transforms(
        dataset.columns("sample_data")["matrix"][rows * len(CHANNELS) + _LIDAR]
    )
    if config.rules.pose != "yaw":
        return ego_from_lidar
    world_from_ego = stored_transforms(dataset.columns("ego_pose")["matrix"][rows])
    world_from_level = conventions.six_vectors_of(world_from_ego) * (1, 1, 1, 0, 0, 1)
    return np.asarray(
        inverses(conventions.matrices_of_six(world_from_level)) @ world_from_ego @ ego_from_lidar
    )


def _seen(
    dataset: Dataset,
    group: Sequence[RowArgument],
    agent: IntArray,
    index: IntArray,
    there: BoolArray,
    config: MotionLabelConfig,
) -> IntArray:
    """The `_pairs` of actors and frames at which an agent whose sight counts for the sample sees them.

    See docs/released_code.md, Visibility and attributes.
    """
    boxes, agents = dataset.columns("annotation"), dataset.columns("agent")
    one_each = dict(zip(agent.tolist(), group, strict=True))
    of_agent = {row: _observers(dataset, sample, config) for row, sample in one_each.items()}
    observers = [of_agent[row] for row in agent.tolist()]
    observer, sample = (
        np.concatenate(observers),
        np.repeat(np.arange(len(agent)), [len(one) for one in observers]),
    )
    known = there[sample]
    row, count = _annotations(
        dataset, (agents["first_sample_row"][observer][:, None] + index[sample])[known]
    )
    frame = np.repeat(np.arange(there.size).reshape(there.shape)[sample][known], count)
    actor, mask = boxes["actor_id"][row], boxes["camera_visible"][row]
    if config.rules.sight != "camera":
        pole = np.repeat(np.nonzero(known)[0], count)
        by_points = visible_mask(
            boxes["translation"][row, :2],
            boxes["category"][row],
            boxes["num_lidar_pts"][row],
            mask,
            infrastructure=(agents["name"][observer] == _POLE)[pole],
        )
        mask = by_points & (actor != UNTRACKED_ID)
    return np.asarray(_pairs(actor, row, frame, there.size)[mask & (actor != OWN_ACTOR_ID)])


def _observers(dataset: Dataset, sample: RowArgument, config: MotionLabelConfig) -> list[int]:
    """The rows of the agents whose sight counts for a sample's agent."""
    scenario = token_of(sample).rsplit("/", 2)[0]
    names = cooperating_agents(dataset, sample, config.agents)
    return [dataset.getind("agent", agent_token(scenario, name)) for name in names]


def _annotations(dataset: Dataset, rows: IntArray) -> tuple[IntArray, IntArray]:
    """The rows of samples' boxes in the annotation table, one sample after another, and how many each has."""
    samples = dataset.columns("sample")
    count: IntArray = samples["num_annotations"][rows].astype(np.int64)
    first = samples["first_annotation_row"][rows] - np.cumsum(count) + count
    rows_of_boxes: IntArray = np.repeat(first, count) + np.arange(count.sum())
    return rows_of_boxes, count


def _pairs(actor: AnyArray, row: IntArray, frame: IntArray, frames: int) -> IntArray:
    """One number for each row of the annotation table: it stands for the pair of actor and frame.

    An untracked row is an actor of its own.
    """
    return np.asarray(
        np.where(actor == UNTRACKED_ID, OWN_ACTOR_ID - 1 - row, actor) * frames + frame
    )
