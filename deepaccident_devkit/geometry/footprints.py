"""Rectangles on the ground, over arrays: common areas and gaps.

A footprint is a row (x, y, length, width, yaw): metres and radians in any right-handed frame whose z points up.
Only differences of positions are used, so that world coordinates lose no digits.
"""

import numpy as np

from deepaccident_devkit.support.arrays import FloatArray

_SIGNS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) / 2
"""Corners as shares of (length, width), counter-clockwise from front left."""
_PAIRS_AT_ONCE = 1 << 14
"""Pairs that are computed together; it limits the memory for the areas and gaps of many pairs."""


def intersection_areas(first: FloatArray, second: FloatArray) -> FloatArray:
    """Common areas of each of N footprints with each of M: (N, 5) and (M, 5) → (N, M), m²."""
    reach = np.hypot(first[:, 2], first[:, 3])[:, None] + np.hypot(second[:, 2], second[:, 3])
    apart = np.hypot(first[:, None, 0] - second[:, 0], first[:, None, 1] - second[:, 1])
    rows, columns = np.nonzero(apart <= reach / 2 * (1 + 1e-9))
    result = np.zeros((len(first), len(second)))
    for start in range(0, len(rows), _PAIRS_AT_ONCE):
        a, b = rows[start : start + _PAIRS_AT_ONCE], columns[start : start + _PAIRS_AT_ONCE]
        result[a, b] = _areas_of_pairs(first[a], second[b])
    return result


