"""Outlines of instances, the rectangles of least area around them, and instances drawn as such rectangles.

The released code gives `cv2.findContours(mask, …)[0][0]` to `cv2.minAreaRect`. The result depends on which part of a
broken mask that is, and on which corner of the hull comes first. Both rules are written out here (OpenCV 4.7.0,
imgproc: contours.cpp, convhull.cpp), so the result is the same with every version. Points are (x, y) = (column, row).

`cv2.minAreaRect` changed its angles with OpenCV 4.13, and new angles cannot be converted to old ones without moving a
few of the rasterised cells. Source: OpenCV 4.7.0, imgproc, rotcalipers.cpp: which side is tried next is decided in
whole numbers, lengths and areas are float32.

The released accident evaluation looks at these and not at the instances themselves (docs/released_code.md,
Post-processing). All its quirks are kept; the masks' rectangles and the rasterising are those of OpenCV 4.7, whatever
version is installed.
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


def first_contour(rows: IntArray, columns: IntArray, *, one_part: bool = False) -> list[Point]:
    """The points where the outer border of a mask's last part turns, which OpenCV lists first.

    The mask has cells in `rows` and `columns` (P,), in row-major order. Its last part is the 8-connected one, in no
    hole of another part, whose first cell comes last. The border starts at this cell and runs down the left side.
    `one_part` says that there is surely only one.
    """
    top, left = int(rows[0]), int(columns.min())
    width = int(columns.max()) - left + 3  # with a margin of one empty cell all around
    mask = np.zeros((int(rows[-1]) - top + 3, width), dtype=np.uint8)
    cells = (rows - (top - 1)) * width + (columns - (left - 1))
    mask.reshape(-1)[cells] = 1
    start = int(cells[0]) if one_part else _start(mask, cells)
    border = _follow(mask.tobytes(), width, start)
    return [(cell % width + left - 1, cell // width + top - 1) for cell in border]


def are_one_part(rows: IntArray, columns: IntArray, instance: IntArray, count: int) -> BoolArray:
    """Which of `count` masks are surely one part: each row has one run of cells, which touches the next row's run.

    The cells (P,) are sorted by mask, row, column; `instance` says whose each is, from 0.
    """
    if not count:
        return np.ones(0, dtype=bool)
    same = np.diff(instance) == 0
    breaks = np.flatnonzero(~same | (np.diff(rows) != 0) | (np.diff(columns) != 1))
    first, last = np.append(0, breaks + 1), np.append(breaks, len(rows) - 1)
    after = first[1:]
    touches = (np.diff(rows[first]) == 1) & (columns[after] <= columns[last[:-1]] + 1)
    touches &= columns[last[1:]] >= columns[first[:-1]] - 1
    apart = instance[after][~touches & (instance[after] == instance[last[:-1]])]
    one = np.ones(count, dtype=bool)
    one[apart] = False
    return one


def _start(mask: AnyArray, cells: IntArray) -> int:
    """The cell that the border starts from."""
    from scipy.ndimage import label

    parts, count = label(mask, np.ones((3, 3)))
    if count == 1:
        return int(cells[0])
    first = cells[np.unique(parts.reshape(-1)[cells], return_index=True)[1]]
    background = label(mask == 0)[0].reshape(-1)
    return int(first[background[first - 1] == background[0]].max())


def _follow(mask: bytes, width: int, start: int) -> list[int]:
    """The cells where the border turns, from `start`, its part's first one, counter-clockwise (Suzuki and Abe)."""
    around = (
        1,
        1 - width,
        -width,
        -width - 1,
        -1,
        width - 1,
        width,
        width + 1,
    )  # from the right, counter-clockwise
    turns = around + around
    back = next((turn for turn in (3, 2, 1, 0, 7, 6, 5) if mask[start + around[turn]]), None)
    if back is None:
        return [start]
    last, here, border = start + around[back], start, []
    while True:
        turn = back + 1
        while not mask[here + turns[turn]]:
            turn += 1
        if (turn - back) % 8 != 4:
            border.append(here)
        there = here + turns[turn]
        if there == start and here == last:
            return border
        here, back = there, (turn + 4) % 8


