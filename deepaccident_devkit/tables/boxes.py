"""What is derived from labels: world poses, chains, instances, tracks, and which annotated actors count as seen.

Arrays are over the N boxes of one scenario, in the order agent, frame, row. Who is seen is decided by the released rule
(docs/released_code.md, Visibility and attributes).
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
_SMALL = np.array([name in SMALL_CATEGORIES for name in CATEGORIES])
LEAST_BOXES: Final = 20
"""With fewer moving boxes it is not known how a scenario's velocities are written."""
# m/s; slower actors are not used.
_LEAST_SPEED = 1.0
# m/s, and as a share of the speed, within which a velocity fits.
_FITS = (0.5, 0.15)
_LEAST_SHARE = 0.5
# Share of the best frame's boxes from which the release's own frame is taken instead.
_AS_GOOD = 0.95


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
    return as_floats(
        np.einsum("nji,nj->ni", boxes.world_from_lidar[boxes.sample, :3, :3], world_vectors)
    )


def chains(boxes: ScenarioBoxes) -> tuple[AnyArray, AnyArray]:
    """(N,) row of the same agent's previous and next box of the same label id; −1 at the ends and for id −1."""
    label_id = boxes.labels.actor_id
    order = np.lexsort((np.arange(len(boxes)), boxes.frame, label_id, boxes.agent))
    same = (boxes.agent[order][1:] == boxes.agent[order][:-1]) & (
        label_id[order][1:] == label_id[order][:-1]
    )
    same &= label_id[order][1:] != UNTRACKED_ID
    previous = np.full(len(boxes), NULL_INTEGER, dtype=np.int32)
    following = previous.copy()
    previous[order[1:][same]] = order[:-1][same]
    following[order[:-1][same]] = order[1:][same]
    return previous, following


def instances(boxes: ScenarioBoxes) -> tuple[Mapping[str, AnyArray], AnyArray]:
    """The columns of the scenario's instances, by ascending actor id, and the instance row (N,) of each box."""
    known = np.flatnonzero(boxes.actor != UNTRACKED_ID)
    order = known[
        np.lexsort((known, boxes.agent_order[known], boxes.frame[known], boxes.actor[known]))
    ]
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
    """Which box (M,) stands for each actor at each frame, by frame and instance; (M,) bit masks of who annotated it.

    The box of the first agent in order that saw the actor from outside. An agent's own row counts only if nobody else
    annotated it, since it lies up to 0.3 m from where the others see it.
    """
    known = np.flatnonzero(instance_row != NULL_INTEGER)
    own = boxes.labels.actor_id[known] == OWN_ACTOR_ID
    order = known[
        np.lexsort((known, boxes.agent_order[known], own, instance_row[known], boxes.frame[known]))
    ]
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
    xy: ArrayLike,
    category: ArrayLike,
    num_lidar_pts: ArrayLike,
    camera_visible: ArrayLike,
    *,
    infrastructure: ArrayLike,
) -> BoolArray:
    """Which boxes of an agent's label the agent sees, by points and cameras alone; also of several agents' labels.

    Far boxes need a camera and points (2, or 1 for two-wheelers and pedestrians); near ones a camera or points (5, or
    2; near the infrastructure 1).

    Args:
        xy: (N, 2) metres in the agent's LiDAR frame, either handedness.
        category: (N,) class indices.
        num_lidar_pts: (N,) the agent's LiDAR points in each box.
        camera_visible: (N,) bool.
        infrastructure: whether the agent is the roadside pole; (N,) bool for boxes of several agents.

    Returns:
        (N,) bool.
    """
    position, points = as_floats(xy).reshape(-1, 2), np.asarray(num_lidar_pts)
    camera, small = (
        np.asarray(camera_visible, dtype=bool),
        _SMALL[np.asarray(category, dtype=np.intp)],
    )
    # squares and root, not hypot: boxes on the very edge are decided by the last bit
    distance = np.sqrt(position[:, 0] * position[:, 0] + position[:, 1] * position[:, 1])
    far_seen = camera & (points >= np.where(small, 1, 2))
    near = distance < np.where(infrastructure, NEAR_INFRASTRUCTURE, NEAR_VEHICLE)
    return np.where(
        near, camera | (points >= np.where(infrastructure, 1, np.where(small, 2, 5))), far_seen
    )


def visible_ids(masks: Sequence[ArrayLike], actor_ids: Sequence[ArrayLike]) -> IntArray:
    """The actors that at least one agent sees: the union over agents, each id once, ascending.

    The agents' own rows (−100) and untracked ones (−1) are never among them.

    Args:
        masks: `visible_mask` of each agent.
        actor_ids: the label ids (N,) of each agent's boxes.
    """
    seen = [
        np.asarray(ids)[np.asarray(mask, dtype=bool)]
        for mask, ids in zip(masks, actor_ids, strict=True)
    ]
    union = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *seen]).astype(np.int64))
    return np.setdiff1d(union, (OWN_ACTOR_ID, UNTRACKED_ID))


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityFit(ShortRepr):
    """How many boxes' velocities fit their displacement in each of `VELOCITY_FRAMES`; adds up over scenarios.

    Attributes:
        boxes: moving, tracked boxes of others that have both velocities.
        fits: frame → boxes that fit.
    """

    boxes: int
    fits: Mapping[str, int]

    @property
    def best(self) -> str | None:
        """The frame that fits most boxes; None if there are too few, or none fits half of them.

        The release's own counts where it fits nearly as many: on a straight road along x all frames are alike.
        """
        name = max(self.fits, key=lambda frame: self.fits[frame])
        if self.fits[RELEASED_VELOCITY_FRAME] >= _AS_GOOD * self.fits[name]:
            name = RELEASED_VELOCITY_FRAME
        return (
            name
            if self.boxes >= LEAST_BOXES and self.fits[name] >= _LEAST_SHARE * self.boxes
            else None
        )


