"""Post-encroachment time: the time after which one road user reaches an area that another has left.

All results are exact for steady motions. The area that two boxes occupy at time t of the first and
t + d of the second is convex in (t, d): strips |g + a·t + b·d| ≤ r, one for each direction of a
side and one for each box's window. Eliminating t leaves the range of delays d at which the boxes
would touch.
"""

from __future__ import annotations

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

# Slopes below this are zero: two such strips do not cross.
_ZERO_SLOPE = 1e-12
# Two boxes that touch by calculation may be apart by this distance.
_CONTACT_TOLERANCE_M = 1e-9
# An actor that moves less than this between all frames of a stretch stands in it, so that it is one
# piece.
_STANDING_STEP_M = 1e-3
# Pairs of pieces that are compared between two checks for pairs that can have a smaller delay.
_PIECE_PAIRS_AT_ONCE = 1 << 12


def post_encroachment_time(
    first: FloatArray,
    second: FloatArray,
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    window: float = 10.0,
) -> FloatArray:
    """Return the smallest delay after which one box of a pair reaches the area of the other.

    Both boxes keep their velocities.

    Args:
        first: First boxes at the begin of the window, shape (…, 5).
        second: Second boxes at the begin of the window, shape (…, 5).
        first_velocity: Velocities of the first boxes, shape (…, 2), m/s.
        second_velocity: Velocities of the second boxes, shape (…, 2), m/s.
        window: Time that counts, seconds.

    Returns:
        Delays, shape (…,), seconds; positive if the first box was in the area first, negative if
        the second was, 0 if they touch, infinite if their paths do not meet within the window; NaN
        where a velocity is NaN.
    """
    leading_shape = np.broadcast_shapes(first.shape, second.shape)[:-1]
    span = np.broadcast_to([0.0, window], (*leading_shape, 2))
    shortest, longest = delays(first, second, first_velocity, second_velocity, (span, span))
    times = signed_least(shortest, longest)
    unknown = np.isnan(first_velocity).any(axis=-1) | np.isnan(second_velocity).any(axis=-1)
    return np.where(unknown, np.nan, times)


