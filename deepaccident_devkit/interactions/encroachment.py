"""Post-encroachment time: the time between one road user leaving an area and another entering it.

All results are exact for constant velocities. The first box at time t and the second box at time
t + d touch for a convex set of (t, d). It is an intersection of strips |g + a·t + b·d| ≤ r: one for
each direction of a box's side, and one for the time window of each box. Eliminating t yields the
range of delays d at which the boxes touch.
"""

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.geometry.box_arrays import (
    along,
    half_extents,
    normals,
    side_gaps,
    side_yaws,
)
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# Slopes below this count as zero, so that two such strips do not cross.
_ZERO_SLOPE = 1e-12
# Largest gap between two boxes that touch up to rounding.
_CONTACT_TOLERANCE_M = 1e-9
# An actor that moves less than this between frames stands still; its path is then a single piece.
_STANDING_STEP_M = 1e-3
# Number of pairs of pieces that are compared at once. Pairs that cannot have a smaller delay than
# the best so far are then skipped.
_PIECE_PAIRS_AT_ONCE = 1 << 12
# Lower and upper ends of ranges, each with shape (…,).
_Ranges = tuple[FloatArray, FloatArray]


def post_encroachment_time(
    first: FloatArray,
    second: FloatArray,
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    window: float = 10.0,
) -> FloatArray:
    """Return the smallest delay after which one box of each pair reaches the area of the other box.

    Both boxes keep their velocities.

    Args:
        first: First boxes at the start of the window, shape (…, 5).
        second: Second boxes at the start of the window, shape (…, 5).
        first_velocity: Velocities of the first boxes in m/s, shape (…, 2).
        second_velocity: Velocities of the second boxes in m/s, shape (…, 2).
        window: Length of the window in seconds.

    Returns:
        Delays in seconds, shape (…,). Positive if the first box was in the area first, negative if
        the second was, 0 if they touch, infinite if their paths do not cross within the window, NaN
        where a velocity is NaN.
    """
    leading_shape = np.broadcast_shapes(first.shape, second.shape)[:-1]
    span = np.broadcast_to([0.0, window], (*leading_shape, 2))
    shortest, longest = delays(first, second, first_velocity, second_velocity, (span, span))
    times = signed_least(shortest, longest)
    first_unknown = np.isnan(first_velocity).any(axis=-1)
    second_unknown = np.isnan(second_velocity).any(axis=-1)
    return np.where(first_unknown | second_unknown, np.nan, times)


def delays(
    first: FloatArray,
    second: FloatArray,
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    spans: _Ranges,
) -> _Ranges:
    """Return the smallest and the largest delay at which two steadily moving boxes touch.

    The delay is the second box's time minus the first box's time.

    Args:
        first: First boxes at time 0, shape (…, 5).
        second: Second boxes at time 0, shape (…, 5).
        first_velocity: Velocities of the first boxes in m/s, shape (…, 2).
        second_velocity: Velocities of the second boxes in m/s, shape (…, 2).
        spans: For each of the two boxes, start and end of the times considered, shape (…, 2), in
            seconds.

    Returns:
        Smallest and largest delays in seconds, each with shape (…); +infinite and −infinite if the
        boxes never touch.
    """
    normal, gap, reach = side_gaps(first, second)
    first_speed = along(normal, first_velocity)
    second_speed = along(normal, second_velocity)
    middles = [span.mean(axis=-1)[..., None] for span in spans]
    halves = [np.diff(span, axis=-1) / 2 for span in spans]
    ones = np.ones_like(middles[0])
    return _delay_range(
        np.concatenate([gap, -middles[0], -middles[1]], axis=-1),
        np.concatenate([second_speed - first_speed, ones, ones], axis=-1),
        np.concatenate([second_speed, np.zeros_like(ones), ones], axis=-1),
        np.concatenate([reach, *halves], axis=-1),
    )


def signed_least(shortest: FloatArray, longest: FloatArray) -> FloatArray:
    """Return the delay in each range that is nearest to 0; infinite where a range is empty."""
    nearest = np.where(longest < 0, longest, 0.0)
    nearest = np.where(shortest > 0, shortest, nearest)
    return np.where(shortest <= longest, nearest, np.inf)


