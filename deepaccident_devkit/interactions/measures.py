"""Surrogate measures of pairs at a moment, as functions of arrays: how near, how fast, how soon they would touch.

A box is a row (x, y, length, width, yaw), a velocity a row (x, y); SI units and radians, in any one right-handed frame
whose z points up. The leading dimensions are free: pairs, or pairs × frames. Where a velocity is NaN, so is what
follows from it. The pair is (first, second), and those measures that are not the same for both are the first's.
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

# Metres by which two boxes may be apart where they touch by calculation.
_TOLERANCE = 1e-9
# Pairs that are computed together: what they need then fits into the processor's cache.
_PAIRS_AT_ONCE = 1 << 9


def time_to_collision_1d(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Seconds until the first's bumper reaches the second, both keeping their velocities, along the first's heading.

    The figure of car-following studies: it knows nothing of crossing paths. See `time_to_collision` for those.

    Returns:
        (…,) infinite unless the two overlap sideways now and come closer; 0 if they overlap along the heading too.
    """
    gap, closing, beside = _along_heading(first, second, first_velocity, second_velocity)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        times = np.where(gap <= 0, 0.0, gap / closing)
    meets = ~beside & ((closing > 0) | (gap <= 0))
    return _known(np.where(meets, times, np.inf), closing)


