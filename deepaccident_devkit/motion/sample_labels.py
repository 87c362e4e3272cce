"""Motion labels of samples of a release."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.geometry import conventions
from deepaccident_devkit.geometry.conventions import inverses, stored_transforms
from deepaccident_devkit.motion.box_polygons import BoxRows, make_polygons
from deepaccident_devkit.motion.config import MotionLabelConfig, resolved_label_config
from deepaccident_devkit.motion.drawing import make_labels
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.warping import egomotion
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    IntArray,
    concatenate_ranges,
)
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

_LIDAR_INDEX = CHANNELS.index(LIDAR)
_INFRASTRUCTURE_INDEX = AGENTS.index(INFRASTRUCTURE)
# The labels of a moment's agents are made together. Larger groups take more memory, but no less
# time.
_SAMPLES_AT_ONCE = 5


def motion_labels(
    dataset: Dataset,
    sample: RowArgument,
    config: MotionLabelConfig | str | None = None,
    *,
    id_map: Mapping[int, int] | None = None,
) -> MotionLabels:
    """Return the motion labels of a sample, each frame in its own ego frame.

    `MotionLabels.to_present` warps them to the present. The agent's own row (−100) appears only as
    the ego's own box, and not at all with `draw_ego=False`. The released code does the same, since
    no agent ever sees that row; but with `filter_invisible=False`, it would rasterise the row
    again, over the ego's box and with a separate id. That never happens here.

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
        TokenError: There is no such sample.
        NotAvailableError: The sample has no label, or an agent with a view that counts is not in
            this (partial) release.
        ChoiceError: There is no such agent or configuration of agents.
    """
    label_config = resolved_label_config(config)
    labels = _label_samples(dataset, [sample], label_config, id_map)
    return next(labels)


def motion_labels_of(
    dataset: Dataset, samples: Iterable[RowArgument], config: MotionLabelConfig | str | None = None
) -> Iterator[MotionLabels]:
    """Return the `motion_labels` of many samples, in their order.

    The labels of several samples are made at once, which takes half the time.

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
    return _label_groups(dataset, samples, label_config)


def _label_groups(
    dataset: Dataset, samples: Iterable[RowArgument], config: MotionLabelConfig
) -> Iterator[MotionLabels]:
    """Yield the labels of samples, made several samples at a time."""
    remaining = iter(samples)
    while group := list(islice(remaining, _SAMPLES_AT_ONCE)):
        yield from _label_samples(dataset, group, config, None)


def _label_samples(
    dataset: Dataset,
    group: Sequence[RowArgument],
    config: MotionLabelConfig,
    id_map: Mapping[int, int] | None,
) -> Iterator[MotionLabels]:
    """Return the labels of S samples; each sample's ids continue `id_map`."""
    if config.rules.sight == "camera":
        dataset = dataset.with_ignored
    rows = np.array([dataset.getind("sample", sample) for sample in group])
    samples = dataset.columns("sample")
    unlabelled = rows[~samples["labelled"][rows]]
    if len(unlabelled):
        raise NotAvailableError(
            f"{dataset.sample[unlabelled.item(0)]['token']} has no label (the test split has none)"
        )
    agent = samples["agent_row"][rows]
    num_frames = dataset.columns("scenario")["num_frames"][samples["scenario_row"][rows]]
    first_rows = dataset.columns("agent")["first_sample_row"][agent]
    offsets = np.array([*config.offsets, config.offsets[-1] + config.step])
    index: IntArray = (rows - first_rows)[:, None] + offsets
    exists = (index >= 0) & (index < num_frames[:, None])
    sample_rows = rows[:, None] + offsets
    poses = dataset.columns("ego_pose")["matrix"][sample_rows[exists]]
    world_from_ego = np.tile(np.eye(4), (*index.shape, 1, 1))
    world_from_ego[exists] = stored_transforms(poses)
    motion = egomotion(world_from_ego.reshape(-1, 4, 4), exists.reshape(-1), config.rules)
    # Leave out the motions from a sample's last moment to the next sample's first moment.
    motion_rows = np.arange(index.size).reshape(index.shape)[:, :-1]
    label_frames = slice(config.receptive_field - 1, -1)
    label_index = index[:, label_frames]
    label_exists = exists[:, label_frames]
    boxes = _read_boxes(dataset, group, agent, label_index, label_exists, config)
    polygons = make_polygons(boxes, config)
    return make_labels(polygons, motion[motion_rows], exists[:, :-1], config, id_map)