def conflict_area_pet(
    first: FloatArray,
    second: FloatArray,
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    window: float = 10.0,
) -> FloatArray:
    """Return the time from one box leaving the area that both cross to the other entering it.

    It is negative where both are in the area at the same time, whether or not they touch.
    `post_encroachment_time` is more precise.

    Args:
        first: First boxes at the start of the window, shape (…, 5).
        second: Second boxes at the start of the window, shape (…, 5).
        first_velocity: Velocities of the first boxes in m/s, shape (…, 2).
        second_velocity: Velocities of the second boxes in m/s, shape (…, 2).
        window: Length of the window in seconds; earlier entries count as its start, later exits as
            its end.

    Returns:
        Times in seconds, shape (…,); NaN where no area is crossed by both, or a velocity is NaN.
    """
    origin = first[..., :2]  # keeps full precision far from the world's origin
    strip_normals = []
    strip_middles = []
    strip_halves = []
    for box, velocity in ((first, first_velocity), (second, second_velocity)):
        box_normals = _swept_normals(box, velocity)
        box_middles, box_halves = _swept_extent(box, velocity, box_normals, origin, window)
        strip_normals.append(box_normals)
        strip_middles.append(box_middles)
        strip_halves.append(box_halves)
    normal = np.concatenate(strip_normals, axis=-2)
    middle = np.concatenate(strip_middles, axis=-1)
    half = np.concatenate(strip_halves, axis=-1)
    lower, upper = _area_extents(normal, middle, half)
    area = (normal, lower, upper)
    first_entry, first_exit = _area_times(first, first_velocity, area, origin, window)
    second_entry, second_exit = _area_times(second, second_velocity, area, origin, window)
    times = np.maximum(second_entry - first_exit, first_entry - second_exit)
    has_area = (lower < upper).all(axis=-1)
    return np.where(has_area, times, np.nan)