def convex_hull(contour: list[Point]) -> list[Point]:
    """The corners of the convex hull, turning from the x axis towards the y axis, as OpenCV lists them.

    That list starts at the rightmost corner. But if the corners' places in the contour fall (or rise) along the list
    with only one jump, it starts at the jump.
    """
    first = {point: place for place, point in reversed(list(enumerate(contour)))}
    last = {point: place for place, point in enumerate(contour)}
    points = sorted(first)
    if len(points) == 1:
        return points
    lowest, highest = min(points, key=itemgetter(1)), max(points, key=itemgetter(1))
    down, up = _chain(points[::-1]), _chain(points)
    hull = down + up
    # A thin part's contour passes a corner twice. OpenCV's order of work decides which of the two places counts: the
    # last one at the rightmost corner and between the leftmost one and the highest or lowest, the first one elsewhere.
    beyond_highest = down.index(highest) + 1 if highest in down else len(down)
    until_lowest = up.index(lowest) if lowest in up else len(up)
    passed_later = {*down[:1], *down[beyond_highest:], *up[1:until_lowest]} - {highest}
    start = _first_corner([(last if corner in passed_later else first)[corner] for corner in hull])
    return hull[start:] + hull[:start]


def _chain(points: list[Point]) -> list[Point]:
    """Half of a convex hull: from the first of the sorted points to the one before the last."""
    chain: list[Point] = []
    for x, y in points:
        while len(chain) > 1:
            (ax, ay), (bx, by) = chain[-2], chain[-1]
            if (bx - ax) * (y - ay) > (by - ay) * (x - ax):
                break
            chain.pop()
        chain.append((x, y))
    return chain[:-1]


def _first_corner(places: list[int]) -> int:
    """Which corner OpenCV lists first, from the corners' places in the contour."""
    count = len(places)
    if count < 3:
        return 0
    rises = sum(second > first for first, second in pairwise(places))
    low, high = places.index(min(places)), places.index(max(places))
    if abs(high - low) not in {1, count - 1} or 1 < rises < count - 2:
        return 0
    rising = (high + 1) % count == low
    first = low if rising else high
    turned = places[first:] + places[:first]
    monotonic = all((second > first) == rising for first, second in pairwise(turned))
    return first if monotonic else 0


# The turns that make edges at the lowest, rightmost, highest and leftmost corner lie like one at the lowest.
_QUARTER_TURNS = np.array(
    [[[1, 0], [0, 1]], [[0, 1], [-1, 0]], [[-1, 0], [0, -1]], [[0, -1], [1, 0]]]
)


def min_area_rects(hulls: Sequence[Sequence[Point]]) -> tuple[AnyArray, AnyArray]:
    """Of the smallest rectangles around N hulls of `convex_hull`: widths and heights, and angles of the widths.

    (N, 2) and (N,) float32; degrees from x towards y.
    """
    size, side = np.zeros((len(hulls), 2), dtype=np.float32), np.zeros((len(hulls), 2))
    corners = np.array([len(hull) for hull in hulls], dtype=np.int64)
    for index in np.flatnonzero(corners == 2).tolist():
        side[index] = np.subtract(hulls[index][1], hulls[index][0])
        size[index, 0] = np.sqrt((side[index] ** 2).sum())
    broad = np.flatnonzero(corners > 2).tolist()
    if broad:
        most = corners[broad].max()
        points = np.array(
            [[*hulls[index], *[hulls[index][0]] * (most - corners[index])] for index in broad]
        )
        width, height = _rectangles(points, corners[broad])
        side[broad] = width
        size[broad] = np.sqrt(
            (np.stack([width, height], axis=1).astype(np.float64) ** 2).sum(axis=-1)
        )
    angle = np.arctan2(side[:, 1], side[:, 0]).astype(np.float32)
    return size, ((angle * np.float32(180)).astype(np.float64) / np.pi).astype(np.float32)


