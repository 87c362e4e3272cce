"""The motion labels of samples of a release, and which samples models are trained on and evaluated at."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from typing import Final, Literal, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.geometry import conventions
from deepaccident_devkit.geometry.conventions import inverses, stored_transforms
from deepaccident_devkit.motion.box_polygons import FrameBoxes
from deepaccident_devkit.motion.config import MotionLabelConfig, label_config
from deepaccident_devkit.motion.drawing import motion_labels_from_boxes
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.warping import egomotion
from deepaccident_devkit.support.arrays import AnyArray, IntArray, checked_number
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.tables import visible_mask
from deepaccident_devkit.taxonomy import (
    AGENTS,
    CHANNELS,
    FRAME_PERIOD,
    INFRASTRUCTURE,
    LIDAR,
    OWN_ACTOR_ID,
    UNTRACKED_ID,
)
from deepaccident_devkit.v2x import cooperating_agents

Purpose = Literal["train", "evaluate", "all", "every"]
SampleProtocol = Literal["released", "paper"]
Scope = Literal["accident", "all"]
_KEY_STEP: Final = 5
"""Recorded frames from one key frame to the next, counted back from a scenario's last frame."""
_STEPS: Final = {"train": 10, "evaluate": _KEY_STEP, "all": _KEY_STEP, "every": 1}
_RELEASED_HORIZON: Final = 2.0


def samples(
    dataset: Dataset,
    split: str | os.PathLike[str],
    purpose: Purpose,
    protocol: SampleProtocol = "released",
    *,
    horizon: float = _RELEASED_HORIZON,
    scope: Scope = "accident",
) -> list[str]:
    """The labelled samples of a split that a model is trained on or evaluated at, of all agents.

    Frames are counted back from a scenario's last one, which in an accident scenario is the collision:

    - `train`: one a second, of normal and accident scenarios;
    - `evaluate`: two a second within the last `horizon` seconds except the last frame, of scenarios designed to end
      in an accident (`_accident` in their folder); `scope="all"` adds the normal ones;
    - `all`: two a second, the whole of every scenario;
    - `every`: all samples, ten a second.

    The released V2X class stops after 50 samples of a list in an unknown order; this function does not.

    Args:
        dataset: the release.
        split: `train`, `val`, … or a split file, as `Dataset.split_scenarios` takes it.
        purpose: `train`, `evaluate`, `all` or `every`.
        protocol: `released` has only a horizon of 2 s and accident scenarios; `paper` allows others.
        horizon: seconds before the end, a multiple of 0.5; only for `evaluate`.
        scope: `accident` or `all`; only for `evaluate`.

    Returns:
        Tokens by scenario, agent and time.

    Raises:
        ChoiceError: no such split, purpose, protocol or scope.
        ConfigError: a horizon that is no multiple of 0.5 s, or one that the released protocol does not have.
        NotAvailableError: the split is unknown, this release has no scenario of it, or none of its samples has labels
            (the test split has none).
    """
    listed: str = choice("purpose", purpose, _STEPS)
    protocol = choice("protocol", protocol, get_args(SampleProtocol))
    scope = choice("scope", scope, get_args(Scope))
    seconds = checked_number("horizon", horizon, "a number of seconds", ConfigError)
    steps = seconds / (_KEY_STEP * FRAME_PERIOD)
    if not (1 <= steps < float("inf") and abs(steps - round(steps)) < 1e-6):
        raise ConfigError(f"horizon: {horizon} s is no multiple of 0.5 s; choose 0.5, 1, 1.5, …")
    if protocol == "released" and (seconds != _RELEASED_HORIZON or scope != "accident"):
        raise ConfigError("the released protocol looks 2 s ahead in accident scenarios; choose protocol='paper'")

    scenario_tokens = dataset.split_scenarios(split)
    if not scenario_tokens:
        raise NotAvailableError(
            f"{split}: no scenario of this split is in {dataset.dataroot}; unpack that part of the release, or choose "
            f"another split: it has {_splits_text(dataset)}"
        )
    wanted = np.isin(np.arange(len(dataset.scenario)), [dataset.getind("scenario", one) for one in scenario_tokens])
    columns, scenarios = dataset.columns("sample"), dataset.columns("scenario")
    row = columns["scenario_row"]
    in_split = wanted[row] & columns["labelled"][:]
    if not in_split.any():
        raise NotAvailableError(f"{split}: none of its samples here has labels (the test split has none)")
    to_end = scenarios["num_frames"][row] - (columns["frame_row"] - scenarios["first_frame_row"][row] + 1)
    chosen = to_end % _STEPS[listed] == 0
    if listed == "evaluate":
        chosen &= (to_end > 0) & (to_end <= round(seconds / FRAME_PERIOD))
        if scope == "accident":
            chosen &= scenarios["designed_accident"][:][row]
    return [dataset.sample[index]["token"] for index in np.flatnonzero(in_split & chosen).tolist()]


