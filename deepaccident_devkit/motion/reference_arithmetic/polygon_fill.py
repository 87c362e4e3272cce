"""Filling many polygons at a time on cells as OpenCV 4.7's fillPoly does, with any installed OpenCV.

Labels are rasterised by `cv2.fillPoly` (8-connected, whole-cell corners), and what it rasterises changed with OpenCV
4.8 (the interior of small polygons) and 4.11 (at the image's border). The released labels are those of 4.7, so its rule
is written out here: the outline as clipped Bresenham lines, and in each row all cells from the first one at or right
of the left edge to the last one at or left of the right edge, in fixed point with 16 binary digits. Source: OpenCV
4.7.0, imgproc, drawing.cpp: clipLine, LineIterator, CollectPolyEdges and FillEdgeCollection.

In a convex polygon inside the image, the cells between the edges of a row only fill the gap between the outlines: the
outline's ends are enough. All other polygons go through the whole rule.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray, checked

# Binary digits after the point, for the place where an edge crosses a row.
_FIXED = 16
# The place of an edge that does not reach a row: it comes after all others.
_BEYOND = np.int64(1) << 62


def filled_cells(
    polygons: ArrayLike, shape: tuple[int, int], image: ArrayLike | None = None, images: int = 1
) -> tuple[IntArray, IntArray]:
    """The cells that polygons cover: `topmost` as ascending indices (P,), and the polygon (P,) of each."""
    top = topmost(polygons, shape, image, images)
    covered = np.flatnonzero(top != 0)  # of bools: twice as fast
    return covered, top[covered] - np.int64(1)


def topmost(
    polygons: ArrayLike, shape: tuple[int, int], image: ArrayLike | None = None, images: int = 1
) -> NDArray[np.int32]:
    """(images · rows · columns,) 1 + the number of the last polygon that covers each cell, 0 where there is none.

    `polygons` (N, V, 2) are columns and rows of V ≥ 3 whole corners in either direction, which may lie outside,
    coincide or cross; `image` (N,) says which of the images each is drawn into, None the first. Raises GeometryError.
    """
    corners = checked("polygons", polygons, (None, None, 2), np.int64)
    where = checked(
        "image", np.zeros(len(corners)) if image is None else image, (len(corners),), np.int64
    )
    if corners.shape[1] < 3:
        raise GeometryError(f"polygons: expected at least 3 corners, found {corners.shape[1]}")
    if len(where) and not 0 <= where.min() <= where.max() < images:
        raise GeometryError(
            f"image: expected numbers from 0 to {images - 1}, found {where.min()} to {where.max()}"
        )
    first, last, owner = _runs(corners, shape)
    lengths = last - first + 1
    before = np.cumsum(lengths) - lengths
    cells = np.repeat(first + where[owner] * math.prod(shape) - before, lengths)
    cells += np.arange(len(cells))
    top = np.zeros(images * math.prod(shape), dtype=np.int32)
    np.maximum.at(top, cells, np.repeat((owner + 1).astype(np.int32), lengths))
    return top


def _runs(corners: IntArray, shape: tuple[int, int]) -> tuple[IntArray, IntArray, IntArray]:
    """First and last cells of runs that cover the polygons, and each run's polygon; runs may overlap."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    near = np.flatnonzero(((high >= 0) & (low < shape[::-1])).all(axis=1))
    corners, low, high = corners[near], low[near], high[near]
    whole = _convex(corners) & ((low >= 0) & (high < shape[::-1])).all(axis=1)
    row, first, last, line = _outlines(corners, ~whole, shape)
    owner = line // corners.shape[1]
    simple, others = whole[owner], np.flatnonzero(~whole)
    runs = np.stack([row, first, last, owner])
    *between, whose = _between(corners[others], shape)
    parts = [
        np.stack(_merged(*runs[:, simple])),
        runs[:, ~simple],
        np.stack([*between, others[whose]]),
    ]
    row, first, last, owner = np.concatenate(parts, axis=1)
    start = row * shape[1]
    return start + first, start + last, near[owner]


