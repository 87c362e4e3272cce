"""Data derived from labels: world poses, chains, instances, tracks and visible actors.

Arrays have one row for each of the N boxes of a scenario, sorted by agent, frame and label row.
Visibility follows the released rule (docs/released_code.md, Visibility and attributes).
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
    NO_INDICES,
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
"""Distance from the LiDAR of a vehicle or a pole, metres, below which a box counts as near."""
_IS_SMALL = np.array([name in SMALL_CATEGORIES for name in CATEGORIES])
MIN_BOXES: Final = 20
"""Smallest number of moving boxes that reveals the frame of the velocities."""
# Slower actors are ignored, m/s.
_MIN_SPEED = 1.0
# Largest error of a velocity that fits: absolute, and as a fraction of the speed.
_TOLERANCE_MPS = 0.5
_TOLERANCE_SHARE = 0.15
# Smallest share of boxes that fit the best frame.
_MIN_FIT_SHARE = 0.5
# The release's own frame is preferred if it fits at least this share of the best frame's boxes.
_RELEASED_FIT_SHARE = 0.95


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScenarioBoxes:
    """The boxes of one scenario, and the sample in which each was recorded.

    Attributes:
        labels: The N boxes themselves.
        sample: Index of the box's sample within the scenario, shape (N,).
        agent: Index of the sample's agent within the scenario, shape (N,).
        frame: Frame number, shape (N,), from 1.
        agent_order: Index of the agent in `taxonomy.AGENTS`, shape (N,).
        actor: CARLA id, shape (N,); where the label has −100 (the recording agent itself), that
            agent's id; −1 if unknown.
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
    """Return the boxes' orientations in their LiDAR frames as quaternions, shape (N, 4)."""
    return quaternions.from_yaw(boxes.labels.yaw)


def world_centers(boxes: ScenarioBoxes) -> FloatArray:
    """Return box centres in world, shape (N, 3), metres."""
    pose = boxes.world_from_lidar[boxes.sample]
    rotated = np.einsum("nij,nj->ni", pose[:, :3, :3], boxes.labels.center)
    return as_floats(rotated + pose[:, :3, 3])


def world_rotations(boxes: ScenarioBoxes) -> FloatArray:
    """Return the boxes' orientations in world (N, 4), including the agent's pitch and roll."""
    rotations = quaternions.from_matrix(boxes.world_from_lidar[:, :3, :3])
    multipliers = quaternions.left_multiplier(rotations)[boxes.sample]
    return as_floats(np.einsum("nij,nj->ni", multipliers, box_rotation(boxes)))


def to_lidar(boxes: ScenarioBoxes, world_vectors: FloatArray) -> FloatArray:
    """Rotate world vectors (N, 3) into each box's LiDAR frame."""
    rotations = boxes.world_from_lidar[boxes.sample, :3, :3]
    return as_floats(np.einsum("nji,nj->ni", rotations, world_vectors))


def chains(boxes: ScenarioBoxes) -> tuple[AnyArray, AnyArray]:
    """Return the rows of the agent's previous and next box with the same label id, (N,) each.

    Rows are −1 at the ends of a track and for boxes with id −1.
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
    """Return the instances' columns, sorted by actor id, and the instance of each box (N,)."""
    known_rows = np.flatnonzero(boxes.actor != UNTRACKED_ID)
    keys = (
        known_rows,
        boxes.agent_order[known_rows],
        boxes.frame[known_rows],
        boxes.actor[known_rows],
    )
    order = known_rows[np.lexsort(keys)]
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
    """Return the box that represents each actor in each frame, and the agents that annotated it.

    It is the box of the first agent, in order, other than the actor itself. An agent's own row is
    used only if no other agent annotated that agent, because it is off by up to 0.3 m.

    Returns:
        Rows of boxes, shape (M,), sorted by frame and instance, and bit masks of agents, shape
            (M,).
    """
    known_rows = np.flatnonzero(instance_row != NULL_INTEGER)
    is_own = boxes.labels.actor_id[known_rows] == OWN_ACTOR_ID
    keys = (
        known_rows,
        boxes.agent_order[known_rows],
        is_own,
        instance_row[known_rows],
        boxes.frame[known_rows],
    )
    order = known_rows[np.lexsort(keys)]
    if not len(order):
        return order, np.zeros(0, dtype=np.uint8)
    starts = _find_group_starts(boxes.frame[order], instance_row[order])
    bits = np.left_shift(1, boxes.agent_order[order]).astype(np.uint8)
    return order[starts], np.bitwise_or.reduceat(bits, np.flatnonzero(starts))