def no_samples_text(dataset: Dataset, split: str | os.PathLike[str], scope: Scope) -> str:
    """What to do where a split of a release has labelled samples, but a list has none of them."""
    scenarios = [dataset.get("scenario", token) for token in sorted(dataset.split_scenarios(split))]
    if scope == "accident" and not any(scenario["designed_accident"] for scenario in scenarios):
        return (
            f"the scope accident, which is the default, leaves out all {len(scenarios)} of its scenarios, since none "
            "was designed to end in an accident; use scope='all' (--scope all)"
        )
    return "choose others"


def _splits_text(dataset: Dataset) -> str:
    """`train: 2 scenarios, split unknown: 1 scenario`."""
    counts = Counter(scenario["split"] or "split unknown" for scenario in dataset.scenario)
    return ", ".join(f"{name}: {count} scenario{'s' * (count != 1)}" for name, count in counts.items())


def training_samples(dataset: Dataset, split: str | os.PathLike[str]) -> list[str]:
    """The samples that a model is trained on, one a second: `samples` for the purpose `train`; see there."""
    return samples(dataset, split, "train")


def evaluation_samples(
    dataset: Dataset,
    split: str | os.PathLike[str],
    protocol: SampleProtocol = "released",
    *,
    horizon: float = _RELEASED_HORIZON,
    scope: Scope = "accident",
) -> list[str]:
    """The samples that a model is evaluated at: `samples` for the purpose `evaluate`; see there."""
    return samples(dataset, split, "evaluate", protocol, horizon=horizon, scope=scope)


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
    config = label_config(config)
    row, samples = dataset.getind("sample", sample), dataset.columns("sample")
    if not samples["labelled"][row]:
        token = dataset.sample[row]["token"]
        raise NotAvailableError(f"{token} has no label (the test split has none)")
    length = dataset.columns("scenario")["num_frames"].item(samples["scenario_row"].item(row))
    first_row = dataset.columns("agent")["first_sample_row"].item(samples["agent_row"].item(row))
    present = row - first_row
    index: IntArray = present + np.array([*config.offsets, config.offsets[-1] + config.step])
    there = (index >= 0) & (index < length)
    world_from_ego = np.tile(np.eye(4), (len(index), 1, 1))
    world_from_ego[there] = stored_transforms(dataset.columns("ego_pose")["matrix"][first_row + index[there]])
    past = config.receptive_field - 1
    known = index[past:-1][there[past:-1]]
    frames = iter(_frames(dataset, sample, first_row, known, config))
    return motion_labels_from_boxes(
        [next(frames) if one else None for one in there[past:-1]],
        egomotion(world_from_ego, there, config.rules),
        config,
        valid=there[:-1],
        is_vehicle=AGENTS[samples["agent"].item(row)] != INFRASTRUCTURE,
        id_map=id_map,
    )


