"""Oriented boxes as plain arrays: checked columns, footprints on the ground, when they touch, and the points in boxes.

A footprint is a row (x, y, length, width, yaw): metres and radians in any right-handed frame whose z points up.
Only differences of positions are used, so that world coordinates lose no digits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, IntArray
from deepaccident_devkit.taxonomy import CATEGORIES

BOX_COLUMNS: dict[str, tuple[tuple[int | None, ...], type]] = {
    "center": ((None, 3), np.float64),
    "size": ((None, 3), np.float64),
    "rotation": ((None, 4), np.float64),
    "velocity": ((None, 3), np.float64),
    "category": ((None,), np.int8),
    "actor_id": ((None,), np.int64),
    "num_lidar_pts": ((None,), np.int64),
    "camera_visible": ((None,), np.bool_),
    "row": ((None,), np.int64),
}
_FINITE = ("center", "size", "rotation")
# How far the norm of a quaternion may be from 1; it is then scaled to 1.
_UNIT_TOLERANCE = 1e-3
# Corners as shares of (length, width), counter-clockwise from front left.
_SIGNS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) / 2
PAIRS_AT_ONCE = 1 << 14
"""Pairs that are computed together; it limits the memory for the areas and gaps of many pairs."""
# Cells of the coarse grid along x and along y, over the ground that the boxes cover.
_CELLS = 128
POINTS_AT_ONCE = 1 << 13
"""Points that are processed together: the arrays are so small that their memory is reused, which halves the time."""
# Pairs of windows and points that are processed together: their memory fits into the processor's cache.
_WINDOWS_AT_ONCE = 1 << 17


def check_numbers(columns: dict[str, AnyArray]) -> None:
    """Check that centres, sizes and rotations are finite, and sizes not negative; raises GeometryError."""
    for name in _FINITE:
        bad = ~np.isfinite(columns[name]).all(axis=1)
        if bad.any():
            raise GeometryError(
                f"Boxes.{name}: expected finite numbers, found {columns[name][bad][0].tolist()} in row "
                f"{np.argmax(bad)}; leave such boxes out"
            )
    negative = (columns["size"] < 0).any(axis=1)
    if negative.any():
        raise GeometryError(
            f"Boxes.size: expected lengths, widths and heights from 0, found {columns['size'][negative][0].tolist()} "
            f"in row {np.argmax(negative)}"
        )


def unit_quaternions(rotation: FloatArray) -> FloatArray:
    """The quaternions (N, 4) scaled to norm 1; before, they must have it up to 0.001, else GeometryError."""
    norm = np.linalg.norm(rotation, axis=1)
    off = np.abs(norm - 1)
    if (off > _UNIT_TOLERANCE).any():
        row = int(np.argmax(off))
        raise GeometryError(
            f"Boxes.rotation: expected unit quaternions w, x, y, z, found {rotation[row].tolist()} in row {row}"
        )
    return rotation / norm[:, None] if (off > 1e-12).any() else rotation


def category_codes(category: ArrayLike) -> AnyArray:
    """The codes of categories that are given as codes or names; raises GeometryError."""
    given = np.asarray(category)
    if given.dtype.kind not in "US":
        if not np.isin(given, range(len(CATEGORIES))).all():
            raise GeometryError(
                f"category codes are 0 to {len(CATEGORIES) - 1} ({', '.join(CATEGORIES)}), found {given}"
            )
        return given.astype(np.int8)
    names = [str(name) for name in given.ravel()]
    unknown = sorted(set(names) - set(CATEGORIES))
    if unknown:
        raise GeometryError(f"unknown category {unknown}; known are {', '.join(CATEGORIES)}")
    return np.array([CATEGORIES.index(name) for name in names], dtype=np.int8).reshape(given.shape)


def intersection_areas(first: FloatArray, second: FloatArray) -> FloatArray:
    """Common areas of each of N footprints with each of M: (N, 5) and (M, 5) → (N, M), m²."""
    reach = np.hypot(first[:, 2], first[:, 3])[:, None] + np.hypot(second[:, 2], second[:, 3])
    apart = np.hypot(first[:, None, 0] - second[:, 0], first[:, None, 1] - second[:, 1])
    rows, columns = np.nonzero(apart <= reach / 2 * (1 + 1e-9))
    result = np.zeros((len(first), len(second)))
    for start in range(0, len(rows), PAIRS_AT_ONCE):
        a, b = rows[start : start + PAIRS_AT_ONCE], columns[start : start + PAIRS_AT_ONCE]
        result[a, b] = _areas_of_pairs(first[a], second[b])
    return result


def gaps(first: FloatArray, second: FloatArray) -> FloatArray:
    """The shortest distance from each of N footprints to each of M: (N, 5) and (M, 5) → (N, M), metres.

    0 if they touch; NaN if one of the two has a NaN.
    """
    result = np.zeros((len(first), len(second)))
    step = max(1, PAIRS_AT_ONCE // max(1, len(second)))
    for start in range(0, len(first), step):
        result[start : start + step] = gaps_of_pairs(
            first[start : start + step, None], second[None]
        )
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
    x, y = (
        values - np.clip(values, -half[..., axis, :], half[..., axis, :])
        for axis, values in enumerate((x, y))
    )
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


def _stretch_within(
    start: FloatArray, change: FloatArray, limit: FloatArray
) -> tuple[FloatArray, FloatArray]:
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
        (step * (a + b) / 2 for step, a, b in zip(steps, at, at[1:], strict=False)),
        start=np.zeros_like(start),
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


def time_to_collision(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Seconds until pairs of boxes touch, seen from above, if each keeps its velocity and does not turn.

    Two boxes touch while they overlap along each of the four directions of their sides. For each direction that is an
    interval of time. So the boxes touch from the latest begin to the earliest end of the four.

    Args:
        first: (…, 5) x, y, length, width, yaw; metres and radians, in one coordinate frame.
        second: (…, 5) the same of the second boxes.
        first_velocity: (…, 2) metres a second, over the ground, along the axes of that frame.
        second_velocity: (…, 2) the same of the second boxes.

    Returns:
        (…,) 0 for boxes that touch now, infinite for boxes that never touch; NaN where a velocity is.
    """
    normal, gap, reach = side_gaps(first, second)
    closing = along(normal, second_velocity - first_velocity)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ends = np.stack([(-reach - gap) / closing, (reach - gap) / closing])
    begin, end = ends.min(axis=0), ends.max(axis=0)
    still = closing == 0
    parted = still & (np.abs(gap) > reach)
    begin, end = np.where(still, -np.inf, begin), np.where(still, np.inf, end)
    start = np.maximum(begin.max(axis=-1), 0.0)
    meets = (start <= end.min(axis=-1)) & ~parted.any(axis=-1)
    times: FloatArray = np.where(meets | np.isnan(start), start, np.inf)
    return times


