"""What is derived from labels: world poses, chains, instances, tracks, and which annotated actors count as seen.

Arrays are over the N boxes of one scenario, in the order agent, frame, row. Who is seen is decided by the released rule
(docs/released_code.md, Visibility and attributes).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.release import Labels
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray, as_floats
from deepaccident_devkit.tables.columns import NULL_INTEGER
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, SMALL_CATEGORIES, UNTRACKED_ID

NEAR_VEHICLE = 10.0
NEAR_INFRASTRUCTURE = 15.0
"""Metres from the LiDAR below which (strictly) a box is near."""
_SMALL = np.array([name in SMALL_CATEGORIES for name in CATEGORIES])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScenarioBoxes:
    """The boxes of one scenario and where each was recorded.

    Attributes:
        labels: the boxes themselves (N).
        sample: (N,) row of each box's sample within the scenario.
        agent: (N,) row of its agent within the scenario.
        frame: (N,) frame number, from 1.
        agent_order: (N,) position of its agent in `taxonomy.AGENTS`.
        actor: (N,) CARLA id; the agent's own for −100, −1 where unknown.
        world_from_lidar: (S, 4, 4) of every sample.
    """

    labels: Labels
    sample: IntArray
    agent: IntArray
    frame: IntArray
    agent_order: IntArray
    actor: IntArray
    world_from_lidar: FloatArray

    def __len__(self) -> int:
        return len(self.sample)


def box_rotation(boxes: ScenarioBoxes) -> FloatArray:
    """(N, 4) quaternions of the boxes in their LiDAR frames."""
    return quaternions.from_yaw(boxes.labels.yaw)


def world_centers(boxes: ScenarioBoxes) -> FloatArray:
    """(N, 3) box centres in world, metres."""
    pose = boxes.world_from_lidar[boxes.sample]
    return as_floats(np.einsum("nij,nj->ni", pose[:, :3, :3], boxes.labels.center) + pose[:, :3, 3])


def world_rotations(boxes: ScenarioBoxes) -> FloatArray:
    """(N, 4) quaternions of the boxes in world: an agent's pitch and roll included."""
    poses = quaternions.left_multiplier(quaternions.from_matrix(boxes.world_from_lidar[:, :3, :3]))
    return as_floats(np.einsum("nij,nj->ni", poses[boxes.sample], box_rotation(boxes)))


def to_lidar(boxes: ScenarioBoxes, world_vectors: FloatArray) -> FloatArray:
    """(N, 3) world vectors along the axes of each box's LiDAR frame."""
    return as_floats(np.einsum("nji,nj->ni", boxes.world_from_lidar[boxes.sample, :3, :3], world_vectors))


def chains(boxes: ScenarioBoxes) -> tuple[AnyArray, AnyArray]:
    """(N,) row of the same agent's previous and next box of the same label id; −1 at the ends and for id −1."""
    label_id = boxes.labels.actor_id
    order = np.lexsort((np.arange(len(boxes)), boxes.frame, label_id, boxes.agent))
    same = (boxes.agent[order][1:] == boxes.agent[order][:-1]) & (label_id[order][1:] == label_id[order][:-1])
    same &= label_id[order][1:] != UNTRACKED_ID
    previous = np.full(len(boxes), NULL_INTEGER, dtype=np.int32)
    following = previous.copy()
    previous[order[1:][same]] = order[:-1][same]
    following[order[:-1][same]] = order[1:][same]
    return previous, following


