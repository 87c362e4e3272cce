"""Surrogate measures of pairs at a moment, as functions of arrays.

A box is a row (x, y, length, width, yaw), a velocity a row (x, y); SI units and radians, in any one
right-handed frame with z upwards. The leading dimensions are free: pairs, or pairs × frames.
Results that depend on a velocity are NaN where it is NaN. The pair is (first, second), and measures
that differ between the two are the first's.
"""

from __future__ import annotations

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

# Two boxes that touch by calculation may be apart by this distance.
_CONTACT_TOLERANCE_M = 1e-9
# Pairs that are computed together: their arrays then fit into the processor's cache.
_PAIRS_AT_ONCE = 1 << 9


def time_to_collision_1d(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Return the time until the first's bumper reaches the second along the first's heading.

    Both keep their velocities. This is the measure of car-following studies, which ignores crossing
    paths; see `time_to_collision` for them.

    Returns:
        Times, shape (…,), seconds; infinite unless the two overlap sideways now and come closer; 0
        if they also overlap along the heading.
    """
    gap, closing, beside = _along_heading(first, second, first_velocity, second_velocity)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        times = np.where(gap <= 0, 0.0, gap / closing)
    meets = ~beside & ((closing > 0) | (gap <= 0))
    return _known(np.where(meets, times, np.inf), closing)


def drac_1d(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Return the deceleration rate to avoid a crash along the first's heading: c² / 2g, m/s².

    See `time_to_collision_1d`.

    Returns:
        Rates, shape (…,); 0 without a conflict, infinite at contact.
    """
    gap, closing, beside = _along_heading(first, second, first_velocity, second_velocity)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        rates = np.where(gap <= 0, np.inf, closing**2 / (2 * gap))
    meets = ~beside & ((closing > 0) | (gap <= 0))
    return _known(np.where(meets, rates, 0.0), closing)


def drac(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Return the deceleration rate to avoid a crash in the plane, m/s².

    This is the relative speed over twice the time to collision.

    Returns:
        Rates, shape (…,); 0 without a conflict, infinite at contact.
    """
    times = time_to_collision(first, second, first_velocity, second_velocity)
    return drac_of(times, relative_speed(first_velocity, second_velocity))


def drac_of(times: FloatArray, relative_speeds: FloatArray) -> FloatArray:
    """Return `drac` for known times to collision (…,) and relative speeds (…,)."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        rates = relative_speeds / (2 * times)
    return _known(np.where(times == 0, np.inf, rates), times)


def modified_ttc_1d(
    first: FloatArray,
    second: FloatArray,
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    first_acceleration: FloatArray,
    second_acceleration: FloatArray,
) -> FloatArray:
    """Return `time_to_collision_1d` with constant accelerations (…,), m/s² along each heading.

    Like the textbook formula it ignores standstill: a braking actor ends up reversing.
    `modified_ttc` does not.

    Returns:
        Times, shape (…,), seconds; infinite unless the two overlap sideways now and the gap closes
        at some time; 0 without a gap.
    """
    gap, closing, beside = _along_heading(first, second, first_velocity, second_velocity)
    heading = normals(first[..., 4])
    first_change = first_acceleration[..., None] * heading
    second_change = second_acceleration[..., None] * normals(second[..., 4])
    direction = np.sign(_dot(second[..., :2] - first[..., :2], heading))
    gain = direction * _dot(first_change - second_change, heading)
    times = np.where(gap <= 0, 0.0, least_root(gain / 2, closing, -gap))
    return _known(np.where(beside, np.inf, times), closing + gain)


def relative_speed(first_velocity: FloatArray, second_velocity: FloatArray) -> FloatArray:
    """Return the length (…,) of the difference of two velocities (…, 2)."""
    return _length(second_velocity - first_velocity)


def closing_speed(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Return the speed (…,) with which the centres approach each other.

    It is negative if they part, NaN if they are one point.
    """
    offset = second[..., :2] - first[..., :2]
    return _closing(offset, second_velocity - first_velocity)


def closing_speed_of_boxes(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Return the speed (…,) with which the gap between the boxes shrinks.

    It is negative if the gap grows, NaN where the boxes touch.
    """
    return _closing(separations_of_pairs(first, second), second_velocity - first_velocity)


def delta_v(
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    first_mass: FloatArray,
    second_mass: FloatArray,
) -> FloatArray:
    """Return the changes of velocity of both actors if they collided now, shape (…, 2), m/s.

    The collision is plastic and central: they go on together. Masses (…,) are in kilograms;
    `masses_of` assumes some.
    """
    total_mass = first_mass + second_mass
    shares = np.stack([second_mass, first_mass], axis=-1) / total_mass[..., None]
    speed = relative_speed(first_velocity, second_velocity)
    return np.asarray(shares * speed[..., None])


def impact_heading(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the second's heading relative to the first's (…,), in (−π, π].

    0 is the same direction, ±π is head-on.
    """
    return wrapped(second[..., 4] - first[..., 4])


def impact_direction(
    first: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Return the direction in which the first moves relative to the second (…,), in (−π, π].

    It is relative to the first's heading: 0 is straight ahead. NaN where there is no relative
    motion.
    """
    motion = first_velocity - second_velocity
    world_direction = np.arctan2(motion[..., 1], motion[..., 0])
    direction = wrapped(world_direction - first[..., 4])
    return np.where(_length(motion) > 0, direction, np.nan)


def time_exposed(times: FloatArray, threshold: float, step: float) -> FloatArray:
    """Return the time exposed TET (…,), seconds.

    It is the duration of the moments with a time to collision within the threshold.

    Args:
        times: Times to collision at T moments, shape (…, T), seconds.
        threshold: Largest time to collision that counts, seconds.
        step: Time between two moments, seconds.
    """
    within = np.asarray(times) <= threshold
    return np.asarray(within.sum(axis=-1) * step)


def time_integrated(times: FloatArray, threshold: float, step: float) -> FloatArray:
    """Return the time integrated TIT (…,), s².

    It is the sum of (threshold − time) · step over the moments within the threshold.

    Args:
        times: Times to collision at T moments, shape (…, T), seconds.
        threshold: Largest time to collision that counts, seconds.
        step: Time between two moments, seconds.
    """
    within = np.asarray(times) <= threshold
    shortfall = np.where(within, threshold - np.where(within, times, 0.0), 0.0)
    return np.asarray(shortfall.sum(axis=-1) * step)


def nearest_approach(
    first: FloatArray,
    second: FloatArray,
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    horizon: float = 20.0,
) -> tuple[FloatArray, FloatArray]:
    """Return the smallest gap of pairs that keep their velocities, and its time.

    The gap of convex outlines that move steadily shrinks and then grows. Where the two never touch,
    it is smallest at the horizon's begin or end, or where a corner passes the other's outline:
    these moments are compared.

    Args:
        first: First boxes, shape (…, 5).
        second: Second boxes, shape (…, 5).
        first_velocity: Velocities of the first boxes, shape (…, 2), m/s.
        second_velocity: Velocities of the second boxes, shape (…, 2), m/s.
        horizon: Time to look ahead, seconds.

    Returns:
        Gaps, shape (…,), metres, 0 for pairs that touch; and the first moment with this gap, shape
        (…,), seconds. NaN where a velocity is NaN.
    """
    first, second = np.broadcast_arrays(first, second)
    motion = np.broadcast_to(second_velocity - first_velocity, (*first.shape[:-1], 2))
    contact_times = time_to_collision(first, second, first_velocity, second_velocity)
    offsets = _corner_to_corner(first, second)
    squared_speed = (motion**2).sum(axis=-1)[..., None]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        passing_times = np.where(squared_speed > 0, -along(offsets, motion) / squared_speed, 0.0)
        passing_times = passing_times.clip(0, horizon)
    passing_offsets = offsets + passing_times[..., None] * motion[..., None, :]
    passing_gaps = np.hypot(*np.moveaxis(passing_offsets, -1, 0))
    moved_centers = second[..., :2] + horizon * motion
    moved = np.concatenate([moved_centers, second[..., 2:]], axis=-1)
    end_gaps = np.stack([gaps_of_pairs(first, second), gaps_of_pairs(first, moved)], axis=-1)
    begins = np.zeros_like(squared_speed)
    ends = np.full_like(squared_speed, horizon)
    times = np.concatenate([begins, ends, passing_times], axis=-1)
    gaps = np.concatenate([end_gaps, passing_gaps], axis=-1)
    best = _first_smallest(gaps, times)[..., None]
    gap = np.take_along_axis(gaps, best, axis=-1)[..., 0]
    time = np.take_along_axis(times, best, axis=-1)[..., 0]
    touches = contact_times <= horizon
    unknown = np.isnan(contact_times)
    return (
        np.where(unknown, np.nan, np.where(touches, 0.0, gap)),
        np.where(unknown, np.nan, np.where(touches, contact_times, time)),
    )


def _corner_to_corner(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the offsets from each corner of the first to each of the second, shape (…, 16, 2)."""
    first_corners = corner_offsets(first)[..., None, :, :]
    second_corners = corner_offsets(second)[..., :, None, :]
    differences = second_corners - first_corners
    centers_offset = second[..., :2] - first[..., :2]
    return differences.reshape(*first.shape[:-1], 16, 2) + centers_offset[..., None, :]


def modified_ttc(
    first: FloatArray,
    second: FloatArray,
    first_speed: FloatArray,
    second_speed: FloatArray,
    first_acceleration: FloatArray,
    second_acceleration: FloatArray,
) -> FloatArray:
    """Return the time until pairs touch if each keeps its heading and its acceleration, seconds.

    A braking actor stays where it stops. Along each direction of a side the boxes' distance is a
    parabola, in up to three pieces, since either may stop. The boxes first touch at a root of one
    of these; all roots are tried.

    Args:
        first: First boxes, shape (…, 5).
        second: Second boxes, shape (…, 5).
        first_speed: Speeds of the first boxes along the heading, shape (…,), m/s; negative for
            reversing.
        second_speed: Speeds of the second boxes along the heading, shape (…,), m/s; negative for
            reversing.
        first_acceleration: Accelerations of the first boxes along the heading, shape (…,), m/s².
        second_acceleration: Accelerations of the second boxes along the heading, shape (…,), m/s².

    Returns:
        Times, shape (…,); 0 for boxes that touch now, infinite for boxes that never touch; NaN
        where a speed or an acceleration is NaN.
    """
    motions = (first_speed, second_speed, first_acceleration, second_acceleration)
    motion_shapes = [np.shape(values) for values in motions]
    shape = np.broadcast_shapes(first.shape[:-1], second.shape[:-1], *motion_shapes)
    motion = np.stack([np.broadcast_to(values, shape).ravel() for values in motions], axis=-1)
    first = np.broadcast_to(first, (*shape, 5)).reshape(-1, 5)
    second = np.broadcast_to(second, (*shape, 5)).reshape(-1, 5)
    times = [np.zeros(0)]
    for start in range(0, len(first), _PAIRS_AT_ONCE):
        part = slice(start, start + _PAIRS_AT_ONCE)
        times.append(_accelerated_ttc(first[part], second[part], motion[part]))
    return np.concatenate(times).reshape(shape)


def wrapped(angles: FloatArray) -> FloatArray:
    """Return angles wrapped to (−π, π]."""
    turns = np.mod(np.pi - angles, 2 * np.pi)
    return np.asarray(np.pi - turns)


def least_root(square: FloatArray, linear: FloatArray, constant: FloatArray) -> FloatArray:
    """Return the smallest positive root of square·t² + linear·t + constant; infinite without one.

    The constant is negative.
    """
    roots = _roots(square, linear, constant)
    return np.asarray(np.where(roots > 0, roots, np.inf).min(axis=0))


def _along_heading(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the relation of two boxes along the first's heading.

    Returns:
        Gap, metres; speed with which it closes, m/s; and whether the two pass side by side. Each of
        shape (…,).
    """
    heading = normals(first[..., 4])
    offset = second[..., :2] - first[..., :2]
    turn = second[..., 4] - first[..., 4]
    cosine = np.abs(np.cos(turn))
    sine = np.abs(np.sin(turn))
    length = second[..., 2]
    width = second[..., 3]
    forward = _dot(offset, heading)
    sideways = heading[..., 0] * offset[..., 1] - heading[..., 1] * offset[..., 0]
    gap = np.abs(forward) - (first[..., 2] + length * cosine + width * sine) / 2
    closing = np.sign(forward) * _dot(first_velocity - second_velocity, heading)
    half_widths = (first[..., 3] + length * sine + width * cosine) / 2
    beside: BoolArray = np.abs(sideways) > half_widths
    return gap, closing, beside


def _closing(offset: FloatArray, relative_velocity: FloatArray) -> FloatArray:
    """Return the speed with which an offset (…, 2) gets shorter; NaN where it has no length."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.asarray(-_dot(offset, relative_velocity) / _length(offset))


def _known(values: FloatArray, source: FloatArray) -> FloatArray:
    """Return `values`, NaN where `source` is NaN."""
    return np.where(np.isnan(source), np.nan, values)


def _dot(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the dot products (…,) of vectors (…, 2)."""
    return np.asarray((first * second).sum(axis=-1))


def _length(vectors: FloatArray) -> FloatArray:
    """Return the lengths (…,) of vectors (…, 2)."""
    return np.hypot(vectors[..., 0], vectors[..., 1])


def _accelerated_ttc(first: FloatArray, second: FloatArray, motion: FloatArray) -> FloatArray:
    """Return `modified_ttc` of P pairs.

    Args:
        first: First boxes, shape (P, 5).
        second: Second boxes, shape (P, 5).
        motion: Both speeds and both accelerations, shape (P, 4).
    """
    normal, gap, reach = side_gaps(first, second)
    speeds = motion[:, :2]
    rates = motion[:, 2:]
    stops = _stop_times(speeds, rates)
    # Shares of each actor's path along the directions of the sides.
    shares = []
    for sign, boxes in ((-1.0, first), (1.0, second)):
        shares.append(sign * along(normal, normals(boxes[:, 4]))[:, :, None])
    no_time = np.zeros((len(first), 1))
    piece_begins = np.concatenate([no_time, np.sort(stops, axis=1)], axis=1)
    candidates = [no_time]
    for piece in range(3):
        begin = piece_begins[:, piece, None]
        moves = stops > begin  # a piece begins where an actor stops
        travelled = _travelled(begin, speeds, rates, stops)
        finite_begin = np.where(np.isfinite(begin), begin, 0.0)
        piece_speeds = np.where(moves, speeds + rates * finite_begin, 0.0)
        constant = gap + _along_sides(shares, travelled)
        linear = _along_sides(shares, piece_speeds)
        square = _along_sides(shares, np.where(moves, rates, 0.0)) / 2
        offsets = np.concatenate([constant - reach, constant + reach], axis=1)
        roots = _roots(np.tile(square, 2), np.tile(linear, 2), offsets)
        times = begin + np.hstack([*roots])
        candidates.append(np.where(times >= 0, times, np.inf))
    contact_times = _first_touch(candidates, (gap, reach), shares, motion)
    return np.where(np.isnan(motion).any(axis=1), np.nan, contact_times)


def _first_touch(
    candidates: list[FloatArray],
    sides: tuple[FloatArray, FloatArray],
    shares: list[FloatArray],
    motion: FloatArray,
) -> FloatArray:
    """Return the earliest candidate time at which boxes touch along all four sides, shape (P,).

    Infinite if they touch at none of the times.

    Args:
        candidates: Arrays of times, each of shape (P, any number), seconds.
        sides: Gaps and reaches along the directions of the sides, each of shape (P, 4).
        shares: Shares of each actor's path along the sides, each of shape (P, 4, 1).
        motion: Both speeds and both accelerations, shape (P, 4).
    """
    gap, reach = sides
    speeds = motion[:, :2]
    rates = motion[:, 2:]
    stops = _stop_times(speeds, rates)
    times = np.concatenate(candidates, axis=1)
    touch = np.isfinite(times)
    first_path, second_path = (
        _travelled(times, speeds[:, actor, None], rates[:, actor, None], stops[:, actor, None])
        for actor in (0, 1)
    )
    for side in range(4):
        first_distance = shares[0][:, side] * first_path
        second_distance = shares[1][:, side] * second_path
        distance = first_distance + second_distance + gap[:, side, None]
        with np.errstate(invalid="ignore"):
            touch &= np.abs(distance) <= reach[:, side, None] + _CONTACT_TOLERANCE_M
    return np.asarray(np.where(touch, times, np.inf).min(axis=1))


def _along_sides(shares: list[FloatArray], values: FloatArray) -> FloatArray:
    """Return the sum of both actors' values (P, 2) along each direction of a side, shape (P, 4)."""
    first_part = shares[0][..., 0] * values[:, None, 0]
    second_part = shares[1][..., 0] * values[:, None, 1]
    return first_part + second_part


def _stop_times(speeds: FloatArray, rates: FloatArray) -> FloatArray:
    """Return when each actor stops, infinite if never.

    An actor that stands and does not accelerate forward has stopped at 0.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        braking = np.where(speeds * rates < 0, -speeds / rates, np.inf)
    return np.where((speeds == 0) & (rates <= 0), 0.0, braking)


def _travelled(
    times: FloatArray, speeds: FloatArray, rates: FloatArray, stops: FloatArray
) -> FloatArray:
    """Return the distance along the heading at times, constant after the stop.

    Infinite times have the distance of time 0.
    """
    duration = np.minimum(np.where(np.isfinite(times), times, 0.0), stops)
    return np.asarray(speeds * duration + rates * duration**2 / 2)


def _roots(square: FloatArray, linear: FloatArray, constant: FloatArray) -> FloatArray:
    """Return both roots of the parabolas square·t² + linear·t + constant, shape (2, …).

    Infinite where there are none. The formula loses no digits where the square is small.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        discriminant = linear**2 - 4 * square * constant
        half = -(linear + np.copysign(np.sqrt(discriminant), linear)) / 2
        roots = np.stack(np.broadcast_arrays(constant / half, half / square))
    return np.where(np.isfinite(roots), roots, np.inf)


def _first_smallest(gaps: FloatArray, times: FloatArray) -> AnyArray:
    """Return the positions (…) of the smallest gaps along the last axis.

    Among gaps that are equal to a rounding, it is the position of the earliest.
    """
    smallest = gaps.min(axis=-1, keepdims=True)
    tied_times = np.where(gaps <= smallest + _CONTACT_TOLERANCE_M * 1e-3, times, np.inf)
    return np.asarray(tied_times.argmin(axis=-1))