def side_gaps(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How pairs of boxes (…, 5) lie along the four directions of their sides; they touch while |gap| ≤ reach in all.

    (…, 4, 2) unit directions, the first's two and then the second's; (…, 4) gaps from centre to centre along them; and
    (…, 4) reaches, half of both boxes' extents. Metres.
    """
    normal = normals(np.concatenate([side_yaws(first), side_yaws(second)], axis=-1))
    gap = along(normal, second[..., :2] - first[..., :2])
    return normal, gap, half_extents(first, normal) + half_extents(second, normal)


def signed_gaps(first: FloatArray, second: FloatArray) -> FloatArray:
    """The widest gaps (…) between boxes (…, 5) along the normal of a side, metres; negative by how far they overlap."""
    _, gap, reach = side_gaps(first, second)
    widest: FloatArray = (np.abs(gap) - reach).max(axis=-1)
    return widest


def side_yaws(boxes: FloatArray) -> FloatArray:
    """The directions (…, 2) of the normals of boxes' (…, 5) front and left sides, radians."""
    yaw: FloatArray = boxes[..., 4, None] + np.array([0.0, np.pi / 2])
    return yaw


def normals(yaw: FloatArray) -> FloatArray:
    """Unit vectors (…, 2) in directions (…), radians."""
    return np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)


def along(directions: FloatArray, vectors: FloatArray) -> FloatArray:
    """How far vectors (…, 2) go along each of their N directions (…, N, 2): (…, N)."""
    result: FloatArray = (
        directions[..., 0] * vectors[..., 0, None] + directions[..., 1] * vectors[..., 1, None]
    )
    return result


