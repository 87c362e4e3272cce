"""Surrogate safety measures of pairs of road users at one time, as functions of arrays.

A box is a row (x, y, length, width, yaw), a velocity is a row (x, y). Units are SI and radians; all
arguments are in the same right-handed frame with z up. Leading dimensions are arbitrary, such as
pairs, or pairs × frames. Results that depend on a velocity are NaN where it is NaN. A pair is
(first, second); measures that differ between the two are the first one's.
"""

import numpy as np

from deepaccident_devkit.geometry import time_to_collision
from deepaccident_devkit.geometry.box_arrays import (
    along,
    corner_offsets,
    gaps_of_pairs,
    normals,
    separations_of_pairs,
    side_gaps,
)
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray

# Largest gap between two boxes that touch up to rounding.
_CONTACT_TOLERANCE_M = 1e-9
# Number of pairs that are computed at once; their arrays then fit into the processor's cache.
_PAIRS_AT_ONCE = 1 << 9


def time_to_collision_1d(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Return the time until the first's bumper reaches the second, along the first's heading.

    Both keep their velocities. This is the measure of car-following studies. It ignores crossing
    paths; `time_to_collision` does not.

    Returns:
        Times in seconds, shape (…,). Infinite unless the two overlap sideways now and the gap
        closes; 0 if they also overlap along the heading.
    """
    gap, closing, passes_beside = _along_heading(first, second, first_velocity, second_velocity)
    with np.errstate(all="ignore"):
        times = np.where(gap <= 0, 0.0, gap / closing)
    meets = ~passes_beside & ((closing > 0) | (gap <= 0))
    contact_times = np.where(meets, times, np.inf)
    return _copy_nan(contact_times, closing)


def drac_1d(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Return the deceleration along the first's heading that avoids a crash (DRAC), in m/s².

    It is c² / 2g for a gap g that closes at the speed c; see `time_to_collision_1d`.

    Returns:
        Decelerations, shape (…,); 0 without a conflict, infinite at contact.
    """
    gap, closing, passes_beside = _along_heading(first, second, first_velocity, second_velocity)
    with np.errstate(all="ignore"):
        decelerations = np.where(gap <= 0, np.inf, closing**2 / (2 * gap))
    meets = ~passes_beside & ((closing > 0) | (gap <= 0))
    needed = np.where(meets, decelerations, 0.0)
    return _copy_nan(needed, closing)


def drac(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Return the deceleration that avoids a crash in the plane (DRAC), in m/s².

    It is the relative speed divided by twice the time to collision.

    Returns:
        Decelerations, shape (…,); 0 without a conflict, infinite at contact.
    """
    times = time_to_collision(first, second, first_velocity, second_velocity)
    speeds = relative_speed(first_velocity, second_velocity)
    return drac_of(times, speeds)


def drac_of(times: FloatArray, relative_speeds: FloatArray) -> FloatArray:
    """Compute `drac` from times to collision (…,) in s and relative speeds (…,) in m/s."""
    with np.errstate(all="ignore"):
        decelerations = relative_speeds / (2 * times)
    needed = np.where(times == 0, np.inf, decelerations)
    return _copy_nan(needed, times)


def modified_ttc_1d(
    first: FloatArray,
    second: FloatArray,
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    first_acceleration: FloatArray,
    second_acceleration: FloatArray,
) -> FloatArray:
    """Return `time_to_collision_1d` with constant accelerations (…,) in m/s², each along a heading.

    Like the textbook formula, it ignores that braking actors stop: here they end up reversing. In
    `modified_ttc` they stop.

    Returns:
        Times in seconds, shape (…,). Infinite unless the two overlap sideways now and the gap
        closes at some time; 0 if there is no gap.
    """
    gap, closing, passes_beside = _along_heading(first, second, first_velocity, second_velocity)
    heading = normals(first[..., 4])
    offset = second[..., :2] - first[..., :2]
    direction = np.sign(_dot_products(offset, heading))
    first_change = first_acceleration[..., None] * heading
    second_change = second_acceleration[..., None] * normals(second[..., 4])
    closing_change = direction * _dot_products(first_change - second_change, heading)
    roots = least_root(closing_change / 2, closing, -gap)
    times = np.where(gap <= 0, 0.0, roots)
    contact_times = np.where(passes_beside, np.inf, times)
    return _copy_nan(contact_times, closing + closing_change)


def relative_speed(first_velocity: FloatArray, second_velocity: FloatArray) -> FloatArray:
    """Return the length (…,) of the difference of two velocities (…, 2)."""
    return _vector_lengths(second_velocity - first_velocity)


def closing_speed(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Return the speed (…,) at which the centres approach each other, in m/s.

    It is negative if they move apart, and NaN if the centres coincide.
    """
    offset = second[..., :2] - first[..., :2]
    return _approach_speed(offset, second_velocity - first_velocity)


def closing_speed_of_boxes(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Return the speed (…,) at which the gap between the boxes shrinks, in m/s.

    It is negative if the gap grows, and NaN where the boxes touch.
    """
    separations = separations_of_pairs(first, second)
    return _approach_speed(separations, second_velocity - first_velocity)


def delta_v(
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    first_mass: FloatArray,
    second_mass: FloatArray,
) -> FloatArray:
    """Return the velocity change of both actors if they collided now, shape (…, 2), in m/s.

    The collision is plastic and central: the two move on together. Masses (…,) are in kilograms;
    `masses_of` returns assumed masses.
    """
    total_mass = first_mass + second_mass
    shares = np.stack([second_mass, first_mass], axis=-1) / total_mass[..., None]
    speed = relative_speed(first_velocity, second_velocity)
    return np.asarray(shares * speed[..., None])


def impact_heading(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the second's heading relative to the first's (…,), in (−π, π] rad.

    0 is the same direction, ±π is head-on.
    """
    return wrapped(second[..., 4] - first[..., 4])


def impact_direction(
    first: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Return the direction in which the first moves relative to the second (…,), in (−π, π] rad.

    It is measured from the first's heading: 0 is straight ahead. It is NaN without relative motion.
    """
    motion = first_velocity - second_velocity
    world_direction = np.arctan2(motion[..., 1], motion[..., 0])
    direction = wrapped(world_direction - first[..., 4])
    return np.where(_vector_lengths(motion) > 0, direction, np.nan)


def time_exposed(times: FloatArray, threshold: float, step: float) -> FloatArray:
    """Return the time exposed (TET) in seconds, shape (…,).

    It is the total time during which the time to collision is within the threshold.

    Args:
        times: Times to collision at T moments in seconds, shape (…, T).
        threshold: Largest time to collision that counts, in seconds.
        step: Time between two moments in seconds.
    """
    within = np.asarray(times) <= threshold
    return np.asarray(within.sum(axis=-1) * step)


def time_integrated(times: FloatArray, threshold: float, step: float) -> FloatArray:
    """Return the time integrated (TIT) in s², shape (…,).

    It is the sum of (threshold − time) · step over the moments within the threshold.

    Args:
        times: Times to collision at T moments in seconds, shape (…, T).
        threshold: Largest time to collision that counts, in seconds.
        step: Time between two moments in seconds.
    """
    within = np.asarray(times) <= threshold
    counted_times = np.where(within, times, 0.0)
    shortfall = np.where(within, threshold - counted_times, 0.0)
    return np.asarray(shortfall.sum(axis=-1) * step)


def nearest_approach(
    first: FloatArray,
    second: FloatArray,
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    horizon: float = 20.0,
) -> tuple[FloatArray, FloatArray]:
    """Return the smallest gap of pairs that keep their velocities, and when it occurs.

    The gap between convex outlines at constant velocities first shrinks, then grows. If the two
    never touch, it is smallest at the start or end of the horizon, or when a corner passes the
    other's outline; these times are compared.

    Args:
        first: First boxes, shape (…, 5).
        second: Second boxes, shape (…, 5).
        first_velocity: Velocities of the first boxes in m/s, shape (…, 2).
        second_velocity: Velocities of the second boxes in m/s, shape (…, 2).
        horizon: Time to look ahead in seconds.

    Returns:
        Gaps in metres, shape (…,), 0 for pairs that touch; and the first times in seconds at which
        they occur, shape (…,). Both are NaN where a velocity is NaN.
    """
    first, second = np.broadcast_arrays(first, second)
    motion = np.broadcast_to(second_velocity - first_velocity, (*first.shape[:-1], 2))
    contact_times = time_to_collision(first, second, first_velocity, second_velocity)
    offsets = _corner_offsets_of_pairs(first, second)
    squared_speed = (motion**2).sum(axis=-1)[..., None]
    with np.errstate(all="ignore"):
        passing_times = np.where(squared_speed > 0, -along(offsets, motion) / squared_speed, 0.0)
        passing_times = passing_times.clip(0, horizon)
    passing_offsets = offsets + passing_times[..., None] * motion[..., None, :]
    passing_gaps = np.hypot(*np.moveaxis(passing_offsets, -1, 0))
    moved_centers = second[..., :2] + horizon * motion
    moved = np.concatenate([moved_centers, second[..., 2:]], axis=-1)
    begin_gap = gaps_of_pairs(first, second)
    end_gap = gaps_of_pairs(first, moved)
    begin_time = np.zeros_like(squared_speed)
    end_time = np.full_like(squared_speed, horizon)
    times = np.concatenate([begin_time, end_time, passing_times], axis=-1)
    gaps = np.concatenate([begin_gap[..., None], end_gap[..., None], passing_gaps], axis=-1)
    nearest = _argmin_earliest(gaps, times)[..., None]
    gap = np.take_along_axis(gaps, nearest, axis=-1)[..., 0]
    time = np.take_along_axis(times, nearest, axis=-1)[..., 0]
    touches = contact_times <= horizon
    gap = np.where(touches, 0.0, gap)
    time = np.where(touches, contact_times, time)
    return _copy_nan(gap, contact_times), _copy_nan(time, contact_times)


def _corner_offsets_of_pairs(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the offsets from each corner of the first to each of the second's, (…, 16, 2)."""
    first_corners = corner_offsets(first)[..., None, :, :]
    second_corners = corner_offsets(second)[..., :, None, :]
    differences = second_corners - first_corners
    differences = differences.reshape(*first.shape[:-1], 16, 2)
    centers_offset = second[..., :2] - first[..., :2]
    return differences + centers_offset[..., None, :]


def modified_ttc(
    first: FloatArray,
    second: FloatArray,
    first_speed: FloatArray,
    second_speed: FloatArray,
    first_acceleration: FloatArray,
    second_acceleration: FloatArray,
) -> FloatArray:
    """Return the time in seconds until pairs touch if each keeps its heading and acceleration.

    Braking actors stay where they stop. Along the direction of each box's side, the distance of the
    boxes is a piecewise parabola with up to three pieces, because each actor may stop. The boxes
    first touch at a root of one of these; all roots are tried.

    Args:
        first: First boxes, shape (…, 5).
        second: Second boxes, shape (…, 5).
        first_speed: Speeds of the first boxes along their headings in m/s, (…,); negative when
            reversing.
        second_speed: Speeds of the second boxes along their headings in m/s, shape (…,); negative
            when reversing.
        first_acceleration: Accelerations of the first boxes along their headings in m/s², (…,).
        second_acceleration: Accelerations of the second boxes along their headings in m/s², (…,).

    Returns:
        Times in seconds, shape (…,). They are 0 for boxes that touch now, infinite for boxes that
        never touch, NaN where a speed or an acceleration is NaN.
    """
    motions = (first_speed, second_speed, first_acceleration, second_acceleration)
    motion_shapes = [np.shape(values) for values in motions]
    shape = np.broadcast_shapes(first.shape[:-1], second.shape[:-1], *motion_shapes)
    columns = [np.broadcast_to(values, shape).ravel() for values in motions]
    motion = np.stack(columns, axis=-1)
    first = np.broadcast_to(first, (*shape, 5)).reshape(-1, 5)
    second = np.broadcast_to(second, (*shape, 5)).reshape(-1, 5)
    times = [np.zeros(0)]
    for start in range(0, len(first), _PAIRS_AT_ONCE):
        rows = slice(start, start + _PAIRS_AT_ONCE)
        times.append(_solve_contact_times(first[rows], second[rows], motion[rows]))
    return np.concatenate(times).reshape(shape)


def wrapped(angles: FloatArray) -> FloatArray:
    """Wrap angles in radians to (−π, π]."""
    turns = np.mod(np.pi - angles, 2 * np.pi)
    return np.asarray(np.pi - turns)


def least_root(square: FloatArray, linear: FloatArray, constant: FloatArray) -> FloatArray:
    """Return the smallest positive root of square·t² + linear·t + constant; infinite if none.

    `constant` must be negative.
    """
    roots = _solve_parabolas(square, linear, constant)
    positive_roots = np.where(roots > 0, roots, np.inf)
    return np.asarray(positive_roots.min(axis=0))


def _along_heading(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Measure how the first box approaches the second along the first's heading.

    Returns:
        Gap in metres, speed at which it closes in m/s, and whether the two pass side by side. Each
        has the shape (…,).
    """
    heading = normals(first[..., 4])
    offset = second[..., :2] - first[..., :2]
    turn = second[..., 4] - first[..., 4]
    cosine = np.abs(np.cos(turn))
    sine = np.abs(np.sin(turn))
    length = second[..., 2]
    width = second[..., 3]
    sum_of_lengths = first[..., 2] + length * cosine + width * sine
    sum_of_widths = first[..., 3] + length * sine + width * cosine
    forward = _dot_products(offset, heading)
    sideways = heading[..., 0] * offset[..., 1] - heading[..., 1] * offset[..., 0]
    gap = np.abs(forward) - sum_of_lengths / 2
    closing = np.sign(forward) * _dot_products(first_velocity - second_velocity, heading)
    passes_beside: BoolArray = np.abs(sideways) > sum_of_widths / 2
    return gap, closing, passes_beside


def _approach_speed(offset: FloatArray, relative_velocity: FloatArray) -> FloatArray:
    """Return the speed at which an offset (…, 2) gets shorter; NaN for an offset of length 0."""
    with np.errstate(all="ignore"):
        dot_products = _dot_products(offset, relative_velocity)
        speed = -dot_products / _vector_lengths(offset)
    return np.asarray(speed)


def _copy_nan(values: FloatArray, source: FloatArray) -> FloatArray:
    """Return `values`, with NaN wherever `source` is NaN."""
    return np.where(np.isnan(source), np.nan, values)


def _dot_products(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the dot products (…,) of vectors (…, 2)."""
    return np.asarray((first * second).sum(axis=-1))


def _vector_lengths(vectors: FloatArray) -> FloatArray:
    """Return the lengths (…,) of vectors (…, 2)."""
    return np.hypot(vectors[..., 0], vectors[..., 1])


def _solve_contact_times(first: FloatArray, second: FloatArray, motion: FloatArray) -> FloatArray:
    """Compute `modified_ttc` for P pairs, shape (P,), in seconds.

    Args:
        first: First boxes, shape (P, 5).
        second: Second boxes, shape (P, 5).
        motion: The two speeds, then the two accelerations, shape (P, 4).
    """
    normal, gap, reach = side_gaps(first, second)
    speeds = motion[:, :2]
    accelerations = motion[:, 2:]
    stops = _stop_times(speeds, accelerations)
    # Fraction of each actor's travelled distance that is along the direction of each side.
    shares = []
    for sign, boxes in ((-1.0, first), (1.0, second)):
        heading_shares = along(normal, normals(boxes[:, 4]))
        shares.append(sign * heading_shares[:, :, None])
    no_time = np.zeros((len(first), 1))
    piece_begins = np.concatenate([no_time, np.sort(stops, axis=1)], axis=1)
    candidates = [no_time]
    for piece in range(3):
        begin = piece_begins[:, piece, None]
        moves = stops > begin  # each piece begins when an actor stops
        distances = _travelled_distances(begin, speeds, accelerations, stops)
        finite_begin = np.where(np.isfinite(begin), begin, 0.0)
        piece_speeds = np.where(moves, speeds + accelerations * finite_begin, 0.0)
        piece_accelerations = np.where(moves, accelerations, 0.0)
        constant = gap + _project_on_sides(shares, distances)
        linear = _project_on_sides(shares, piece_speeds)
        square = _project_on_sides(shares, piece_accelerations) / 2
        offsets = np.concatenate([constant - reach, constant + reach], axis=1)
        roots = _solve_parabolas(np.tile(square, 2), np.tile(linear, 2), offsets)
        times = begin + np.hstack([*roots])
        candidates.append(np.where(times >= 0, times, np.inf))
    contact_times = _find_first_contacts(candidates, (gap, reach), shares, motion)
    is_unknown = np.isnan(motion).any(axis=1)
    return np.where(is_unknown, np.nan, contact_times)


def _find_first_contacts(
    candidates: list[FloatArray],
    sides: tuple[FloatArray, FloatArray],
    shares: list[FloatArray],
    motion: FloatArray,
) -> FloatArray:
    """Return the first candidate time at which boxes touch along all four sides, shape (P,).

    It is infinite if they touch at none of the times.

    Args:
        candidates: Arrays of times in seconds, each with shape (P, any number).
        sides: Gaps and reaches along the directions of the sides, each with shape (P, 4).
        shares: Fractions of each actor's distance along the sides, each with shape (P, 4, 1).
        motion: The two speeds, then the two accelerations, shape (P, 4).
    """
    gap, reach = sides
    speeds = motion[:, :2]
    accelerations = motion[:, 2:]
    stops = _stop_times(speeds, accelerations)
    times = np.concatenate(candidates, axis=1)
    touches = np.isfinite(times)
    distances = []
    for actor in (0, 1):
        column = np.s_[:, actor, None]
        distances.append(
            _travelled_distances(times, speeds[column], accelerations[column], stops[column])
        )
    for side in range(4):
        first_part = shares[0][:, side] * distances[0]
        second_part = shares[1][:, side] * distances[1]
        offset = first_part + second_part + gap[:, side, None]
        with np.errstate(invalid="ignore"):
            touches &= np.abs(offset) <= reach[:, side, None] + _CONTACT_TOLERANCE_M
    contact_times = np.where(touches, times, np.inf)
    return np.asarray(contact_times.min(axis=1))


def _project_on_sides(shares: list[FloatArray], values: FloatArray) -> FloatArray:
    """Sum both actors' values (P, 2) along the direction of each side, shape (P, 4)."""
    first_part = shares[0][..., 0] * values[:, None, 0]
    second_part = shares[1][..., 0] * values[:, None, 1]
    return first_part + second_part


def _stop_times(speeds: FloatArray, accelerations: FloatArray) -> FloatArray:
    """Return the time in seconds at which each actor stops; infinite if it never does.

    An actor that stands still and does not accelerate forwards stops at 0.
    """
    with np.errstate(all="ignore"):
        braking_times = -speeds / accelerations
        stop_times = np.where(speeds * accelerations < 0, braking_times, np.inf)
    is_standing = (speeds == 0) & (accelerations <= 0)
    return np.where(is_standing, 0.0, stop_times)


def _travelled_distances(
    times: FloatArray, speeds: FloatArray, accelerations: FloatArray, stops: FloatArray
) -> FloatArray:
    """Return the distances that actors have travelled along their headings at some times.

    After a stop, they stay constant. For infinite times, they are taken at time 0.
    """
    finite_times = np.where(np.isfinite(times), times, 0.0)
    duration = np.minimum(finite_times, stops)
    return np.asarray(speeds * duration + accelerations * duration**2 / 2)


def _solve_parabolas(square: FloatArray, linear: FloatArray, constant: FloatArray) -> FloatArray:
    """Return both roots of square·t² + linear·t + constant, shape (2, …).

    They are infinite if there are none. The formula keeps full precision when `square` is small.
    """
    with np.errstate(all="ignore"):
        discriminant = linear**2 - 4 * square * constant
        root_of_discriminant = np.copysign(np.sqrt(discriminant), linear)
        half = -(linear + root_of_discriminant) / 2
        roots = np.stack(np.broadcast_arrays(constant / half, half / square))
    return np.where(np.isfinite(roots), roots, np.inf)


def _argmin_earliest(gaps: FloatArray, times: FloatArray) -> AnyArray:
    """Return the indices (…) of the smallest gaps along the last axis.

    Of gaps that are equal up to rounding, the earliest is taken.
    """
    smallest = gaps.min(axis=-1, keepdims=True)
    is_tied = gaps <= smallest + _CONTACT_TOLERANCE_M * 1e-3
    tied_times = np.where(is_tied, times, np.inf)
    return np.asarray(tied_times.argmin(axis=-1))
