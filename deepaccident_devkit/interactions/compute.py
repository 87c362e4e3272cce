"""Columns of a scenario's interactions, from dense arrays of the motion of all actors."""

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

# Pairs times frames that are computed together.
_PAIR_FRAMES_AT_ONCE = 1 << 17


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ActorMotion(FrozenArrays):
    """Motion of A actors at F frames, seen from above; world, right-handed, SI units.

    NaN where an actor is not annotated.

    Attributes:
        ids: CARLA ids, shape (A,), ascending.
        masses: Assumed masses, shape (A,), kilograms.
        boxes: x, y, length, width, yaw, shape (A, F, 5).
        velocity: Velocities over the ground, shape (A, F, 2); NaN where neither a label nor a
            displacement gives one.
        speed: Speeds along the heading, shape (A, F).
        acceleration: Accelerations along the heading, shape (A, F), from the speeds one frame
            before and after; 0 without such speeds.
        moves: Whether an actor is annotated and faster than `standing_speed`, shape (A, F).
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
        """Whether each actor is annotated, shape (A, F)."""
        return np.asarray(~np.isnan(self.boxes[..., 0]))


def actor_motion(tracks: ScenarioTracks, num_frames: int, config: InteractionConfig) -> ActorMotion:
    """Return the motion of the actors of a scenario at its frames 1 to `num_frames`."""
    boxes = tracks.boxes
    ids, last_positions = np.unique(tracks.actor_id[::-1], return_index=True)
    last_rows = len(boxes) - 1 - last_positions
    actors = np.searchsorted(ids, tracks.actor_id)
    cells = (actors, tracks.index - 1)
    dense_boxes = np.full((len(ids), num_frames, 5), np.nan)
    dense_boxes[cells] = np.column_stack([boxes.center[:, :2], boxes.size[:, :2], boxes.yaw])
    velocity = np.full((len(ids), num_frames, 2), np.nan)
    velocity[cells] = _velocities(tracks)
    speed = (velocity * normals(dense_boxes[..., 4])).sum(axis=-1)
    with np.errstate(invalid="ignore"):
        ground_speed = np.hypot(velocity[..., 0], velocity[..., 1])
        moves: BoolArray = ground_speed > config.standing_speed
    sizes = _median_sizes(boxes.size, actors, len(ids))
    return ActorMotion(
        ids=ids,
        masses=masses_of(boxes.category[last_rows], sizes, config.class_masses),
        boxes=dense_boxes,
        velocity=velocity,
        speed=speed,
        acceleration=_accelerations(speed),
        moves=moves,
    )


def _velocities(tracks: ScenarioTracks) -> FloatArray:
    """Return the tracks' velocities, shape (M, 2), from displacements where they are unknown."""
    velocity = tracks.boxes.velocity[:, :2]
    unknown: BoolArray = np.isnan(velocity.sum(axis=1))
    if not unknown.any():
        return velocity
    one_scenario = np.zeros(len(velocity), dtype=np.int64)
    displacements = displacement_velocities(
        tracks.boxes.center, one_scenario, tracks.actor_id, tracks.index
    )
    return np.where(unknown[:, None], displacements[:, :2], velocity)


def _median_sizes(sizes: FloatArray, actors: IntArray, count: int) -> FloatArray:
    """Return the median size of each actor, shape (A, 3).

    The box of a pedestrian changes its size with the steps.
    """
    medians = [np.median(sizes[actors == actor], axis=0) for actor in range(count)]
    return np.array(medians).reshape(-1, 3)


def _accelerations(speed: FloatArray) -> FloatArray:
    """Return the mean change of the speed to and from each frame, shape (A, F).

    The mean is over the known changes, and 0 without one.
    """
    edge = np.full((len(speed), 1), np.nan)
    change = np.concatenate([edge, np.diff(speed, axis=1) / FRAME_PERIOD, edge], axis=1)
    neighbours = np.stack([change[:, :-1], change[:, 1:]])
    known = ~np.isnan(neighbours)
    sums = np.where(known, neighbours, 0.0).sum(axis=0)
    return np.asarray(sums / np.maximum(known.sum(axis=0), 1))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measured(FrozenArrays):
    """L pairs that come under a threshold, at all their F frames.

    NaN where an actor is not annotated, or both stand.

    Attributes:
        pairs: Positions of the actors, shape (L, 2), ascending.
        counts: Whether both actors are annotated and at least one moves, shape (L, F).
        rows: Whether the pair is under a threshold, shape (L, F).
        values: Measure → its values, shape (L, F) or (L, F, 2), as in `InteractionRecord`.
    """

    pairs: IntArray
    counts: BoolArray
    rows: BoolArray
    values: Mapping[str, FloatArray]