def _merged(
    row: IntArray, first: IntArray, last: IntArray, owner: IntArray
) -> tuple[IntArray, ...]:
    """The runs (R,) of each polygon merged into one for each row, from the first column of all to the last."""
    if not len(row):
        return row, first, last, owner
    low = row.min()
    rows = int(row.max() - low) + 1
    slot = owner * rows + (row - low)
    begin, end = np.full(slot.max() + 1, first.max() + 1), np.full(slot.max() + 1, -1)
    np.minimum.at(begin, slot, first)
    np.maximum.at(end, slot, last)
    used = np.flatnonzero(end >= 0)
    owner = used // rows
    return used - owner * rows + low, begin[used], end[used], owner


def _convex(corners: IntArray) -> BoolArray:
    """Which quadrangles have an area and turn the same way at all corners; False for others: a star may do so too."""
    if corners.shape[1] != 4:
        return np.zeros(len(corners), dtype=bool)
    ahead = corners[:, [1, 2, 3, 0]] - corners
    following = ahead[:, [1, 2, 3, 0]]
    turn = ahead[..., 0] * following[..., 1] - ahead[..., 1] * following[..., 0]
    one_way: BoolArray = (turn >= 0).all(axis=1) != (turn <= 0).all(axis=1)
    return one_way


def _outlines(
    corners: IntArray, beside: BoolArray, shape: tuple[int, int]
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """The runs of the edges (N · V) in the image, one for each row that an edge touches: row, columns, which edge."""
    start, end = _before(corners).reshape(-1, 2), corners.reshape(-1, 2)
    drawn = np.ones(len(start), dtype=bool)
    if beside.any():
        cut = np.repeat(beside, corners.shape[1])
        near, far = start[cut], end[cut]
        drawn[cut] = _clip(near, far, shape)
        end = end.copy()
        start[cut], end[cut] = near, far
    lines = _Lines(start, end)
    counts = np.where(drawn, lines.rise + 1, 0)
    line = np.repeat(np.arange(len(counts)), counts)
    step = np.arange(len(line)) - np.repeat(np.cumsum(counts) - counts, counts)
    first, last = lines.columns(line, step)
    return lines.y[line] + step * lines.direction[line], first, last, line


def _before(corners: IntArray) -> IntArray:
    """(N, V, 2) the corner before each, the last one before the first: np.roll, which takes five times as long."""
    return corners.take(np.arange(-1, corners.shape[1] - 1), axis=1)


class _Lines:
    """Bresenham's lines between cells (L, 2), column and row, as LineIterator walks them: from left to right.

    Attributes:
        y: (L,) row of the left end.
        rise: (L,) rows from there to the other end.
        direction: (L,) 1 where the rows rise from left to right, else −1.
    """

    def __init__(self, start: IntArray, end: IntArray) -> None:
        leftward = end[:, :1] < start[:, :1]
        (x1, y1), (x2, y2) = np.where(leftward, end, start).T, np.where(leftward, start, end).T
        across, down = x2 - x1, y2 - y1
        self.y, self.rise, self.direction = y1, np.abs(down), np.where(down < 0, -1, 1)
        # After k of the D steps along its longer side a line has made (2 d k + D − 1) // 2 D steps along the other
        # side (d). A steep line has one cell in each row. Where a flat line enters and leaves row j, solved for k.
        level, steep = self.rise == 0, self.rise > across
        enter = np.where(steep, self.rise - 1, np.where(level, 0, 2 * self.rise - across))
        leave = np.where(steep, self.rise - 1, across)
        divisor = np.where(level, 1, 2 * self.rise)
        self._numbers = np.stack([x1, across, enter, leave, divisor]).astype(np.float64)

    def columns(self, line: IntArray, step: IntArray) -> tuple[IntArray, IntArray]:
        """First and last columns of lines in their rows number `step`, counted from the left end."""
        x, across, enter, leave, divisor = self._numbers.take(line, axis=1)
        travelled = 2 * across * step
        # quotients of small whole numbers: rounding moves none past a whole number
        first = np.maximum(np.floor((travelled + enter) / divisor), 0)
        last = np.minimum(np.floor((travelled + leave) / divisor), across)
        return (x + first).astype(np.int64), (x + last).astype(np.int64)


def _between(
    corners: IntArray, shape: tuple[int, int]
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """The runs between the edges of polygons in the image: row, first and last column, polygon."""
    height, width = shape
    low = np.maximum(corners[..., 1].min(axis=1), 0)
    rows = np.minimum(corners[..., 1].max(axis=1), height - 1) - low + 1
    owner = np.repeat(np.arange(len(corners)), rows)
    row = np.arange(len(owner)) + np.repeat(low - np.cumsum(rows) + rows, rows)
    start = _before(corners)
    downward = (start[..., 1] < corners[..., 1])[..., None]
    upper, lower = np.where(downward, start, corners), np.where(downward, corners, start)
    ahead = (lower[..., 0] - upper[..., 0]) << _FIXED
    slope = np.sign(ahead) * (
        np.abs(ahead) // np.maximum(lower[..., 1] - upper[..., 1], 1)
    )  # C++ rounds towards 0
    below = row[:, None] - upper[owner, :, 1]
    crossing = (upper[owner, :, 0] << _FIXED) + below * slope[owner]
    crossing[(below < 0) | (row[:, None] >= lower[owner, :, 1])] = _BEYOND
    crossing.sort(axis=1)
    left, right = crossing[:, 0:-1:2], crossing[:, 1::2]
    first = np.maximum((left + ((1 << _FIXED) - 1)) >> _FIXED, 0)
    last = np.minimum(np.where(right < _BEYOND, right >> _FIXED, -1), width - 1)
    some = first <= last
    which = np.nonzero(some)[0]
    return row[which], first[some], last[some], owner[which]


def _clip(start: IntArray, end: IntArray, shape: tuple[int, int]) -> BoolArray:
    """Clip lines (L, 2) to the image in place as clipLine does, first to its rows; returns which of them touch it."""
    right, bottom = shape[1] - 1, shape[0] - 1
    inside = _not_beside(start, end, 0, right) & _not_beside(start, end, 1, bottom)
    _clip_end(start, end, 1, bottom, inside)
    _clip_end(end, start, 1, bottom, inside)
    inside &= _not_beside(start, end, 0, right)
    _clip_end(start, end, 0, right, inside)
    _clip_end(end, start, 0, right, inside)
    return inside


def _not_beside(start: IntArray, end: IntArray, axis: int, most: int) -> BoolArray:
    """Which lines (L, 2) lie neither entirely before 0 nor entirely after `most`."""
    result: BoolArray = (np.maximum(start[:, axis], end[:, axis]) >= 0) & (
        np.minimum(start[:, axis], end[:, axis]) <= most
    )
    return result


def _clip_end(near: IntArray, far: IntArray, axis: int, most: int, which: BoolArray) -> None:
    """Move one end of lines (L, 2) to 0 or `most` along an axis where it lies beyond."""
    edge = np.minimum(np.maximum(near[:, axis], 0), most)
    beyond = np.flatnonzero(which & (edge != near[:, axis]))
    if not len(beyond):
        return
    edge, corner = edge[beyond], near[beyond]
    way = far[beyond] - corner
    share: FloatArray = (
        (edge - corner[:, axis]).astype(np.float64) * way[:, 1 - axis] / way[:, axis]
    )
    near[beyond, 1 - axis] += share.astype(np.int64)  # C++ rounds towards 0
    near[beyond, axis] = edge
