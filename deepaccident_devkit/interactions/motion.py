"""`ActorMotion`: all actors of a scenario at all frames in dense arrays, for work on pairs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.geometry.conflicts import normals
from deepaccident_devkit.interactions.config import InteractionConfig
from deepaccident_devkit.interactions.masses import masses_of
from deepaccident_devkit.tables import displacement_velocities
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x.tracks import ScenarioTracks


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ActorMotion(FrozenArrays):
    """A actors at F frames, seen from above; world, right-handed, SI units. NaN where nobody annotated an actor.

    Attributes:
        ids: (A,) CARLA ids, ascending.
        masses: (A,) kilograms, assumed.
        boxes: (A, F, 5) x, y, length, width, yaw.
        velocity: (A, F, 2) over the ground; NaN where neither a label nor a displacement says it.
        speed: (A, F) along the heading.
        acceleration: (A, F) along the heading: by the speeds one frame before and after; 0 without such.
        moves: (A, F) whether an actor is there and faster than `standing_speed`.
    """

    ids: IntArray
    masses: FloatArray
    boxes: FloatArray
    velocity: FloatArray
    speed: FloatArray
    acceleration: FloatArray
    moves: BoolArray

    @property
    def present(self) -> BoolArray:
        """(A, F) whether somebody annotated the actor."""
        there: BoolArray = ~np.isnan(self.boxes[..., 0])
        return there


def actor_motion(tracks: ScenarioTracks, num_frames: int, config: InteractionConfig) -> ActorMotion:
    """The actors of a scenario at its frames 1 to `num_frames`."""
    boxes = tracks.boxes
    ids, last = np.unique(tracks.actor_id[::-1], return_index=True)
    actor = np.searchsorted(ids, tracks.actor_id)
    place = (actor, tracks.index - 1)
    dense = np.full((len(ids), num_frames, 5), np.nan)
    dense[place] = np.column_stack([boxes.center[:, :2], boxes.size[:, :2], boxes.yaw])
    velocity = np.full((len(ids), num_frames, 2), np.nan)
    velocity[place] = _velocities(tracks)
    speed = (velocity * normals(dense[..., 4])).sum(axis=-1)
    rows = len(boxes) - 1 - last
    with np.errstate(invalid="ignore"):
        moves: BoolArray = np.hypot(velocity[..., 0], velocity[..., 1]) > config.standing_speed
    return ActorMotion(
        ids=ids,
        masses=masses_of(boxes.category[rows], _median_sizes(boxes.size, actor, len(ids)), config.class_masses),
        boxes=dense,
        velocity=velocity,
        speed=speed,
        acceleration=_accelerations(speed),
        moves=moves,
    )


def _velocities(tracks: ScenarioTracks) -> FloatArray:
    """(M, 2) the tracks' velocities, displacements where these are unknown."""
    velocity = tracks.boxes.velocity[:, :2]
    unknown: BoolArray = np.isnan(velocity.sum(axis=1))
    if not unknown.any():
        return velocity
    together = np.zeros(len(velocity), dtype=np.int64)
    moved = displacement_velocities(tracks.boxes.center, together, tracks.actor_id, tracks.index)
    return np.where(unknown[:, None], moved[:, :2], velocity)


def _median_sizes(sizes: FloatArray, actor: IntArray, count: int) -> FloatArray:
    """(A, 3) medians: a pedestrian's box changes its size with the steps."""
    return np.array([np.median(sizes[actor == each], axis=0) for each in range(count)]).reshape(-1, 3)


def _accelerations(speed: FloatArray) -> FloatArray:
    """(A, F) mean change of the speed to and from each frame, of what is known of both; 0 where nothing is."""
    edge = np.full((len(speed), 1), np.nan)
    change = np.concatenate([edge, np.diff(speed, axis=1) / FRAME_PERIOD, edge], axis=1)
    around = np.stack([change[:, :-1], change[:, 1:]])
    known = ~np.isnan(around)
    rates: FloatArray = np.where(known, around, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return rates
