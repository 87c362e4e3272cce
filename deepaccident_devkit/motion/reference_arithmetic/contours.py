"""Outlines of instances, the smallest rectangles around them, and instances redrawn as rectangles.

The released code gives `cv2.findContours(mask, …)[0][0]` to `cv2.minAreaRect`. The result depends
on which part of a broken mask OpenCV lists first, and on which corner of the hull comes first. Both
rules are written out here (OpenCV 4.7.0, imgproc: contours.cpp, convhull.cpp), so the result does
not depend on the installed version. Points are (x, y) = (column, row).

OpenCV 4.13 changed the angles of `cv2.minAreaRect`, and new angles cannot be converted to old ones
without moving a few rasterised cells. Source: OpenCV 4.7.0, imgproc, rotcalipers.cpp. The side that
is tried next is decided in integers; lengths and areas are float32.

The released accident evaluation uses these rectangles instead of the instances themselves
(docs/released_code.md, Post-processing). All its quirks are reproduced.
"""

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
"""Distance that an instance must move in one step for its box to turn to that direction, cells."""
# The released code's π.
_PI = 3.1415926
# A rectangle's corners across and along its long side, in half widths and half lengths.
_CORNERS = np.array([[1, -1], [-1, -1], [-1, 1], [1, 1]])
# Rotations of the edges at the lowest, rightmost, highest and leftmost corner, after which they
# are compared as if all were at the lowest one.
_QUARTER_TURNS = np.array(
    [[[1, 0], [0, 1]], [[0, 1], [-1, 0]], [[-1, 0], [0, -1]], [[0, -1], [1, 0]]]
)


def first_contour(rows: IntArray, columns: IntArray, *, one_part: bool = False) -> list[Point]:
    """Return the points where the outer border of a mask's last connected part turns.

    OpenCV lists this border first. Parts are 8-connected, and parts inside a hole of another part
    are ignored. The last part is the one whose first cell comes last in row-major order. The border
    starts at that cell and runs down the left side.

    Args:
        rows: Rows of the mask's cells, shape (P,), in row-major order.
        columns: Columns of the mask's cells, shape (P,).
        one_part: Whether the mask certainly has only one part.
    """
    # The mask has a margin of one empty cell on all sides.
    top = int(rows[0]) - 1
    left = int(columns.min()) - 1
    height = int(rows[-1]) - top + 2
    width = int(columns.max()) - left + 2
    mask = np.zeros((height, width), dtype=np.uint8)
    cells = (rows - top) * width + (columns - left)
    mask.reshape(-1)[cells] = 1
    start = int(cells[0])
    if not one_part:
        start = _find_start_cell(mask, cells)
    contour = []
    for cell in _follow_border(mask.tobytes(), width, start):
        row, column = divmod(cell, width)
        contour.append((column + left, row + top))
    return contour


def are_one_part(rows: IntArray, columns: IntArray, instance: IntArray, count: int) -> BoolArray:
    """Return whether each mask certainly has only one part, shape (count,).

    Each row of such a mask has one run of cells, which touches the next row's run.

    Args:
        rows: Rows of the masks' cells, shape (P,), sorted by mask, row, column.
        columns: Columns of the cells, shape (P,).
        instance: Index of each cell's mask, shape (P,).
        count: Number of masks.
    """
    if not count:
        return np.ones(0, dtype=bool)
    is_break = np.diff(instance) != 0
    is_break |= np.diff(rows) != 0
    is_break |= np.diff(columns) != 1
    breaks = np.flatnonzero(is_break)
    first = np.append(0, breaks + 1)
    last = np.append(breaks, len(rows) - 1)
    mask = instance[first]
    left = columns[first]
    right = columns[last]
    touches_next = np.diff(rows[first]) == 1
    touches_next &= left[1:] <= right[:-1] + 1
    touches_next &= right[1:] >= left[:-1] - 1
    continues = np.diff(mask) == 0
    broken_masks = mask[1:][~touches_next & continues]
    is_one_part = np.ones(count, dtype=bool)
    is_one_part[broken_masks] = False
    return is_one_part


def _find_start_cell(mask: AnyArray, cells: IntArray) -> int:
    """Return the index of the first cell of the mask's last part, where the border starts."""
    from scipy.ndimage import label

    part_map, count = label(mask, np.ones((3, 3)))
    if count == 1:
        return int(cells[0])
    cell_parts = part_map.reshape(-1)[cells]
    _, first_positions = np.unique(cell_parts, return_index=True)
    first_cells = cells[first_positions]
    background_parts, _ = label(mask == 0)
    background = background_parts.reshape(-1)
    outside_part = background[0]
    is_outside = background[first_cells - 1] == outside_part
    return int(first_cells[is_outside].max())