def total_fit(fits: list[VelocityFit]) -> VelocityFit:
    """The sum over scenarios."""
    return VelocityFit(
        boxes=sum(fit.boxes for fit in fits),
        fits={name: sum(fit.fits[name] for fit in fits) for name in VELOCITY_FRAMES},
    )


def displacement_velocities(
    centers: FloatArray, agent: IntArray, label_id: IntArray, frame: IntArray
) -> FloatArray:
    """(N, 3) m/s in world from displacements at 10 Hz, NaN where unknown.

    A track is one agent's rows of one label id (−100 is its own track): central differences where the frames before
    and after are there, one-sided where one is, NaN where none is and for untracked rows.

    Args:
        centers: (N, 3) box centres in world, metres.
        agent: (N,) which agent's.
        label_id: (N,) ids as the labels say.
        frame: (N,) frame numbers.
    """
    keys = np.column_stack([agent, label_id, frame])
    steps, first, step_of = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    position = centers[first]
    follows = (steps[1:, :2] == steps[:-1, :2]).all(axis=1) & (steps[1:, 2] == steps[:-1, 2] + 1)
    before = np.concatenate([[False], follows])[: len(steps)]
    after = np.concatenate([follows, [False]])[: len(steps)]
    index = np.arange(len(steps))
    span = (before.astype(np.float64) + after) * FRAME_PERIOD
    known = (before | after) & (steps[:, 1] != UNTRACKED_ID)
    velocity = np.full((len(steps), 3), np.nan)
    with np.errstate(over="ignore"):  # labels may hold the largest numbers
        moved = position[index + after] - position[index - before]
        velocity[known] = moved[known] / span[known, None]
    return velocity[step_of.reshape(-1)]


def fit_velocities(boxes: ScenarioBoxes, displacement: FloatArray) -> VelocityFit:
    """Which of `VELOCITY_FRAMES` the labels' velocities are in, by the displacements (N, 3) of the same boxes."""
    rows, fits = velocities_that_fit(boxes, displacement)
    return VelocityFit(boxes=len(rows), fits={name: int(fit.sum()) for name, fit in fits.items()})


def velocities_that_fit(
    boxes: ScenarioBoxes, displacement: FloatArray
) -> tuple[IntArray, dict[str, BoolArray]]:
    """The rows (M,) of boxes that are used, and which of them fit each frame."""
    label_id, said = boxes.labels.actor_id, boxes.labels.velocity
    speed = np.linalg.norm(displacement[:, :2], axis=1)
    telling = (label_id != OWN_ACTOR_ID) & (label_id != UNTRACKED_ID) & (label_id < STATIC_ACTOR_ID)
    rows = np.flatnonzero(telling & (speed > _LEAST_SPEED) & np.isfinite(said).all(axis=1))
    limit = _FITS[0] + _FITS[1] * speed[rows]
    return rows, {
        name: np.linalg.norm(
            turned_vectors(said[rows], angle[rows]) - displacement[rows, :2], axis=1
        )
        < limit
        for name, angle in _angles(boxes).items()
    }


def decoded_velocities(
    boxes: ScenarioBoxes, displacement: FloatArray, frame: str | None
) -> FloatArray:
    """(N, 3) m/s in world: the labels' own, which are in `frame`, where they have any; else the displacements (N, 3).

    A label has no vertical velocity: it is taken from the displacement, and is 0 without one. None for the frame is the
    release's own way.
    """
    over_ground = turned_vectors(
        boxes.labels.velocity, _angles(boxes)[frame or RELEASED_VELOCITY_FRAME]
    )
    own = boxes.labels.actor_id == OWN_ACTOR_ID
    over_ground[own] = boxes.labels.velocity[own]  # in world, whatever the others' are in
    velocity = np.column_stack([over_ground, np.nan_to_num(displacement[:, 2])])
    unknown = np.flatnonzero(np.isnan(over_ground[:, 0] + over_ground[:, 1]))
    velocity[unknown] = displacement[unknown]
    return velocity


def _angles(boxes: ScenarioBoxes) -> dict[str, FloatArray]:
    """Frame → the angles (N,) that turn the labels' velocities into world."""
    pose = boxes.world_from_lidar[boxes.sample]
    heading = np.arctan2(pose[:, 1, 0], pose[:, 0, 0])
    return {
        "released": -boxes.labels.yaw,
        "lidar": heading,
        "world": np.zeros(len(boxes)),
        "turned-wrong": -heading,
        "box": quaternions.yaw_of(world_rotations(boxes)),
    }