def _find_group_starts(*keys: AnyArray) -> BoolArray:
    """Return which rows start a group of equal keys; the keys must be sorted."""
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
    """Return which boxes of its label an agent sees, using only its own LiDAR points and cameras.

    Boxes from several agents' labels can be passed at once. A distant box must be seen by a camera
    and have at least 2 points (two-wheelers and pedestrians: 1). A near box must be seen by a
    camera or have at least 5 points (two-wheelers and pedestrians: 2; near the infrastructure: 1).

    Args:
        xy: Positions in the agent's LiDAR frame, shape (N, 2), metres, either handedness.
        category: Class indices, shape (N,).
        num_lidar_pts: The agent's LiDAR points in each box, shape (N,).
        camera_visible: Whether a camera sees the box, shape (N,), bool.
        infrastructure: Whether the agent is the roadside pole, bool; for boxes of several agents,
            shape (N,).

    Returns:
        Mask of visible boxes, shape (N,), bool.
    """
    position = as_floats(xy).reshape(-1, 2)
    points = np.asarray(num_lidar_pts)
    camera = np.asarray(camera_visible, dtype=bool)
    is_small = _IS_SMALL[np.asarray(category, dtype=np.intp)]
    # Not np.hypot: its last bit may differ, which matters for boxes exactly at the limit.
    x = position[:, 0]
    y = position[:, 1]
    distance = np.sqrt(x * x + y * y)
    visible_if_distant = camera & (points >= np.where(is_small, 1, 2))
    min_points = np.where(infrastructure, 1, np.where(is_small, 2, 5))
    visible_if_near = camera | (points >= min_points)
    is_near = distance < np.where(infrastructure, NEAR_INFRASTRUCTURE, NEAR_VEHICLE)
    return np.where(is_near, visible_if_near, visible_if_distant)


def visible_ids(masks: Sequence[ArrayLike], actor_ids: Sequence[ArrayLike]) -> IntArray:
    """Return the actors that at least one agent sees, each id once, ascending.

    Agents' own rows (−100) and untracked rows (−1) are left out.

    Args:
        masks: `visible_mask` of each agent.
        actor_ids: Label ids (N,) of each agent's boxes.
    """
    visible = [NO_INDICES]
    for mask, ids in zip(masks, actor_ids, strict=True):
        visible.append(np.asarray(ids)[np.asarray(mask, dtype=bool)])
    union = np.unique(np.concatenate(visible).astype(np.int64))
    return np.setdiff1d(union, (OWN_ACTOR_ID, UNTRACKED_ID))


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityFit(ShortRepr):
    """Counts of boxes whose velocity fits their displacement, for each of `VELOCITY_FRAMES`.

    Counts of several scenarios add up.

    Attributes:
        boxes: Number of moving, tracked boxes (not agents' own) that have both velocities.
        fits: Frame → number of boxes that fit.
    """

    boxes: int
    fits: Mapping[str, int]

    @property
    def best(self) -> str | None:
        """Frame that fits most boxes; None for too few boxes, or if no frame fits half of them.

        The release's own frame is preferred if it fits nearly as many: on a straight road along x,
        all frames fit equally well.
        """
        name = max(self.fits, key=lambda frame: self.fits[frame])
        if self.fits[RELEASED_VELOCITY_FRAME] >= _RELEASED_FIT_SHARE * self.fits[name]:
            name = RELEASED_VELOCITY_FRAME
        if self.boxes >= MIN_BOXES and self.fits[name] >= _MIN_FIT_SHARE * self.boxes:
            return name
        return None

    def to_text(self) -> str:
        """Return the share of boxes that fit each frame as text, for one or more boxes."""
        shares = [f"{name} {100 * count / self.boxes:.0f} %" for name, count in self.fits.items()]
        return f"share of the {self.boxes:,} moving boxes that fit: {', '.join(shares)}"


def total_fit(fits: list[VelocityFit]) -> VelocityFit:
    """Return the sum of several scenarios' counts."""
    return VelocityFit(
        boxes=sum(fit.boxes for fit in fits),
        fits={name: sum(fit.fits[name] for fit in fits) for name in VELOCITY_FRAMES},
    )