def _follow_border(mask: bytes, width: int, start: int) -> list[int]:
    """Return the cells where the border of a part turns, counter-clockwise (Suzuki and Abe).

    `start` is the part's first cell.
    """
    # From the right, counter-clockwise.
    neighbours = (1, 1 - width, -width, -width - 1, -1, width - 1, width, width + 1)
    turns = neighbours + neighbours
    backs = [turn for turn in (3, 2, 1, 0, 7, 6, 5) if mask[start + neighbours[turn]]]
    if not backs:
        return [start]
    back = backs[0]
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

    The corners run from the x axis towards the y axis. The list starts at the rightmost corner,
    unless the corners' positions in the contour decrease (or increase) along the list with only one
    jump: then it starts at the jump.
    """
    first: dict[Point, int] = {}
    last = {}
    for position, point in enumerate(contour):
        first.setdefault(point, position)
        last[point] = position
    points = sorted(first)
    if len(points) == 1:
        return points
    lowest = min(points, key=itemgetter(1))
    highest = max(points, key=itemgetter(1))
    down = _find_half_hull(points[::-1])
    up = _find_half_hull(points)
    hull = down + up
    # A thin part's contour passes a corner twice. OpenCV's order of processing decides which of
    # the two positions counts: the last one at the rightmost corner and between the leftmost one
    # and the highest or lowest, otherwise the first one.
    after_highest = len(down)
    if highest in down:
        after_highest = down.index(highest) + 1
    before_lowest = len(up)
    if lowest in up:
        before_lowest = up.index(lowest)
    passed_later = {*down[:1], *down[after_highest:], *up[1:before_lowest]}
    passed_later.discard(highest)
    positions = []
    for corner in hull:
        if corner in passed_later:
            positions.append(last[corner])
        else:
            positions.append(first[corner])
    start = _find_first_corner(positions)
    return hull[start:] + hull[:start]


def _find_half_hull(points: list[Point]) -> list[Point]:
    """Return half of a convex hull: from the first sorted point to the last but one."""
    chain: list[Point] = []
    for x, y in points:
        while len(chain) > 1:
            start_x, start_y = chain[-2]
            last_x, last_y = chain[-1]
            if (last_x - start_x) * (y - start_y) > (last_y - start_y) * (x - start_x):
                break
            chain.pop()
        chain.append((x, y))
    return chain[:-1]


def _find_first_corner(positions: list[int]) -> int:
    """Return the corner that OpenCV lists first, by the corners' positions in the contour."""
    count = len(positions)
    if count < 3:
        return 0
    rises = sum(second > first for first, second in pairwise(positions))
    low = positions.index(min(positions))
    high = positions.index(max(positions))
    if abs(high - low) not in {1, count - 1} or 1 < rises < count - 2:
        return 0
    is_rising = (high + 1) % count == low
    start = low if is_rising else high
    turned = positions[start:] + positions[:start]
    for first, second in pairwise(turned):
        if (second > first) != is_rising:
            return 0
    return start


def min_area_rects(hulls: Sequence[Sequence[Point]]) -> tuple[AnyArray, AnyArray]:
    """Return the smallest rectangles around N hulls that `convex_hull` returned.

    Returns:
        Widths and heights, shape (N, 2), float32, cells; and the angles of the width sides, shape
        (N,), float32, degrees from x towards y.
    """
    size = np.zeros((len(hulls), 2), dtype=np.float32)
    width_side = np.zeros((len(hulls), 2))
    num_corners = np.array([len(hull) for hull in hulls], dtype=np.int64)
    for index in np.flatnonzero(num_corners == 2).tolist():
        start, end = hulls[index]
        width_side[index] = np.subtract(end, start)
        size[index, 0] = np.sqrt((width_side[index] ** 2).sum())
    broad = np.flatnonzero(num_corners > 2).tolist()
    if broad:
        max_corners = num_corners[broad].max()
        padded_hulls = []
        for index in broad:
            hull = hulls[index]
            padding = [hull[0]] * (max_corners - len(hull))
            padded_hulls.append([*hull, *padding])
        width, height = _find_rectangle_sides(np.array(padded_hulls), num_corners[broad])
        sides = np.stack([width, height], axis=1).astype(np.float64)
        width_side[broad] = width
        size[broad] = np.sqrt((sides**2).sum(axis=-1))
    angle = np.arctan2(width_side[:, 1], width_side[:, 0]).astype(np.float32)
    degrees = (angle * np.float32(180)).astype(np.float64) / np.pi
    return size, degrees.astype(np.float32)


