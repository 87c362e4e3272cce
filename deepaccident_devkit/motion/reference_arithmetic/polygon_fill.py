"""Fill many polygons at a time as OpenCV 4.7's fillPoly does, whatever OpenCV is installed.

Labels are rasterised by `cv2.fillPoly` (8-connected, whole-cell corners), and what it rasterises
changed with OpenCV 4.8 (the interior of small polygons) and 4.11 (at the image's border). The
released labels follow 4.7, so its rule is written out here: the outline as clipped Bresenham
lines, and in each row all cells from the first one at or right of the left edge to the last one at
or left of the right edge, in fixed point with 16 binary digits. Source: OpenCV 4.7.0, imgproc,
drawing.cpp: clipLine, LineIterator, CollectPolyEdges and FillEdgeCollection.

In a convex polygon inside the image, the cells between the edges of a row only fill the gap between
the outlines: the outline's ends are enough. All other polygons go through the full rule.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray, checked

# Binary digits after the point, for the column where an edge crosses a row.
_FRACTION_BITS = 16
# Column of an edge that does not reach a row: it comes after all others.
_NO_CROSSING = np.int64(1) << 62


def filled_cells(
    polygons: ArrayLike, shape: tuple[int, int], image: ArrayLike | None = None, images: int = 1
) -> tuple[IntArray, IntArray]:
    """Return the cells that polygons cover, for the same arguments as `topmost`.

    Returns:
        Ascending flat indices of covered cells, shape (P,), and the index of each cell's topmost
        polygon, shape (P,).
    """
    top = topmost(polygons, shape, image, images)
    covered = np.flatnonzero(top != 0)  # of bools: twice as fast
    return covered, top[covered] - np.int64(1)


def topmost(
    polygons: ArrayLike, shape: tuple[int, int], image: ArrayLike | None = None, images: int = 1
) -> NDArray[np.int32]:
    """Return 1 + the index of the last polygon that covers each cell, 0 where there is none.

    Args:
        polygons: Columns and rows of V ≥ 3 whole corners in either direction, shape (N, V, 2). They
            may lie outside the image, coincide or cross.
        shape: Rows and columns of an image.
        image: Index of the image that each polygon is drawn into, shape (N,); if None, all are
            drawn into the first image.
        images: Number of images.

    Returns:
        Numbers, shape (images · rows · columns,).

    Raises:
        GeometryError: An array has a wrong shape, or an image number is out of range.
    """
    corners = checked("polygons", polygons, (None, None, 2), np.int64)
    if image is None:
        image = np.zeros(len(corners))
    image_numbers = checked("image", image, (len(corners),), np.int64)
    if corners.shape[1] < 3:
        raise GeometryError(f"polygons: expected at least 3 corners, found {corners.shape[1]}")
    if len(image_numbers) and not 0 <= image_numbers.min() <= image_numbers.max() < images:
        raise GeometryError(
            f"image: expected numbers from 0 to {images - 1}, "
            f"found {image_numbers.min()} to {image_numbers.max()}"
        )
    first, last, owner = _find_runs(corners, shape)
    num_cells = math.prod(shape)
    lengths = last - first + 1
    offsets = np.cumsum(lengths) - lengths
    first_cells = first + image_numbers[owner] * num_cells
    cells = np.repeat(first_cells - offsets, lengths)
    cells += np.arange(len(cells))
    top = np.zeros(images * num_cells, dtype=np.int32)
    polygon_numbers = (owner + 1).astype(np.int32)
    np.maximum.at(top, cells, np.repeat(polygon_numbers, lengths))
    return top


def _find_runs(corners: IntArray, shape: tuple[int, int]) -> tuple[IntArray, IntArray, IntArray]:
    """Return the first and last cell of the runs that cover the polygons, and each run's polygon.

    Runs may overlap.
    """
    low = corners.min(axis=1)
    high = corners.max(axis=1)
    is_visible = ((high >= 0) & (low < shape[::-1])).all(axis=1)
    visible = np.flatnonzero(is_visible)
    corners = corners[visible]
    low = low[visible]
    high = high[visible]
    is_inside = ((low >= 0) & (high < shape[::-1])).all(axis=1)
    is_simple = _are_convex(corners) & is_inside
    row, first, last, line = _trace_outlines(corners, ~is_simple, shape)
    owner = line // corners.shape[1]
    is_simple_run = is_simple[owner]
    runs = np.stack([row, first, last, owner])
    simple_runs = np.stack(_merge_runs(*runs[:, is_simple_run]))
    complex_polygons = np.flatnonzero(~is_simple)
    *inner_runs, inner_owner = _fill_inside(corners[complex_polygons], shape)
    complex_runs = np.stack([*inner_runs, complex_polygons[inner_owner]])
    all_runs = [simple_runs, runs[:, ~is_simple_run], complex_runs]
    row, first, last, owner = np.concatenate(all_runs, axis=1)
    row_start = row * shape[1]
    return row_start + first, row_start + last, visible[owner]


def _merge_runs(
    row: IntArray, first: IntArray, last: IntArray, owner: IntArray
) -> tuple[IntArray, ...]:
    """Merge each polygon's runs (R,) into one run per row, from its first to its last column."""
    if not len(row):
        return row, first, last, owner
    low = row.min()
    num_rows = int(row.max() - low) + 1
    # Each slot is one row of one polygon.
    slot = owner * num_rows + (row - low)
    num_slots = slot.max() + 1
    begin = np.full(num_slots, first.max() + 1)
    end = np.full(num_slots, -1)
    np.minimum.at(begin, slot, first)
    np.maximum.at(end, slot, last)
    used = np.flatnonzero(end >= 0)
    used_owner, used_row = np.divmod(used, num_rows)
    return used_row + low, begin[used], end[used], used_owner


