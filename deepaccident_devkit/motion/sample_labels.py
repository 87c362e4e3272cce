"""Motion labels of a sample of a release: what the tables hold, gathered for `motion_labels_from_boxes`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from deepaccident_devkit.arrays import BoolArray
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.motion.config import MotionLabelConfig
from deepaccident_devkit.motion.drawing.from_boxes import FrameBoxes, motion_labels_from_boxes
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.warps.chains import egomotion
from deepaccident_devkit.taxonomy import INFRASTRUCTURE, LIDAR
from deepaccident_devkit.v2x.cooperation import visible_actors


def motion_labels(
    dataset: Dataset,
    sample: RowArgument,
    config: MotionLabelConfig | None = None,
    *,
    id_map: Mapping[int, int] | None = None,
) -> MotionLabels:
    """The motion labels of a sample, each frame in its own ego frame; `MotionLabels.to_present` warps them.

    Args:
        dataset: the release.
        sample: token or record of the present.
        config: what labels show; None for the released ones in the devkit's orientation.
        id_map: actor id → id that a sample before this one had: the released code keeps them for a scenario and agent
            as long as a worker meets no other, so that ids depend on what it met. None starts at 1.

    Returns:
        Labels of `config.label_frames` frames; what is beyond the recording is not valid.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label, or an agent whose sight counts is not in this (partial) release.
        ChoiceError: no such agent or configuration of agents.
    """
    chosen = config or MotionLabelConfig()
    record = dataset.get("sample", sample)
    if not record["labelled"]:
        raise NotAvailableError(f"{record['token']} has no label to draw (the test split ships without them)")
    recording, number = record["token"].rsplit("/", 1)
    length = dataset.columns("scenario")["num_frames"].item(dataset.getind("scenario", record["scenario_token"]))
    indices = [int(number) + offset for offset in chosen.offsets]
    tokens = [_sample_at(recording, index, length) for index in indices]
    beyond = _sample_at(recording, indices[-1] + chosen.step, length)
    poses = np.stack([np.eye(4) if one is None else dataset.world_from(one, "ego").matrix for one in [*tokens, beyond]])
    there: BoolArray = np.array([one is not None for one in [*tokens, beyond]])
    return motion_labels_from_boxes(
        [None if one is None else _frame_boxes(dataset, one, chosen) for one in tokens[chosen.receptive_field - 1 :]],
        egomotion(poses, there, chosen.rules.warp),
        chosen,
        valid=there[:-1],
        is_vehicle=record["agent"] != INFRASTRUCTURE,
        id_map=id_map,
    )


def _sample_at(recording: str, index: int, length: int) -> str | None:
    return f"{recording}/{index:03d}" if 1 <= index <= length else None


def _frame_boxes(dataset: Dataset, token: str, config: MotionLabelConfig) -> FrameBoxes:
    boxes, columns = dataset.boxes(token, "lidar"), dataset.columns("annotation")
    visible = np.ones(len(boxes), dtype=bool)
    if config.filter_invisible:
        visible = np.isin(boxes.actor_id, visible_actors(dataset, token, agents=config.agents))
    return FrameBoxes(
        center=boxes.center,
        size=boxes.size,
        yaw=columns["yaw"][dataset.annotation_rows(token)],
        actor_id=boxes.actor_id,
        category=boxes.category,
        visible=visible,
        ego_from_lidar=dataset.ego_from(token, LIDAR).matrix,
    )