def gaps(first: FloatArray, second: FloatArray) -> FloatArray:
    """The shortest distance from each of N footprints to each of M: (N, 5) and (M, 5) → (N, M), metres.

    0 if they touch; NaN if one of the two has a NaN.
    """
    result = np.zeros((len(first), len(second)))
    step = max(1, _PAIRS_AT_ONCE // max(1, len(second)))
    for start in range(0, len(first), step):
        result[start : start + step] = gaps_of_pairs(first[start : start + step, None], second[None])
    return result


def gaps_of_pairs(first: FloatArray, second: FloatArray) -> FloatArray:
    """`gaps` between footprints (…, 5) and the others (…, 5) at the same places, which may broadcast: (…), metres."""
    beside, here = _outside(first, second)
    beside_too, there = _outside(second, first)
    together = np.maximum(beside, beside_too) <= 0
    return np.where(together, 0.0, np.minimum(here, there))


def separations_of_pairs(first: FloatArray, second: FloatArray) -> FloatArray:
    """The shortest way from footprints (…, 5) to the others (…, 5) at the same places, as a vector (…, 2), metres.

    Its length is the gap. NaN if the two overlap or touch, since then there is no direction. Where sides lie
    parallel, any of the shortest ways.
    """
    there, here = -_reaching(first, second), _reaching(second, first)
    shorter = np.hypot(*np.moveaxis(there, -1, 0)) <= np.hypot(*np.moveaxis(here, -1, 0))
    vectors = np.where(shorter[..., None], there, here)
    apart = np.maximum(_outside(first, second)[0], _outside(second, first)[0]) > 0
    result: FloatArray = np.where(apart[..., None], vectors, np.nan)
    return result


def corner_offsets(footprints: FloatArray) -> FloatArray:
    """The corners (…, 4, 2) of footprints (…, 5), counter-clockwise from front left, less their centres."""
    along = footprints[..., 2, None] * _SIGNS[:, 0]
    aside = footprints[..., 3, None] * _SIGNS[:, 1]
    cosine, sine = np.cos(footprints[..., 4])[..., None], np.sin(footprints[..., 4])[..., None]
    return np.stack([cosine * along - sine * aside, sine * along + cosine * aside], axis=-1)


def _reaching(first: FloatArray, second: FloatArray) -> FloatArray:
    """The way (…, 2) to the first's nearest corner from the nearest place of the second."""
    x, y = _corners_in(first, second)
    half = second[..., 2:4, None] / 2
    x, y = (values - np.clip(values, -half[..., axis, :], half[..., axis, :]) for axis, values in enumerate((x, y)))
    nearest = (x**2 + y**2).argmin(axis=-1)[..., None]
    x, y = (np.take_along_axis(values, nearest, axis=-1)[..., 0] for values in (x, y))
    cosine, sine = np.cos(second[..., 4]), np.sin(second[..., 4])
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def _areas_of_pairs(first: FloatArray, second: FloatArray) -> FloatArray:
    """Common area of `first[i]` and `second[i]`, (P,) m².

    In the second's own axes, in which it is |x| ≤ h, |y| ≤ k, the area is −∮ clamp(y, ±k) d clamp(x, ±h) around the
    first: every edge adds a sum of trapezoids. No corners of the overlap are computed, so identical and touching
    rectangles are no special cases: the result depends continuously on the input.
    """
    x, y = _corners_in(first, second)
    half = second[:, 2:4, None] / 2
    across, up = np.roll(x, -1, axis=1) - x, np.roll(y, -1, axis=1) - y
    start, end = _stretch_within(x, across, half[:, 0])
    below, above = y + start * up, y + end * up
    mean = _mean_of_clamped(below, above - below, half[:, 1])
    area = -np.sum(across * (end - start) * mean, axis=1)
    most = np.minimum(first[:, 2] * first[:, 3], second[:, 2] * second[:, 3])
    result: FloatArray = np.clip(area, 0, most)
    return result


def _stretch_within(start: FloatArray, change: FloatArray, limit: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The part [t0, t1] of [0, 1] where |start + t·change| ≤ limit; if it is empty, t0 = t1."""
    divisor = np.where(change == 0, 1.0, change)  # with 0 the caller multiplies by 0 later
    with np.errstate(over="ignore"):
        one = np.clip((-limit - start) / divisor, 0, 1)
        two = np.clip((limit - start) / divisor, 0, 1)
    return np.minimum(one, two), np.maximum(one, two)


def _mean_of_clamped(start: FloatArray, change: FloatArray, limit: FloatArray) -> FloatArray:
    """The mean over t in [0, 1] of start + t·change, clamped to ±limit."""
    enters, leaves = _stretch_within(start, change, limit)
    at = [np.clip(start + t * change, -limit, limit) for t in (0.0, enters, leaves, 1.0)]
    steps = (enters, leaves - enters, 1 - leaves)
    total: FloatArray = sum(
        (step * (a + b) / 2 for step, a, b in zip(steps, at, at[1:], strict=False)), start=np.zeros_like(start)
    )
    return total


def _outside(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The gap along the second's axes (negative if they overlap), and the distance of the first's nearest corner."""
    x, y = _corners_in(first, second)
    half = second[..., 2:4, None] / 2
    half_x, half_y = half[..., 0, :], half[..., 1, :]
    beside = [
        np.maximum(values.min(axis=-1) - limit[..., 0], -limit[..., 0] - values.max(axis=-1))
        for values, limit in ((x, half_x), (y, half_y))
    ]
    squares = np.maximum(np.abs(x) - half_x, 0) ** 2 + np.maximum(np.abs(y) - half_y, 0) ** 2
    return np.maximum(*beside), np.sqrt(squares.min(axis=-1))


def _corners_in(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The first's four corners in the second's own axes, origin at its centre: x and y (…, 4)."""
    dx, dy = first[..., 0] - second[..., 0], first[..., 1] - second[..., 1]
    cosine, sine = np.cos(second[..., 4]), np.sin(second[..., 4])
    turn = first[..., 4] - second[..., 4]
    along, aside = first[..., 2, None] * _SIGNS[:, 0], first[..., 3, None] * _SIGNS[:, 1]
    turn_cosine, turn_sine = np.cos(turn)[..., None], np.sin(turn)[..., None]
    x = (cosine * dx + sine * dy)[..., None] + turn_cosine * along - turn_sine * aside
    y = (cosine * dy - sine * dx)[..., None] + turn_sine * along + turn_cosine * aside
    return x, y
