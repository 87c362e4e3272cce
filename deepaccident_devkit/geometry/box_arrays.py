"""Oriented boxes as plain arrays: checked columns, footprints, contacts, and points in boxes.

A footprint is a row (x, y, length, width, yaw): metres and radians in any right-handed frame
with z up. Only differences of positions are used, so that world coordinates lose no digits.
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
_FINITE_COLUMNS = ("center", "size", "rotation")
# Largest difference of the norm of a quaternion from 1; it is then scaled to 1.
_UNIT_TOLERANCE = 1e-3
# Corners as shares of (length, width), counter-clockwise from front left.
_CORNER_SHARES = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) / 2
PAIRS_AT_ONCE = 1 << 14
"""Pairs that are computed together; it limits the memory for the areas and gaps of many pairs."""
# Cells of the coarse grid along x and along y, over the ground that the boxes cover.
_CELLS = 128
POINTS_AT_ONCE = 1 << 13
"""Points that are processed together: the arrays are so small that their memory is reused, which
halves the time."""
# Pairs of windows and points that are processed together: their memory fits into the processor's
# cache.
_WINDOWS_AT_ONCE = 1 << 17


def check_numbers(columns: dict[str, AnyArray]) -> None:
    """Check that centres, sizes and rotations are finite, and sizes not negative.

    Raises GeometryError.
    """
    for name in _FINITE_COLUMNS:
        is_bad = ~np.isfinite(columns[name]).all(axis=1)
        if is_bad.any():
            row = np.argmax(is_bad)
            raise GeometryError(
                f"Boxes.{name}: expected finite numbers, found {columns[name][row].tolist()} in "
                f"row {row}; leave such boxes out"
            )
    is_negative = (columns["size"] < 0).any(axis=1)
    if is_negative.any():
        row = np.argmax(is_negative)
        raise GeometryError(
            "Boxes.size: expected lengths, widths and heights from 0, found "
            f"{columns['size'][row].tolist()} in row {row}"
        )


def unit_quaternions(rotation: FloatArray) -> FloatArray:
    """Return quaternions (N, 4) scaled to norm 1.

    Raises GeometryError if a norm differs from 1 by more than 0.001.
    """
    norm = np.linalg.norm(rotation, axis=1)
    difference = np.abs(norm - 1)
    if (difference > _UNIT_TOLERANCE).any():
        row = int(np.argmax(difference))
        raise GeometryError(
            "Boxes.rotation: expected unit quaternions w, x, y, z, found "
            f"{rotation[row].tolist()} in row {row}"
        )
    return rotation / norm[:, None] if (difference > 1e-12).any() else rotation


def category_codes(category: ArrayLike) -> AnyArray:
    """Return the codes of categories, from codes or names; raises GeometryError."""
    values = np.asarray(category)
    if values.dtype.kind not in "US":
        if not np.isin(values, range(len(CATEGORIES))).all():
            raise GeometryError(
                f"category codes are 0 to {len(CATEGORIES) - 1} ({', '.join(CATEGORIES)}), found "
                f"{values}"
            )
        return values.astype(np.int8)
    names = [str(name) for name in values.ravel()]
    unknown = sorted(set(names) - set(CATEGORIES))
    if unknown:
        raise GeometryError(f"unknown category {unknown}; known are {', '.join(CATEGORIES)}")
    codes = [CATEGORIES.index(name) for name in names]
    return np.array(codes, dtype=np.int8).reshape(values.shape)


def intersection_areas(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the common areas of each of N footprints with each of M, shape (N, M), m².

    Args:
        first: (N, 5) footprints.
        second: (M, 5) footprints.
    """
    diagonals = np.hypot(first[:, 2], first[:, 3])[:, None] + np.hypot(second[:, 2], second[:, 3])
    dx = first[:, None, 0] - second[:, 0]
    dy = first[:, None, 1] - second[:, 1]
    rows, columns = np.nonzero(np.hypot(dx, dy) <= diagonals / 2 * (1 + 1e-9))
    result = np.zeros((len(first), len(second)))
    for start in range(0, len(rows), PAIRS_AT_ONCE):
        batch = slice(start, start + PAIRS_AT_ONCE)
        row = rows[batch]
        column = columns[batch]
        result[row, column] = _areas_of_pairs(first[row], second[column])
    return result