def _find_rectangle_sides(points: IntArray, num_corners: IntArray) -> tuple[AnyArray, AnyArray]:
    """Return both side vectors of the smallest rectangles around hulls, each (N, 2), float32.

    Args:
        points: Corners of the hulls, shape (N, C, 2), with padding.
        num_corners: Number of each hull's corners that are not padding, shape (N,).
    """
    num_hulls, max_corners, _ = points.shape
    hull = np.arange(num_hulls)
    next_corner = (np.arange(max_corners) + 1) % num_corners[:, None]
    edges = points[hull[:, None], next_corner] - points
    touching, leading, line = _rotate_lines(points, edges, num_corners)
    lengths = np.sqrt((edges.astype(np.float64) ** 2).sum(axis=-1))
    inverse_length = (1 / lengths[hull, leading]).astype(np.float32)
    edge = edges[hull, leading].astype(np.float32)
    edge_x, edge_y = np.moveaxis(edge * inverse_length[..., None], -1, 0)
    # The width has the direction of the edge, after one quarter turn for each line before this one.
    a = np.choose(line, [edge_x, edge_y, -edge_x, -edge_y])
    b = np.choose(line, [edge_y, -edge_x, -edge_y, edge_x])
    touched_points = points[hull[:, None], touching].astype(np.float32)
    lowest, rightmost, highest, leftmost = np.moveaxis(touched_points, 2, 0)
    width_x, width_y = np.moveaxis(rightmost - leftmost, -1, 0)
    height_x, height_y = np.moveaxis(highest - lowest, -1, 0)
    width = width_x * a + width_y * b
    height = -height_x * b + height_y * a
    is_counted = np.arange(max_corners)[:, None] < num_corners
    area = np.where(is_counted, width * height, np.inf)
    best = max_corners - 1 - area[::-1].argmin(axis=0)  # the last one in a tie
    a = a[best, hull]
    b = b[best, hull]
    width = width[best, hull]
    height = height[best, hull]
    width_side = np.stack([a * width, b * width], axis=1)
    height_side = np.stack([-b * height, a * height], axis=1)
    return width_side, height_side