def _rectangles(points: IntArray, corners: IntArray) -> tuple[AnyArray, AnyArray]:
    """Both sides (N, 2) float32 of the smallest rectangles around hulls (N, C, 2); their first `corners` (N,) count."""
    which = np.arange(len(points))
    following = (np.arange(points.shape[1]) + 1) % corners[:, None]
    edges = points[which[:, None], following] - points
    touching, leading, turned = _rotate(points, edges, corners)
    lengths = np.sqrt((edges.astype(np.float64) ** 2).sum(axis=-1))
    edge = edges[which, leading].astype(np.float32)
    unit = edge * (1 / lengths[which, leading]).astype(np.float32)[..., None]
    base = np.choose(turned[..., None], [unit, _swapped(unit, 1, -1), -unit, _swapped(unit, -1, 1)])
    a, b = base[..., 0], base[..., 1]
    x, y = np.moveaxis(points[which[:, None], touching].astype(np.float32), -1, 0)
    width = (x[..., 1] - x[..., 3]) * a + (y[..., 1] - y[..., 3]) * b
    height = -(x[..., 2] - x[..., 0]) * b + (y[..., 2] - y[..., 0]) * a
    area = np.where(np.arange(len(a))[:, None] < corners, width * height, np.inf)
    best = len(area) - 1 - area[::-1].argmin(axis=0)  # the last of equal ones
    a, b, width, height = (values[best, which] for values in (a, b, width, height))
    return np.stack([a * width, b * width], axis=1), np.stack([-b * height, a * height], axis=1)