def delays(
    first: FloatArray,
    second: FloatArray,
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    spans: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Return the smallest and the largest delay at which two steadily moving boxes touch.

    A delay is the second's time less the first's.

    Args:
        first: First boxes at time 0, shape (…, 5).
        second: Second boxes at time 0, shape (…, 5).
        first_velocity: Velocities of the first boxes, shape (…, 2), m/s.
        second_velocity: Velocities of the second boxes, shape (…, 2), m/s.
        spans: Begin and end of the times that count for each of the two, shape (…, 2), seconds.

    Returns:
        Smallest and largest delays, each of shape (…), seconds; infinite and −infinite if the boxes
        never touch.
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
    """Return the delay nearest to 0 in ranges of delays; infinite where a range is empty."""
    nearest = np.where(shortest > 0, shortest, np.where(longest < 0, longest, 0.0))
    return np.where(shortest <= longest, nearest, np.inf)


def conflict_area_pet(
    first: FloatArray,
    second: FloatArray,
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    window: float = 10.0,
) -> FloatArray:
    """Return the time from one box's exit to the other's entry into the area that both cross.

    It is negative where both are in the area together, whether they touch or not;
    `post_encroachment_time` is more precise.

    Args:
        first: First boxes at the begin of the window, shape (…, 5).
        second: Second boxes at the begin of the window, shape (…, 5).
        first_velocity: Velocities of the first boxes, shape (…, 2), m/s.
        second_velocity: Velocities of the second boxes, shape (…, 2), m/s.
        window: Time that counts, seconds; an entry before it or an exit after it counts as at its
            begin or end.

    Returns:
        Times, shape (…,), seconds; NaN where there is no such area, or a velocity is NaN.
    """
    boxes = (first, second)
    velocities = (first_velocity, second_velocity)
    origin = first[..., :2]  # far from the world's origin, no digits are lost
    normals_of_boxes = []
    middles = []
    halves = []
    for box, velocity in zip(boxes, velocities, strict=True):
        sides = _swept_sides(box, velocity)
        middle, half = _swept_extent(box, velocity, sides, origin, window)
        normals_of_boxes.append(sides)
        middles.append(middle)
        halves.append(half)
    normal = np.concatenate(normals_of_boxes, axis=-2)
    middle = np.concatenate(middles, axis=-1)
    half = np.concatenate(halves, axis=-1)
    lower, upper = _area_extents(normal, middle, half)
    area = (normal, lower, upper)
    first_entry, first_exit = _area_times(first, first_velocity, area, origin, window)
    second_entry, second_exit = _area_times(second, second_velocity, area, origin, window)
    between = np.maximum(second_entry - first_exit, first_entry - second_exit)
    return np.where((lower < upper).all(axis=-1), between, np.nan)


def _swept_sides(box: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return the normals of the sides of the area that a box sweeps, shape (…, 3, 2).

    Two are the box's own, and one is that of its path.
    """
    yaw = box[..., 4]
    standing = (velocity == 0).all(axis=-1)
    path_direction = np.arctan2(velocity[..., 1], velocity[..., 0])
    path_normal = np.where(standing, yaw, path_direction + np.pi / 2)
    return normals(np.concatenate([side_yaws(box), path_normal[..., None]], axis=-1))


def _swept_extent(
    box: FloatArray, velocity: FloatArray, normal: FloatArray, origin: FloatArray, window: float
) -> tuple[FloatArray, FloatArray]:
    """Return the extent of the area that a box sweeps, along directions.

    Returns:
        Middles and half widths of the extents, each of shape (…, N).
    """
    start = along(normal, box[..., :2] - origin)
    distance = along(normal, velocity) * window
    return start + distance / 2, np.abs(distance) / 2 + half_extents(box, normal)


def _area_extents(
    normal: FloatArray, middle: FloatArray, half: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the extent of the area within N strips along the normal of each strip.

    Args:
        normal: Normals of the strips, shape (…, N, 2).
        middle: Middles of the strips along their normals, shape (…, N).
        half: Half widths of the strips, shape (…, N).

    Returns:
        Lower and upper ends, each of shape (…, N).
    """
    tangent = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
    along_normals = np.einsum("...nk,...mk->...mn", normal, normal)
    along_tangents = np.einsum("...nk,...mk->...mn", normal, tangent)
    return _delay_range(-middle[..., None, :], along_tangents, along_normals, half[..., None, :])


def _area_times(
    box: FloatArray,
    velocity: FloatArray,
    area: tuple[FloatArray, FloatArray, FloatArray],
    origin: FloatArray,
    window: float,
) -> tuple[FloatArray, FloatArray]:
    """Return when a moving box first and last touches an area, each of shape (…,), seconds.

    Args:
        box: Boxes at the begin of the window, shape (…, 5).
        velocity: Velocities, shape (…, 2), m/s.
        area: Normals of the area's sides, and its lower and upper ends along them.
        origin: Origin of the area's coordinates, shape (…, 2).
        window: Time that counts, seconds.
    """
    normal, lower, upper = area
    start = along(normal, box[..., :2] - origin)
    speed = along(normal, velocity)
    half = half_extents(box, normal)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ends = np.stack([(lower - half - start) / speed, (upper + half - start) / speed])
    standing = np.abs(speed) < _ZERO_SLOPE
    begin = np.where(standing, -np.inf, ends.min(axis=0)).max(axis=-1)
    end = np.where(standing, np.inf, ends.max(axis=0)).min(axis=-1)
    return np.clip(begin, 0, window), np.clip(end, 0, window)


def _delay_range(
    g: FloatArray, a: FloatArray, b: FloatArray, r: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the smallest and largest d for which some t lies in all strips |g + a·t + b·d| ≤ r.

    The N strips are rows of (…, N), the results have the shape (…). Each strip bounds a·t from both
    sides; each lower bound must be within each upper one.
    """
    sign = np.where(a < 0, -1.0, 1.0)
    g, a, b = np.broadcast_arrays(g * sign, a * sign, b * sign)
    # Each strip along the rows is paired with each strip along the columns.
    row_a = a[..., :, None]
    column_a = a[..., None, :]
    slope = column_a * b[..., :, None] - row_a * b[..., None, :]
    upper_bound = column_a * (r - g)[..., :, None]
    lower_bound = row_a * (r + g)[..., None, :]
    bound = upper_bound + lower_bound
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        delay = bound / slope
    parallel = np.abs(slope) < _ZERO_SLOPE
    longest = np.where(~parallel & (slope > 0), delay, np.inf).min(axis=(-2, -1))
    shortest = np.where(~parallel & (slope < 0), delay, -np.inf).max(axis=(-2, -1))
    contradictory = (parallel & (bound < -_CONTACT_TOLERANCE_M)).any(axis=(-2, -1))
    empty = contradictory | ~(shortest <= longest + _CONTACT_TOLERANCE_M)
    # A touch may end before it begins, by a rounding.
    shortest, longest = np.minimum(shortest, longest), np.maximum(shortest, longest)
    return np.where(empty, np.inf, shortest), np.where(empty, -np.inf, longest)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pieces(FrozenArrays):
    """Path of an actor in N straight pieces.

    Attributes:
        boxes: Boxes in the middle of each piece, with their yaw at that moment, shape (N, 5).
        velocity: Velocities, shape (N, 2), m/s.
        spans: Begin and end, shape (N, 2), seconds from the first frame.
        radius: Radius around the middle within which the box is during the piece, shape (N,),
            metres.
    """

    boxes: FloatArray
    velocity: FloatArray
    spans: FloatArray
    radius: FloatArray


def pieces_of(boxes: FloatArray) -> Pieces:
    """Return the pieces of a track, straight over frames without a box.

    A track of one frame is one piece without length.

    Args:
        boxes: Boxes at each frame, shape (F, 5), NaN where the track has none.
    """
    frames = np.flatnonzero(~np.isnan(boxes[:, 0]))
    track = boxes[frames]
    times = frames * FRAME_PERIOD
    if len(frames) == 1:
        begin = end = np.zeros(1, dtype=np.int64)
    else:
        begin = np.flatnonzero(_piece_begins(track))
        end = np.append(begin[1:], len(frames) - 1)
    spans = np.column_stack([times[begin], times[end]])
    duration = np.maximum(spans[:, 1] - spans[:, 0], FRAME_PERIOD)[:, None]
    offset = track[end, :2] - track[begin, :2]
    turn = np.mod(track[end, 4] - track[begin, 4] + np.pi, 2 * np.pi) - np.pi
    half_step = np.column_stack([offset / 2, np.zeros((len(offset), 2)), turn / 2])
    middle = track[begin] + half_step
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

    The sign is as in `post_encroachment_time`. Pieces are compared in the order of the smallest
    delay that they can have, until no other pair can have a smaller one.
    """
    first_rows, second_rows = np.nonzero(_circles_meet(first, second))
    first_rows, second_rows = _crossing(first, second, first_rows, second_rows)
    first_spans = first.spans[first_rows]
    second_spans = second.spans[second_rows]
    min_delays = np.maximum(
        second_spans[:, 0] - first_spans[:, 1], first_spans[:, 0] - second_spans[:, 1]
    )
    order = np.argsort(min_delays, kind="stable")
    best = np.inf
    for start in range(0, len(order), _PIECE_PAIRS_AT_ONCE):
        rows = order[start : start + _PIECE_PAIRS_AT_ONCE]
        if min_delays[rows[0]] >= abs(best):
            break
        pair_delays = _delays_of_pieces(first, second, first_rows[rows], second_rows[rows])
        delay = pair_delays[np.abs(pair_delays).argmin()]
        if abs(delay) < abs(best):
            best = float(delay)
    return best


def _piece_begins(track: FloatArray) -> BoolArray:
    """Return whether a piece begins at each frame but the last, shape (F − 1,).

    It does if the actor moves to the next frame, or has moved from the frame before.
    """
    moves = np.abs(np.diff(track, axis=0)).max(axis=1) > _STANDING_STEP_M
    return np.asarray(moves | np.append(True, moves[:-1]))


def _circles_meet(first: Pieces, second: Pieces) -> BoolArray:
    """Return whether the circles around two pieces meet, shape (N, M)."""
    offset = first.boxes[:, None, :2] - second.boxes[None, :, :2]
    sum_of_radii = first.radius[:, None] + second.radius
    return np.asarray((offset**2).sum(axis=-1) <= sum_of_radii**2)


def _crossing(
    first: Pieces, second: Pieces, first_rows: IntArray, second_rows: IntArray
) -> tuple[IntArray, IntArray]:
    """Return the rows of the pairs of pieces that no direction of a side parts at all times."""
    normal, gap, reach = side_gaps(first.boxes[first_rows], second.boxes[second_rows])
    half_distances = []
    for pieces, rows in ((first, first_rows), (second, second_rows)):
        speed = np.abs(along(normal, pieces.velocity[rows]))
        half_distances.append(speed * np.diff(pieces.spans[rows], axis=-1) / 2)
    max_gap = reach + half_distances[0] + half_distances[1] + 1e-9
    crossing = (np.abs(gap) <= max_gap).all(axis=-1)
    return first_rows[crossing], second_rows[crossing]


def _delays_of_pieces(
    first: Pieces, second: Pieces, first_rows: IntArray, second_rows: IntArray
) -> FloatArray:
    """Return the delay nearest to 0 of pairs of pieces; infinite where they never touch."""
    boxes, velocities, middles, spans = [], [], [], []
    for pieces, rows in ((first, first_rows), (second, second_rows)):
        span = pieces.spans[rows]
        middle = span.mean(axis=-1)
        boxes.append(pieces.boxes[rows])
        velocities.append(pieces.velocity[rows])
        middles.append(middle)
        spans.append(span - middle[:, None])
    shift = middles[1] - middles[0]
    shortest, longest = delays(
        boxes[0], boxes[1], velocities[0], velocities[1], (spans[0], spans[1])
    )
    return signed_least(shortest + shift, longest + shift)