def _rotate_lines(
    points: IntArray, edges: IntArray, num_corners: IntArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Rotate four lines around all hulls at once, from edge to edge.

    Args:
        points: Corners of the hulls, shape (N, C, 2), with padding.
        edges: Offsets from each corner to the next, shape (N, C, 2).
        num_corners: Number of each hull's corners that are not padding, shape (N,).

    Returns:
        For each of C steps: the corners that the lines touch after the step, shape (C, N, 4); the
        edge on which one of the lines came to lie, shape (C, N); and the index of that line, shape
        (C, N): 0 lowest, 1 rightmost, 2 highest, 3 leftmost.
    """
    hull = np.arange(len(points))
    x = points[..., 0]
    y = points[..., 1]
    extremes = [y.argmin(axis=1), x.argmax(axis=1), y.argmax(axis=1), x.argmin(axis=1)]
    touching = np.stack(extremes, axis=1)
    turned_edges = np.einsum("lij,ncj->lnci", _QUARTER_TURNS, edges)
    all_touching = []
    all_edges = []
    all_lines = []
    for _ in range(points.shape[1]):
        next_edges = turned_edges[np.arange(4), hull[:, None], touching]
        x, y = np.moveaxis(next_edges, -1, 0)
        line = np.zeros(len(points), dtype=np.int64)
        for other in range(1, 4):
            comes_earlier = y[:, other] * x[hull, line] < x[:, other] * y[hull, line]
            line[comes_earlier] = other
        edge = touching[hull, line]
        touching = touching.copy()
        touching[hull, line] = (edge + 1) % num_corners
        all_touching.append(touching)
        all_edges.append(edge)
        all_lines.append(line)
    return np.stack(all_touching), np.stack(all_edges), np.stack(all_lines)


def redrawn_cells(
    hulls: Sequence[Sequence[Point]], centers: FloatArray, exists: BoolArray, shape: tuple[int, int]
) -> tuple[list[IntArray], list[IntArray]]:
    """Return the cells of boxes that redraw the first frame's instances in all frames.

    An instance's first box has the length, width and angle of the smallest rectangle around its
    (last) part in the first frame. Later boxes turn in the direction of the instance's movement if
    it moved far enough. An instance that occurs in n frames has boxes in the first n frames, so
    boxes after a gap are in the wrong frames. Later ids overwrite earlier ones.

    Args:
        hulls: Hulls of instances 1 to I, as `first_hulls` returns them.
        centers: Mean row and column of each instance, shape (I, T, 2).
        exists: Whether each instance occurs in each frame, shape (I, T).
        shape: Rows and columns of the map.

    Returns:
        For each frame, rows and columns of the cells, shape (2, P), and their ids, shape (P,).
    """
    num_instances, num_frames = exists.shape
    if not num_instances:
        no_cells = np.zeros((2, 0), dtype=np.int64)
        return [no_cells] * num_frames, [no_cells[0]] * num_frames
    size, angle = _measure_boxes(hulls)
    instance, frame = np.nonzero(exists)
    steps = np.cumsum(exists, axis=1) - 1
    step = steps[instance, frame]
    box_centers = centers[instance, frame]
    path = np.zeros((num_instances, num_frames, 2))
    path[instance, step] = box_centers
    heading = _compute_headings(path, angle)[instance, step]
    half_size = np.minimum(size, LARGEST_BOX_CELLS) / 2
    half_size = np.maximum(np.rint(half_size + 0.001), 1)
    corners = _compute_corners(box_centers, half_size[instance], heading)
    rows, columns = shape
    whole_corners = np.clip(np.rint(corners).astype(np.int64), 0, (columns - 1, rows - 1))
    cells, box = filled_cells(whole_corners, shape, step, num_frames)
    image, *position = np.unravel_index(cells, (num_frames, *shape))
    frame_starts = np.searchsorted(image, np.arange(1, num_frames))
    positions = np.split(np.stack(position), frame_starts, axis=1)
    ids = np.split(instance[box] + 1, frame_starts)
    return positions, ids


def first_hulls(position: IntArray, ids: IntArray, instances: int) -> list[list[Point]]:
    """Return the convex hull of each instance's part that OpenCV lists first, for ids 1 to I.

    Points are (x, y).

    Args:
        position: Rows and columns of cells in row-major order, shape (2, P).
        ids: Instance of each cell, shape (P,); 0 is background.
        instances: Number of instances I.
    """
    num_background = np.count_nonzero(ids == 0)
    order = np.argsort(ids, kind="stable")[num_background:]
    owner = ids[order]
    rows, columns = position[:, order]
    bounds = np.searchsorted(owner, np.arange(1, instances + 2)).tolist()
    is_one_part = are_one_part(rows, columns, owner - 1, instances).tolist()
    hulls = []
    for (start, end), one_part in zip(pairwise(bounds), is_one_part, strict=True):
        contour = first_contour(rows[start:end], columns[start:end], one_part=one_part)
        hulls.append(convex_hull(contour))
    return hulls


def _measure_boxes(hulls: Sequence[Sequence[Point]]) -> tuple[FloatArray, FloatArray]:
    """Return the size and angle of the smallest rectangles around hulls.

    Returns:
        Lengths and widths, shape (I, 2), cells; and angles, shape (I,), radians.
    """
    sizes, degrees = min_area_rects(hulls)
    sides = sizes.astype(np.float64)
    degrees = degrees.astype(np.float64)
    is_upright = sides[:, 1] > sides[:, 0]
    turned_degrees = np.where(is_upright, -degrees, 270 - degrees)
    lengths_and_widths = np.where(is_upright[:, None], sides[:, ::-1], sides)
    return lengths_and_widths, turned_degrees / 180 * _PI


def _compute_headings(path: FloatArray, angle: FloatArray) -> FloatArray:
    """Return the angles of the boxes at each step of their paths, shape (I, T).

    The first angle is `angle`; later ones are the direction of the latest step that was long
    enough.

    Args:
        path: Rows and columns of the centres, shape (I, T, 2).
        angle: Angles of the first boxes, shape (I,).
    """
    moves = np.diff(np.rint(path), axis=1)
    is_far_enough = (moves**2).sum(axis=-1) >= TURNING_MOVE**2
    headings = np.zeros(path.shape[:2])
    headings[:, 0] = angle
    has_heading = np.ones(headings.shape, dtype=bool)
    has_heading[:, 1:] = is_far_enough
    # The math module's functions give the same bits with every version of numpy.
    directions = [math.atan2(across, down) for down, across in moves[is_far_enough].tolist()]
    headings[:, 1:][is_far_enough] = directions
    steps = np.where(has_heading, np.arange(path.shape[1]), 0)
    latest: IntArray = np.maximum.accumulate(steps, axis=1)
    return np.take_along_axis(headings, latest, axis=1)


def _compute_corners(centers: FloatArray, half_size: FloatArray, angle: FloatArray) -> FloatArray:
    """Return columns and rows of the corners of boxes, shape (N, 4, 2).

    Args:
        centers: Rows and columns of the centres, shape (N, 2).
        half_size: Half lengths and half widths, shape (N, 2).
        angle: Angles, shape (N,), radians.
    """
    # The math module's functions give the same bits with every version of numpy.
    angles = angle.tolist()
    cosine = np.array([math.cos(radians) for radians in angles])[:, None]
    sine = np.array([math.sin(radians) for radians in angles])[:, None]
    offsets = _CORNERS * half_size[:, None, ::-1]
    across = offsets[..., 0]
    along = offsets[..., 1]
    column = cosine * across + sine * along + centers[:, 1:]
    row = -sine * across + cosine * along + centers[:, :1]
    return np.stack([column, row], axis=-1)