def _swept_normals(box: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return the side normals of the area that a box sweeps, shape (…, 3, 2).

    Two are the normals of the box; the third is normal to its path.
    """
    yaw = box[..., 4]
    standing = (velocity == 0).all(axis=-1)
    path_yaw = np.arctan2(velocity[..., 1], velocity[..., 0])
    normal_yaw = np.where(standing, yaw, path_yaw + np.pi / 2)
    yaws = np.concatenate([side_yaws(box), normal_yaw[..., None]], axis=-1)
    return normals(yaws)


def _swept_extent(
    box: FloatArray, velocity: FloatArray, normal: FloatArray, origin: FloatArray, window: float
) -> _Ranges:
    """Return the extent of the area that a box sweeps along some directions.

    Returns:
        Centres and half widths of the area along the directions in metres, each (…, N).
    """
    start = along(normal, box[..., :2] - origin)
    distance = along(normal, velocity) * window
    middle = start + distance / 2
    half = np.abs(distance) / 2 + half_extents(box, normal)
    return middle, half


def _area_extents(normal: FloatArray, middle: FloatArray, half: FloatArray) -> _Ranges:
    """Return the extent of the intersection of N strips along the normal of each strip.

    Args:
        normal: Normals of the strips, shape (…, N, 2).
        middle: Centres of the strips along their normals in metres, shape (…, N).
        half: Half widths of the strips in metres, shape (…, N).

    Returns:
        Lower and upper ends in metres, each with shape (…, N).
    """
    tangent = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
    along_normals = np.einsum("...nk,...mk->...mn", normal, normal)
    along_tangents = np.einsum("...nk,...mk->...mn", normal, tangent)
    offset = -middle[..., None, :]
    width = half[..., None, :]
    return _delay_range(offset, along_tangents, along_normals, width)


def _area_times(
    box: FloatArray,
    velocity: FloatArray,
    area: tuple[FloatArray, FloatArray, FloatArray],
    origin: FloatArray,
    window: float,
) -> _Ranges:
    """Return the first and the last time at which a moving box touches an area, in seconds.

    Each has the shape (…,).

    Args:
        box: Boxes at the start of the window, shape (…, 5).
        velocity: Velocities in m/s, shape (…, 2).
        area: Normals of the area's sides, and its lower and upper ends along them in metres.
        origin: Origin of the area's coordinates in metres, shape (…, 2).
        window: Length of the window in seconds.
    """
    normal, lower, upper = area
    start = along(normal, box[..., :2] - origin)
    speed = along(normal, velocity)
    half = half_extents(box, normal)
    with np.errstate(all="ignore"):
        lower_times = (lower - half - start) / speed
        upper_times = (upper + half - start) / speed
    standing = np.abs(speed) < _ZERO_SLOPE
    entry_times = np.where(standing, -np.inf, np.minimum(lower_times, upper_times))
    exit_times = np.where(standing, np.inf, np.maximum(lower_times, upper_times))
    entry = entry_times.max(axis=-1).clip(0, window)
    last_exit = exit_times.min(axis=-1).clip(0, window)
    return entry, last_exit


def _delay_range(g: FloatArray, a: FloatArray, b: FloatArray, r: FloatArray) -> _Ranges:
    """Return the smallest and largest d for which some t is in all strips |g + a·t + b·d| ≤ r.

    The arguments have the shape (…, N) for N strips, the results (…). Each strip is a lower and an
    upper bound of a·t; every lower bound must not exceed any upper one.
    """
    sign = np.where(a < 0, -1.0, 1.0)
    g, a, b = np.broadcast_arrays(g * sign, a * sign, b * sign)
    # Strips along the rows are combined with strips along the columns.
    row_a = a[..., :, None]
    column_a = a[..., None, :]
    slope = column_a * b[..., :, None] - row_a * b[..., None, :]
    upper_bound = column_a * (r - g)[..., :, None]
    lower_bound = row_a * (r + g)[..., None, :]
    bound = upper_bound + lower_bound
    with np.errstate(all="ignore"):
        delay = bound / slope
    parallel = np.abs(slope) < _ZERO_SLOPE
    latest = np.where(~parallel & (slope > 0), delay, np.inf)
    earliest = np.where(~parallel & (slope < 0), delay, -np.inf)
    longest = latest.min(axis=(-2, -1))
    shortest = earliest.max(axis=(-2, -1))
    contradicts = parallel & (bound < -_CONTACT_TOLERANCE_M)
    empty = contradicts.any(axis=(-2, -1)) | ~(shortest <= longest + _CONTACT_TOLERANCE_M)
    # Due to rounding, a touch may end before it begins.
    lower = np.where(empty, np.inf, np.minimum(shortest, longest))
    upper = np.where(empty, -np.inf, np.maximum(shortest, longest))
    return lower, upper


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pieces(FrozenArrays):
    """The path of one actor as N straight pieces.

    Attributes:
        boxes: Box in the middle of each piece, with its yaw at that time, shape (N, 5).
        velocity: Velocities in m/s, shape (N, 2).
        spans: Start and end in seconds from the first frame, shape (N, 2).
        radius: Radius in metres around the middle of a piece that contains the box throughout the
            piece, shape (N,).
    """

    boxes: FloatArray
    velocity: FloatArray
    spans: FloatArray
    radius: FloatArray


def pieces_of(boxes: FloatArray) -> Pieces:
    """Split a track into straight pieces; frames without a box are bridged by a straight piece.

    A track of one frame is one piece of zero duration.

    Args:
        boxes: Boxes in each frame, shape (F, 5); NaN in frames without one.
    """
    frames = np.flatnonzero(~np.isnan(boxes[:, 0]))
    track = boxes[frames]
    times = frames * FRAME_PERIOD
    if len(frames) == 1:
        begins = np.zeros(1, dtype=np.int64)
        ends = begins
    else:
        begins = np.flatnonzero(_begins_piece(track))
        ends = np.append(begins[1:], len(frames) - 1)
    spans = np.column_stack([times[begins], times[ends]])
    duration = np.maximum(spans[:, 1] - spans[:, 0], FRAME_PERIOD)[:, None]
    offset = track[ends, :2] - track[begins, :2]
    yaw_change = track[ends, 4] - track[begins, 4]
    turn = np.mod(yaw_change + np.pi, 2 * np.pi) - np.pi
    no_growth = np.zeros((len(offset), 2))
    half_step = np.column_stack([offset / 2, no_growth, turn / 2])
    middle = track[begins] + half_step
    diagonal = np.hypot(middle[:, 2], middle[:, 3])
    distance = np.hypot(offset[:, 0], offset[:, 1])
    return Pieces(
        boxes=middle,
        velocity=offset / duration,
        spans=spans,
        radius=(diagonal + distance) / 2,
    )


def recorded_pet(first: Pieces, second: Pieces) -> float:
    """Return the smallest delay after which one of two recorded actors reaches the other's area.

    The sign is as in `post_encroachment_time`. Pairs of pieces are compared in the order of their
    smallest possible delay, until no remaining pair can have a smaller one.
    """
    first_rows, second_rows = _crossing_pieces(first, second)
    first_spans = first.spans[first_rows]
    second_spans = second.spans[second_rows]
    first_waits = first_spans[:, 0] - second_spans[:, 1]
    second_waits = second_spans[:, 0] - first_spans[:, 1]
    min_delays = np.maximum(second_waits, first_waits)
    order = np.argsort(min_delays, kind="stable")
    least_delay = np.inf
    for start in range(0, len(order), _PIECE_PAIRS_AT_ONCE):
        rows = order[start : start + _PIECE_PAIRS_AT_ONCE]
        if min_delays[rows[0]] >= abs(least_delay):
            break
        pair_delays = _least_delays(first, second, first_rows[rows], second_rows[rows])
        delay = pair_delays[np.abs(pair_delays).argmin()]
        if abs(delay) < abs(least_delay):
            least_delay = float(delay)
    return least_delay


def _begins_piece(track: FloatArray) -> BoolArray:
    """Return whether a piece begins in each frame except the last, shape (F − 1,).

    It does if the actor moves until the next frame, or has moved since the frame before.
    """
    changes = np.abs(np.diff(track, axis=0))
    moves = changes.max(axis=1) > _STANDING_STEP_M
    moved_before = np.append(True, moves[:-1])
    return np.asarray(moves | moved_before)


def _crossing_pieces(first: Pieces, second: Pieces) -> tuple[IntArray, IntArray]:
    """Return the indices of the pairs of pieces that can touch at some time.

    The circles around such a pair meet, and no side direction of the boxes always separates them.
    """
    offset = first.boxes[:, None, :2] - second.boxes[None, :, :2]
    squared_distance = (offset**2).sum(axis=-1)
    sum_of_radii = first.radius[:, None] + second.radius
    first_rows, second_rows = np.nonzero(squared_distance <= sum_of_radii**2)
    normal, gap, reach = side_gaps(first.boxes[first_rows], second.boxes[second_rows])
    max_gap = reach
    for pieces, rows in ((first, first_rows), (second, second_rows)):
        speed = np.abs(along(normal, pieces.velocity[rows]))
        duration = np.diff(pieces.spans[rows], axis=-1)
        max_gap = max_gap + speed * duration / 2
    crossing = (np.abs(gap) <= max_gap + _CONTACT_TOLERANCE_M).all(axis=-1)
    return first_rows[crossing], second_rows[crossing]


def _least_delays(
    first: Pieces, second: Pieces, first_rows: IntArray, second_rows: IntArray
) -> FloatArray:
    """Return each pair's delay nearest to 0 in seconds; infinite if the pieces never touch."""
    boxes = []
    velocities = []
    middles = []
    spans = []
    for pieces, rows in ((first, first_rows), (second, second_rows)):
        span = pieces.spans[rows]
        middle = span.mean(axis=-1)
        boxes.append(pieces.boxes[rows])
        velocities.append(pieces.velocity[rows])
        middles.append(middle)
        spans.append(span - middle[:, None])
    span_pair = (spans[0], spans[1])
    shortest, longest = delays(boxes[0], boxes[1], velocities[0], velocities[1], span_pair)
    shift = middles[1] - middles[0]
    return signed_least(shortest + shift, longest + shift)