def measured_pairs(motion: ActorMotion, config: InteractionConfig) -> Measured:
    """Return the pairs that come under a threshold, with their measures at all frames.

    Pairs that lie in each other at all frames and move together, such as a rider and a bicycle, are
    one object and are left out.
    """
    pairs = _pairs_under_threshold(motion, config)
    first, second = pairs.T
    counts = _counts(motion, pairs)
    pair_rows, frames = np.nonzero(counts)
    sides = [(actors[pair_rows], frames) for actors in (first, second)]
    columns, under = _values(motion, sides, config)
    shape = counts.shape
    values = {}
    for name, column in columns.items():
        dense = np.full((*shape, *column.shape[1:]), np.nan)
        dense[pair_rows, frames] = column
        values[name] = dense
    rows = np.zeros(shape, dtype=bool)
    rows[pair_rows, frames] = under
    separate = ~_moves_as_one(motion, pairs, values["gap"], config)
    return Measured(
        pairs=pairs[separate],
        counts=counts[separate],
        rows=rows[separate],
        values={name: dense[separate] for name, dense in values.items()},
    )


def pair_summaries(
    motion: ActorMotion, measured: Measured, config: InteractionConfig
) -> dict[str, AnyArray]:
    """Return the columns of `InteractionPairRecord` by name: minima and maxima over frames.

    Frames are positions from 0, or −1 for none.
    """
    values = measured.values
    ttc = _filled(values["ttc"], np.inf)
    gap = _filled(values["gap"], np.inf)
    min_ttc = _minima(ttc)
    min_ttc_frame = np.where(np.isfinite(min_ttc), _first_minima(ttc), -1)
    tet = [time_exposed(ttc, tau, FRAME_PERIOD) for tau in config.taus]
    tit = [time_integrated(ttc, tau, FRAME_PERIOD) for tau in config.taus]
    moves: BoolArray = motion.moves.sum(axis=1) > 0
    return {
        "num_frames": measured.counts.sum(axis=1),
        "moving": moves[measured.pairs].all(axis=1),
        "min_ttc": min_ttc,
        "min_ttc_frame": min_ttc_frame,
        "min_gap": _minima(gap),
        "min_gap_frame": _first_minima(gap),
        "max_drac": -_minima(-_filled(values["drac"], 0.0)),
        "min_mttc": _minima(_filled(values["mttc"], np.inf)),
        "pet": _encroachment_times(motion, measured.pairs),
        "tet": np.stack(tet, axis=-1),
        "tit": np.stack(tit, axis=-1),
    }


def _encroachment_times(motion: ActorMotion, pairs: IntArray) -> FloatArray:
    """Return the post-encroachment time of each pair over the recording, shape (L,), seconds."""
    pieces = {}
    for actor in np.unique(pairs).tolist():
        pieces[actor] = pieces_of(motion.boxes[actor])
    times = [recorded_pet(pieces[first], pieces[second]) for first, second in pairs.tolist()]
    return np.array(times, dtype=np.float64)


