"""The columns of a scenario's interactions, from the motion of all actors at all frames in dense arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.collisions.recorded import masses_of
from deepaccident_devkit.geometry import time_to_collision
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs, normals
from deepaccident_devkit.interactions.encroachment import pieces_of, recorded_pet
from deepaccident_devkit.interactions.measures import (
    closing_speed_of_boxes,
    delta_v,
    drac_of,
    impact_heading,
    modified_ttc,
    relative_speed,
    time_exposed,
    time_integrated,
    time_to_collision_1d,
)
from deepaccident_devkit.interactions.table import InteractionConfig
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
)
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
        return np.asarray(~np.isnan(self.boxes[..., 0]))


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
        masses=masses_of(
            boxes.category[rows], _median_sizes(boxes.size, actor, len(ids)), config.class_masses
        ),
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
    return np.array([np.median(sizes[actor == each], axis=0) for each in range(count)]).reshape(
        -1, 3
    )


def _accelerations(speed: FloatArray) -> FloatArray:
    """(A, F) mean change of the speed to and from each frame, of what is known of both; 0 where nothing is."""
    edge = np.full((len(speed), 1), np.nan)
    change = np.concatenate([edge, np.diff(speed, axis=1) / FRAME_PERIOD, edge], axis=1)
    around = np.stack([change[:, :-1], change[:, 1:]])
    known = ~np.isnan(around)
    return np.asarray(np.where(known, around, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1))


# Pairs times frames that are looked at together.
_AT_ONCE = 1 << 17


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measured(FrozenArrays):
    """L pairs that come under a threshold, at all their F frames; NaN where one is not there or both stand.

    Attributes:
        pairs: (L, 2) positions of the actors, ascending.
        counts: (L, F) where both are annotated and at least one moves.
        rows: (L, F) where they are under a threshold.
        values: name → (L, F) or (L, F, 2), as in `InteractionRecord`.
    """

    pairs: IntArray
    counts: BoolArray
    rows: BoolArray
    values: Mapping[str, FloatArray]


def measured_pairs(motion: ActorMotion, config: InteractionConfig) -> Measured:
    """The pairs that come under a threshold, with their measures at all frames.

    Pairs that lie in each other at all frames and move together, such as a rider and what is ridden, are one thing.
    """
    pairs = _listed(motion, config)
    first, second = pairs.T
    counts = _counts(motion, pairs)
    place = np.nonzero(counts)
    sides = [(actors[place[0]], place[1]) for actors in (first, second)]
    columns, rows = _values(motion, sides, config)
    shape = counts.shape
    values = {}
    for name, column in columns.items():
        values[name] = np.full((*shape, *column.shape[1:]), np.nan)
        values[name][place] = column
    under = np.zeros(shape, dtype=bool)
    under[place] = rows
    kept = ~_moves_as_one(motion, pairs, values["gap"], config)
    return Measured(
        pairs=pairs[kept],
        counts=counts[kept],
        rows=under[kept],
        values={name: each[kept] for name, each in values.items()},
    )


def pair_summaries(
    motion: ActorMotion, measured: Measured, config: InteractionConfig
) -> dict[str, AnyArray]:
    """The columns of `InteractionPairRecord` by name: least and most over frames; frames as positions, −1 for none."""
    values = measured.values
    ttc, gap = _filled(values["ttc"], np.inf), _filled(values["gap"], np.inf)
    least_ttc = _least(ttc)
    pieces = {actor: pieces_of(motion.boxes[actor]) for actor in np.unique(measured.pairs).tolist()}
    pet = [recorded_pet(pieces[first], pieces[second]) for first, second in measured.pairs.tolist()]
    moves: BoolArray = motion.moves.sum(axis=1) > 0
    return {
        "num_frames": measured.counts.sum(axis=1),
        "moving": moves[measured.pairs].all(axis=1),
        "min_ttc": least_ttc,
        "min_ttc_frame": np.where(np.isfinite(least_ttc), _first_least(ttc), -1),
        "min_gap": _least(gap),
        "min_gap_frame": _first_least(gap),
        "max_drac": -_least(-_filled(values["drac"], 0.0)),
        "min_mttc": _least(_filled(values["mttc"], np.inf)),
        "pet": np.array(pet, dtype=np.float64),
        **{
            name: np.stack([measure(ttc, tau, FRAME_PERIOD) for tau in config.taus], axis=-1)
            for name, measure in (("tet", time_exposed), ("tit", time_integrated))
        },
    }


def _listed(motion: ActorMotion, config: InteractionConfig) -> IntArray:
    """(L, 2) the pairs that are under a threshold at some frame; circles around the boxes leave most others out."""
    actors, frames = motion.moves.shape
    candidates = np.column_stack(np.triu_indices(actors, 1))
    kept = [np.zeros((0, 2), dtype=np.int64)]
    for start in range(0, len(candidates), max(1, _AT_ONCE // max(1, frames))):
        pairs = candidates[start : start + max(1, _AT_ONCE // max(1, frames))]
        pair, frame = np.nonzero(_may_be_under(motion, pairs, config))
        sides = [(pairs[pair, side], frame) for side in (0, 1)]
        kept.append(pairs[np.unique(pair[_under(motion, sides, config)])])
    return np.concatenate(kept)


def _counts(motion: ActorMotion, pairs: IntArray) -> BoolArray:
    """(P, F) where both of each pair are there and at least one moves."""
    first, second = pairs.T
    present, moves = motion.present, motion.moves
    return np.asarray(present[first] & present[second] & (moves[first] | moves[second]))


def _may_be_under(motion: ActorMotion, pairs: IntArray, config: InteractionConfig) -> BoolArray:
    """(P, F) where circles around the boxes are within the radius, and meet soon enough or are near enough."""
    first, second = pairs.T
    counts = _counts(motion, pairs)
    apart = motion.boxes[second, :, :2] - motion.boxes[first, :, :2]
    speed = motion.velocity[second] - motion.velocity[first]
    radius = np.hypot(motion.boxes[..., 2], motion.boxes[..., 3]) / 2
    reach = radius[first] + radius[second]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        distance = np.hypot(apart[..., 0], apart[..., 1])
        when = np.clip(-(apart * speed).sum(axis=-1) / (speed**2).sum(axis=-1), 0, config.max_ttc)
        nearest = apart + np.nan_to_num(when)[..., None] * np.nan_to_num(speed)
        soon = np.hypot(nearest[..., 0], nearest[..., 1]) <= reach
        near: BoolArray = soon | (distance - reach <= config.max_gap)
        return counts & (distance <= config.radius) & near


def _under(
    motion: ActorMotion, sides: list[tuple[IntArray, IntArray]], config: InteractionConfig
) -> BoolArray:
    """Whether pairs, given by (actors, frames) of each side, are under a threshold."""
    boxes, velocity = ([array[side] for side in sides] for array in (motion.boxes, motion.velocity))
    return _within(boxes, gaps_of_pairs(*boxes), time_to_collision(*boxes, *velocity), config)


def _within(
    boxes: list[FloatArray], gap: FloatArray, ttc: FloatArray, config: InteractionConfig
) -> BoolArray:
    apart = boxes[1][:, :2] - boxes[0][:, :2]
    within: BoolArray = np.hypot(apart[:, 0], apart[:, 1]) <= config.radius
    return within & ((ttc <= config.max_ttc) | (gap <= config.max_gap))


def _values(
    motion: ActorMotion, sides: list[tuple[IntArray, IntArray]], config: InteractionConfig
) -> tuple[dict[str, FloatArray], BoolArray]:
    """The measures of pairs at frames, given by (actors, frames) of each side; and which are under a threshold."""
    boxes, velocity = ([array[side] for side in sides] for array in (motion.boxes, motion.velocity))
    speed, acceleration = (
        [array[side] for side in sides] for array in (motion.speed, motion.acceleration)
    )
    gap = gaps_of_pairs(*boxes)
    ttc = _until(time_to_collision(*boxes, *velocity), config)
    one_way = [
        time_to_collision_1d(*boxes, *velocity),
        time_to_collision_1d(*boxes[::-1], *velocity[::-1]),
    ]
    values = {
        "gap": gap,
        "closing_speed": closing_speed_of_boxes(*boxes, *velocity),
        "ttc": ttc,
        "ttc_1d": _until(np.minimum(*one_way), config),
        "drac": drac_of(ttc, relative_speed(*velocity)),
        "mttc": _until(modified_ttc(*boxes, *speed, *acceleration), config),
        "delta_v": delta_v(*velocity, *(motion.masses[actors] for actors, _ in sides)),
        "impact_angle": impact_heading(*boxes),
    }
    return values, _within(boxes, gap, ttc, config)


def _until(times: FloatArray, config: InteractionConfig) -> FloatArray:
    return np.where(times > config.horizon, np.inf, times)


def _moves_as_one(
    motion: ActorMotion, pairs: IntArray, gap: FloatArray, config: InteractionConfig
) -> BoolArray:
    """(L,) whether two touch at all frames that count, and are never faster relative to each other than who stands."""
    speed = relative_speed(motion.velocity[pairs[:, 0]], motion.velocity[pairs[:, 1]])
    with np.errstate(invalid="ignore"):
        alone = (gap > 0) | ((speed > config.standing_speed) & ~np.isnan(gap))
    return np.asarray(alone.sum(axis=1) == 0)


def _filled(values: FloatArray, filler: float) -> FloatArray:
    return np.where(np.isnan(values), filler, values)


def _least(values: FloatArray) -> FloatArray:
    """(L,) least of (L, F), infinite if there is none."""
    return np.asarray(values.min(axis=1, initial=np.inf))


def _first_least(values: FloatArray) -> IntArray:
    """(L,) positions of the first least of (L, F)."""
    return (
        np.asarray(values.argmin(axis=1)) if values.size else np.zeros(len(values), dtype=np.int64)
    )
