"""Post-encroachment time: how long after one road user the other comes to where it was.

All is exact for steady motions. What two boxes occupy at the times t of the first and t + d of the second is convex in
(t, d): strips |g + a·t + b·d| ≤ r, one for each direction of a side, one for each one's window. Eliminating t leaves
the range of delays d at which they would touch.
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

# Below this two strips do not cross.
_PARALLEL = 1e-12
# Metres by which two boxes may be apart where they touch by calculation.
_TOUCHING = 1e-9


def post_encroachment_time(
    first: FloatArray,
    second: FloatArray,
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    window: float = 10.0,
) -> FloatArray:
    """Least delay with which one of a pair comes to where the other is at another time, both keeping their velocities.

    Args:
        first: (…, 5) boxes at the window's begin.
        second: (…, 5) the same.
        first_velocity: (…, 2) metres a second.
        second_velocity: (…, 2) metres a second.
        window: seconds; what is beyond does not count.

    Returns:
        (…,) seconds: positive if the first was there first, negative if the second was, 0 if they touch, infinite if
        their ways do not meet within the window; NaN where a velocity is.
    """
    span = np.broadcast_to([0.0, window], (*np.broadcast_shapes(first.shape, second.shape)[:-1], 2))
    least, most = delays(first, second, first_velocity, second_velocity, (span, span))
    times = signed_least(least, most)
    unknown = np.isnan(first_velocity).any(axis=-1) | np.isnan(second_velocity).any(axis=-1)
    return np.where(unknown, np.nan, times)


def delays(
    first: FloatArray,
    second: FloatArray,
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    spans: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """The least and most delays (…), seconds, at which two steadily moving boxes touch; ±infinite for none.

    A delay is the second's time less the first's; boxes (…, 5) are at time 0, and `spans` the begins and ends (…,
    2) of the times that count.
    """
    normal, gap, reach = side_gaps(first, second)
    first_way, second_way = along(normal, first_velocity), along(normal, second_velocity)
    middles = [span.mean(axis=-1)[..., None] for span in spans]
    halves = [np.diff(span, axis=-1) / 2 for span in spans]
    one = np.ones_like(middles[0])
    return _range_of(
        np.concatenate([gap, -middles[0], -middles[1]], axis=-1),
        np.concatenate([second_way - first_way, one, one], axis=-1),
        np.concatenate([second_way, np.zeros_like(one), one], axis=-1),
        np.concatenate([reach, *halves], axis=-1),
    )


def signed_least(least: FloatArray, most: FloatArray) -> FloatArray:
    """The delay that is nearest to 0 of ranges of delays; infinite where a range is empty."""
    nearest = np.where(least > 0, least, np.where(most < 0, most, 0.0))
    return np.where(least <= most, nearest, np.inf)


def conflict_area_pet(
    first: FloatArray,
    second: FloatArray,
    first_velocity: FloatArray,
    second_velocity: FloatArray,
    window: float = 10.0,
) -> FloatArray:
    """The time between one's leaving the area that both pass over and the other's entering it.

    Negative where both are in it together, whether they touch or not: `post_encroachment_time` says more.

    Args:
        first: (…, 5) boxes at the window's begin.
        second: (…, 5) the same.
        first_velocity: (…, 2) metres a second.
        second_velocity: (…, 2) metres a second.
        window: seconds; who enters before it or leaves after it counts as doing so at its begin or end.

    Returns:
        (…,) seconds; NaN where there is no such area, or a velocity is NaN.
    """
    boxes, velocities = (first, second), (first_velocity, second_velocity)
    origin = first[..., :2]  # far from the world's, no digits are lost
    sides = [_swept_sides(box, velocity) for box, velocity in zip(boxes, velocities, strict=True)]
    strips = [
        _swept(box, velocity, normal, origin, window)
        for box, velocity, normal in zip(boxes, velocities, sides, strict=True)
    ]
    normal = np.concatenate(sides, axis=-2)
    middle, half = (np.concatenate([strip[part] for strip in strips], axis=-1) for part in (0, 1))
    least, most = _extents(normal, middle, half)
    times = [
        _times_inside(box, velocity, (normal, least, most), origin, window)
        for box, velocity in zip(boxes, velocities, strict=True)
    ]
    between = np.maximum(times[1][0] - times[0][1], times[0][0] - times[1][1])
    return np.where((least < most).all(axis=-1), between, np.nan)


def _swept_sides(box: FloatArray, velocity: FloatArray) -> FloatArray:
    """(…, 3, 2) normals of the sides of what a box passes over: its own two, and that of its way."""
    yaw = box[..., 4]
    still = (velocity == 0).all(axis=-1)
    way = np.where(still, yaw, np.arctan2(velocity[..., 1], velocity[..., 0]) + np.pi / 2)
    return normals(np.concatenate([side_yaws(box), way[..., None]], axis=-1))


def _swept(
    box: FloatArray, velocity: FloatArray, normal: FloatArray, origin: FloatArray, window: float
) -> tuple[FloatArray, FloatArray]:
    """Middle and half (…, N) of the extent, along directions, of what a box passes over."""
    begin, way = along(normal, box[..., :2] - origin), along(normal, velocity) * window
    return begin + way / 2, np.abs(way) / 2 + half_extents(box, normal)


def _extents(
    normal: FloatArray, middle: FloatArray, half: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The area within N strips (…, N): its least and most (…, N) along the normal (…, N, 2) of each."""
    across = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
    along_each, across_each = (
        np.einsum("...nk,...mk->...mn", normal, other) for other in (normal, across)
    )
    return _range_of(-middle[..., None, :], across_each, along_each, half[..., None, :])


