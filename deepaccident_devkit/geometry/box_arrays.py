"""Oriented boxes as plain arrays: checks, footprints, gaps, collisions, and points in boxes.

A footprint is a row (x, y, length, width, yaw), in metres and radians, in any right-handed frame
with z up. All footprints of a call are in the same frame. Only differences of positions are used,
so large world coordinates cost no precision.
"""

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.support.arrays import NO_INDICES, AnyArray, FloatArray, IntArray
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
# Largest accepted difference of a quaternion's norm from 1; the quaternion is then normalised.
_UNIT_TOLERANCE = 1e-3
# Corners relative to the centre, as fractions of (length, width), counter-clockwise from front
# left.
_CORNER_SHARES = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) / 2
PAIRS_AT_ONCE = 1 << 14
"""Number of pairs that are processed at a time, to limit the memory of areas and gaps."""
# Number of cells, along x and along y, of the coarse grid over the area that the boxes cover.
_CELLS = 128
POINTS_AT_ONCE = 1 << 13
"""Number of points that are processed at a time: small arrays reuse memory (twice as fast)."""
# Number of pairs of windows and points that are processed at a time: they fit into the processor's
# cache.
_WINDOWS_AT_ONCE = 1 << 17


def check_numbers(columns: dict[str, AnyArray]) -> None:
    """Check that centres, sizes and rotations are finite, and that sizes are not negative.

    Raises:
        GeometryError: If a number is not finite, or a size is negative.
    """
    for name in _FINITE_COLUMNS:
        values = columns[name]
        is_infinite = ~np.isfinite(values).all(axis=1)
        if is_infinite.any():
            row = np.argmax(is_infinite)
            raise GeometryError(
                f"Boxes.{name}: expected finite numbers, found {values[row].tolist()} in row "
                f"{row}; leave out such boxes"
            )
    sizes = columns["size"]
    is_negative = (sizes < 0).any(axis=1)
    if is_negative.any():
        row = np.argmax(is_negative)
        raise GeometryError(
            "Boxes.size: expected lengths, widths and heights from 0, found "
            f"{sizes[row].tolist()} in row {row}"
        )


def unit_quaternions(rotation: FloatArray) -> FloatArray:
    """Return quaternions (N, 4) scaled to norm 1.

    Raises:
        GeometryError: If a norm differs from 1 by more than 0.001.
    """
    norm = np.linalg.norm(rotation, axis=1)
    difference = np.abs(norm - 1)
    if (difference > _UNIT_TOLERANCE).any():
        row = int(np.argmax(difference))
        raise GeometryError(
            "Boxes.rotation: expected unit quaternions w, x, y, z, found "
            f"{rotation[row].tolist()} in row {row}"
        )
    if (difference > 1e-12).any():
        rotation = rotation / norm[:, None]
    return rotation


def category_codes(category: ArrayLike) -> AnyArray:
    """Return category codes from codes or names; raise GeometryError if one is unknown."""
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
        raise GeometryError(f"unknown category {unknown}; expected {', '.join(CATEGORIES)}")
    codes = [CATEGORIES.index(name) for name in names]
    return np.array(codes, dtype=np.int8).reshape(values.shape)


