"""Which annotated actors count as seen: the released rule (docs/released_code.md, Visibility and attributes)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import BoolArray, IntArray, as_floats
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, SMALL_CATEGORIES, UNTRACKED_ID

NEAR_VEHICLE = 10.0
NEAR_INFRASTRUCTURE = 15.0
"""Metres from the LiDAR below which (strictly) a box is near."""
_SMALL = np.array([name in SMALL_CATEGORIES for name in CATEGORIES])


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