def _times_inside(
    box: FloatArray,
    velocity: FloatArray,
    area: tuple[FloatArray, FloatArray, FloatArray],
    origin: FloatArray,
    window: float,
) -> tuple[FloatArray, FloatArray]:
    """When a moving box first and last touches an area, given by directions and its least and most along them."""
    normal, least, most = area
    start, speed, half = (
        along(normal, box[..., :2] - origin),
        along(normal, velocity),
        half_extents(box, normal),
    )
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ends = np.stack([(least - half - start) / speed, (most + half - start) / speed])
    still = np.abs(speed) < _PARALLEL
    begin = np.where(still, -np.inf, ends.min(axis=0)).max(axis=-1)
    end = np.where(still, np.inf, ends.max(axis=0)).min(axis=-1)
    return np.clip(begin, 0, window), np.clip(end, 0, window)


def _range_of(
    g: FloatArray, a: FloatArray, b: FloatArray, r: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The least and most d (…) for which some t lies in all N strips |g + a·t + b·d| ≤ r, given by (…, N) each.

    Each strip bounds a·t from below and above; each lower bound must be within each upper one.
    """
    flipped = np.where(a < 0, -1.0, 1.0)
    g, a, b = np.broadcast_arrays(g * flipped, a * flipped, b * flipped)
    slope = a[..., None, :] * b[..., :, None] - a[..., :, None] * b[..., None, :]
    bound = a[..., None, :] * (r - g)[..., :, None] + a[..., :, None] * (r + g)[..., None, :]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        at = bound / slope
    parallel = np.abs(slope) < _PARALLEL
    most = np.where(~parallel & (slope > 0), at, np.inf).min(axis=(-2, -1))
    least = np.where(~parallel & (slope < 0), at, -np.inf).max(axis=(-2, -1))
    empty = (parallel & (bound < -_TOUCHING)).any(axis=(-2, -1)) | ~(least <= most + _TOUCHING)
    least, most = np.minimum(least, most), np.maximum(least, most)  # a touch, to a rounding
    return np.where(empty, np.inf, least), np.where(empty, -np.inf, most)


# Metres; an actor that moves less between all frames of a stretch stands in it, which is one piece then.
_STILL = 1e-3
# Pairs of pieces that are compared before it is looked which can still be nearer.
_ROUND = 1 << 12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pieces(FrozenArrays):
    """An actor's way in N straight pieces.

    Attributes:
        boxes: (N, 5) in the middle of each, as they are turned there.
        velocity: (N, 2) metres a second.
        spans: (N, 2) begin and end, seconds from the first frame.
        radius: (N,) metres around the middle within which the box is during the piece.
    """

    boxes: FloatArray
    velocity: FloatArray
    spans: FloatArray
    radius: FloatArray


def pieces_of(boxes: FloatArray) -> Pieces:
    """The pieces of a track (F, 5), one row a frame, NaN where it has none; straight over frames that lack it.

    A track of one frame is one piece without length.
    """
    frames = np.flatnonzero(~np.isnan(boxes[:, 0]))
    track = boxes[frames]
    times = frames * FRAME_PERIOD
    if len(frames) == 1:
        begin = end = np.zeros(1, dtype=np.int64)
    else:
        begin = np.flatnonzero(_parts(track))
        end = np.append(begin[1:], len(frames) - 1)
    spans = np.column_stack([times[begin], times[end]])
    seconds = np.maximum(spans[:, 1] - spans[:, 0], FRAME_PERIOD)[:, None]
    way = track[end, :2] - track[begin, :2]
    turn = np.mod(track[end, 4] - track[begin, 4] + np.pi, 2 * np.pi) - np.pi
    middle = track[begin] + np.column_stack([way / 2, np.zeros((len(way), 2)), turn / 2])
    return Pieces(
        boxes=middle,
        velocity=way / seconds,
        spans=spans,
        radius=(np.hypot(middle[:, 2], middle[:, 3]) + np.hypot(way[:, 0], way[:, 1])) / 2,
    )


def recorded_pet(first: Pieces, second: Pieces) -> float:
    """Least delay, as of `post_encroachment_time`, with which one of two recorded actors comes to where the other is.

    Pieces are compared in the order of the least delay that they can have, until no other can have a smaller one.
    """
    one, other = np.nonzero(_near(first, second))
    one, other = _crossing(first, second, one, other)
    apart = np.maximum(
        second.spans[other, 0] - first.spans[one, 1], first.spans[one, 0] - second.spans[other, 1]
    )
    order = np.argsort(apart, kind="stable")
    best = np.inf
    for start in range(0, len(order), _ROUND):
        rows = order[start : start + _ROUND]
        if apart[rows[0]] >= abs(best):
            break
        found = _delays(first, second, one[rows], other[rows])
        least = found[np.abs(found).argmin()]
        if abs(least) < abs(best):
            best = float(least)
    return best


def _parts(track: FloatArray) -> BoolArray:
    """(F − 1,) whether a piece begins at each frame but the last: it moves to the next one, or came from the last."""
    moves = np.abs(np.diff(track, axis=0)).max(axis=1) > _STILL
    return np.asarray(moves | np.append(True, moves[:-1]))


def _near(first: Pieces, second: Pieces) -> BoolArray:
    """(N, M) whether the circles around two pieces meet."""
    apart = first.boxes[:, None, :2] - second.boxes[None, :, :2]
    reach = first.radius[:, None] + second.radius
    return np.asarray((apart**2).sum(axis=-1) <= reach**2)


def _crossing(
    first: Pieces, second: Pieces, one: IntArray, other: IntArray
) -> tuple[IntArray, IntArray]:
    """Those pairs of pieces that no direction of a side parts at all times."""
    normal, gap, reach = side_gaps(first.boxes[one], second.boxes[other])
    ways = [
        np.abs(along(normal, pieces.velocity[rows])) * np.diff(pieces.spans[rows], axis=-1) / 2
        for pieces, rows in ((first, one), (second, other))
    ]
    kept = (np.abs(gap) <= reach + ways[0] + ways[1] + 1e-9).all(axis=-1)
    return one[kept], other[kept]


def _delays(first: Pieces, second: Pieces, one: IntArray, other: IntArray) -> FloatArray:
    """The least delay of each of some pairs of pieces, signed; infinite where they never touch."""
    rows, offsets, spans = [], [], []
    for pieces, chosen in ((first, one), (second, other)):
        span = pieces.spans[chosen]
        middle = span.mean(axis=-1)
        rows.append((pieces.boxes[chosen], pieces.velocity[chosen]))
        offsets.append(middle)
        spans.append(span - middle[:, None])
    shift = offsets[1] - offsets[0]
    least, most = delays(rows[0][0], rows[1][0], rows[0][1], rows[1][1], (spans[0], spans[1]))
    return signed_least(least + shift, most + shift)
