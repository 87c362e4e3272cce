"""The outline that OpenCV lists first for a mask, and its convex hull in OpenCV's order, without OpenCV.

The released code gives `cv2.findContours(mask, …)[0][0]` to `cv2.minAreaRect`. The result depends on which part of a
broken mask that is, and on which corner of the hull comes first. Both rules are written out here (OpenCV 4.7.0,
imgproc: contours.cpp, convhull.cpp), so the result is the same with every version. Points are (x, y) = (column, row).
"""

from __future__ import annotations

from itertools import pairwise
from operator import itemgetter

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray, IntArray

Point = tuple[int, int]


def first_contour(rows: IntArray, columns: IntArray, *, one_part: bool = False) -> list[Point]:
    """The outer border of a mask's last part, which OpenCV lists first.

    The last part is the 8-connected part, in no hole of another part, whose first cell in row-major order comes last.
    The border starts at this cell and runs down the left side.

    Args:
        rows: (P,) rows of the mask's cells, in row-major order.
        columns: (P,) their columns.
        one_part: whether the mask is known to be one part.

    Returns:
        The points at which the border turns.
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
    """Which of many masks are surely one part: each row has one run of cells, which touches the next row's run.

    Args:
        rows: (P,) rows of the masks' cells, sorted by mask, row, column.
        columns: (P,) their columns.
        instance: (P,) which of the masks each belongs to, from 0.
        count: how many masks there are.
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
    around = (1, 1 - width, -width, -width - 1, -1, width - 1, width, width + 1)  # from the right, counter-clockwise
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