def _pairs_under_threshold(motion: ActorMotion, config: InteractionConfig) -> IntArray:
    """Return the pairs that are under a threshold at some frame, shape (L, 2).

    Circles around the boxes exclude most of the other pairs.
    """
    num_actors, num_frames = motion.moves.shape
    candidates = np.column_stack(np.triu_indices(num_actors, 1))
    parts = [np.zeros((0, 2), dtype=np.int64)]
    pairs_at_once = max(1, _PAIR_FRAMES_AT_ONCE // max(1, num_frames))
    for start in range(0, len(candidates), pairs_at_once):
        pairs = candidates[start : start + pairs_at_once]
        pair_rows, frames = np.nonzero(_may_be_under(motion, pairs, config))
        sides = [(pairs[pair_rows, side], frames) for side in (0, 1)]
        under = _under(motion, sides, config)
        parts.append(pairs[np.unique(pair_rows[under])])
    return np.concatenate(parts)


def _counts(motion: ActorMotion, pairs: IntArray) -> BoolArray:
    """Return where both actors of each pair are annotated and at least one moves, shape (P, F)."""
    first, second = pairs.T
    both_present = motion.present[first] & motion.present[second]
    return np.asarray(both_present & (motion.moves[first] | motion.moves[second]))


def _may_be_under(motion: ActorMotion, pairs: IntArray, config: InteractionConfig) -> BoolArray:
    """Return where pairs may be under a threshold by circles around their boxes, shape (P, F).

    The circles must be within the radius, and meet soon enough or have a gap that is small enough.
    """
    first, second = pairs.T
    counts = _counts(motion, pairs)
    offset = motion.boxes[second, :, :2] - motion.boxes[first, :, :2]
    velocity = motion.velocity[second] - motion.velocity[first]
    radius = np.hypot(motion.boxes[..., 2], motion.boxes[..., 3]) / 2
    sum_of_radii = radius[first] + radius[second]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        distance = np.hypot(offset[..., 0], offset[..., 1])
        time = -(offset * velocity).sum(axis=-1) / (velocity**2).sum(axis=-1)
        time = np.clip(time, 0, config.max_ttc)
        nearest = offset + np.nan_to_num(time)[..., None] * np.nan_to_num(velocity)
        meets = np.hypot(nearest[..., 0], nearest[..., 1]) <= sum_of_radii
        under: BoolArray = meets | (distance - sum_of_radii <= config.max_gap)
        return counts & (distance <= config.radius) & under


def _of_sides(array: FloatArray, sides: list[tuple[IntArray, IntArray]]) -> list[FloatArray]:
    """Return the entries of a dense array at the (actors, frames) of each side of pairs."""
    return [array[side] for side in sides]


def _under(
    motion: ActorMotion, sides: list[tuple[IntArray, IntArray]], config: InteractionConfig
) -> BoolArray:
    """Return whether pairs are under a threshold.

    Args:
        motion: Motion of all actors.
        sides: Actors and frames of the first and of the second actor of each pair.
        config: Thresholds.
    """
    boxes = _of_sides(motion.boxes, sides)
    velocity = _of_sides(motion.velocity, sides)
    gap = gaps_of_pairs(*boxes)
    ttc = time_to_collision(*boxes, *velocity)
    return _within_thresholds(boxes, gap, ttc, config)


def _within_thresholds(
    boxes: list[FloatArray], gap: FloatArray, ttc: FloatArray, config: InteractionConfig
) -> BoolArray:
    """Return whether pairs with known gaps and times to collision are under a threshold."""
    offset = boxes[1][:, :2] - boxes[0][:, :2]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    within_radius: BoolArray = distance <= config.radius
    return within_radius & ((ttc <= config.max_ttc) | (gap <= config.max_gap))


def _values(
    motion: ActorMotion, sides: list[tuple[IntArray, IntArray]], config: InteractionConfig
) -> tuple[dict[str, FloatArray], BoolArray]:
    """Return the measures of pairs at frames, and whether they are under a threshold.

    Args:
        motion: Motion of all actors.
        sides: Actors and frames of the first and of the second actor of each pair.
        config: Thresholds and assumptions.
    """
    boxes = _of_sides(motion.boxes, sides)
    velocity = _of_sides(motion.velocity, sides)
    speed = _of_sides(motion.speed, sides)
    acceleration = _of_sides(motion.acceleration, sides)
    masses = [motion.masses[actors] for actors, _ in sides]
    gap = gaps_of_pairs(*boxes)
    ttc = _before_horizon(time_to_collision(*boxes, *velocity), config)
    first_ttc_1d = time_to_collision_1d(*boxes, *velocity)
    second_ttc_1d = time_to_collision_1d(*boxes[::-1], *velocity[::-1])
    values = {
        "gap": gap,
        "closing_speed": closing_speed_of_boxes(*boxes, *velocity),
        "ttc": ttc,
        "ttc_1d": _before_horizon(np.minimum(first_ttc_1d, second_ttc_1d), config),
        "drac": drac_of(ttc, relative_speed(*velocity)),
        "mttc": _before_horizon(modified_ttc(*boxes, *speed, *acceleration), config),
        "delta_v": delta_v(*velocity, *masses),
        "impact_angle": impact_heading(*boxes),
    }
    return values, _within_thresholds(boxes, gap, ttc, config)


def _before_horizon(times: FloatArray, config: InteractionConfig) -> FloatArray:
    """Return times to collision, infinite after the horizon."""
    return np.where(times > config.horizon, np.inf, times)


def _moves_as_one(
    motion: ActorMotion, pairs: IntArray, gap: FloatArray, config: InteractionConfig
) -> BoolArray:
    """Return whether two actors touch at all frames that count, and move together, shape (L,).

    They move together if their relative speed never exceeds the speed up to which an actor stands.
    """
    speed = relative_speed(motion.velocity[pairs[:, 0]], motion.velocity[pairs[:, 1]])
    with np.errstate(invalid="ignore"):
        separate = (gap > 0) | ((speed > config.standing_speed) & ~np.isnan(gap))
    return np.asarray(separate.sum(axis=1) == 0)


def _filled(values: FloatArray, filler: float) -> FloatArray:
    """Return values with a filler instead of NaN."""
    return np.where(np.isnan(values), filler, values)


def _minima(values: FloatArray) -> FloatArray:
    """Return the minimum of each row of (L, F), shape (L,), infinite for empty rows."""
    return np.asarray(values.min(axis=1, initial=np.inf))


def _first_minima(values: FloatArray) -> IntArray:
    """Return the position of the first minimum of each row of (L, F), shape (L,)."""
    if not values.size:
        return np.zeros(len(values), dtype=np.int64)
    return np.asarray(values.argmin(axis=1))
