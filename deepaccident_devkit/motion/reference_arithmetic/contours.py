"""Outlines of instances, the smallest rectangles around them, and instances redrawn as rectangles.

The released code gives `cv2.findContours(mask, …)[0][0]` to `cv2.minAreaRect`. The result depends
on which part of a broken mask that is, and on which corner of the hull comes first. Both rules are
written out here (OpenCV 4.7.0, imgproc: contours.cpp, convhull.cpp), so the result is the same with
every version. Points are (x, y) = (column, row).

`cv2.minAreaRect` changed its angles with OpenCV 4.13, and new angles cannot be converted to old
ones without moving a few of the rasterised cells. Source: OpenCV 4.7.0, imgproc, rotcalipers.cpp:
the side that is tried next is decided in whole numbers, lengths and areas are float32.

The released accident evaluation looks at these rectangles and not at the instances themselves
(docs/released_code.md, Post-processing). All its quirks are reproduced; the masks' rectangles and
the rasterising follow OpenCV 4.7, whatever version is installed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from operator import itemgetter
from typing import Final

import numpy as np

from deepaccident_devkit.motion.reference_arithmetic.polygon_fill import filled_cells
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray

Point = tuple[int, int]

LARGEST_BOX_CELLS: Final = (10, 4)
"""Largest length and width of a box, cells: a truck is rasterised as 5 m × 2 m."""
TURNING_MOVE: Final = 4
"""Distance that an instance must move in a step for its box to turn in that direction, cells."""
# The released code's π.
_PI: Final = 3.1415926
# A rectangle's corners: across and along its long side.
_CORNERS: Final = np.array([[1, -1], [-1, -1], [-1, 1], [1, 1]])
# The turns that make edges at the lowest, rightmost, highest and leftmost corner lie like one at
# the lowest.
_QUARTER_TURNS = np.array(
    [[[1, 0], [0, 1]], [[0, 1], [-1, 0]], [[-1, 0], [0, -1]], [[0, -1], [1, 0]]]
)


def first_contour(rows: IntArray, columns: IntArray, *, one_part: bool = False) -> list[Point]:
    """Return the points where the outer border of a mask's last part turns.

    OpenCV lists this border first. The last part is the 8-connected one, in no hole of another
    part, with the latest first cell. The border starts at this cell and runs down the left side.

    Args:
        rows: Rows of the mask's cells, shape (P,), in row-major order.
        columns: Columns of the mask's cells, shape (P,).
        one_part: Whether the mask certainly has only one part.
    """
    top = int(rows[0])
    left = int(columns.min())
    width = int(columns.max()) - left + 3  # with a margin of one empty cell on all sides
    mask = np.zeros((int(rows[-1]) - top + 3, width), dtype=np.uint8)
    cells = (rows - (top - 1)) * width + (columns - (left - 1))
    mask.reshape(-1)[cells] = 1
    start = int(cells[0]) if one_part else _start_cell(mask, cells)
    border = _follow(mask.tobytes(), width, start)
    return [(cell % width + left - 1, cell // width + top - 1) for cell in border]


def are_one_part(rows: IntArray, columns: IntArray, instance: IntArray, count: int) -> BoolArray:
    """Return whether masks are certainly one part, shape (count,).

    Each row of such a mask has one run of cells, which touches the next row's run.

    Args:
        rows: Rows of the masks' cells, shape (P,), sorted by mask, row, column.
        columns: Columns of the cells, shape (P,).
        instance: Number of each cell's mask from 0, shape (P,).
        count: Number of masks.
    """
    if not count:
        return np.ones(0, dtype=bool)
    same_mask = np.diff(instance) == 0
    breaks = np.flatnonzero(~same_mask | (np.diff(rows) != 0) | (np.diff(columns) != 1))
    first = np.append(0, breaks + 1)
    last = np.append(breaks, len(rows) - 1)
    next_first = first[1:]
    touches = (np.diff(rows[first]) == 1) & (columns[next_first] <= columns[last[:-1]] + 1)
    touches &= columns[last[1:]] >= columns[first[:-1]] - 1
    continues = instance[next_first] == instance[last[:-1]]
    broken = instance[next_first][~touches & continues]
    is_one_part = np.ones(count, dtype=bool)
    is_one_part[broken] = False
    return is_one_part


def _start_cell(mask: AnyArray, cells: IntArray) -> int:
    """Return the cell that the border starts from."""
    from scipy.ndimage import label

    parts, count = label(mask, np.ones((3, 3)))
    if count == 1:
        return int(cells[0])
    _, first_positions = np.unique(parts.reshape(-1)[cells], return_index=True)
    first_cells = cells[first_positions]
    background = label(mask == 0)[0].reshape(-1)
    not_in_hole = background[first_cells - 1] == background[0]
    return int(first_cells[not_in_hole].max())


def _follow(mask: bytes, width: int, start: int) -> list[int]:
    """Return the cells where the border of a part turns, counter-clockwise (Suzuki and Abe).

    `start` is the part's first cell.
    """
    # From the right, counter-clockwise.
    neighbours = (1, 1 - width, -width, -width - 1, -1, width - 1, width, width + 1)
    turns = neighbours + neighbours
    back = next((turn for turn in (3, 2, 1, 0, 7, 6, 5) if mask[start + neighbours[turn]]), None)
    if back is None:
        return [start]
    last = start + neighbours[back]
    cell = start
    border = []
    while True:
        turn = back + 1
        while not mask[cell + turns[turn]]:
            turn += 1
        if (turn - back) % 8 != 4:
            border.append(cell)
        next_cell = cell + turns[turn]
        if next_cell == start and cell == last:
            return border
        cell = next_cell
        back = (turn + 4) % 8


def convex_hull(contour: list[Point]) -> list[Point]:
    """Return the corners of the convex hull as OpenCV lists them.

    They turn from the x axis towards the y axis. The list starts at the rightmost corner. But if
    the corners' positions in the contour fall (or rise) along the list with only one jump, it
    starts at the jump.
    """
    first = {point: position for position, point in reversed(list(enumerate(contour)))}
    last = {point: position for position, point in enumerate(contour)}
    points = sorted(first)
    if len(points) == 1:
        return points
    lowest = min(points, key=itemgetter(1))
    highest = max(points, key=itemgetter(1))
    down = _half_hull(points[::-1])
    up = _half_hull(points)
    hull = down + up
    # A thin part's contour passes a corner twice. OpenCV's order of work decides which of the two
    # positions counts: the last one at the rightmost corner and between the leftmost one and the
    # highest or lowest, otherwise the first one.
    after_highest = down.index(highest) + 1 if highest in down else len(down)
    before_lowest = up.index(lowest) if lowest in up else len(up)
    passed_later = {*down[:1], *down[after_highest:], *up[1:before_lowest]} - {highest}
    positions = [(last if corner in passed_later else first)[corner] for corner in hull]
    start = _first_corner(positions)
    return hull[start:] + hull[:start]


def _half_hull(points: list[Point]) -> list[Point]:
    """Return half of a convex hull: from the first sorted point to the last but one."""
    chain: list[Point] = []
    for x, y in points:
        while len(chain) > 1:
            (ax, ay), (bx, by) = chain[-2], chain[-1]
            if (bx - ax) * (y - ay) > (by - ay) * (x - ax):
                break
            chain.pop()
        chain.append((x, y))
    return chain[:-1]


def _first_corner(positions: list[int]) -> int:
    """Return the corner that OpenCV lists first, by the corners' positions in the contour."""
    count = len(positions)
    if count < 3:
        return 0
    rises = sum(second > first for first, second in pairwise(positions))
    low = positions.index(min(positions))
    high = positions.index(max(positions))
    if abs(high - low) not in {1, count - 1} or 1 < rises < count - 2:
        return 0
    rising = (high + 1) % count == low
    start = low if rising else high
    turned = positions[start:] + positions[:start]
    monotonic = all((second > first) == rising for first, second in pairwise(turned))
    return start if monotonic else 0