def _rotate(
    points: IntArray, edges: IntArray, corners: IntArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Turn four lines around all hulls at once, from edge to edge.

    For each step: the corners (C, N, 4) that the lines touch after it, the edge (C, N) that one of them came to lie on,
    and which of them (C, N) that was: 0 at the lowest corner, then 1 right, 2 highest, 3 left.
    """
    which = np.arange(len(points))
    x, y = points[..., 0], points[..., 1]
    touching = np.stack(
        [y.argmin(axis=1), x.argmax(axis=1), y.argmax(axis=1), x.argmin(axis=1)], axis=1
    )
    turned_edges = np.einsum("lij,ncj->lnci", _QUARTER_TURNS, edges)
    steps, leading, turned = [], [], []
    for _ in range(points.shape[1]):
        x, y = np.moveaxis(turned_edges[np.arange(4), which[:, None], touching], -1, 0)
        line = np.zeros(len(points), dtype=np.int64)
        for other in range(1, 4):
            line[y[:, other] * x[which, line] < x[:, other] * y[which, line]] = other
        leading.append(touching[which, line])
        turned.append(line)
        touching = touching.copy()
        touching[which, line] = (leading[-1] + 1) % corners
        steps.append(touching)
    return np.stack(steps), np.stack(leading), np.stack(turned)


def _swapped(vectors: AnyArray, first: int, second: int) -> AnyArray:
    """(…, 2) vectors with both components exchanged and signed."""
    return vectors[..., ::-1] * np.array([first, second], dtype=np.float32)


LARGEST_BOX_CELLS: Final = (10, 4)
"""Cells, length and width that a box is cut down to: a truck is rasterised as 5 m × 2 m."""
TURNING_MOVE: Final = 4
"""Cells that an instance must move in a step for its box to turn that way."""
# The released code's π.
_PI: Final = 3.1415926
# A rectangle's corners: across and along its long side.
_CORNERS: Final = np.array([[1, -1], [-1, -1], [-1, 1], [1, 1]])


def redrawn_cells(
    hulls: Sequence[Sequence[Point]], centers: FloatArray, exists: BoolArray, shape: tuple[int, int]
) -> tuple[list[IntArray], list[IntArray]]:
    """Boxes of ids 1 to I of the first frame, in all frames: (2, P) rows and columns of the cells, and (P,) their ids.

    An instance's first box has the length, width and angle of the smallest rectangle around its (last) part in the
    first frame; the later ones turn to where it moved if that was far enough. Boxes are rasterised in frames without a
    gap from the first on, as many as the instance is in: after a gap they are in the wrong frames. Later ids overwrite
    earlier ones. `hulls` are those of `first_hulls`, `centers` (I, T, 2) rows and columns of the means; `exists` (I,
    T).
    """
    instances, frames = exists.shape
    if not instances:
        nothing = np.zeros((2, 0), dtype=np.int64)
        return [nothing] * frames, [nothing[0]] * frames
    size, angle = _first_boxes(hulls)
    instance, frame = np.nonzero(exists)
    step = (np.cumsum(exists, axis=1) - 1)[instance, frame]
    path = np.zeros((instances, frames, 2))
    path[instance, step] = centers[instance, frame]
    heading = _headings(path, angle)[instance, step]
    half = np.maximum(np.rint(np.minimum(size, LARGEST_BOX_CELLS) / 2 + 0.001), 1)[instance]
    corners = _corners(path[instance, step], half, heading)
    corners = np.clip(np.rint(corners).astype(np.int64), 0, (shape[1] - 1, shape[0] - 1))
    cells, drawn = filled_cells(corners, shape, step, frames)
    image, *position = np.unravel_index(cells, (frames, *shape))
    ends = np.searchsorted(image, np.arange(1, frames))
    return np.split(np.stack(position), ends, axis=1), np.split(instance[drawn] + 1, ends)


def first_hulls(position: IntArray, ids: IntArray, instances: int) -> list[list[Point]]:
    """The convex hulls, (x, y), of instances 1 to I: of each one the part that OpenCV lists first.

    `position` (2, P) are rows and columns in row-major order, `ids` (P,) whose; 0 is background.
    """
    order = np.argsort(ids, kind="stable")[np.count_nonzero(ids == 0) :]
    owner, (rows, columns) = ids[order], position[:, order]
    ends = np.searchsorted(owner, np.arange(1, instances + 2)).tolist()
    whole = are_one_part(rows, columns, owner - 1, instances).tolist()
    return [
        convex_hull(first_contour(rows[start:end], columns[start:end], one_part=one))
        for (start, end), one in zip(pairwise(ends), whole, strict=True)
    ]


def _first_boxes(hulls: Sequence[Sequence[Point]]) -> tuple[FloatArray, FloatArray]:
    """(I, 2) length and width, cells, and (I,) angles of the smallest rectangles around hulls."""
    sides, angles = (values.astype(np.float64) for values in min_area_rects(hulls))
    upright = sides[:, 1] > sides[:, 0]
    angle = np.where(upright, -angles, 270 - angles) / 180 * _PI
    return np.where(upright[:, None], sides[:, ::-1], sides), angle


def _headings(path: FloatArray, angle: FloatArray) -> FloatArray:
    """(I, T) angles of the boxes at each step of the paths (I, T, 2): first `angle`, then that of the last far move."""
    moved = np.diff(np.rint(path), axis=1)
    far = (moved**2).sum(axis=-1) >= TURNING_MOVE**2
    headings = np.zeros(path.shape[:2])
    headings[:, 0] = angle
    # the math module's functions give the same bits with every numpy
    headings[:, 1:][far] = [math.atan2(across, down) for down, across in moved[far].tolist()]
    counts = np.concatenate([np.ones((len(path), 1), dtype=bool), far], axis=1)
    latest: IntArray = np.maximum.accumulate(np.where(counts, np.arange(path.shape[1]), 0), axis=1)
    return np.take_along_axis(headings, latest, axis=1)


def _corners(centers: FloatArray, half: FloatArray, angle: FloatArray) -> FloatArray:
    """(N, 4, 2) columns and rows of the corners of boxes around `centers` (rows, columns), half as long and wide."""
    cosine, sine = (
        np.array([function(a) for a in angle.tolist()])[:, None]
        for function in (math.cos, math.sin)
    )
    across, along = np.moveaxis(_CORNERS * half[:, None, ::-1], -1, 0)
    column = cosine * across + sine * along + centers[:, 1:]
    row = -sine * across + cosine * along + centers[:, :1]
    return np.stack([column, row], axis=-1)
