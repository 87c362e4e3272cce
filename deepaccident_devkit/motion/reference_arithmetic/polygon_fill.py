"""Filling many polygons at a time on cells as OpenCV 4.7's fillPoly does, with any OpenCV.

Labels are rasterised by `cv2.fillPoly` (8-connected, whole-cell corners), and what it rasterises
changed with OpenCV 4.8 (the interior of small polygons) and 4.11 (at the image's border). The
released labels follow 4.7, so its rule is written out here: the outline as clipped Bresenham
lines, and in each row all cells from the first one at or right of the left edge to the last one at
or left of the right edge, in fixed point with 16 binary digits. Source: OpenCV 4.7.0, imgproc,
drawing.cpp: clipLine, LineIterator, CollectPolyEdges and FillEdgeCollection.

In a convex polygon inside the image, the cells between the edges of a row only fill the gap between
the outlines: the outline's ends are enough. All other polygons go through the full rule.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray, checked

# Binary digits after the point, for the column where an edge crosses a row.
_FRACTION_BITS = 16
# The column of an edge that does not reach a row: it comes after all others.
_NO_CROSSING = np.int64(1) << 62


def filled_cells(
    polygons: ArrayLike, shape: tuple[int, int], image: ArrayLike | None = None, images: int = 1
) -> tuple[IntArray, IntArray]:
    """Return the cells that polygons cover, with the arguments of `topmost`.

    Returns:
        Ascending indices of cells, shape (P,), and the number of the polygon of each cell, shape
        (P,).
    """
    top = topmost(polygons, shape, image, images)
    covered = np.flatnonzero(top != 0)  # of bools: twice as fast
    return covered, top[covered] - np.int64(1)


def topmost(
    polygons: ArrayLike, shape: tuple[int, int], image: ArrayLike | None = None, images: int = 1
) -> NDArray[np.int32]:
    """Return 1 + the number of the last polygon that covers each cell, 0 where there is none.

    Args:
        polygons: Columns and rows of V ≥ 3 whole corners in either direction, shape (N, V, 2). They
            may lie outside the image, coincide or cross.
        shape: Rows and columns of an image.
        image: Number of the image that each polygon is drawn into, shape (N,); None for the first
            image.
        images: Number of images.

    Returns:
        Numbers, shape (images · rows · columns,).

    Raises:
        GeometryError: An array has another shape, or a polygon another image.
    """
    corners = checked("polygons", polygons, (None, None, 2), np.int64)
    image_numbers = np.zeros(len(corners)) if image is None else image
    image_numbers = checked("image", image_numbers, (len(corners),), np.int64)
    if corners.shape[1] < 3:
        raise GeometryError(f"polygons: expected at least 3 corners, found {corners.shape[1]}")
    if len(image_numbers) and not 0 <= image_numbers.min() <= image_numbers.max() < images:
        raise GeometryError(
            f"image: expected numbers from 0 to {images - 1}, "
            f"found {image_numbers.min()} to {image_numbers.max()}"
        )
    first, last, owner = _runs(corners, shape)
    num_cells = math.prod(shape)
    lengths = last - first + 1
    offsets = np.cumsum(lengths) - lengths
    cells = np.repeat(first + image_numbers[owner] * num_cells - offsets, lengths)
    cells += np.arange(len(cells))
    top = np.zeros(images * num_cells, dtype=np.int32)
    np.maximum.at(top, cells, np.repeat((owner + 1).astype(np.int32), lengths))
    return top


def _runs(corners: IntArray, shape: tuple[int, int]) -> tuple[IntArray, IntArray, IntArray]:
    """Return first and last cells of runs that cover the polygons, and each run's polygon.

    Runs may overlap.
    """
    low = corners.min(axis=1)
    high = corners.max(axis=1)
    visible = np.flatnonzero(((high >= 0) & (low < shape[::-1])).all(axis=1))
    corners = corners[visible]
    low = low[visible]
    high = high[visible]
    is_inside = ((low >= 0) & (high < shape[::-1])).all(axis=1)
    is_simple = _are_convex(corners) & is_inside
    row, first, last, line = _outlines(corners, ~is_simple, shape)
    owner = line // corners.shape[1]
    simple_runs = is_simple[owner]
    runs = np.stack([row, first, last, owner])
    complex_polygons = np.flatnonzero(~is_simple)
    *inner_runs, inner_owner = _inner_runs(corners[complex_polygons], shape)
    parts = [
        np.stack(_merged_runs(*runs[:, simple_runs])),
        runs[:, ~simple_runs],
        np.stack([*inner_runs, complex_polygons[inner_owner]]),
    ]
    row, first, last, owner = np.concatenate(parts, axis=1)
    row_start = row * shape[1]
    return row_start + first, row_start + last, visible[owner]


def _merged_runs(
    row: IntArray, first: IntArray, last: IntArray, owner: IntArray
) -> tuple[IntArray, ...]:
    """Merge the runs (R,) of each polygon into one for each row, from first to last column."""
    if not len(row):
        return row, first, last, owner
    low = row.min()
    num_rows = int(row.max() - low) + 1
    slot = owner * num_rows + (row - low)
    num_slots = slot.max() + 1
    begin = np.full(num_slots, first.max() + 1)
    end = np.full(num_slots, -1)
    np.minimum.at(begin, slot, first)
    np.maximum.at(end, slot, last)
    used = np.flatnonzero(end >= 0)
    owner = used // num_rows
    return used - owner * num_rows + low, begin[used], end[used], owner


def _are_convex(corners: IntArray) -> BoolArray:
    """Return which quadrangles have an area and turn in the same direction at all corners.

    False for other polygons: a star may turn like this too.
    """
    if corners.shape[1] != 4:
        return np.zeros(len(corners), dtype=bool)
    edge = corners[:, [1, 2, 3, 0]] - corners
    next_edge = edge[:, [1, 2, 3, 0]]
    turn = edge[..., 0] * next_edge[..., 1] - edge[..., 1] * next_edge[..., 0]
    is_convex: BoolArray = (turn >= 0).all(axis=1) != (turn <= 0).all(axis=1)
    return is_convex


def _outlines(
    corners: IntArray, to_clip: BoolArray, shape: tuple[int, int]
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return the runs of the edges in the image, one for each row that an edge touches.

    Args:
        corners: Corners of the polygons, shape (N, V, 2).
        to_clip: Whether a polygon may leave the image, shape (N,).
        shape: Rows and columns of the image.

    Returns:
        Row, first and last column, and number of the edge among N · V, each of shape (R,).
    """
    start = _previous(corners).reshape(-1, 2)
    end = corners.reshape(-1, 2)
    visible = np.ones(len(start), dtype=bool)
    if to_clip.any():
        clipped = np.repeat(to_clip, corners.shape[1])
        clipped_start = start[clipped]
        clipped_end = end[clipped]
        visible[clipped] = _clip(clipped_start, clipped_end, shape)
        end = end.copy()
        start[clipped], end[clipped] = clipped_start, clipped_end
    lines = _Lines(start, end)
    counts = np.where(visible, lines.rise + 1, 0)
    line = np.repeat(np.arange(len(counts)), counts)
    step = np.arange(len(line)) - np.repeat(np.cumsum(counts) - counts, counts)
    first, last = lines.columns(line, step)
    return lines.y[line] + step * lines.direction[line], first, last, line