def _read_boxes(
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
        agent: Table rows of the samples' agents, shape (S,).
        index: Frame indices in the recordings, from 0, shape (S, T).
        exists: Whether each frame is in the recording, shape (S, T).
        config: Configuration of the labels.
    """
    boxes = dataset.columns("annotation")
    agents = dataset.columns("agent")
    all_sample_rows = agents["first_sample_row"][agent][:, None] + index
    sample_rows = all_sample_rows[exists]
    row, count = _find_annotations(dataset, sample_rows)
    frame = np.repeat(np.flatnonzero(exists), count)
    actor = boxes["actor_id"][row]
    visible = np.ones(len(row), dtype=bool)
    if config.filter_invisible:
        visible_pairs = _find_visible_pairs(dataset, group, agent, index, exists, config)
        pairs = _number_pairs(actor, row, frame, exists.size)
        visible = np.isin(pairs, visible_pairs)
    ego_from_lidar = np.tile(np.eye(4), (exists.size, 1, 1))
    ego_from_lidar[exists.reshape(-1)] = _read_lidar_poses(dataset, sample_rows, config)
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


def _read_lidar_poses(dataset: Dataset, rows: IntArray, config: MotionLabelConfig) -> FloatArray:
    """Return `FrameBoxes.ego_from_lidar` of samples, shape (K, 4, 4)."""
    lidar_rows = rows * len(CHANNELS) + _LIDAR_INDEX
    lidar_poses = dataset.columns("sample_data")["matrix"][lidar_rows]
    ego_from_lidar = stored_transforms(lidar_poses)
    if config.rules.pose != "yaw":
        return ego_from_lidar
    ego_poses = dataset.columns("ego_pose")["matrix"][rows]
    world_from_ego = stored_transforms(ego_poses)
    level_vectors = conventions.six_vectors_of(world_from_ego) * (1, 1, 1, 0, 0, 1)
    level_from_world = inverses(conventions.matrices_of_six(level_vectors))
    return np.asarray(level_from_world @ world_from_ego @ ego_from_lidar)


def _find_visible_pairs(
    dataset: Dataset,
    group: Sequence[RowArgument],
    agent: IntArray,
    index: IntArray,
    exists: BoolArray,
    config: MotionLabelConfig,
) -> IntArray:
    """Return the pairs (`_number_pairs`) that are visible to an agent whose view counts.

    Arguments are as in `_read_boxes`. See docs/released_code.md, Visibility and attributes.
    """
    boxes = dataset.columns("annotation")
    agents = dataset.columns("agent")
    agent_rows = agent.tolist()
    sample_of_agent = dict(zip(agent_rows, group, strict=True))
    observers_of_agent = {}
    for agent_row, agent_sample in sample_of_agent.items():
        observers_of_agent[agent_row] = _find_observers(dataset, agent_sample, config)
    observers = [observers_of_agent[agent_row] for agent_row in agent_rows]
    observer = np.concatenate(observers)
    sample = np.repeat(np.arange(len(agent)), [len(rows) for rows in observers])
    known = exists[sample]
    observed_rows = agents["first_sample_row"][observer][:, None] + index[sample]
    row, count = _find_annotations(dataset, observed_rows[known])
    frame_numbers = np.arange(exists.size).reshape(exists.shape)
    observed_frames = frame_numbers[sample][known]
    frame = np.repeat(observed_frames, count)
    actor = boxes["actor_id"][row]
    visible = boxes["camera_visible"][row]
    if config.rules.sight != "camera":
        known_observations, _ = np.nonzero(known)
        observation = np.repeat(known_observations, count)
        is_infrastructure = agents["name"][observer] == _INFRASTRUCTURE_INDEX
        by_points = visible_mask(
            boxes["translation"][row, :2],
            boxes["category"][row],
            boxes["num_lidar_pts"][row],
            visible,
            infrastructure=is_infrastructure[observation],
        )
        visible = by_points & (actor != UNTRACKED_ID)
    pairs = _number_pairs(actor, row, frame, exists.size)
    is_other = actor != OWN_ACTOR_ID
    return np.asarray(pairs[visible & is_other])


def _find_observers(dataset: Dataset, sample: RowArgument, config: MotionLabelConfig) -> list[int]:
    """Return the table rows of the agents whose views count for a sample's agent."""
    scenario, _, _ = token_of(sample).rsplit("/", 2)
    names = cooperating_agents(dataset, sample, config.agents)
    return [dataset.getind("agent", agent_token(scenario, name)) for name in names]


def _find_annotations(dataset: Dataset, rows: IntArray) -> tuple[IntArray, IntArray]:
    """Return the annotation rows of samples, sample by sample, and how many each sample has."""
    samples = dataset.columns("sample")
    counts: IntArray = samples["num_annotations"][rows].astype(np.int64)
    return concatenate_ranges(samples["first_annotation_row"][rows], counts), counts


def _number_pairs(actor: AnyArray, row: IntArray, frame: IntArray, frames: int) -> IntArray:
    """Return a number for the pair of actor and frame of each row of the annotation table.

    An untracked row counts as a separate actor.
    """
    row_actor = OWN_ACTOR_ID - 1 - row
    distinct_actor = np.where(actor == UNTRACKED_ID, row_actor, actor)
    return np.asarray(distinct_actor * frames + frame)