def intersection_areas(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the intersection areas of N footprints with M others, shape (N, M), m².

    Args:
        first: (N, 5) footprints.
        second: (M, 5) footprints.
    """
    x, y, length, width, _ = first.T
    other_x, other_y, other_length, other_width, _ = second.T
    diagonals = np.hypot(length, width)[:, None] + np.hypot(other_length, other_width)
    dx = x[:, None] - other_x
    dy = y[:, None] - other_y
    is_near = np.hypot(dx, dy) <= diagonals / 2 * (1 + 1e-9)
    rows, columns = np.nonzero(is_near)
    areas = np.zeros(is_near.shape)
    for start in range(0, len(rows), PAIRS_AT_ONCE):
        batch = slice(start, start + PAIRS_AT_ONCE)
        row = rows[batch]
        column = columns[batch]
        areas[row, column] = _areas_of_pairs(first[row], second[column])
    return areas


def gaps(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the shortest distances from N footprints to M others, shape (N, M), metres.

    A distance is 0 if the two touch or overlap, and NaN if either contains a NaN.

    Args:
        first: (N, 5) footprints.
        second: (M, 5) footprints.
    """
    distances = np.zeros((len(first), len(second)))
    step = max(1, PAIRS_AT_ONCE // max(1, len(second)))
    for start in range(0, len(first), step):
        batch = slice(start, start + step)
        distances[batch] = gaps_of_pairs(first[batch, None], second[None])
    return distances


def gaps_of_pairs(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the shortest distance within each pair of footprints (…, 5), shape (…), metres.

    The two arrays are broadcast. A distance is 0 or NaN under the same conditions as in `gaps`.
    """
    axis_gap, corner_distance = _gaps_and_corner_distances(first, second)
    other_axis_gap, other_corner_distance = _gaps_and_corner_distances(second, first)
    overlaps = np.maximum(axis_gap, other_axis_gap) <= 0
    distance = np.minimum(corner_distance, other_corner_distance)
    return np.where(overlaps, 0.0, distance)


def separations_of_pairs(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the shortest vector (…, 2), in metres, from the first to the second of each pair.

    The vector's length is the gap. The vector is NaN if the two touch or overlap, because it then
    has no direction. If several vectors are equally short (parallel sides), one of them is
    returned.

    Args:
        first: (…, 5) footprints.
        second: (…, 5) footprints.
    """
    from_corners = -_vectors_to_corners(first, second)
    to_corners = _vectors_to_corners(second, first)
    from_length = np.hypot(*np.moveaxis(from_corners, -1, 0))
    to_length = np.hypot(*np.moveaxis(to_corners, -1, 0))
    is_shorter = from_length <= to_length
    vectors = np.where(is_shorter[..., None], from_corners, to_corners)
    axis_gap, _ = _gaps_and_corner_distances(first, second)
    other_axis_gap, _ = _gaps_and_corner_distances(second, first)
    is_apart = np.maximum(axis_gap, other_axis_gap) > 0
    return np.where(is_apart[..., None], vectors, np.nan)


def corner_offsets(footprints: FloatArray) -> FloatArray:
    """Return the corners (…, 4, 2) of footprints (…, 5) relative to their centres.

    The order is counter-clockwise from front left.
    """
    yaw = footprints[..., 4]
    cosine = np.cos(yaw)[..., None]
    sine = np.sin(yaw)[..., None]
    forward, left = _corner_shifts(footprints)
    x = cosine * forward - sine * left
    y = sine * forward + cosine * left
    return np.stack([x, y], axis=-1)


def _corner_shifts(footprints: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far ahead and left of its centre each corner of footprints (…, 5) is, (…, 4)."""
    length = footprints[..., 2, None]
    width = footprints[..., 3, None]
    return length * _CORNER_SHARES[:, 0], width * _CORNER_SHARES[:, 1]


def _vectors_to_corners(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the vector from the second's nearest point to the first's nearest corner.

    Returns:
        Vectors, shape (…, 2), metres.
    """
    corner_x, corner_y = _corners_in(first, second)
    half_length, half_width = _half_sizes(second)
    corner_dx = corner_x - np.clip(corner_x, -half_length, half_length)
    corner_dy = corner_y - np.clip(corner_y, -half_width, half_width)
    nearest_corners = (corner_dx**2 + corner_dy**2).argmin(axis=-1)[..., None]
    dx = np.take_along_axis(corner_dx, nearest_corners, axis=-1)[..., 0]
    dy = np.take_along_axis(corner_dy, nearest_corners, axis=-1)[..., 0]
    yaw = second[..., 4]
    cosine = np.cos(yaw)
    sine = np.sin(yaw)
    return np.stack([cosine * dx - sine * dy, sine * dx + cosine * dy], axis=-1)


def _half_sizes(footprints: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return half the length and half the width of footprints (…, 5), shape (…, 1) each."""
    length = footprints[..., 2, None]
    width = footprints[..., 3, None]
    return length / 2, width / 2


def _areas_of_pairs(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the intersection area of `first[i]` and `second[i]`, shape (P,), m².

    In the second's axes, where it is |x| ≤ h, |y| ≤ k, the area is −∮ clamp(y, ±k) d clamp(x, ±h)
    around the first: every edge adds a sum of trapezoids. The corners of the overlap are not
    computed, so identical and touching rectangles need no special cases, and the result depends
    continuously on the input.
    """
    x, y = _corners_in(first, second)
    half_length, half_width = _half_sizes(second)
    edge_x = np.roll(x, -1, axis=1) - x
    edge_y = np.roll(y, -1, axis=1) - y
    start, end = _interval_within(x, edge_x, half_length)
    start_y = y + start * edge_y
    end_y = y + end * edge_y
    mean_y = _mean_of_clamped(start_y, end_y - start_y, half_width)
    area = -np.sum(edge_x * (end - start) * mean_y, axis=1)
    smaller_area = np.minimum(first[:, 2] * first[:, 3], second[:, 2] * second[:, 3])
    clipped_area: FloatArray = np.clip(area, 0, smaller_area)
    return clipped_area


def _interval_within(
    start: FloatArray, change: FloatArray, limit: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the interval [t0, t1] in [0, 1] where |start + t·change| ≤ limit.

    If the interval is empty, t0 = t1.
    """
    divisor = np.where(change == 0, 1.0, change)  # the caller multiplies these by 0 later
    with np.errstate(over="ignore"):
        at_lower_limit = np.clip((-limit - start) / divisor, 0, 1)
        at_upper_limit = np.clip((limit - start) / divisor, 0, 1)
    return np.minimum(at_lower_limit, at_upper_limit), np.maximum(at_lower_limit, at_upper_limit)


def _mean_of_clamped(start: FloatArray, change: FloatArray, limit: FloatArray) -> FloatArray:
    """Return the mean over t in [0, 1] of start + t·change, clamped to ±limit."""
    enter, leave = _interval_within(start, change, limit)
    times = (0.0, enter, leave, 1.0)
    values = [np.clip(start + time * change, -limit, limit) for time in times]
    mean: FloatArray = np.zeros_like(start)
    mean = mean + enter * (values[0] + values[1]) / 2
    mean = mean + (leave - enter) * (values[1] + values[2]) / 2
    mean = mean + (1 - leave) * (values[2] + values[3]) / 2
    return mean


def _gaps_and_corner_distances(
    first: FloatArray, second: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the gap along the second's axes, and the distance to the first's nearest corner.

    The gap is negative if the two overlap along both axes.
    """
    x, y = _corners_in(first, second)
    half_length, half_width = _half_sizes(second)
    gap_x = _axis_gap(x, half_length[..., 0])
    gap_y = _axis_gap(y, half_width[..., 0])
    outside_x = np.maximum(np.abs(x) - half_length, 0)
    outside_y = np.maximum(np.abs(y) - half_width, 0)
    squares = outside_x**2 + outside_y**2
    return np.maximum(gap_x, gap_y), np.sqrt(squares.min(axis=-1))


def _axis_gap(values: FloatArray, limit: FloatArray) -> FloatArray:
    """Return the gap along an axis between the corners' range (…, 4) and ±limit, shape (…)."""
    gap_above = values.min(axis=-1) - limit
    gap_below = -limit - values.max(axis=-1)
    gap: FloatArray = np.maximum(gap_above, gap_below)
    return gap


def _corners_in(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the first's four corners in the second's axes, relative to the second's centre.

    Returns:
        x and y, shape (…, 4) each.
    """
    dx = first[..., 0] - second[..., 0]
    dy = first[..., 1] - second[..., 1]
    yaw = second[..., 4]
    cosine = np.cos(yaw)
    sine = np.sin(yaw)
    turn = first[..., 4] - yaw
    turn_cosine = np.cos(turn)[..., None]
    turn_sine = np.sin(turn)[..., None]
    forward, left = _corner_shifts(first)
    center_x = (cosine * dx + sine * dy)[..., None]
    center_y = (cosine * dy - sine * dx)[..., None]
    x = center_x + turn_cosine * forward - turn_sine * left
    y = center_y + turn_sine * forward + turn_cosine * left
    return x, y


def time_to_collision(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Return the time until each pair of boxes touches, seen from above, at constant velocities.

    The boxes do not rotate. Two boxes touch while they overlap along all four directions of their
    sides. Along each direction they overlap during one interval of time, so they touch from the
    latest start to the earliest end of the four intervals.

    Args:
        first: (…, 5) x, y, length, width, yaw; metres and radians, in one coordinate frame.
        second: (…, 5) the same for the second boxes.
        first_velocity: (…, 2) velocities over the ground, m/s, along the axes of that frame.
        second_velocity: (…, 2) the same for the second boxes.

    Returns:
        (…,) seconds: 0 for boxes that touch now, infinity for boxes that never touch, NaN if a
            velocity is NaN.
    """
    normal, gap, reach = side_gaps(first, second)
    closing_speed = along(normal, second_velocity - first_velocity)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        times = np.stack([(-reach - gap) / closing_speed, (reach - gap) / closing_speed])
    is_still = closing_speed == 0
    begin = np.where(is_still, -np.inf, times.min(axis=0))
    end = np.where(is_still, np.inf, times.max(axis=0))
    stays_apart = is_still & (np.abs(gap) > reach)
    latest_begin = np.maximum(begin.max(axis=-1), 0.0)
    meets = (latest_begin <= end.min(axis=-1)) & ~stays_apart.any(axis=-1)
    return np.where(meets | np.isnan(latest_begin), latest_begin, np.inf)


def side_gaps(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the centre distances of pairs of boxes (…, 5) along the directions of their sides.

    Two boxes touch while |gap| ≤ reach along all four directions.

    Returns:
        (…, 4, 2) unit directions, the first box's two and then the second's; (…, 4) gaps from
            centre to centre along them, metres; and (…, 4) reaches, half the sum of both boxes'
            extents, metres.
    """
    yaws = np.concatenate([side_yaws(first), side_yaws(second)], axis=-1)
    normal = normals(yaws)
    offset = second[..., :2] - first[..., :2]
    reach = half_extents(first, normal) + half_extents(second, normal)
    return normal, along(normal, offset), reach


def signed_gaps(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the widest gap of each pair of boxes (…, 5) along their sides' normals, metres.

    If the two overlap, the result is the negated depth of the overlap.
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
    x_products = directions[..., 0] * vectors[..., 0, None]
    y_products = directions[..., 1] * vectors[..., 1, None]
    components: FloatArray = x_products + y_products
    return components


def half_extents(boxes: FloatArray, directions: FloatArray) -> FloatArray:
    """Return half the extents of boxes (…, 5) along directions, shape (…, N), metres.

    Args:
        boxes: (…, 5) footprints.
        directions: (…, N, 2) unit directions of each box.
    """
    front_yaw, left_yaw = np.moveaxis(side_yaws(boxes), -1, 0)
    length = boxes[..., 2, None]
    width = boxes[..., 3, None]
    lengthwise = np.abs(along(directions, normals(front_yaw)))
    widthwise = np.abs(along(directions, normals(left_yaw)))
    half_extent: FloatArray = lengthwise * length / 2 + widthwise * width / 2
    return half_extent


def points_in_boxes(
    points: FloatArray, center: FloatArray, half: FloatArray, axes: FloatArray
) -> tuple[IntArray, IntArray]:
    """Return every pair of a box and a point inside it or on its faces.

    A point p is in a box if |(p − centre) · a| ≤ half for each axis a, with the products summed as
    (x + y) + z. The coarse grid and the windows only leave out points that cannot be in a box. A
    point with a NaN is in no box.

    Args:
        points: (P, 3) positions, metres.
        center: (N, 3) centres of the boxes, metres.
        half: (N, 3) half sizes, metres.
        axes: (N, 3, 3) axes of the boxes, in columns.

    Returns:
        Indices of boxes (K,) and indices of points (K,), sorted by box, then by point.
    """
    reach = (np.abs(axes) @ half[:, :, None])[:, :, 0] * 1.001 + 1e-6  # exceeds any rounding error
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
    """Find the points (P,) in each of the windows (N,), seen from above.

    Returns:
        Indices of windows (K,) and indices of the points in them (K,), sorted by window.
    """
    point_count = max(1, len(x))
    step = max(1, _WINDOWS_AT_ONCE // point_count)
    windows = [NO_INDICES]
    rows = [NO_INDICES]
    for start in range(0, len(low), step):
        batch = slice(start, start + step)
        low_x, low_y = low[batch, :2].T[..., None]
        high_x, high_y = high[batch, :2].T[..., None]
        is_inside = (x >= low_x) & (x <= high_x)
        is_inside &= (y >= low_y) & (y <= high_y)
        window, row = np.divmod(np.flatnonzero(is_inside), point_count)
        windows.append(window + start)
        rows.append(row)
    return np.concatenate(windows), np.concatenate(rows)


def _near_any(points: FloatArray, low: FloatArray, high: FloatArray) -> IntArray:
    """Return the ascending indices of the points in coarse cells that a box's window touches."""
    is_finite = np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1)
    if not is_finite.any():
        return NO_INDICES
    low = low[is_finite, :2]
    high = high[is_finite, :2]
    origin = low.min(axis=0)
    end = high.max(axis=0)
    # the width of very large numbers can be rounded to 0
    scale = (_CELLS - 1) / np.maximum(end - origin, 1e-6)
    touched = np.zeros((_CELLS, _CELLS), dtype=bool)
    # the mapping to cells is monotonic, so a point in a window is in one of the window's cells
    first_cells = ((low - origin) * scale).astype(int)
    last_cells = ((high - origin) * scale).astype(int)
    windows = np.hstack([first_cells, last_cells]).tolist()
    for first_column, first_row, last_column, last_row in windows:
        touched[first_column : last_column + 1, first_row : last_row + 1] = True
    candidates = [NO_INDICES]
    for start in range(0, len(points), POINTS_AT_ONCE):
        x, y = np.ascontiguousarray(points[start : start + POINTS_AT_ONCE, :2].T)
        is_inside = (x >= origin[0]) & (x <= end[0])
        is_inside &= (y >= origin[1]) & (y <= end[1])
        rows = np.flatnonzero(is_inside)
        column = ((x[rows] - origin[0]) * scale[0]).astype(np.int64)
        row = ((y[rows] - origin[1]) * scale[1]).astype(np.int64)
        is_touched = touched[column, row]
        candidates.append(rows[is_touched] + start)
    return np.concatenate(candidates)