def _previous(corners: IntArray) -> IntArray:
    """Return the corner before each corner, the last one before the first, shape (N, V, 2).

    This equals np.roll, which takes five times as long.
    """
    return corners.take(np.arange(-1, corners.shape[1] - 1), axis=1)


class _Lines:
    """Bresenham's lines between cells, from left to right, as LineIterator steps along them.

    Attributes:
        y: Row of the left end, shape (L,).
        rise: Number of rows from the left end to the other end, shape (L,).
        direction: 1 where the rows rise from left to right, otherwise −1, shape (L,).
    """

    def __init__(self, start: IntArray, end: IntArray) -> None:
        """Prepare lines between cells (column, row), each of shape (L, 2)."""
        leftward = end[:, :1] < start[:, :1]
        x1, y1 = np.where(leftward, end, start).T
        x2, y2 = np.where(leftward, start, end).T
        across = x2 - x1
        down = y2 - y1
        self.y = y1
        self.rise = np.abs(down)
        self.direction = np.where(down < 0, -1, 1)
        # After k of the D steps along its longer side a line has made (2 d k + D − 1) // 2 D steps
        # along the other side (d). A steep line has one cell in each row. Where a flat line enters
        # and leaves row j, solved for k.
        level = self.rise == 0
        steep = self.rise > across
        flat_enter = np.where(level, 0, 2 * self.rise - across)
        enter = np.where(steep, self.rise - 1, flat_enter)
        leave = np.where(steep, self.rise - 1, across)
        divisor = np.where(level, 1, 2 * self.rise)
        self._numbers = np.stack([x1, across, enter, leave, divisor]).astype(np.float64)

    def columns(self, line: IntArray, step: IntArray) -> tuple[IntArray, IntArray]:
        """Return first and last columns of lines in row `step`, counted from the left end."""
        x, across, enter, leave, divisor = self._numbers.take(line, axis=1)
        travelled = 2 * across * step
        # Quotients of small whole numbers: rounding moves none past a whole number.
        first = np.maximum(np.floor((travelled + enter) / divisor), 0)
        last = np.minimum(np.floor((travelled + leave) / divisor), across)
        return (x + first).astype(np.int64), (x + last).astype(np.int64)


