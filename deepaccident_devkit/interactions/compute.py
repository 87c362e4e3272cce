"""Columns of a scenario's interactions, computed from dense arrays of all actors' motion."""

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

# Number of pairs × frames that are computed at once.
_PAIR_FRAMES_AT_ONCE = 1 << 17
# Indices (actors, frames) of the first and of the second actor of each pair.
_Sides = list[tuple[IntArray, IntArray]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ActorMotion(FrozenArrays):
    """Motion of A actors in F frames, seen from above; world frame, right-handed, SI units.

    Values are NaN where an actor is not annotated.

    Attributes:
        ids: CARLA ids, shape (A,), ascending.
        masses: Assumed masses in kilograms, shape (A,).
        boxes: x, y, length, width, yaw, shape (A, F, 5).
        velocity: Velocities over the ground, shape (A, F, 2); NaN where neither a label nor a
            displacement yields one.
        speed: Speeds along the heading, shape (A, F).
        acceleration: Accelerations along the heading, shape (A, F), from the speeds one frame
            before and one frame after; 0 if these are unknown.
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
        return ~np.isnan(self.boxes[..., 0])


def actor_motion(tracks: ScenarioTracks, num_frames: int, config: InteractionConfig) -> ActorMotion:
    """Return the motion of a scenario's actors in the frames 1 to `num_frames`."""
    boxes = tracks.boxes
    ids, last_positions = np.unique(tracks.actor_id[::-1], return_index=True)
    last_rows = len(boxes) - 1 - last_positions
    actors = np.searchsorted(ids, tracks.actor_id)
    cells = (actors, tracks.index - 1)
    dense_boxes = np.full((len(ids), num_frames, 5), np.nan)
    dense_boxes[cells] = np.column_stack([boxes.center[:, :2], boxes.size[:, :2], boxes.yaw])
    velocity = np.full((len(ids), num_frames, 2), np.nan)
    velocity[cells] = _track_velocities(tracks)
    heading = normals(dense_boxes[..., 4])
    speed = (velocity * heading).sum(axis=-1)
    with np.errstate(invalid="ignore"):
        ground_speed = np.hypot(velocity[..., 0], velocity[..., 1])
        moves: BoolArray = ground_speed > config.standing_speed
    # A pedestrian's box changes its size with every step.
    sizes = [np.median(boxes.size[actors == actor], axis=0) for actor in range(len(ids))]
    median_sizes = np.array(sizes).reshape(-1, 3)
    return ActorMotion(
        ids=ids,
        masses=masses_of(boxes.category[last_rows], median_sizes, config.class_masses),
        boxes=dense_boxes,
        velocity=velocity,
        speed=speed,
        acceleration=_accelerations(speed),
        moves=moves,
    )


def _track_velocities(tracks: ScenarioTracks) -> FloatArray:
    """Return the velocities of the tracks in m/s, shape (M, 2).

    Where the labels contain none, velocities are computed from displacements.
    """
    velocity = tracks.boxes.velocity[:, :2]
    unknown: BoolArray = np.isnan(velocity.sum(axis=1))
    if not unknown.any():
        return velocity
    one_scenario = np.zeros(len(velocity), dtype=np.int64)
    displacements = displacement_velocities(
        tracks.boxes.center, one_scenario, tracks.actor_id, tracks.index
    )
    return np.where(unknown[:, None], displacements[:, :2], velocity)


def _accelerations(speed: FloatArray) -> FloatArray:
    """Return the mean rate of change of the speed around each frame in m/s², shape (A, F).

    It averages the known changes from the frame before and to the frame after; 0 if none is known.
    """
    unknown = np.full((len(speed), 1), np.nan)
    changes = np.diff(speed, axis=1) / FRAME_PERIOD
    changes = np.concatenate([unknown, changes, unknown], axis=1)
    neighbours = np.stack([changes[:, :-1], changes[:, 1:]])
    is_known = ~np.isnan(neighbours)
    sums = np.where(is_known, neighbours, 0.0).sum(axis=0)
    counts = is_known.sum(axis=0)
    accelerations: FloatArray = sums / np.maximum(counts, 1)
    return accelerations


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredPairs(FrozenArrays):
    """L pairs that are under a threshold in some frame, with their measures in all F frames.

    Measures are NaN in frames in which an actor is not annotated, or both stand still.

    Attributes:
        pairs: Indices of the actors, shape (L, 2), ascending.
        counts: Whether both actors are annotated and at least one moves, shape (L, F).
        rows: Whether the pair is under a threshold, shape (L, F).
        values: Name of a measure → its values, shape (L, F) or (L, F, 2); see `InteractionRecord`.
    """

    pairs: IntArray
    counts: BoolArray
    rows: BoolArray
    values: Mapping[str, FloatArray]


def measured_pairs(motion: ActorMotion, config: InteractionConfig) -> MeasuredPairs:
    """Find the pairs that are under a threshold in some frame; return all their measures.

    Two actors whose boxes overlap in every frame, and that move together, are one object (such as a
    rider and a bicycle). Such pairs are left out.
    """
    pairs = _pairs_under_threshold(motion, config)
    counts = _mask_counted_frames(motion, pairs)
    pair_rows, frames = np.nonzero(counts)
    sides = [(actors[pair_rows], frames) for actors in pairs.T]
    columns, is_under = _measure_sides(motion, sides, config)
    values = {}
    for name, column in columns.items():
        dense = np.full((*counts.shape, *column.shape[1:]), np.nan)
        dense[pair_rows, frames] = column
        values[name] = dense
    rows = np.zeros(counts.shape, dtype=bool)
    rows[pair_rows, frames] = is_under
    separate = ~_moves_as_one(motion, pairs, values["gap"], config)
    return MeasuredPairs(
        pairs=pairs[separate],
        counts=counts[separate],
        rows=rows[separate],
        values={name: dense[separate] for name, dense in values.items()},
    )


def pair_summaries(
    motion: ActorMotion, measured: MeasuredPairs, config: InteractionConfig
) -> dict[str, AnyArray]:
    """Compute the columns of `InteractionPairRecord`: minima and maxima over frames, by name.

    Frames are indices from 0; −1 means that there is no such frame.
    """
    values = measured.values
    ttc = _fill_nan(values["ttc"], np.inf)
    mttc = _fill_nan(values["mttc"], np.inf)
    gap = _fill_nan(values["gap"], np.inf)
    drac = _fill_nan(values["drac"], 0.0)
    min_ttc = _min_over_frames(ttc)
    min_ttc_frame = np.where(np.isfinite(min_ttc), _argmin_over_frames(ttc), -1)
    tet = [time_exposed(ttc, tau, FRAME_PERIOD) for tau in config.taus]
    tit = [time_integrated(ttc, tau, FRAME_PERIOD) for tau in config.taus]
    moves: BoolArray = motion.moves.sum(axis=1) > 0
    return {
        "num_frames": measured.counts.sum(axis=1),
        "moving": moves[measured.pairs].all(axis=1),
        "min_ttc": min_ttc,
        "min_ttc_frame": min_ttc_frame,
        "min_gap": _min_over_frames(gap),
        "min_gap_frame": _argmin_over_frames(gap),
        "max_drac": -_min_over_frames(-drac),
        "min_mttc": _min_over_frames(mttc),
        "pet": _encroachment_times(motion, measured.pairs),
        "tet": np.stack(tet, axis=-1),
        "tit": np.stack(tit, axis=-1),
    }


def _encroachment_times(motion: ActorMotion, pairs: IntArray) -> FloatArray:
    """Return each pair's post-encroachment time over the recording in seconds, shape (L,)."""
    pieces = {}
    for actor in np.unique(pairs).tolist():
        pieces[actor] = pieces_of(motion.boxes[actor])
    times = []
    for first, second in pairs.tolist():
        pet = recorded_pet(pieces[first], pieces[second])
        times.append(pet)
    return np.array(times)


def _pairs_under_threshold(motion: ActorMotion, config: InteractionConfig) -> IntArray:
    """Return the pairs that are under a threshold in some frame, shape (L, 2).

    Circles around the boxes are compared first, to exclude most other pairs.
    """
    num_actors, num_frames = motion.moves.shape
    candidates = np.column_stack(np.triu_indices(num_actors, 1))
    critical_pairs = [np.zeros((0, 2), dtype=np.int64)]
    pairs_at_once = max(1, _PAIR_FRAMES_AT_ONCE // max(1, num_frames))
    for start in range(0, len(candidates), pairs_at_once):
        pairs = candidates[start : start + pairs_at_once]
        pair_rows, frames = np.nonzero(_may_be_under(motion, pairs, config))
        sides = [(pairs[pair_rows, side], frames) for side in (0, 1)]
        boxes = _select_sides(motion.boxes, sides)
        velocity = _select_sides(motion.velocity, sides)
        gap = gaps_of_pairs(*boxes)
        ttc = time_to_collision(*boxes, *velocity)
        is_under = _within_thresholds(boxes, gap, ttc, config)
        rows = np.unique(pair_rows[is_under])
        critical_pairs.append(pairs[rows])
    return np.concatenate(critical_pairs)


def _mask_counted_frames(motion: ActorMotion, pairs: IntArray) -> BoolArray:
    """Return in which frames both actors are annotated and at least one moves, shape (P, F)."""
    first, second = pairs.T
    are_present = motion.present[first] & motion.present[second]
    is_moving = motion.moves[first] | motion.moves[second]
    is_counted: BoolArray = are_present & is_moving
    return is_counted


def _may_be_under(motion: ActorMotion, pairs: IntArray, config: InteractionConfig) -> BoolArray:
    """Return in which frames pairs may be under a threshold, shape (P, F).

    This is decided by circles around the boxes: they must be within the radius, and either meet
    soon enough or have a small enough gap.
    """
    first, second = pairs.T
    is_counted = _mask_counted_frames(motion, pairs)
    offset = motion.boxes[second, :, :2] - motion.boxes[first, :, :2]
    velocity = motion.velocity[second] - motion.velocity[first]
    radius = np.hypot(motion.boxes[..., 2], motion.boxes[..., 3]) / 2
    sum_of_radii = radius[first] + radius[second]
    with np.errstate(all="ignore"):
        distance = np.hypot(offset[..., 0], offset[..., 1])
        time = -(offset * velocity).sum(axis=-1) / (velocity**2).sum(axis=-1)
        time = np.clip(time, 0, config.max_ttc)
        travelled = np.nan_to_num(time)[..., None] * np.nan_to_num(velocity)
        nearest_offset = offset + travelled
        nearest_distance = np.hypot(nearest_offset[..., 0], nearest_offset[..., 1])
        meets_soon = nearest_distance <= sum_of_radii
        is_near = distance - sum_of_radii <= config.max_gap
        within_radius = distance <= config.radius
    may_be_under: BoolArray = is_counted & within_radius & (meets_soon | is_near)
    return may_be_under


def _select_sides(array: FloatArray, sides: _Sides) -> list[FloatArray]:
    """Return the entries of a dense array for the first and for the second actors of pairs."""
    return [array[side] for side in sides]


def _within_thresholds(
    boxes: list[FloatArray], gap: FloatArray, ttc: FloatArray, config: InteractionConfig
) -> BoolArray:
    """Return which pairs with known gaps and times to collision are under a threshold."""
    offset = boxes[1][:, :2] - boxes[0][:, :2]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    within_radius: BoolArray = distance <= config.radius
    meets_soon = ttc <= config.max_ttc
    is_near = gap <= config.max_gap
    return within_radius & (meets_soon | is_near)


def _measure_sides(
    motion: ActorMotion, sides: _Sides, config: InteractionConfig
) -> tuple[dict[str, FloatArray], BoolArray]:
    """Compute the measures of pairs in single frames, and whether they are under a threshold.

    Args:
        motion: Motion of all actors.
        sides: Indices (actors, frames) of the first and of the second actor of each pair.
        config: Thresholds and assumptions.
    """
    boxes = _select_sides(motion.boxes, sides)
    velocity = _select_sides(motion.velocity, sides)
    speed = _select_sides(motion.speed, sides)
    acceleration = _select_sides(motion.acceleration, sides)
    masses = [motion.masses[actors] for actors, _ in sides]
    gap = gaps_of_pairs(*boxes)
    ttc = _limit_to_horizon(time_to_collision(*boxes, *velocity), config)
    mttc = modified_ttc(*boxes, *speed, *acceleration)
    first_ttc_1d = time_to_collision_1d(*boxes, *velocity)
    second_ttc_1d = time_to_collision_1d(*boxes[::-1], *velocity[::-1])
    ttc_1d = np.minimum(first_ttc_1d, second_ttc_1d)
    values = {
        "gap": gap,
        "closing_speed": closing_speed_of_boxes(*boxes, *velocity),
        "ttc": ttc,
        "ttc_1d": _limit_to_horizon(ttc_1d, config),
        "drac": drac_of(ttc, relative_speed(*velocity)),
        "mttc": _limit_to_horizon(mttc, config),
        "delta_v": delta_v(*velocity, *masses),
        "impact_angle": impact_heading(*boxes),
    }
    return values, _within_thresholds(boxes, gap, ttc, config)


def _limit_to_horizon(times: FloatArray, config: InteractionConfig) -> FloatArray:
    """Replace times to collision beyond the horizon by infinity."""
    return np.where(times > config.horizon, np.inf, times)


def _moves_as_one(
    motion: ActorMotion, pairs: IntArray, gap: FloatArray, config: InteractionConfig
) -> BoolArray:
    """Return whether two actors touch in all frames that count and move together, shape (L,).

    They move together if their relative speed never exceeds the largest speed of a standing actor.
    """
    first, second = pairs.T
    speed = relative_speed(motion.velocity[first], motion.velocity[second])
    with np.errstate(invalid="ignore"):
        has_gap = gap > 0
        moves_apart = (speed > config.standing_speed) & ~np.isnan(gap)
    num_separate = (has_gap | moves_apart).sum(axis=1)
    moves_as_one: BoolArray = num_separate == 0
    return moves_as_one


def _fill_nan(values: FloatArray, filler: float) -> FloatArray:
    """Replace NaN in `values` by a filler."""
    is_unknown = np.isnan(values)
    return np.where(is_unknown, filler, values)


def _min_over_frames(values: FloatArray) -> FloatArray:
    """Return the minimum over the frames of (L, F), shape (L,); infinite for all-NaN rows."""
    minima: FloatArray = values.min(axis=1, initial=np.inf)
    return minima


def _argmin_over_frames(values: FloatArray) -> IntArray:
    """Return the index of the first frame with the minimum of (L, F), shape (L,)."""
    if not values.size:
        return np.zeros(len(values), dtype=np.int64)
    frames: IntArray = values.argmin(axis=1)
    return frames
