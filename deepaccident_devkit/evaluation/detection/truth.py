"""The true boxes of a sample, as a detection protocol has them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.evaluation.detection.protocols import DetectionProtocol, detection_protocol
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID, UNTRACKED_ID
from deepaccident_devkit.v2x import Agents, cooperative_boxes


def detection_truth(
    dataset: Dataset,
    sample: RowArgument,
    protocol: str | DetectionProtocol = "released",
    *,
    agents: Agents = None,
) -> Boxes:
    """What a detector should have found at a sample, by a protocol: its `truth`, `label_velocity` and `own_box`.

    Area and ranges are not applied: `DetectionEvaluator.update` does that to both sides.

    Args:
        dataset: the release.
        sample: token or record: its agent is the one around whom is evaluated.
        protocol: name, or a protocol.
        agents: for `cooperative` truth, whose labels are united (as `v2x.cooperative_boxes`); None for all.

    Returns:
        Boxes in the protocol's frame.

    Raises:
        TokenError: no such sample.
        ChoiceError: no such protocol, agent or configuration.
        ConfigError: `agents` are given and the truth is not cooperative.
        NotAvailableError: the sample has no label (the test split ships without), or an agent is not in this release.
    """
    rules = detection_protocol(protocol)
    record = dataset.get("sample", sample)
    if not record["labelled"]:
        raise NotAvailableError(f"{record['token']}: has no label, so that nothing can be evaluated")
    if rules.truth == "cooperative":
        boxes = cooperative_boxes(dataset, sample, agents=agents, frame=rules.frame)
        own_actor = dataset.get("agent", record["agent_token"])["actor_id"]
        own = boxes.actor_id == (OWN_ACTOR_ID if own_actor is None or own_actor == UNTRACKED_ID else own_actor)
    elif agents is not None:
        raise ConfigError(f"agents: the truth of this protocol is {rules.truth!r}; choose truth='cooperative', or None")
    else:
        boxes = dataset.boxes(sample, rules.frame, "released" if rules.truth == "visible" else None)
        own = boxes.actor_id == OWN_ACTOR_ID
    if rules.label_velocity:
        boxes = _with_label_velocity(dataset, sample, boxes, rules)
    return boxes if rules.own_box else boxes.select(~own)


def _with_label_velocity(dataset: Dataset, sample: RowArgument, boxes: Boxes, rules: DetectionProtocol) -> Boxes:
    """The boxes with the velocities that stand in the label, which the released code takes to be in LiDAR axes."""
    if rules.frame != "lidar" or rules.truth == "cooperative":
        raise ConfigError("label_velocity: the label's velocities are those of one agent's LiDAR frame; choose False")
    written = dataset.columns("annotation")["velocity_label"][dataset.annotation_rows(sample)][boxes.row]
    return replace(boxes, velocity=np.column_stack([written, np.zeros(len(written))]))