def displacement_velocities(
    centers: FloatArray, agent: IntArray, label_id: IntArray, frame: IntArray
) -> FloatArray:
    """Return world velocities (N, 3), m/s, from displacements at 10 Hz; NaN if unknown.

    A track consists of one agent's rows with one label id (−100 is the agent's own track).
    Differences are central if the frames before and after exist, and one-sided if only one does.
    They are NaN if neither exists, and for untracked rows.

    Args:
        centers: Box centres in world, shape (N, 3), metres.
        agent: Index of the agent, shape (N,).
        label_id: Ids of the labels, shape (N,).
        frame: Frame numbers, shape (N,).
    """
    keys = np.column_stack([agent, label_id, frame])
    steps, row_of_step, step_of_row = np.unique(
        keys, axis=0, return_index=True, return_inverse=True
    )
    step_tracks = steps[:, :2]
    step_ids = steps[:, 1]
    step_frames = steps[:, 2]
    position = centers[row_of_step]
    is_same_track = (step_tracks[1:] == step_tracks[:-1]).all(axis=1)
    follows = is_same_track & (step_frames[1:] == step_frames[:-1] + 1)
    has_previous = np.concatenate([[False], follows])[: len(steps)]
    has_next = np.concatenate([follows, [False]])[: len(steps)]
    index = np.arange(len(steps))
    seconds = (has_previous.astype(np.float64) + has_next) * FRAME_PERIOD
    is_known = (has_previous | has_next) & (step_ids != UNTRACKED_ID)
    velocity = np.full((len(steps), 3), np.nan)
    # Labels may contain the largest floats.
    with np.errstate(over="ignore"):
        displacement = position[index + has_next] - position[index - has_previous]
        velocity[is_known] = displacement[is_known] / seconds[is_known, None]
    return velocity[step_of_row.reshape(-1)]


def fit_velocities(boxes: ScenarioBoxes, displacement: FloatArray) -> VelocityFit:
    """Count the label velocities that fit their displacements (N, 3), m/s, for each frame."""
    rows, matches = match_velocities(boxes, displacement)
    fits = {name: int(mask.sum()) for name, mask in matches.items()}
    return VelocityFit(boxes=len(rows), fits=fits)


def match_velocities(
    boxes: ScenarioBoxes, displacement: FloatArray
) -> tuple[IntArray, dict[str, BoolArray]]:
    """Compare label velocities with displacements (N, 3), m/s, for each of `VELOCITY_FRAMES`.

    Returns:
        Rows (M,) of the boxes that were compared, and frame → mask (M,) of the boxes that fit.
    """
    label_id = boxes.labels.actor_id
    velocity = boxes.labels.velocity
    speed = np.linalg.norm(displacement[:, :2], axis=1)
    is_other = (label_id != OWN_ACTOR_ID) & (label_id != UNTRACKED_ID)
    is_moving = (label_id < STATIC_ACTOR_ID) & (speed > _MIN_SPEED)
    is_finite = np.isfinite(velocity).all(axis=1)
    rows = np.flatnonzero(is_other & is_moving & is_finite)
    tolerance = _TOLERANCE_MPS + _TOLERANCE_SHARE * speed[rows]
    matches = {}
    for name, angle in _compute_angles(boxes).items():
        turned = turned_vectors(velocity[rows], angle[rows])
        error = np.linalg.norm(turned - displacement[rows, :2], axis=1)
        matches[name] = error < tolerance
    return rows, matches


def decoded_velocities(
    boxes: ScenarioBoxes, displacement: FloatArray, frame: str | None
) -> FloatArray:
    """Return world velocities (N, 3), m/s, from labels, or from displacements if labels have none.

    A label has no vertical velocity: that comes from the displacement, and is 0 if it is unknown.

    Args:
        boxes: Boxes of a scenario.
        displacement: Velocities from displacements, shape (N, 3), m/s.
        frame: Frame of the labels' velocities; None for the release's own.
    """
    angles = _compute_angles(boxes)[frame or RELEASED_VELOCITY_FRAME]
    horizontal = turned_vectors(boxes.labels.velocity, angles)
    # Agents' own rows are in world, whatever the frame of the others.
    is_own = boxes.labels.actor_id == OWN_ACTOR_ID
    horizontal[is_own] = boxes.labels.velocity[is_own]
    vertical = np.nan_to_num(displacement[:, 2])
    velocity = np.column_stack([horizontal, vertical])
    unknown_rows = np.flatnonzero(np.isnan(horizontal[:, 0] + horizontal[:, 1]))
    velocity[unknown_rows] = displacement[unknown_rows]
    return velocity


def _compute_angles(boxes: ScenarioBoxes) -> dict[str, FloatArray]:
    """Return frame → angles (N,), radians, that rotate label velocities to world."""
    pose = boxes.world_from_lidar[boxes.sample]
    heading = np.arctan2(pose[:, 1, 0], pose[:, 0, 0])
    return {
        "released": -boxes.labels.yaw,
        "lidar": heading,
        "world": np.zeros(len(boxes)),
        "turned-wrong": -heading,
        "box": quaternions.yaw_of(world_rotations(boxes)),
    }
