"""Surrogate measures of pairs at a moment, as functions of arrays: how near, how fast, how soon they would touch.

A box is a row (x, y, length, width, yaw), a velocity a row (x, y); SI units and radians, in any one right-handed frame
whose z points up. The leading dimensions are free: pairs, or pairs × frames. Where a velocity is NaN, so is what
follows from it. The pair is (first, second), and those measures that are not the same for both are the first's.
"""

from __future__ import annotations

import numpy as np

from deepaccident_devkit.geometry import time_to_collision
from deepaccident_devkit.geometry.box_arrays import normals, separations_of_pairs
from deepaccident_devkit.support.arrays import BoolArray, FloatArray


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


def drac(first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray) -> FloatArray:
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
    apart = second[..., :2] - first[..., :2]
    return _closing(apart, second_velocity - first_velocity)


def closing_speed_of_boxes(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Speed (…,) with which the gap between the boxes shrinks; negative if it grows, NaN where they touch."""
    return _closing(separations_of_pairs(first, second), second_velocity - first_velocity)


def delta_v(
    first_velocity: FloatArray, second_velocity: FloatArray, first_mass: FloatArray, second_mass: FloatArray
) -> FloatArray:
    """How much the velocity of the first and of the second would change if they collided now: (…, 2) m/s.

    Plastic and central: they go on together. Masses (…,) in kilograms; `masses_of` assumes some.
    """
    shares = np.stack([second_mass, first_mass], axis=-1) / (first_mass + second_mass)[..., None]
    return np.asarray(shares * relative_speed(first_velocity, second_velocity)[..., None])


def impact_heading(first: FloatArray, second: FloatArray) -> FloatArray:
    """The second's heading as the first sees it (…,), in (−π, π]: 0 the same direction, ±π head-on."""
    return wrapped(second[..., 4] - first[..., 4])


def impact_direction(first: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray) -> FloatArray:
    """The direction (…,) in which the first moves relative to the second, as the first sees it, in (−π, π].

    0 is straight ahead. NaN where there is no relative motion.
    """
    motion = first_velocity - second_velocity
    direction = wrapped(np.arctan2(motion[..., 1], motion[..., 0]) - first[..., 4])
    return np.where(_length(motion) > 0, direction, np.nan)


def time_exposed(times: FloatArray, threshold: float, step: float) -> FloatArray:
    """Time exposed TET (…,): seconds of moments (…, T), `step` apart, whose time to collision is within a threshold."""
    result: FloatArray = (np.asarray(times) <= threshold).sum(axis=-1) * step
    return result


def time_integrated(times: FloatArray, threshold: float, step: float) -> FloatArray:
    """Time integrated TIT (…,), s²: sum of (threshold − time) · step over moments (…, T) within a threshold."""
    below = np.asarray(times) <= threshold
    result: FloatArray = np.where(below, threshold - np.where(below, times, 0.0), 0.0).sum(axis=-1) * step
    return result


def wrapped(angles: FloatArray) -> FloatArray:
    """Angles in (−π, π]."""
    turned: FloatArray = np.pi - np.mod(np.pi - angles, 2 * np.pi)
    return turned


def least_root(square: FloatArray, linear: FloatArray, constant: FloatArray) -> FloatArray:
    """The least root above 0 of square·t² + linear·t + constant, whose constant is below 0; infinite without one.

    In the form that loses no digits where the square is small.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inner = linear**2 - 4 * square * constant
        half = -(linear + np.copysign(np.sqrt(inner), linear)) / 2
        roots = np.stack(np.broadcast_arrays(constant / half, half / square))
    roots = np.where(np.isfinite(roots) & (roots > 0), roots, np.inf)
    least: FloatArray = roots.min(axis=0)
    return least


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
        speeds: FloatArray = -_dot(way, relative_velocity) / _length(way)
    return speeds


def _known(values: FloatArray, source: FloatArray) -> FloatArray:
    """`values`, NaN where `source` is."""
    return np.where(np.isnan(source), np.nan, values)


def _dot(one: FloatArray, other: FloatArray) -> FloatArray:
    return np.asarray((one * other).sum(axis=-1))


def _length(vectors: FloatArray) -> FloatArray:
    return np.hypot(vectors[..., 0], vectors[..., 1])
