"""Post-encroachment times of recorded tracks: straight pieces of a frame's length, compared with all of the other's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.geometry.conflicts import along, side_gaps
from deepaccident_devkit.interactions.encroachment import delays, signed_least
from deepaccident_devkit.taxonomy import FRAME_PERIOD

_STILL = 1e-3
"""Metres; an actor that moves less between all frames of a stretch stands in it, which is one piece then."""
_ROUND = 1 << 12
"""Pairs of pieces that are compared before it is looked which can still be nearer."""


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
    """Least delay with which one of two recorded actors comes to where the other is at another time.

    Pieces are compared in the order of the least delay that they can have, until no other can have a smaller one.

    Returns:
        Seconds, signed and infinite as of `post_encroachment_time`.
    """
    one, other = np.nonzero(_near(first, second))
    one, other = _crossing(first, second, one, other)
    apart = np.maximum(second.spans[other, 0] - first.spans[one, 1], first.spans[one, 0] - second.spans[other, 1])
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
    before = np.append(True, moves[:-1])
    starts: BoolArray = moves | before
    return starts


def _near(first: Pieces, second: Pieces) -> BoolArray:
    """(N, M) whether the circles around two pieces meet."""
    apart = first.boxes[:, None, :2] - second.boxes[None, :, :2]
    reach = first.radius[:, None] + second.radius
    near: BoolArray = (apart**2).sum(axis=-1) <= reach**2
    return near


def _crossing(first: Pieces, second: Pieces, one: IntArray, other: IntArray) -> tuple[IntArray, IntArray]:
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