def _frames(
    dataset: Dataset, sample: RowArgument, first_row: int, index: IntArray, config: MotionLabelConfig
) -> list[FrameBoxes]:
    """The boxes of the sample's agent, whose samples begin at `first_row`, at the frames `index`, from 0."""
    boxes, rows = dataset.columns("annotation"), first_row + index
    slices = _annotations(dataset, rows)
    actors = [boxes["actor_id"][one] for one in slices]
    visible = [np.ones(len(actor), dtype=bool) for actor in actors]
    if config.filter_invisible:
        mask = np.isin(_pairs(actors, slices), _seen(dataset, sample, index, config))
        visible = np.split(mask, np.cumsum([len(actor) for actor in actors])[:-1])
    lidars = rows * len(CHANNELS) + CHANNELS.index(LIDAR)
    ego_from_lidar = stored_transforms(dataset.columns("sample_data")["matrix"][lidars])
    if config.rules.pose == "yaw":
        world_from_ego = stored_transforms(dataset.columns("ego_pose")["matrix"][rows])
        world_from_level = conventions.six_vectors_of(world_from_ego) * (1, 1, 1, 0, 0, 1)
        ego_from_lidar = inverses(conventions.matrices_of_six(world_from_level)) @ world_from_ego @ ego_from_lidar
    return [
        FrameBoxes(
            center=boxes["translation"][one],
            size=boxes["size"][one],
            yaw=boxes["yaw"][one],
            actor_id=actor,
            category=boxes["category"][one],
            visible=is_visible,
            ego_from_lidar=pose,
        )
        for one, actor, is_visible, pose in zip(slices, actors, visible, ego_from_lidar, strict=True)
    ]


def _seen(dataset: Dataset, sample: RowArgument, index: IntArray, config: MotionLabelConfig) -> IntArray:
    """The `_pairs` of actors and frames at which an agent whose sight counts sees them.

    See docs/released_code.md, Visibility and attributes.
    """
    boxes, scenario = dataset.columns("annotation"), dataset.get("sample", sample)["scenario_token"]
    pairs = []
    for agent in cooperating_agents(dataset, sample, config.agents):
        first_row = dataset.columns("agent")["first_sample_row"].item(dataset.getind("agent", f"{scenario}/{agent}"))
        slices = _annotations(dataset, first_row + index)
        actors = [boxes["actor_id"][one] for one in slices]
        actor, mask = np.concatenate(actors), np.concatenate([boxes["camera_visible"][one] for one in slices])
        if config.rules.sight != "camera":
            by_points = visible_mask(
                np.concatenate([boxes["translation"][one] for one in slices])[:, :2],
                np.concatenate([boxes["category"][one] for one in slices]),
                np.concatenate([boxes["num_lidar_pts"][one] for one in slices]),
                mask,
                infrastructure=agent == INFRASTRUCTURE,
            )
            mask = by_points & (actor != UNTRACKED_ID)
        pairs.append(_pairs(actors, slices)[mask & (actor != OWN_ACTOR_ID)])
    return np.concatenate(pairs)


def _annotations(dataset: Dataset, rows: IntArray) -> list[slice]:
    """Where the boxes of samples are in the annotation table; empty without a label."""
    samples = dataset.columns("sample")
    first = np.maximum(samples["first_annotation_row"][rows], 0).tolist()
    count = samples["num_annotations"][rows].tolist()
    return [slice(start, start + length) for start, length in zip(first, count, strict=True)]


def _pairs(actors: list[AnyArray], slices: list[slice]) -> IntArray:
    """One number for each row of `actors`, frame by frame: it stands for the pair of actor and frame.

    An untracked row is an actor of its own; `slices` has the rows in the annotation table.
    """
    actor, row = np.concatenate(actors), np.concatenate([np.arange(one.start, one.stop) for one in slices])
    number = np.repeat(np.arange(len(actors)), [len(actor) for actor in actors])
    pairs: IntArray = np.where(actor == UNTRACKED_ID, OWN_ACTOR_ID - 1 - row, actor) * len(actors) + number
    return pairs