def gaps(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the shortest distance from each of N footprints to each of M, shape (N, M), metres.

    0 if they touch; NaN if one of the two has a NaN.

    Args:
        first: (N, 5) footprints.
        second: (M, 5) footprints.
    """
    result = np.zeros((len(first), len(second)))
    step = max(1, PAIRS_AT_ONCE // max(1, len(second)))
    for start in range(0, len(first), step):
        batch = slice(start, start + step)
        result[batch] = gaps_of_pairs(first[batch, None], second[None])
    return result


def gaps_of_pairs(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return `gaps` of footprints (…, 5), pair by pair, which may broadcast; shape (…), metres."""
    axis_gap, corner_distance = _outside(first, second)
    other_axis_gap, other_corner_distance = _outside(second, first)
    overlaps = np.maximum(axis_gap, other_axis_gap) <= 0
    return np.where(overlaps, 0.0, np.minimum(corner_distance, other_corner_distance))


def separations_of_pairs(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the shortest way from footprints (…, 5) to others, pair by pair, as a vector (…, 2).

    Its length is the gap in metres. NaN if the two overlap or touch, since then there is no
    direction. Where sides lie parallel, any of the shortest ways.
    """
    from_corners = -_reaching(first, second)
    to_corners = _reaching(second, first)
    from_length = np.hypot(*np.moveaxis(from_corners, -1, 0))
    to_length = np.hypot(*np.moveaxis(to_corners, -1, 0))
    is_shorter = from_length <= to_length
    vectors = np.where(is_shorter[..., None], from_corners, to_corners)
    axis_gap, _ = _outside(first, second)
    other_axis_gap, _ = _outside(second, first)
    is_apart = np.maximum(axis_gap, other_axis_gap) > 0
    result: FloatArray = np.where(is_apart[..., None], vectors, np.nan)
    return result


def corner_offsets(footprints: FloatArray) -> FloatArray:
    """Return the corners (…, 4, 2) of footprints (…, 5) relative to their centres.

    The order is counter-clockwise from front left.
    """
    along = footprints[..., 2, None] * _CORNER_SHARES[:, 0]
    aside = footprints[..., 3, None] * _CORNER_SHARES[:, 1]
    cosine = np.cos(footprints[..., 4])[..., None]
    sine = np.sin(footprints[..., 4])[..., None]
    x = cosine * along - sine * aside
    y = sine * along + cosine * aside
    return np.stack([x, y], axis=-1)


def _reaching(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the way (…, 2) to the first's nearest corner from the nearest point of the second."""
    x, y = _corners_in(first, second)
    half = second[..., 2:4, None] / 2
    half_x = half[..., 0, :]
    half_y = half[..., 1, :]
    x = x - np.clip(x, -half_x, half_x)
    y = y - np.clip(y, -half_y, half_y)
    nearest = (x**2 + y**2).argmin(axis=-1)[..., None]
    x = np.take_along_axis(x, nearest, axis=-1)[..., 0]
    y = np.take_along_axis(y, nearest, axis=-1)[..., 0]
    cosine = np.cos(second[..., 4])
    sine = np.sin(second[..., 4])
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def _areas_of_pairs(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the common area of `first[i]` and `second[i]`, (P,) m².

    In the second's own axes, in which it is |x| ≤ h, |y| ≤ k, the area is −∮ clamp(y, ±k) d
    clamp(x, ±h) around the first: every edge adds a sum of trapezoids. No corners of the overlap
    are computed, so identical and touching rectangles are no special cases: the result depends
    continuously on the input.
    """
    x, y = _corners_in(first, second)
    half = second[:, 2:4, None] / 2
    across = np.roll(x, -1, axis=1) - x
    up = np.roll(y, -1, axis=1) - y
    start, end = _stretch_within(x, across, half[:, 0])
    start_height = y + start * up
    end_height = y + end * up
    mean = _mean_of_clamped(start_height, end_height - start_height, half[:, 1])
    area = -np.sum(across * (end - start) * mean, axis=1)
    smaller_area = np.minimum(first[:, 2] * first[:, 3], second[:, 2] * second[:, 3])
    result: FloatArray = np.clip(area, 0, smaller_area)
    return result


def _stretch_within(
    start: FloatArray, change: FloatArray, limit: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the part [t0, t1] of [0, 1] where |start + t·change| ≤ limit.

    If it is empty, t0 = t1.
    """
    divisor = np.where(change == 0, 1.0, change)  # with 0 the caller multiplies by 0 later
    with np.errstate(over="ignore"):
        at_lower_limit = np.clip((-limit - start) / divisor, 0, 1)
        at_upper_limit = np.clip((limit - start) / divisor, 0, 1)
    return np.minimum(at_lower_limit, at_upper_limit), np.maximum(at_lower_limit, at_upper_limit)


def _mean_of_clamped(start: FloatArray, change: FloatArray, limit: FloatArray) -> FloatArray:
    """Return the mean over t in [0, 1] of start + t·change, clamped to ±limit."""
    enters, leaves = _stretch_within(start, change, limit)
    times = (0.0, enters, leaves, 1.0)
    values = [np.clip(start + t * change, -limit, limit) for t in times]
    total: FloatArray = np.zeros_like(start)
    total = total + enters * (values[0] + values[1]) / 2
    total = total + (leaves - enters) * (values[1] + values[2]) / 2
    result: FloatArray = total + (1 - leaves) * (values[2] + values[3]) / 2
    return result


def _outside(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the gap along the second's axes, and the distance of the first's nearest corner.

    The gap is negative if they overlap along both axes.
    """
    x, y = _corners_in(first, second)
    half = second[..., 2:4, None] / 2
    half_x = half[..., 0, :]
    half_y = half[..., 1, :]
    gap_x = _axis_gap(x, half_x[..., 0])
    gap_y = _axis_gap(y, half_y[..., 0])
    squares = np.maximum(np.abs(x) - half_x, 0) ** 2 + np.maximum(np.abs(y) - half_y, 0) ** 2
    return np.maximum(gap_x, gap_y), np.sqrt(squares.min(axis=-1))


def _axis_gap(values: FloatArray, limit: FloatArray) -> FloatArray:
    """Return the gap between the range of corners (…, 4) and ±limit along an axis, shape (…)."""
    beyond_upper = values.min(axis=-1) - limit
    beyond_lower = -limit - values.max(axis=-1)
    result: FloatArray = np.maximum(beyond_upper, beyond_lower)
    return result


def _corners_in(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the first's four corners in the second's own axes, origin at its centre.

    Returns:
        x and y, shape (…, 4) each.
    """
    dx = first[..., 0] - second[..., 0]
    dy = first[..., 1] - second[..., 1]
    cosine = np.cos(second[..., 4])
    sine = np.sin(second[..., 4])
    turn = first[..., 4] - second[..., 4]
    turn_cosine = np.cos(turn)[..., None]
    turn_sine = np.sin(turn)[..., None]
    along = first[..., 2, None] * _CORNER_SHARES[:, 0]
    aside = first[..., 3, None] * _CORNER_SHARES[:, 1]
    center_x = (cosine * dx + sine * dy)[..., None]
    center_y = (cosine * dy - sine * dx)[..., None]
    x = center_x + turn_cosine * along - turn_sine * aside
    y = center_y + turn_sine * along + turn_cosine * aside
    return x, y


def time_to_collision(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Return the seconds until pairs of boxes touch, seen from above, at constant velocities.

    The boxes do not turn. Two boxes touch while they overlap along each of the four directions of
    their sides. For each direction that is an interval of time. So the boxes touch from the latest
    begin to the earliest end of the four.

    Args:
        first: (…, 5) x, y, length, width, yaw; metres and radians, in one coordinate frame.
        second: (…, 5) the same for the second boxes.
        first_velocity: (…, 2) m/s over the ground, along the axes of that frame.
        second_velocity: (…, 2) the same for the second boxes.

    Returns:
        (…,) 0 for boxes that touch now, infinite for boxes that never touch; NaN where a velocity
        is.
    """
    normal, gap, reach = side_gaps(first, second)
    closing = along(normal, second_velocity - first_velocity)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        times = np.stack([(-reach - gap) / closing, (reach - gap) / closing])
    begin = times.min(axis=0)
    end = times.max(axis=0)
    is_still = closing == 0
    stays_apart = is_still & (np.abs(gap) > reach)
    begin = np.where(is_still, -np.inf, begin)
    end = np.where(is_still, np.inf, end)
    start = np.maximum(begin.max(axis=-1), 0.0)
    meets = (start <= end.min(axis=-1)) & ~stays_apart.any(axis=-1)
    seconds: FloatArray = np.where(meets | np.isnan(start), start, np.inf)
    return seconds


def side_gaps(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the position of pairs of boxes (…, 5) along the four directions of their sides.

    They touch while |gap| ≤ reach in all.

    Returns:
        (…, 4, 2) unit directions, the first's two and then the second's; (…, 4) gaps from centre to
        centre along them; and (…, 4) reaches, half of both boxes' extents. Metres.
    """
    yaws = np.concatenate([side_yaws(first), side_yaws(second)], axis=-1)
    normal = normals(yaws)
    offset = second[..., :2] - first[..., :2]
    reach = half_extents(first, normal) + half_extents(second, normal)
    return normal, along(normal, offset), reach


def signed_gaps(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the widest gaps (…) between boxes (…, 5) along the normal of a side, metres.

    A gap is negative by the length of the overlap.
    """
    _, gap, reach = side_gaps(first, second)
    widest: FloatArray = (np.abs(gap) - reach).max(axis=-1)
    return widest


def side_yaws(boxes: FloatArray) -> FloatArray:
    """Return the directions (…, 2) of the normals of front and left sides, radians.

    Args:
        boxes: (…, 5) footprints.
    """
    yaw: FloatArray = boxes[..., 4, None] + np.array([0.0, np.pi / 2])
    return yaw


def normals(yaw: FloatArray) -> FloatArray:
    """Return unit vectors (…, 2) in directions (…), radians."""
    cosine = np.cos(yaw)
    sine = np.sin(yaw)
    return np.stack([cosine, sine], axis=-1)


def along(directions: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return the components of vectors (…, 2) along their N directions (…, N, 2), shape (…, N)."""
    x = directions[..., 0] * vectors[..., 0, None]
    y = directions[..., 1] * vectors[..., 1, None]
    result: FloatArray = x + y
    return result


def half_extents(boxes: FloatArray, directions: FloatArray) -> FloatArray:
    """Return half of the extents of boxes (…, 5) along directions, shape (…, N), metres.

    Args:
        boxes: (…, 5) footprints.
        directions: (…, N, 2) unit directions of each box.
    """
    yaws = side_yaws(boxes)
    lengthwise = np.abs(along(directions, normals(yaws[..., 0])))
    across = np.abs(along(directions, normals(yaws[..., 1])))
    result: FloatArray = lengthwise * boxes[..., 2, None] / 2 + across * boxes[..., 3, None] / 2
    return result


def points_in_boxes(
    points: FloatArray, center: FloatArray, half: FloatArray, axes: FloatArray
) -> tuple[IntArray, IntArray]:
    """Return every pair of a box and a point in it, faces included.

    A point p is in a box if |(p − centre) · a| ≤ half for each axis a, with the products summed as
    (x + y) + z: grid and windows only leave out points that cannot be. NaN lies in no box.

    Args:
        points: (P, 3) metres.
        center: (N, 3) centres of the boxes, metres.
        half: (N, 3) half sizes, metres.
        axes: (N, 3, 3) axes of the boxes, in columns.

    Returns:
        Rows of boxes (K,) and rows of points (K,), sorted by box, then by point.
    """
    reach = (np.abs(axes) @ half[:, :, None])[:, :, 0] * 1.001 + 1e-6  # wider than any rounding
    low = center - reach
    high = center + reach
    candidates = _near_any(points, low, high)
    x, y, z = np.ascontiguousarray(points[candidates].T)
    boxes, rows = _in_windows(x, y, low, high)
    dx = x[rows] - center[boxes, 0]
    dy = y[rows] - center[boxes, 1]
    dz = z[rows] - center[boxes, 2]
    is_inside = np.ones(len(rows), dtype=bool)
    for axis in range(3):
        axis_x, axis_y, axis_z = axes[:, :, axis].T
        distance = dx * axis_x[boxes] + dy * axis_y[boxes] + dz * axis_z[boxes]
        is_inside &= np.abs(distance) <= half[boxes, axis]
    return boxes[is_inside], candidates[rows[is_inside]]


def _in_windows(
    x: FloatArray, y: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[IntArray, IntArray]:
    """Return every pair of a window (N,) and a point (P,) in it, seen from above."""
    step = max(1, _WINDOWS_AT_ONCE // max(1, len(x)))
    windows = [np.zeros(0, dtype=np.int64)]
    rows = [np.zeros(0, dtype=np.int64)]
    for start in range(0, len(low), step):
        batch = slice(start, start + step)
        lowest = low[batch, :2, None]
        highest = high[batch, :2, None]
        within = (x >= lowest[:, 0]) & (x <= highest[:, 0])
        within &= (y >= lowest[:, 1]) & (y <= highest[:, 1])
        window, row = np.divmod(np.flatnonzero(within), max(1, len(x)))
        windows.append(window + start)
        rows.append(row)
    return np.concatenate(windows), np.concatenate(rows)


def _near_any(points: FloatArray, low: FloatArray, high: FloatArray) -> IntArray:
    """Return the rows of points in coarse cells that the window of any box touches, ascending."""
    is_finite = np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1)
    if not is_finite.any():
        return np.zeros(0, dtype=np.int64)
    low = low[is_finite, :2]
    high = high[is_finite, :2]
    origin = low.min(axis=0)
    end = high.max(axis=0)
    # the width can be 0 after rounding of very large numbers
    scale = (_CELLS - 1) / np.maximum(end - origin, 1e-6)
    touched = np.zeros((_CELLS, _CELLS), dtype=bool)
    # points and windows go through the same rising function, so a point in a window is in a cell of
    # the window
    first = ((low - origin) * scale).astype(int)
    last = ((high - origin) * scale).astype(int)
    for (column, row), (last_column, last_row) in zip(first.tolist(), last.tolist(), strict=True):
        touched[column : last_column + 1, row : last_row + 1] = True
    candidates = [np.zeros(0, dtype=np.int64)]
    for start in range(0, len(points), POINTS_AT_ONCE):
        x, y = np.ascontiguousarray(points[start : start + POINTS_AT_ONCE, :2].T)
        within = (x >= origin[0]) & (x <= end[0])
        within &= (y >= origin[1]) & (y <= end[1])
        rows = np.flatnonzero(within)
        cell = ((x[rows] - origin[0]) * scale[0]).astype(np.int64) * _CELLS
        cell += ((y[rows] - origin[1]) * scale[1]).astype(np.int64)
        candidates.append(rows[touched.ravel()[cell]] + start)
    return np.concatenate(candidates)