def drac_1d(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Deceleration rate to avoid a crash, m/s², along the first's heading: c² / 2g; see `time_to_collision_1d`.

    Returns:
        (…,) 0 without a conflict, infinite at contact.
    """
    gap, closing, beside = _along_heading(first, second, first_velocity, second_velocity)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        rates = np.where(gap <= 0, np.inf, closing**2 / (2 * gap))
    meets = ~beside & ((closing > 0) | (gap <= 0))
    return _known(np.where(meets, rates, 0.0), closing)


def drac(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Deceleration rate to avoid a crash in the plane, m/s²: the relative speed over twice the time to collision.

    Returns:
        (…,) 0 without a conflict, infinite at contact.
    """
    times = time_to_collision(first, second, first_velocity, second_velocity)
    return drac_of(times, relative_speed(first_velocity, second_velocity))


def drac_of(times: FloatArray, relative_speeds: FloatArray) -> FloatArray:
    """`drac` by known times to collision (…,) and relative speeds (…,)."""
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
    """`time_to_collision_1d` with accelerations (…,) that stay, m/s² along each one's own heading.

    As the literature has it, also past a standstill: who brakes reverses in the end. `modified_ttc` does not.

    Returns:
        (…,) infinite unless the two overlap sideways now and the gap closes at some time; 0 if it has none.
    """
    gap, closing, beside = _along_heading(first, second, first_velocity, second_velocity)
    heading = normals(first[..., 4])
    accelerations = [
        acceleration[..., None] * normals(boxes[..., 4])
        for boxes, acceleration in ((first, first_acceleration), (second, second_acceleration))
    ]
    ahead = np.sign(_dot(second[..., :2] - first[..., :2], heading))
    gaining = ahead * _dot(accelerations[0] - accelerations[1], heading)
    times = np.where(gap <= 0, 0.0, least_root(gaining / 2, closing, -gap))
    return _known(np.where(beside, np.inf, times), closing + gaining)


def relative_speed(first_velocity: FloatArray, second_velocity: FloatArray) -> FloatArray:
    """Length (…,) of the difference of two velocities (…, 2)."""
    return _length(second_velocity - first_velocity)


def closing_speed(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Speed (…,) with which the centres come closer; negative if they part, NaN if they are one point."""
    return _closing(second[..., :2] - first[..., :2], second_velocity - first_velocity)


def closing_speed_of_boxes(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Speed (…,) with which the gap between the boxes shrinks; negative if it grows, NaN where they touch."""
    return _closing(separations_of_pairs(first, second), second_velocity - first_velocity)


def delta_v(
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    first_mass: FloatArray,
    second_mass: FloatArray,
) -> FloatArray:
    """How much the velocity of the first and of the second would change if they collided now: (…, 2) m/s.

    Plastic and central: they go on together. Masses (…,) in kilograms; `masses_of` assumes some.
    """
    shares = np.stack([second_mass, first_mass], axis=-1) / (first_mass + second_mass)[..., None]
    return np.asarray(shares * relative_speed(first_velocity, second_velocity)[..., None])


def impact_heading(first: FloatArray, second: FloatArray) -> FloatArray:
    """The second's heading as the first sees it (…,), in (−π, π]: 0 the same direction, ±π head-on."""
    return wrapped(second[..., 4] - first[..., 4])


def impact_direction(
    first: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """The direction (…,) in which the first moves relative to the second, as the first sees it, in (−π, π].

    0 is straight ahead. NaN where there is no relative motion.
    """
    motion = first_velocity - second_velocity
    direction = wrapped(np.arctan2(motion[..., 1], motion[..., 0]) - first[..., 4])
    return np.where(_length(motion) > 0, direction, np.nan)


def time_exposed(times: FloatArray, threshold: float, step: float) -> FloatArray:
    """Time exposed TET (…,): seconds of moments (…, T), `step` apart, whose time to collision is within a threshold."""
    return np.asarray((np.asarray(times) <= threshold).sum(axis=-1) * step)


def time_integrated(times: FloatArray, threshold: float, step: float) -> FloatArray:
    """Time integrated TIT (…,), s²: sum of (threshold − time) · step over moments (…, T) within a threshold."""
    below = np.asarray(times) <= threshold
    return np.asarray(
        np.where(below, threshold - np.where(below, times, 0.0), 0.0).sum(axis=-1) * step
    )


def nearest_approach(
    first: FloatArray,
    second: FloatArray,
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    horizon: float = 20.0,
) -> tuple[FloatArray, FloatArray]:
    """The least gap of pairs that keep their velocities, and when.

    The gap of convex outlines that move steadily shrinks and then grows. Where the two never touch, it is least at the
    horizon's begin or end, or where a corner passes the other's outline: these are compared.

    Args:
        first: (…, 5) boxes.
        second: (…, 5) boxes.
        first_velocity: (…, 2) metres a second.
        second_velocity: (…, 2) metres a second.
        horizon: seconds to look ahead.

    Returns:
        (…,) metres, 0 for those that touch; (…,) seconds, the first such moment; NaN where a velocity is.
    """
    first, second = np.broadcast_arrays(first, second)
    motion = np.broadcast_to(second_velocity - first_velocity, (*first.shape[:-1], 2))
    touch = time_to_collision(first, second, first_velocity, second_velocity)
    ways = (
        corner_offsets(second)[..., :, None, :] - corner_offsets(first)[..., None, :, :]
    ).reshape(*first.shape[:-1], 16, 2) + (second[..., :2] - first[..., :2])[..., None, :]
    speed = (motion**2).sum(axis=-1)[..., None]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        passing = np.where(speed > 0, -along(ways, motion) / speed, 0.0).clip(0, horizon)
    at_passing = np.hypot(*np.moveaxis(ways + passing[..., None] * motion[..., None, :], -1, 0))
    moved = np.concatenate([second[..., :2] + horizon * motion, second[..., 2:]], axis=-1)
    ends = np.stack([gaps_of_pairs(first, second), gaps_of_pairs(first, moved)], axis=-1)
    times = np.concatenate([np.zeros_like(speed), np.full_like(speed, horizon), passing], axis=-1)
    gaps = np.concatenate([ends, at_passing], axis=-1)
    best = _first_least(gaps, times)[..., None]
    gap, time = (np.take_along_axis(values, best, axis=-1)[..., 0] for values in (gaps, times))
    touches = touch <= horizon
    unknown = np.isnan(touch)
    return (
        np.where(unknown, np.nan, np.where(touches, 0.0, gap)),
        np.where(unknown, np.nan, np.where(touches, touch, time)),
    )


def modified_ttc(
    first: FloatArray,
    second: FloatArray,
    first_speed: FloatArray,
    second_speed: FloatArray,
    first_acceleration: FloatArray,
    second_acceleration: FloatArray,
) -> FloatArray:
    """Seconds until pairs touch if each keeps its heading and its acceleration; one that brakes stays where it stops.

    Along each direction of a side the boxes' distance is a parabola, in up to three pieces, since either may stop. The
    boxes first touch at a root of one of these; all roots are tried.

    Args:
        first: (…, 5) boxes.
        second: (…, 5) boxes.
        first_speed: (…,) metres a second along the heading; negative for reversing.
        second_speed: (…,) the same.
        first_acceleration: (…,) m/s² along the heading.
        second_acceleration: (…,) the same.

    Returns:
        (…,) 0 for boxes that touch now, infinite for boxes that never touch; NaN where a speed or acceleration is.
    """
    given = (first_speed, second_speed, first_acceleration, second_acceleration)
    shape = np.broadcast_shapes(first.shape[:-1], second.shape[:-1], *map(np.shape, given))
    motion = np.stack([np.broadcast_to(each, shape).ravel() for each in given], axis=-1)
    first, second = (
        np.broadcast_to(boxes, (*shape, 5)).reshape(-1, 5) for boxes in (first, second)
    )
    parts = [slice(start, start + _PAIRS_AT_ONCE) for start in range(0, len(first), _PAIRS_AT_ONCE)]
    times = [_accelerated(first[part], second[part], motion[part]) for part in parts]
    return np.concatenate([np.zeros(0), *times]).reshape(shape)


def wrapped(angles: FloatArray) -> FloatArray:
    """Angles in (−π, π]."""
    return np.asarray(np.pi - np.mod(np.pi - angles, 2 * np.pi))


def least_root(square: FloatArray, linear: FloatArray, constant: FloatArray) -> FloatArray:
    """The least root above 0 of square·t² + linear·t + constant, whose constant is below 0; infinite without one."""
    roots = _roots(square, linear, constant)
    return np.asarray(np.where(roots > 0, roots, np.inf).min(axis=0))


def _along_heading(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Along the first's heading: the gap, the speed with which it closes, and whether the two pass side by side."""
    heading, apart = normals(first[..., 4]), second[..., :2] - first[..., :2]
    turn = second[..., 4] - first[..., 4]
    cosine, sine = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    length, width = second[..., 2], second[..., 3]
    ahead = _dot(apart, heading)
    aside = heading[..., 0] * apart[..., 1] - heading[..., 1] * apart[..., 0]
    gap = np.abs(ahead) - (first[..., 2] + length * cosine + width * sine) / 2
    closing = np.sign(ahead) * _dot(first_velocity - second_velocity, heading)
    beside: BoolArray = np.abs(aside) > (first[..., 3] + length * sine + width * cosine) / 2
    return gap, closing, beside


def _closing(way: FloatArray, relative_velocity: FloatArray) -> FloatArray:
    """Speed with which a way (…, 2) gets shorter; NaN where it has no length."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.asarray(-_dot(way, relative_velocity) / _length(way))


def _known(values: FloatArray, source: FloatArray) -> FloatArray:
    """`values`, NaN where `source` is."""
    return np.where(np.isnan(source), np.nan, values)


def _dot(one: FloatArray, other: FloatArray) -> FloatArray:
    return np.asarray((one * other).sum(axis=-1))


def _length(vectors: FloatArray) -> FloatArray:
    return np.hypot(vectors[..., 0], vectors[..., 1])


def _accelerated(first: FloatArray, second: FloatArray, motion: FloatArray) -> FloatArray:
    """`modified_ttc` of (P, 5) boxes and (P, 4) motions: both speeds, both accelerations."""
    normal, gap, reach = side_gaps(first, second)
    speeds, rates = motion[:, :2], motion[:, 2:]
    stops = _stops(speeds, rates)
    shares = [  # of the way of each, along a side
        sign * along(normal, normals(box[:, 4]))[:, :, None]
        for sign, box in ((-1.0, first), (1.0, second))
    ]
    edges = np.concatenate([np.zeros((len(first), 1)), np.sort(stops, axis=1)], axis=1)
    candidates = [np.zeros((len(first), 1))]
    for piece in range(3):
        begin = edges[:, piece, None]
        moves = stops > begin  # a piece begins where one stops
        travelled = _travelled(begin, speeds, rates, stops)
        speed_then = np.where(moves, speeds + rates * np.where(np.isfinite(begin), begin, 0.0), 0.0)
        constant = gap + _along_sides(shares, travelled)
        linear = _along_sides(shares, speed_then)
        square = _along_sides(shares, np.where(moves, rates, 0.0)) / 2
        offsets = np.concatenate([constant - reach, constant + reach], axis=1)
        times = begin + np.hstack([*_roots(np.tile(square, 2), np.tile(linear, 2), offsets)])
        candidates.append(np.where(times >= 0, times, np.inf))
    return np.where(
        np.isnan(motion).any(axis=1), np.nan, _first_touch(candidates, (gap, reach), shares, motion)
    )


def _first_touch(
    candidates: list[FloatArray],
    sides: tuple[FloatArray, FloatArray],
    shares: list[FloatArray],
    motion: FloatArray,
) -> FloatArray:
    """The earliest (P,) of some times at which boxes touch along all four sides; infinite if they do at none."""
    gap, reach = sides
    speeds, rates = motion[:, :2], motion[:, 2:]
    stops = _stops(speeds, rates)
    times = np.concatenate(candidates, axis=1)
    touch = np.isfinite(times)
    ways = [
        _travelled(times, *(each[:, which, None] for each in (speeds, rates, stops)))
        for which in (0, 1)
    ]
    for side in range(4):
        distance = shares[0][:, side] * ways[0] + shares[1][:, side] * ways[1] + gap[:, side, None]
        with np.errstate(invalid="ignore"):
            touch &= np.abs(distance) <= reach[:, side, None] + _TOLERANCE
    return np.asarray(np.where(touch, times, np.inf).min(axis=1))


def _along_sides(shares: list[FloatArray], values: FloatArray) -> FloatArray:
    """(P, 4) what the values (P, 2) of both come to along each direction of a side."""
    return shares[0][..., 0] * values[:, None, 0] + shares[1][..., 0] * values[:, None, 1]


def _stops(speeds: FloatArray, rates: FloatArray) -> FloatArray:
    """When each comes to a stop, infinite if never; one that stands and is not sped up forward stays."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        braking = np.where(speeds * rates < 0, -speeds / rates, np.inf)
    return np.where((speeds == 0) & (rates <= 0), 0.0, braking)


def _travelled(
    times: FloatArray, speeds: FloatArray, rates: FloatArray, stops: FloatArray
) -> FloatArray:
    """Way along the heading at times, which stays where it stops; of infinite times those of 0."""
    until = np.minimum(np.where(np.isfinite(times), times, 0.0), stops)
    return np.asarray(speeds * until + rates * until**2 / 2)


def _roots(square: FloatArray, linear: FloatArray, constant: FloatArray) -> FloatArray:
    """Both roots (2, …) of parabolas square·t² + linear·t + constant, infinite where there are none.

    In the form that loses no digits where the square is small.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inner = linear**2 - 4 * square * constant
        half = -(linear + np.copysign(np.sqrt(inner), linear)) / 2
        roots = np.stack(np.broadcast_arrays(constant / half, half / square))
    return np.where(np.isfinite(roots), roots, np.inf)


def _first_least(gaps: FloatArray, times: FloatArray) -> AnyArray:
    """Positions (…) along the last axis of the least gaps, of equal ones (to a rounding) the earliest."""
    least = gaps.min(axis=-1, keepdims=True)
    return np.asarray(np.where(gaps <= least + _TOLERANCE * 1e-3, times, np.inf).argmin(axis=-1))
