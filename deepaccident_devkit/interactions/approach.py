"""The time to collision of pairs with steady accelerations until they stop: nothing is sampled, it is exact."""

from __future__ import annotations

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.geometry.conflicts import along, normals, side_gaps

_TOLERANCE = 1e-9
"""Metres by which two boxes may be apart where they touch by calculation."""
_PAIRS_AT_ONCE = 1 << 9
"""Pairs that are computed together: what they need then fits into the processor's cache."""


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
    first, second = (np.broadcast_to(boxes, (*shape, 5)).reshape(-1, 5) for boxes in (first, second))
    starts = range(0, len(first), _PAIRS_AT_ONCE)
    parts = [slice(start, start + _PAIRS_AT_ONCE) for start in starts]
    times = [_accelerated(first[part], second[part], motion[part]) for part in parts]
    return np.concatenate([np.zeros(0), *times]).reshape(shape)


def _accelerated(first: FloatArray, second: FloatArray, motion: FloatArray) -> FloatArray:
    """`modified_ttc` of (P, 5) boxes and (P, 4) motions: both speeds, both accelerations."""
    normal, gap, reach = side_gaps(first, second)
    speeds, rates = motion[:, :2], motion[:, 2:]
    stops = _stops(speeds, rates)
    shares = [  # of the way of each, along a side
        sign * along(normal, normals(box[:, 4]))[:, :, None] for sign, box in ((-1.0, first), (1.0, second))
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
        times = begin + _roots(np.tile(square, 2), np.tile(linear, 2), offsets)
        candidates.append(np.where(times >= 0, times, np.inf))
    return np.where(np.isnan(motion).any(axis=1), np.nan, _first_touch(candidates, (gap, reach), shares, motion))


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
    ways = [_travelled(times, *(each[:, which, None] for each in (speeds, rates, stops))) for which in (0, 1)]
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


def _travelled(times: FloatArray, speeds: FloatArray, rates: FloatArray, stops: FloatArray) -> FloatArray:
    """Way along the heading at times, which stays where it stops; of infinite times those of 0."""
    until = np.minimum(np.where(np.isfinite(times), times, 0.0), stops)
    return np.asarray(speeds * until + rates * until**2 / 2)


def _roots(square: FloatArray, linear: FloatArray, constant: FloatArray) -> FloatArray:
    """Both roots (P, 2 N) of parabolas (P, N), infinite where there are none."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inner = linear**2 - 4 * square * constant
        half = -(linear + np.copysign(np.sqrt(inner), linear)) / 2
        roots = np.concatenate([constant / half, half / square], axis=1)
    return np.where(np.isfinite(roots), roots, np.inf)