def min_area_rects(hulls: Sequence[Sequence[Point]]) -> tuple[AnyArray, AnyArray]:
    """Return the smallest rectangles around N hulls of `convex_hull`.

    Returns:
        Widths and heights, shape (N, 2), float32; and angles of the widths, shape (N,), float32,
        degrees from x towards y.
    """
    size = np.zeros((len(hulls), 2), dtype=np.float32)
    side = np.zeros((len(hulls), 2))
    num_corners = np.array([len(hull) for hull in hulls], dtype=np.int64)
    for index in np.flatnonzero(num_corners == 2).tolist():
        side[index] = np.subtract(hulls[index][1], hulls[index][0])
        size[index, 0] = np.sqrt((side[index] ** 2).sum())
    broad = np.flatnonzero(num_corners > 2).tolist()
    if broad:
        max_corners = num_corners[broad].max()
        padded_hulls = []
        for index in broad:
            hull = hulls[index]
            padded_hulls.append([*hull, *[hull[0]] * (max_corners - num_corners[index])])
        width, height = _rectangles(np.array(padded_hulls), num_corners[broad])
        sides = np.stack([width, height], axis=1).astype(np.float64)
        side[broad] = width
        size[broad] = np.sqrt((sides**2).sum(axis=-1))
    angle = np.arctan2(side[:, 1], side[:, 0]).astype(np.float32)
    degrees = (angle * np.float32(180)).astype(np.float64) / np.pi
    return size, degrees.astype(np.float32)


