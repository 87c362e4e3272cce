"""Data derived from labels: world poses, chains, instances, tracks, and visibility of actors.

Arrays are over the N boxes of one scenario, in the order agent, frame, row. Visibility follows the
released rule (docs/released_code.md, Visibility and attributes).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.release import Labels
from deepaccident_devkit.release.labels import turned_vectors
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    IntArray,
    ShortRepr,
    as_floats,
)
from deepaccident_devkit.tables.columns import NULL_INTEGER
from deepaccident_devkit.taxonomy import (
    CATEGORIES,
    FRAME_PERIOD,
    OWN_ACTOR_ID,
    RELEASED_VELOCITY_FRAME,
    SMALL_CATEGORIES,
    STATIC_ACTOR_ID,
    UNTRACKED_ID,
    VELOCITY_FRAMES,
)

NEAR_VEHICLE = 10.0
NEAR_INFRASTRUCTURE = 15.0
"""Metres from the LiDAR below which (strictly) a box is near."""
_IS_SMALL = np.array([name in SMALL_CATEGORIES for name in CATEGORIES])
MIN_BOXES: Final = 20
"""Moving boxes that a scenario needs to show the frame of its velocities."""
# m/s; slower actors are not used.
_MIN_SPEED = 1.0
# Error of a velocity that fits: absolute, and as a share of the speed.
_TOLERANCE_MPS = 0.5
_TOLERANCE_SHARE = 0.15
# Share of the boxes that the best frame must fit.
_MIN_FIT_SHARE = 0.5
# Share of the best frame's boxes with which the release's own frame is preferred.
_RELEASED_FIT_SHARE = 0.95


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScenarioBoxes:
    """The boxes of one scenario and where each was recorded.

    Attributes:
        labels: The N boxes themselves.
        sample: Row of each box's sample within the scenario, shape (N,).
        agent: Row of its agent within the scenario, shape (N,).
        frame: Frame number, shape (N,), from 1.
        agent_order: Position of its agent in `taxonomy.AGENTS`, shape (N,).
        actor: CARLA id, shape (N,); the agent's own for −100, −1 where unknown.
        world_from_lidar: Pose of every sample, shape (S, 4, 4).
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
    """Return quaternions of the boxes in their LiDAR frames, shape (N, 4)."""
    return quaternions.from_yaw(boxes.labels.yaw)


def world_centers(boxes: ScenarioBoxes) -> FloatArray:
    """Return box centres in world, shape (N, 3), metres."""
    pose = boxes.world_from_lidar[boxes.sample]
    rotated = np.einsum("nij,nj->ni", pose[:, :3, :3], boxes.labels.center)
    return as_floats(rotated + pose[:, :3, 3])


def world_rotations(boxes: ScenarioBoxes) -> FloatArray:
    """Return quaternions of the boxes in world, shape (N, 4), with an agent's pitch and roll."""
    rotations = quaternions.from_matrix(boxes.world_from_lidar[:, :3, :3])
    multipliers = quaternions.left_multiplier(rotations)[boxes.sample]
    return as_floats(np.einsum("nij,nj->ni", multipliers, box_rotation(boxes)))


def to_lidar(boxes: ScenarioBoxes, world_vectors: FloatArray) -> FloatArray:
    """Return world vectors (N, 3) along the axes of each box's LiDAR frame."""
    rotations = boxes.world_from_lidar[boxes.sample, :3, :3]
    return as_floats(np.einsum("nji,nj->ni", rotations, world_vectors))


def chains(boxes: ScenarioBoxes) -> tuple[AnyArray, AnyArray]:
    """Return rows of the same agent's previous and next box of the same label id, shape (N,) each.

    Rows are −1 at the ends and for id −1.
    """
    label_id = boxes.labels.actor_id
    order = np.lexsort((np.arange(len(boxes)), boxes.frame, label_id, boxes.agent))
    ids = label_id[order]
    agents = boxes.agent[order]
    same_track = (agents[1:] == agents[:-1]) & (ids[1:] == ids[:-1])
    same_track &= ids[1:] != UNTRACKED_ID
    previous = np.full(len(boxes), NULL_INTEGER, dtype=np.int32)
    following = previous.copy()
    previous[order[1:][same_track]] = order[:-1][same_track]
    following[order[:-1][same_track]] = order[1:][same_track]
    return previous, following


def instances(boxes: ScenarioBoxes) -> tuple[Mapping[str, AnyArray], AnyArray]:
    """Return columns of the scenario's instances, by actor id, and each box's instance row (N,)."""
    known = np.flatnonzero(boxes.actor != UNTRACKED_ID)
    keys = (known, boxes.agent_order[known], boxes.frame[known], boxes.actor[known])
    order = known[np.lexsort(keys)]
    actors, start, count = np.unique(boxes.actor[order], return_index=True, return_counts=True)
    instance_row = np.full(len(boxes), NULL_INTEGER, dtype=np.int32)
    instance_row[order] = np.repeat(np.arange(len(actors)), count)
    first_row = order[start]
    columns = {
        "scenario_row": np.zeros(len(actors)),
        "actor_id": actors,
        "category": boxes.labels.category[first_row],
        "num_annotations": count,
        "first_annotation_row": first_row,
        "last_annotation_row": order[start + count - 1],
    }
    return columns, instance_row