def half_extents(boxes: FloatArray, directions: FloatArray) -> FloatArray:
    """Half of the extents of boxes (…, 5) along each of their N unit directions (…, N, 2): (…, N) metres."""
    lengthwise, across = (
        np.abs(along(directions, normals(yaw))) for yaw in np.moveaxis(side_yaws(boxes), -1, 0)
    )
    result: FloatArray = lengthwise * boxes[..., 2, None] / 2 + across * boxes[..., 3, None] / 2
    return result


def points_in_boxes(
    points: FloatArray, center: FloatArray, half: FloatArray, axes: FloatArray
) -> tuple[IntArray, IntArray]:
    """Rows of boxes (K,) and rows of points (K,): every pair of a box and a point in it, faces included.

    The boxes have centres and half sizes (N, 3), metres, and axes (N, 3, 3) in columns. A point p is in a box if |(p −
    centre) · a| ≤ half for each axis a, with the products summed as (x + y) + z: grid and windows only leave out points
    that cannot be. NaN lies in no box. Pairs are sorted by box, then by point.
    """
    reach = (np.abs(axes) @ half[:, :, None])[:, :, 0] * 1.001 + 1e-6  # wider than any rounding
    low, high = center - reach, center + reach
    near = _near_any(points, low, high)
    x, y, z = np.ascontiguousarray(points[near].T)
    boxes, rows = _in_windows(x, y, low, high)
    dx, dy, dz = x[rows] - center[boxes, 0], y[rows] - center[boxes, 1], z[rows] - center[boxes, 2]
    inside = np.ones(len(rows), dtype=bool)
    for axis in range(3):
        along_x, along_y, along_z = axes[:, :, axis].T
        along = dx * along_x[boxes] + dy * along_y[boxes] + dz * along_z[boxes]
        inside &= np.abs(along) <= half[boxes, axis]
    return boxes[inside], near[rows[inside]]


def _in_windows(
    x: FloatArray, y: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[IntArray, IntArray]:
    """Every pair of a window (N,) and a point (P,) in it, seen from above."""
    step = max(1, _WINDOWS_AT_ONCE // max(1, len(x)))
    windows, rows = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for start in range(0, len(low), step):
        first, last = low[start : start + step, :2, None], high[start : start + step, :2, None]
        within = (x >= first[:, 0]) & (x <= last[:, 0])
        within &= (y >= first[:, 1]) & (y <= last[:, 1])
        window, row = np.divmod(np.flatnonzero(within), max(1, len(x)))
        windows.append(window + start)
        rows.append(row)
    return np.concatenate(windows), np.concatenate(rows)


def _near_any(points: FloatArray, low: FloatArray, high: FloatArray) -> IntArray:
    """Rows, ascending, of the points in coarse cells that the window (`low` to `high`) of any box touches."""
    windows = np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1)
    if not windows.any():
        return np.zeros(0, dtype=np.int64)
    low, high = low[windows, :2], high[windows, :2]
    origin, end = low.min(axis=0), high.max(axis=0)
    scale = (_CELLS - 1) / np.maximum(
        end - origin, 1e-6
    )  # the width can be 0 after rounding of very large numbers
    touched = np.zeros((_CELLS, _CELLS), dtype=bool)
    # points and windows go through the same rising function, so a point in a window is in a cell of the window
    first, last = ((low - origin) * scale).astype(int), ((high - origin) * scale).astype(int)
    for (column, row), (last_column, last_row) in zip(first.tolist(), last.tolist(), strict=True):
        touched[column : last_column + 1, row : last_row + 1] = True
    found = [np.zeros(0, dtype=np.int64)]
    for start in range(0, len(points), POINTS_AT_ONCE):
        x, y = np.ascontiguousarray(points[start : start + POINTS_AT_ONCE, :2].T)
        within = (x >= origin[0]) & (x <= end[0])
        within &= (y >= origin[1]) & (y <= end[1])
        rows = np.flatnonzero(within)
        cell = ((x[rows] - origin[0]) * scale[0]).astype(np.int64) * _CELLS
        cell += ((y[rows] - origin[1]) * scale[1]).astype(np.int64)
        found.append(rows[touched.ravel()[cell]] + start)
    return np.concatenate(found)