def _rectangles(points: IntArray, num_corners: IntArray) -> tuple[AnyArray, AnyArray]:
    """Return both sides of the smallest rectangles around hulls, each of shape (N, 2), float32.

    Args:
        points: Corners of the hulls, shape (N, C, 2), with padding.
        num_corners: Number of corners of each hull that count, shape (N,).
    """
    hull = np.arange(len(points))
    next_corner = (np.arange(points.shape[1]) + 1) % num_corners[:, None]
    edges = points[hull[:, None], next_corner] - points
    touching, leading, turned = _rotate(points, edges, num_corners)
    lengths = np.sqrt((edges.astype(np.float64) ** 2).sum(axis=-1))
    edge = edges[hull, leading].astype(np.float32)
    unit = edge * (1 / lengths[hull, leading]).astype(np.float32)[..., None]
    turned_units = [unit, _swapped(unit, 1, -1), -unit, _swapped(unit, -1, 1)]
    base = np.choose(turned[..., None], turned_units)
    a = base[..., 0]
    b = base[..., 1]
    x, y = np.moveaxis(points[hull[:, None], touching].astype(np.float32), -1, 0)
    width_x = x[..., 1] - x[..., 3]
    width_y = y[..., 1] - y[..., 3]
    height_x = x[..., 2] - x[..., 0]
    height_y = y[..., 2] - y[..., 0]
    width = width_x * a + width_y * b
    height = -height_x * b + height_y * a
    area = np.where(np.arange(len(a))[:, None] < num_corners, width * height, np.inf)
    best = len(area) - 1 - area[::-1].argmin(axis=0)  # the last of equal ones
    a, b, width, height = (values[best, hull] for values in (a, b, width, height))
    width_side = np.stack([a * width, b * width], axis=1)
    height_side = np.stack([-b * height, a * height], axis=1)
    return width_side, height_side