def tracks(boxes: ScenarioBoxes, instance_row: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Return the box that stands for each actor at each frame, and the agents that annotated it.

    It is the box of the first agent in order that saw the actor from outside. An agent's own row
    only counts if nobody else annotated it, since it lies up to 0.3 m from where the others see it.

    Returns:
        Rows of boxes, shape (M,), by frame and instance, and bit masks of agents, shape (M,).
    """
    known = np.flatnonzero(instance_row != NULL_INTEGER)
    is_own = boxes.labels.actor_id[known] == OWN_ACTOR_ID
    keys = (known, boxes.agent_order[known], is_own, instance_row[known], boxes.frame[known])
    order = known[np.lexsort(keys)]
    if not len(order):
        return order, np.zeros(0, dtype=np.uint8)
    starts = _group_starts(boxes.frame[order], instance_row[order])
    bits = np.left_shift(1, boxes.agent_order[order]).astype(np.uint8)
    return order[starts], np.bitwise_or.reduceat(bits, np.flatnonzero(starts))


def _group_starts(*keys: AnyArray) -> BoolArray:
    starts = np.ones(len(keys[0]), dtype=bool)
    changes = [key[1:] != key[:-1] for key in keys]
    starts[1:] = np.any(changes, axis=0)
    return starts


def visible_mask(
    xy: ArrayLike,
    category: ArrayLike,
    num_lidar_pts: ArrayLike,
    camera_visible: ArrayLike,
    *,
    infrastructure: ArrayLike,
) -> BoolArray:
    """Return which boxes of an agent's label the agent sees, from its points and cameras only.

    Boxes of several agents' labels can be given at once. Distant boxes need a camera and points (2,
    or 1 for two-wheelers and pedestrians); near ones need a camera or points (5, or 2; near the
    infrastructure 1).

    Args:
        xy: Positions in the agent's LiDAR frame, shape (N, 2), metres, either handedness.
        category: Class indices, shape (N,).
        num_lidar_pts: The agent's LiDAR points in each box, shape (N,).
        camera_visible: Whether a camera sees the box, shape (N,), bool.
        infrastructure: Whether the agent is the roadside pole; for boxes of several agents shape
            (N,), bool.

    Returns:
        Mask of visible boxes, shape (N,), bool.
    """
    position = as_floats(xy).reshape(-1, 2)
    points = np.asarray(num_lidar_pts)
    camera = np.asarray(camera_visible, dtype=bool)
    small = _IS_SMALL[np.asarray(category, dtype=np.intp)]
    # Squares and root, not hypot: the last bit decides about boxes on the very edge.
    distance = np.sqrt(position[:, 0] * position[:, 0] + position[:, 1] * position[:, 1])
    visible_if_distant = camera & (points >= np.where(small, 1, 2))
    min_points = np.where(infrastructure, 1, np.where(small, 2, 5))
    visible_if_near = camera | (points >= min_points)
    near = distance < np.where(infrastructure, NEAR_INFRASTRUCTURE, NEAR_VEHICLE)
    return np.where(near, visible_if_near, visible_if_distant)


def visible_ids(masks: Sequence[ArrayLike], actor_ids: Sequence[ArrayLike]) -> IntArray:
    """Return the actors that at least one agent sees, each id once, ascending.

    The agents' own rows (−100) and untracked ones (−1) are left out.

    Args:
        masks: `visible_mask` of each agent.
        actor_ids: Label ids (N,) of each agent's boxes.
    """
    visible = [np.zeros(0, dtype=np.int64)]
    for mask, ids in zip(masks, actor_ids, strict=True):
        visible.append(np.asarray(ids)[np.asarray(mask, dtype=bool)])
    union = np.unique(np.concatenate(visible).astype(np.int64))
    return np.setdiff1d(union, (OWN_ACTOR_ID, UNTRACKED_ID))


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityFit(ShortRepr):
    """Boxes with velocities that fit their displacement in each of `VELOCITY_FRAMES`.

    Fits add up over scenarios.

    Attributes:
        boxes: Number of moving, tracked boxes of others that have both velocities.
        fits: Frame → boxes that fit.
    """

    boxes: int
    fits: Mapping[str, int]

    @property
    def best(self) -> str | None:
        """The frame that fits most boxes; None if there are too few, or none fits half of them.

        The release's own frame is taken where it fits nearly as many: on a straight road along x
        all frames are alike.
        """
        name = max(self.fits, key=lambda frame: self.fits[frame])
        if self.fits[RELEASED_VELOCITY_FRAME] >= _RELEASED_FIT_SHARE * self.fits[name]:
            name = RELEASED_VELOCITY_FRAME
        if self.boxes >= MIN_BOXES and self.fits[name] >= _MIN_FIT_SHARE * self.boxes:
            return name
        return None


def total_fit(fits: list[VelocityFit]) -> VelocityFit:
    """Return the sum over scenarios."""
    return VelocityFit(
        boxes=sum(fit.boxes for fit in fits),
        fits={name: sum(fit.fits[name] for fit in fits) for name in VELOCITY_FRAMES},
    )


def displacement_velocities(
    centers: FloatArray, agent: IntArray, label_id: IntArray, frame: IntArray
) -> FloatArray:
    """Return velocities in world from displacements at 10 Hz, shape (N, 3), m/s; NaN where unknown.

    A track is one agent's rows of one label id (−100 is its own track). Differences are central
    where the frames before and after exist, one-sided where only one does, and NaN without any and
    for untracked rows.

    Args:
        centers: Box centres in world, shape (N, 3), metres.
        agent: Row of the agent, shape (N,).
        label_id: Ids of the labels, shape (N,).
        frame: Frame numbers, shape (N,).
    """
    keys = np.column_stack([agent, label_id, frame])
    steps, row_of_step, step_of = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    position = centers[row_of_step]
    same_track = (steps[1:, :2] == steps[:-1, :2]).all(axis=1)
    follows = same_track & (steps[1:, 2] == steps[:-1, 2] + 1)
    before = np.concatenate([[False], follows])[: len(steps)]
    after = np.concatenate([follows, [False]])[: len(steps)]
    index = np.arange(len(steps))
    span = (before.astype(np.float64) + after) * FRAME_PERIOD
    known = (before | after) & (steps[:, 1] != UNTRACKED_ID)
    velocity = np.full((len(steps), 3), np.nan)
    # Labels may hold the largest numbers.
    with np.errstate(over="ignore"):
        moved = position[index + after] - position[index - before]
        velocity[known] = moved[known] / span[known, None]
    return velocity[step_of.reshape(-1)]


def fit_velocities(boxes: ScenarioBoxes, displacement: FloatArray) -> VelocityFit:
    """Return how many labels' velocities fit their displacements (N, 3) in each frame."""
    rows, matches = match_velocities(boxes, displacement)
    fits = {name: int(mask.sum()) for name, mask in matches.items()}
    return VelocityFit(boxes=len(rows), fits=fits)