def _inner_runs(
    corners: IntArray, shape: tuple[int, int]
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return the runs between the edges of polygons in the image.

    Returns:
        Row, first and last column, and number of the polygon, each of shape (R,).
    """
    height, width = shape
    low = np.maximum(corners[..., 1].min(axis=1), 0)
    num_rows = np.minimum(corners[..., 1].max(axis=1), height - 1) - low + 1
    owner = np.repeat(np.arange(len(corners)), num_rows)
    row = np.arange(len(owner)) + np.repeat(low - np.cumsum(num_rows) + num_rows, num_rows)
    start = _previous(corners)
    downward = (start[..., 1] < corners[..., 1])[..., None]
    upper = np.where(downward, start, corners)
    lower = np.where(downward, corners, start)
    distance = (lower[..., 0] - upper[..., 0]) << _FRACTION_BITS
    height_of_edge = np.maximum(lower[..., 1] - upper[..., 1], 1)
    slope = np.sign(distance) * (np.abs(distance) // height_of_edge)  # C++ rounds towards 0
    depth = row[:, None] - upper[owner, :, 1]
    crossing = (upper[owner, :, 0] << _FRACTION_BITS) + depth * slope[owner]
    crossing[(depth < 0) | (row[:, None] >= lower[owner, :, 1])] = _NO_CROSSING
    crossing.sort(axis=1)
    left = crossing[:, 0:-1:2]
    right = crossing[:, 1::2]
    first = np.maximum((left + ((1 << _FRACTION_BITS) - 1)) >> _FRACTION_BITS, 0)
    last = np.where(right < _NO_CROSSING, right >> _FRACTION_BITS, -1)
    last = np.minimum(last, width - 1)
    not_empty = first <= last
    line = np.nonzero(not_empty)[0]
    return row[line], first[not_empty], last[not_empty], owner[line]


def _clip(start: IntArray, end: IntArray, shape: tuple[int, int]) -> BoolArray:
    """Clip lines (L, 2) to the image in place as clipLine does, first to its rows.

    Return which of them touch the image.
    """
    right = shape[1] - 1
    bottom = shape[0] - 1
    visible = _may_cross(start, end, 0, right) & _may_cross(start, end, 1, bottom)
    _clip_end(start, end, 1, bottom, visible)
    _clip_end(end, start, 1, bottom, visible)
    visible &= _may_cross(start, end, 0, right)
    _clip_end(start, end, 0, right, visible)
    _clip_end(end, start, 0, right, visible)
    return visible


def _may_cross(start: IntArray, end: IntArray, axis: int, upper: int) -> BoolArray:
    """Return which lines (L, 2) lie neither entirely before 0 nor entirely after `upper`."""
    ends_after = np.maximum(start[:, axis], end[:, axis]) >= 0
    begins_before: BoolArray = np.minimum(start[:, axis], end[:, axis]) <= upper
    return ends_after & begins_before


def _clip_end(
    moved_end: IntArray, other_end: IntArray, axis: int, upper: int, visible: BoolArray
) -> None:
    """Move one end of visible lines (L, 2) to the range from 0 to `upper` along an axis."""
    edge = np.minimum(np.maximum(moved_end[:, axis], 0), upper)
    beyond = np.flatnonzero(visible & (edge != moved_end[:, axis]))
    if not len(beyond):
        return
    edge = edge[beyond]
    corner = moved_end[beyond]
    offset = other_end[beyond] - corner
    distance = (edge - corner[:, axis]).astype(np.float64)
    share: FloatArray = distance * offset[:, 1 - axis] / offset[:, axis]
    moved_end[beyond, 1 - axis] += share.astype(np.int64)  # C++ rounds towards 0
    moved_end[beyond, axis] = edge