def _rotate(
    points: IntArray, edges: IntArray, num_corners: IntArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Turn four lines around all hulls at once, from edge to edge.

    Args:
        points: Corners of the hulls, shape (N, C, 2), with padding.
        edges: Offsets from each corner to the next, shape (N, C, 2).
        num_corners: Number of corners of each hull that count, shape (N,).

    Returns:
        For each step, the corners that the lines touch after it, shape (C, N, 4); the edge that one
        of the lines came to lie on, shape (C, N); and the number of that line, shape (C, N): 0 at
        the lowest corner, then 1 right, 2 highest, 3 left.
    """
    hull = np.arange(len(points))
    x = points[..., 0]
    y = points[..., 1]
    extremes = [y.argmin(axis=1), x.argmax(axis=1), y.argmax(axis=1), x.argmin(axis=1)]
    touching = np.stack(extremes, axis=1)
    turned_edges = np.einsum("lij,ncj->lnci", _QUARTER_TURNS, edges)
    steps, leading, turned = [], [], []
    for _ in range(points.shape[1]):
        x, y = np.moveaxis(turned_edges[np.arange(4), hull[:, None], touching], -1, 0)
        line = np.zeros(len(points), dtype=np.int64)
        for other in range(1, 4):
            line[y[:, other] * x[hull, line] < x[:, other] * y[hull, line]] = other
        edge = touching[hull, line]
        leading.append(edge)
        turned.append(line)
        touching = touching.copy()
        touching[hull, line] = (edge + 1) % num_corners
        steps.append(touching)
    return np.stack(steps), np.stack(leading), np.stack(turned)


def _swapped(vectors: AnyArray, first_sign: int, second_sign: int) -> AnyArray:
    """Return vectors (…, 2) with both components exchanged and signed."""
    return vectors[..., ::-1] * np.array([first_sign, second_sign], dtype=np.float32)


def redrawn_cells(
    hulls: Sequence[Sequence[Point]], centers: FloatArray, exists: BoolArray, shape: tuple[int, int]
) -> tuple[list[IntArray], list[IntArray]]:
    """Return the cells of boxes of the first frame's instances, redrawn in all frames.

    An instance's first box has the length, width and angle of the smallest rectangle around its
    (last) part in the first frame; later boxes turn towards the instance's movement if it was far
    enough. Boxes are rasterised in consecutive frames from the first on, as many as the instance is
    in: after a gap they are in the wrong frames. Later ids overwrite earlier ones.

    Args:
        hulls: Hulls of instances 1 to I, as `first_hulls` returns them.
        centers: Rows and columns of the instances' means, shape (I, T, 2).
        exists: Whether each instance is in each frame, shape (I, T).
        shape: Rows and columns of the map.

    Returns:
        For each frame, rows and columns of the cells, shape (2, P), and their ids, shape (P,).
    """
    num_instances, num_frames = exists.shape
    if not num_instances:
        no_cells = np.zeros((2, 0), dtype=np.int64)
        return [no_cells] * num_frames, [no_cells[0]] * num_frames
    size, angle = _first_boxes(hulls)
    instance, frame = np.nonzero(exists)
    step = (np.cumsum(exists, axis=1) - 1)[instance, frame]
    path = np.zeros((num_instances, num_frames, 2))
    path[instance, step] = centers[instance, frame]
    heading = _headings(path, angle)[instance, step]
    half_size = np.maximum(np.rint(np.minimum(size, LARGEST_BOX_CELLS) / 2 + 0.001), 1)[instance]
    corners = np.rint(_corners(path[instance, step], half_size, heading)).astype(np.int64)
    corners = np.clip(corners, 0, (shape[1] - 1, shape[0] - 1))
    cells, box = filled_cells(corners, shape, step, num_frames)
    image, *position = np.unravel_index(cells, (num_frames, *shape))
    ends = np.searchsorted(image, np.arange(1, num_frames))
    return np.split(np.stack(position), ends, axis=1), np.split(instance[box] + 1, ends)


def first_hulls(position: IntArray, ids: IntArray, instances: int) -> list[list[Point]]:
    """Return the convex hulls, (x, y), of instances 1 to I: of the part that OpenCV lists first.

    Args:
        position: Rows and columns of cells in row-major order, shape (2, P).
        ids: Instance of each cell, shape (P,); 0 is background.
        instances: Number of instances I.
    """
    order = np.argsort(ids, kind="stable")[np.count_nonzero(ids == 0) :]
    owner, (rows, columns) = ids[order], position[:, order]
    ends = np.searchsorted(owner, np.arange(1, instances + 2)).tolist()
    is_one_part = are_one_part(rows, columns, owner - 1, instances).tolist()
    hulls = []
    for (start, end), one_part in zip(pairwise(ends), is_one_part, strict=True):
        contour = first_contour(rows[start:end], columns[start:end], one_part=one_part)
        hulls.append(convex_hull(contour))
    return hulls


def _first_boxes(hulls: Sequence[Sequence[Point]]) -> tuple[FloatArray, FloatArray]:
    """Return the size and angle of the smallest rectangles around hulls.

    Returns:
        Lengths and widths, shape (I, 2), cells; and angles, shape (I,), radians.
    """
    sides, angles = (values.astype(np.float64) for values in min_area_rects(hulls))
    upright = sides[:, 1] > sides[:, 0]
    angle = np.where(upright, -angles, 270 - angles) / 180 * _PI
    return np.where(upright[:, None], sides[:, ::-1], sides), angle


def _headings(path: FloatArray, angle: FloatArray) -> FloatArray:
    """Return the angles of the boxes at each step of their paths, shape (I, T).

    The first is `angle`, later ones are the direction of the latest step that was far enough.

    Args:
        path: Rows and columns of the centres, shape (I, T, 2).
        angle: Angles of the first boxes, shape (I,).
    """
    moves = np.diff(np.rint(path), axis=1)
    turns = (moves**2).sum(axis=-1) >= TURNING_MOVE**2
    headings = np.zeros(path.shape[:2])
    headings[:, 0] = angle
    # The math module's functions give the same bits with every numpy.
    headings[:, 1:][turns] = [math.atan2(across, down) for down, across in moves[turns].tolist()]
    has_heading = np.concatenate([np.ones((len(path), 1), dtype=bool), turns], axis=1)
    steps = np.where(has_heading, np.arange(path.shape[1]), 0)
    latest: IntArray = np.maximum.accumulate(steps, axis=1)
    return np.take_along_axis(headings, latest, axis=1)


def _corners(centers: FloatArray, half_size: FloatArray, angle: FloatArray) -> FloatArray:
    """Return columns and rows of the corners of boxes, shape (N, 4, 2).

    Args:
        centers: Rows and columns of the centres, shape (N, 2).
        half_size: Half lengths and half widths, shape (N, 2).
        angle: Angles, shape (N,), radians.
    """
    angles = angle.tolist()
    cosine = np.array([math.cos(value) for value in angles])[:, None]
    sine = np.array([math.sin(value) for value in angles])[:, None]
    across, along = np.moveaxis(_CORNERS * half_size[:, None, ::-1], -1, 0)
    column = cosine * across + sine * along + centers[:, 1:]
    row = -sine * across + cosine * along + centers[:, :1]
    return np.stack([column, row], axis=-1)