def match_velocities(
    boxes: ScenarioBoxes, displacement: FloatArray
) -> tuple[IntArray, dict[str, BoolArray]]:
    """Match the labels' velocities with displacements (N, 3) in each of `VELOCITY_FRAMES`.

    Returns:
        Rows (M,) of the boxes that are used, and frame → mask (M,) of boxes that fit.
    """
    label_id = boxes.labels.actor_id
    velocity = boxes.labels.velocity
    speed = np.linalg.norm(displacement[:, :2], axis=1)
    tracked = (label_id != OWN_ACTOR_ID) & (label_id != UNTRACKED_ID) & (label_id < STATIC_ACTOR_ID)
    rows = np.flatnonzero(tracked & (speed > _MIN_SPEED) & np.isfinite(velocity).all(axis=1))
    tolerance = _TOLERANCE_MPS + _TOLERANCE_SHARE * speed[rows]
    matches = {}
    for name, angle in _angles(boxes).items():
        turned = turned_vectors(velocity[rows], angle[rows])
        error = np.linalg.norm(turned - displacement[rows, :2], axis=1)
        matches[name] = error < tolerance
    return rows, matches


def decoded_velocities(
    boxes: ScenarioBoxes, displacement: FloatArray, frame: str | None
) -> FloatArray:
    """Return velocities in world, shape (N, 3), m/s: the labels' own, or displacements (N, 3).

    Displacements are used for labels without a velocity. A label has no vertical velocity: it comes
    from the displacement, and is 0 without one.

    Args:
        boxes: Boxes of a scenario.
        displacement: Velocities from displacements, shape (N, 3), m/s.
        frame: Frame of the labels' velocities; None for the release's own.
    """
    angles = _angles(boxes)[frame or RELEASED_VELOCITY_FRAME]
    horizontal = turned_vectors(boxes.labels.velocity, angles)
    # Own rows are in world, whatever the frame of the others.
    own = boxes.labels.actor_id == OWN_ACTOR_ID
    horizontal[own] = boxes.labels.velocity[own]
    velocity = np.column_stack([horizontal, np.nan_to_num(displacement[:, 2])])
    unknown = np.flatnonzero(np.isnan(horizontal[:, 0] + horizontal[:, 1]))
    velocity[unknown] = displacement[unknown]
    return velocity


def _angles(boxes: ScenarioBoxes) -> dict[str, FloatArray]:
    """Return frame → angles (N,) that turn the labels' velocities into world."""
    pose = boxes.world_from_lidar[boxes.sample]
    heading = np.arctan2(pose[:, 1, 0], pose[:, 0, 0])
    return {
        "released": -boxes.labels.yaw,
        "lidar": heading,
        "world": np.zeros(len(boxes)),
        "turned-wrong": -heading,
        "box": quaternions.yaw_of(world_rotations(boxes)),
    }