def instances(boxes: ScenarioBoxes) -> tuple[Mapping[str, AnyArray], AnyArray]:
    """The columns of the scenario's instances, by ascending actor id, and the instance row (N,) of each box."""
    known = np.flatnonzero(boxes.actor != UNTRACKED_ID)
    order = known[np.lexsort((known, boxes.agent_order[known], boxes.frame[known], boxes.actor[known]))]
    actors, first, count = np.unique(boxes.actor[order], return_index=True, return_counts=True)
    instance_row = np.full(len(boxes), NULL_INTEGER, dtype=np.int32)
    instance_row[order] = np.repeat(np.arange(len(actors)), count)
    columns = {
        "scenario_row": np.zeros(len(actors)),
        "actor_id": actors,
        "category": boxes.labels.category[order[first]],
        "num_annotations": count,
        "first_annotation_row": order[first],
        "last_annotation_row": order[first + count - 1],
    }
    return columns, instance_row


def tracks(boxes: ScenarioBoxes, instance_row: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Which box stands for each actor at each frame, ordered by frame and instance, and who annotated it.

    The box of the first agent in order that saw the actor from outside. An agent's own row counts only if nobody else
    annotated it, since it lies up to 0.3 m from where the others see it.

    Returns:
        (M,) rows of the chosen boxes; (M,) uint8 bit masks over `taxonomy.AGENTS`.
    """
    known = np.flatnonzero(instance_row != NULL_INTEGER)
    own = boxes.labels.actor_id[known] == OWN_ACTOR_ID
    order = known[np.lexsort((known, boxes.agent_order[known], own, instance_row[known], boxes.frame[known]))]
    if not len(order):
        return order, np.zeros(0, dtype=np.uint8)
    starts = _group_starts(boxes.frame[order], instance_row[order])
    bits = np.left_shift(1, boxes.agent_order[order]).astype(np.uint8)
    return order[starts], np.bitwise_or.reduceat(bits, np.flatnonzero(starts))


def _group_starts(*keys: AnyArray) -> BoolArray:
    starts = np.ones(len(keys[0]), dtype=bool)
    starts[1:] = np.any([key[1:] != key[:-1] for key in keys], axis=0)
    return starts


def visible_mask(
    xy: ArrayLike, category: ArrayLike, num_lidar_pts: ArrayLike, camera_visible: ArrayLike, *, infrastructure: bool
) -> BoolArray:
    """Which boxes of one agent's label the agent sees, by points and cameras alone.

    Far boxes need a camera and points (2, or 1 for two-wheelers and pedestrians); near ones a camera or points (5, or
    2; near the infrastructure 1).

    Args:
        xy: (N, 2) metres in the agent's LiDAR frame, either handedness.
        category: (N,) class indices.
        num_lidar_pts: (N,) the agent's LiDAR points in each box.
        camera_visible: (N,) bool.
        infrastructure: whether the agent is the roadside pole.

    Returns:
        (N,) bool.
    """
    position, points = as_floats(xy).reshape(-1, 2), np.asarray(num_lidar_pts)
    camera, small = np.asarray(camera_visible, dtype=bool), _SMALL[np.asarray(category, dtype=np.intp)]
    # squares and root, not hypot: boxes on the very edge are decided by the last bit
    distance = np.sqrt(position[:, 0] * position[:, 0] + position[:, 1] * position[:, 1])
    far_seen = camera & (points >= np.where(small, 1, 2))
    if infrastructure:
        return np.where(distance < NEAR_INFRASTRUCTURE, camera | (points >= 1), far_seen)
    return np.where(distance < NEAR_VEHICLE, camera | (points >= np.where(small, 2, 5)), far_seen)


def visible_ids(masks: Sequence[ArrayLike], actor_ids: Sequence[ArrayLike]) -> IntArray:
    """The actors that at least one agent sees: the union over agents, each id once, ascending.

    The agents' own rows (−100) and untracked ones (−1) are never among them.

    Args:
        masks: `visible_mask` of each agent.
        actor_ids: the label ids (N,) of each agent's boxes.
    """
    seen = [np.asarray(ids)[np.asarray(mask, dtype=bool)] for mask, ids in zip(masks, actor_ids, strict=True)]
    union = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *seen]).astype(np.int64))
    return np.setdiff1d(union, (OWN_ACTOR_ID, UNTRACKED_ID))