def _are_convex(corners: IntArray) -> BoolArray:
    """Return whether each quadrangle has an area and turns in the same direction at all corners.

    The result is False for polygons with more corners, since a star can turn like this too.
    """
    if corners.shape[1] != 4:
        return np.zeros(len(corners), dtype=bool)
    next_corner = [1, 2, 3, 0]
    edge = corners[:, next_corner] - corners
    x, y = np.moveaxis(edge, -1, 0)
    turn = x * y[:, next_corner] - y * x[:, next_corner]
    never_right = (turn >= 0).all(axis=1)
    never_left = (turn <= 0).all(axis=1)
    is_convex: BoolArray = never_right != never_left
    return is_convex


def _trace_outlines(
    corners: IntArray, to_clip: BoolArray, shape: tuple[int, int]
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return the runs of the edges inside the image, one for each row that an edge touches.

    Args:
        corners: Corners of the polygons, shape (N, V, 2).
        to_clip: Whether a polygon may leave the image, shape (N,).
        shape: Rows and columns of the image.

    Returns:
        Row, first and last column, and index of the edge (of N · V), each of shape (R,).
    """
    start = _shift_corners(corners).reshape(-1, 2)
    end = corners.reshape(-1, 2)
    visible = np.ones(len(start), dtype=bool)
    if to_clip.any():
        clipped = np.repeat(to_clip, corners.shape[1])
        clipped_start = start[clipped]
        clipped_end = end[clipped]
        visible[clipped] = _clip(clipped_start, clipped_end, shape)
        end = end.copy()
        start[clipped] = clipped_start
        end[clipped] = clipped_end
    lines = _Lines(start, end)
    counts = np.where(visible, lines.rise + 1, 0)
    line = np.repeat(np.arange(len(counts)), counts)
    begins = np.cumsum(counts) - counts
    step = np.arange(len(line)) - np.repeat(begins, counts)
    first, last = lines.columns(line, step)
    row = lines.y[line] + step * lines.direction[line]
    return row, first, last, line


def _shift_corners(corners: IntArray) -> IntArray:
    """Return the corner before each corner, the last one before the first, shape (N, V, 2).

    Equal to np.roll, which takes five times as long.
    """
    previous = np.arange(-1, corners.shape[1] - 1)
    return corners.take(previous, axis=1)


class _Lines:
    """Bresenham's lines between cells, from left to right, as LineIterator steps along them.

    Attributes:
        y: Row of the left end, shape (L,).
        rise: Number of rows from the left end to the other end, shape (L,).
        direction: 1 where the row number increases from left to right, otherwise −1, shape (L,).
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
        # along the other side (d). A steep line has one cell in each row. For a flat line the
        # equation is solved for the k at which the line enters and leaves row j.
        level = self.rise == 0
        steep = self.rise > across
        flat_enter = np.where(level, 0, 2 * self.rise - across)
        enter = np.where(steep, self.rise - 1, flat_enter)
        leave = np.where(steep, self.rise - 1, across)
        divisor = np.where(level, 1, 2 * self.rise)
        self._numbers = np.stack([x1, across, enter, leave, divisor]).astype(np.float64)

    def columns(self, line: IntArray, step: IntArray) -> tuple[IntArray, IntArray]:
        """Return each line's first and last column in row `step`, counted from its left end."""
        x, across, enter, leave, divisor = self._numbers.take(line, axis=1)
        travelled = 2 * across * step
        # These are quotients of small integers: rounding never carries one past an integer.
        first = np.maximum(np.floor((travelled + enter) / divisor), 0)
        last = np.minimum(np.floor((travelled + leave) / divisor), across)
        return (x + first).astype(np.int64), (x + last).astype(np.int64)


def _fill_inside(
    corners: IntArray, shape: tuple[int, int]
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return the runs between the edges of polygons inside the image.

    Returns:
        Row, first and last column, and index of the polygon, each of shape (R,).
    """
    height, width = shape
    corner_rows = corners[..., 1]
    low = np.maximum(corner_rows.min(axis=1), 0)
    high = np.minimum(corner_rows.max(axis=1), height - 1)
    num_rows = high - low + 1
    owner = np.repeat(np.arange(len(corners)), num_rows)
    begins = np.cumsum(num_rows) - num_rows
    row = np.arange(len(owner)) + np.repeat(low - begins, num_rows)
    start = _shift_corners(corners)
    is_downward = (start[..., 1] < corner_rows)[..., None]
    upper_x, upper_y = np.moveaxis(np.where(is_downward, start, corners), -1, 0)
    lower_x, lower_y = np.moveaxis(np.where(is_downward, corners, start), -1, 0)
    distance = (lower_x - upper_x) << _FRACTION_BITS
    edge_height = np.maximum(lower_y - upper_y, 1)
    slope = np.sign(distance) * (np.abs(distance) // edge_height)  # C++ rounds towards 0
    depth = row[:, None] - upper_y[owner]
    crossing = (upper_x[owner] << _FRACTION_BITS) + depth * slope[owner]
    is_missed = (depth < 0) | (row[:, None] >= lower_y[owner])
    crossing[is_missed] = _NO_CROSSING
    crossing.sort(axis=1)
    left = crossing[:, 0:-1:2]
    right = crossing[:, 1::2]
    almost_one = (1 << _FRACTION_BITS) - 1
    first = np.maximum((left + almost_one) >> _FRACTION_BITS, 0)
    last = np.where(right < _NO_CROSSING, right >> _FRACTION_BITS, -1)
    last = np.minimum(last, width - 1)
    has_cells = first <= last
    run, _ = np.nonzero(has_cells)
    return row[run], first[has_cells], last[has_cells], owner[run]


def _clip(start: IntArray, end: IntArray, shape: tuple[int, int]) -> BoolArray:
    """Clip lines (L, 2) to the image in place, as clipLine does: first to its rows.

    Return whether each line touches the image.
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
    """Return whether each line (L, 2) lies neither entirely before 0 nor entirely after `upper`."""
    first = start[:, axis]
    last = end[:, axis]
    ends_after: BoolArray = np.maximum(first, last) >= 0
    begins_before = np.minimum(first, last) <= upper
    return ends_after & begins_before


def _clip_end(
    moved_end: IntArray, other_end: IntArray, axis: int, upper: int, visible: BoolArray
) -> None:
    """Move one end of visible lines (L, 2) into the range from 0 to `upper` along an axis."""
    edge = np.clip(moved_end[:, axis], 0, upper)
    beyond = np.flatnonzero(visible & (edge != moved_end[:, axis]))
    if not len(beyond):
        return
    edge = edge[beyond]
    corner = moved_end[beyond]
    offset = other_end[beyond] - corner
    other_axis = 1 - axis
    distance = (edge - corner[:, axis]).astype(np.float64)
    shift: FloatArray = distance * offset[:, other_axis] / offset[:, axis]
    moved_end[beyond, other_axis] += shift.astype(np.int64)  # C++ rounds towards 0
    moved_end[beyond, axis] = edge
