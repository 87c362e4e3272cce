"""Gaps between the outlines of the instances of one frame, as the released code measures them.

The released code takes `find_contours(mask * id, 0.1)[0]` and then `approximate_polygon(…,
tolerance=0.5)`. Both are written out here (scikit-image 0.20, BSD), the first to the last bit. The
second decides ties at exactly its tolerance by the last bit of trigonometric functions, which
differs between machines; here lengths that differ by less than `LENGTH_TIE` compare equal.

Points are (row, column), whole numbers in the middle of cells, counted in the full image.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from deepaccident_devkit.support.arrays import AnyArray, FloatArray, IntArray

LEVEL: Final = 0.1
"""Level of the outline, between 0 outside the instance and its id inside.

A higher id moves the outline outwards.
"""
TOLERANCE: Final = 0.5
"""Largest error of a simplified outline, cells."""
LENGTH_TIE: Final = 1e-9
"""Lengths that differ by less than this compare equal, cells."""
NO_OUTLINE: Final = 1e11
"""The released code's distance to an instance without an outline, cells.

The map lacks such an instance, or it is too small there.
"""
# Slices of the rows and of the columns.
_Window = tuple[slice, slice]
_TOP, _LEFT, _BOTTOM, _RIGHT = range(4)
_BORDER_SQUARE: Final = 16
# The edge at which an outline leaves a square, by the edge at which it enters, with the mask to its
# right. The index is the sum of the square's cells in the mask: 1 top left, 2 top right, 4 bottom
# left, 8 bottom right. If there are two entries, the first is scikit-image's first.
_EXITS: Final[tuple[dict[int, int], ...]] = (
    {},
    {_TOP: _LEFT},
    {_RIGHT: _TOP},
    {_RIGHT: _LEFT},
    {_LEFT: _BOTTOM},
    {_TOP: _BOTTOM},
    {_RIGHT: _TOP, _LEFT: _BOTTOM},
    {_RIGHT: _BOTTOM},
    {_BOTTOM: _RIGHT},
    {_TOP: _LEFT, _BOTTOM: _RIGHT},
    {_BOTTOM: _TOP},
    {_BOTTOM: _LEFT},
    {_LEFT: _RIGHT},
    {_TOP: _RIGHT},
    {_LEFT: _TOP},
    {},
    {},
)
_ENTRIES: Final = tuple({leave: enter for enter, leave in exits.items()} for exits in _EXITS)
_OPPOSITE: Final = (_BOTTOM, _RIGHT, _TOP, _LEFT)


def pair_gaps(
    image: AnyArray, ids: IntArray, *, below: float = np.inf
) -> tuple[IntArray, FloatArray]:
    """Return pairs of instances and the distances between their outlines in a map.

    Args:
        image: Instance ids, shape (H, W).
        ids: Ids of the instances, ascending.
        below: Pairs that cannot be nearer than this are left out, cells.

    Returns:
        Pairs of ids, shape (P, 2), ascending; and distances, shape (P,), cells: 0 where outlines
        overlap, `NO_OUTLINE` where an instance has none.
    """
    windows = _windows(image, ids)
    first, second = np.triu_indices(len(ids), 1)
    close = _box_gaps(windows)[first, second] < below
    first = first[close]
    second = second[close]
    shapes = _shapes(image, ids, windows, np.unique([first, second]))
    pairs = np.stack([ids[first], ids[second]], axis=1)
    return pairs, _distances(shapes[first], shapes[second])


def first_outline(image: AnyArray, instance_id: int, window: _Window) -> FloatArray:
    """Return the outline of an instance that scikit-image lists first, shape (P, 2).

    It runs around the instance's part with the highest cell. Cells that only touch at a corner are
    two parts. Rows and columns are as in `find_contours`, beginning where the last segment in
    row-major order ends.

    Args:
        image: Instance ids, shape (H, W).
        instance_id: Id of the instance.
        window: Rows and columns that hold the instance.
    """
    rows, columns = window
    top = max(rows.start - 1, 0)
    left = max(columns.start - 1, 0)
    mask = (image[top : rows.stop + 1, left : columns.stop + 1] == instance_id).view(np.uint8)
    shape = (mask.shape[0] + 1, mask.shape[1] + 1)
    squares = np.full(shape, _BORDER_SQUARE, dtype=np.uint8)
    inner = squares[1:-1, 1:-1]
    inner[:] = mask[:-1, :-1]
    inner += 2 * mask[:-1, 1:]
    inner += 4 * mask[1:, :-1]
    inner += 8 * mask[1:, 1:]
    crossed = np.flatnonzero((squares > 0) & (squares < 15))
    if not len(crossed):
        return np.zeros((0, 2))
    width = squares.shape[1]
    cells, edges = _follow(squares.tobytes(), width, int(crossed[0]))
    row, column = np.divmod(np.array(cells), width)
    return _points(row + (top - 1), column + (left - 1), np.array(edges), instance_id)


def simplified_outlines(outlines: list[FloatArray]) -> list[FloatArray]:
    """Return outlines simplified by Douglas and Peucker at `TOLERANCE`; all at once."""
    lengths = np.array([len(outline) for outline in outlines], dtype=np.int64)
    if not lengths.any():
        return outlines
    points = np.concatenate(outlines)
    ends = np.cumsum(lengths)
    starts = ends - lengths
    has_points = lengths > 0
    first = starts[has_points]
    last = ends[has_points] - 1
    is_corner = np.zeros(len(points), dtype=bool)
    is_corner[first] = is_corner[last] = True
    while True:
        has_inner = last - first > 1
        first = first[has_inner]
        last = last[has_inner]
        if not len(first):
            break
        farthest, distance = _farthest(points, first, last)
        split = distance > TOLERANCE + LENGTH_TIE
        first = first[split]
        farthest = farthest[split]
        last = last[split]
        is_corner[farthest] = True
        first = np.concatenate([first, farthest])
        last = np.concatenate([farthest, last])
    simplified = []
    for outline, corners in zip(outlines, np.split(is_corner, ends[:-1]), strict=True):
        simplified.append(outline[corners])
    return simplified


def _windows(image: AnyArray, ids: IntArray) -> list[_Window | None]:
    """Return the window of each instance; None for instances that are not in the map.

    The instances are renumbered, since ids may be of any size.
    """
    from scipy.ndimage import find_objects

    cells = np.flatnonzero(image > 0)
    cell_ids = image.reshape(-1)[cells]
    rank = np.searchsorted(ids, cell_ids)
    known = np.append(ids, -1)[rank] == cell_ids
    ranks = np.zeros(image.shape, dtype=np.int32)
    ranks.reshape(-1)[cells[known]] = rank[known] + 1
    windows: list[Any] = find_objects(ranks, len(ids)) if len(ids) else []
    return windows


def _box_gaps(windows: Sequence[_Window | None]) -> FloatArray:
    """Return lower bounds of the distances between outlines of instances, shape (N, N), cells.

    They are the gaps between the boxes of the instances, each widened by a cell on all sides.
    """
    lowest, highest = np.full((2, len(windows), 2), np.nan)
    for index, window in enumerate(windows):
        if window is not None:
            lowest[index] = [span.start - 1 for span in window]
            highest[index] = [span.stop for span in window]
    gaps = np.maximum(lowest[:, None] - highest, lowest - highest[:, None])
    distances: FloatArray = np.sqrt((np.maximum(gaps, 0) ** 2).sum(axis=-1))
    return np.where(np.isnan(distances), NO_OUTLINE, distances)


def _shapes(
    image: AnyArray, ids: IntArray, windows: Sequence[_Window | None], indices: IntArray
) -> AnyArray:
    """Return shapely's polygons of some instances, shape (N,).

    None for the instances that are not in `indices`, and for instances without an outline.
    """
    import shapely

    present = []
    outlines = []
    for index in indices.tolist():
        window = windows[index]
        if window is not None:
            present.append(index)
            outlines.append(first_outline(image, ids.item(index), window))
    owners = []
    rings = []
    for index, points in zip(present, simplified_outlines(outlines), strict=True):
        if _num_corners(points) >= 3:
            owners.append(index)
            rings.append(points)
    shapes = np.full(len(ids), None)
    if rings:
        ring_numbers = np.repeat(np.arange(len(rings)), [len(points) for points in rings])
        linear_rings = shapely.linearrings(np.concatenate(rings), indices=ring_numbers)
        shapes[owners] = shapely.polygons(linear_rings)
    return shapes


def _num_corners(outline: FloatArray) -> int:
    """Return the number of corners of an outline, whether or not it ends at its first point."""
    count = len(outline)
    is_closed = count > 1 and bool((outline[0] == outline[-1]).all())
    return count - int(is_closed)


def _distances(first: AnyArray, second: AnyArray) -> FloatArray:
    """Return the distances between polygons, `NO_OUTLINE` where one is missing."""
    import shapely

    distances = shapely.distance(first, second)
    return np.where(np.isnan(distances), NO_OUTLINE, distances)


def _follow(squares: bytes, width: int, start: int) -> tuple[list[int], list[int]]:
    """Return the squares of an outline, and the edges at which it leaves them.

    The outline passes through square `start`, its first one in row-major order.
    """
    moves = (-width, -1, width, 1)
    first_entry = next(iter(_EXITS[squares[start]]))
    cells, edges, ranks = [], [], []
    cell = start
    entry = first_entry
    while squares[cell] != _BORDER_SQUARE:
        exits = _EXITS[squares[cell]]
        leave = exits[entry]
        cells.append(cell)
        edges.append(leave)
        is_second = len(exits) > 1 and entry != next(iter(exits))
        ranks.append(2 * cell + is_second)
        cell = cell + moves[leave]
        entry = _OPPOSITE[leave]
        if cell == start and entry == first_entry:
            latest = ranks.index(max(ranks))
            return cells[latest:] + cells[: latest + 1], edges[latest:] + edges[: latest + 1]
    # The outline ends at the image's border: follow it backwards from the start, too.
    previous_cells: list[int] = []
    previous_edges: list[int] = []
    cell = start + moves[first_entry]
    leave = _OPPOSITE[first_entry]
    while squares[cell] != _BORDER_SQUARE:
        previous_cells.append(cell)
        previous_edges.append(leave)
        entry = _ENTRIES[squares[cell]][leave]
        cell = cell + moves[entry]
        leave = _OPPOSITE[entry]
    previous_cells.append(cell)
    previous_edges.append(leave)
    return previous_cells[::-1] + cells, previous_edges[::-1] + edges


def _points(row: IntArray, column: IntArray, edge: IntArray, instance_id: int) -> FloatArray:
    """Return where the outline crosses edges of squares, shape (P, 2).

    The top left cells of the squares are at `row` and `column`.
    """
    # The share of the way from a cell beside the instance to one of its own, and in the other
    # direction.
    inwards = LEVEL / instance_id
    outwards = (LEVEL - instance_id) / -instance_id
    across = np.array([inwards, 0.0, outwards, 1.0])
    down = np.array([0.0, outwards, 1.0, inwards])
    return np.stack([row + down[edge], column + across[edge]], axis=1)


def _farthest(points: FloatArray, first: IntArray, last: IntArray) -> tuple[IntArray, FloatArray]:
    """Return the farthest point from each line, the first of ties, and its distance.

    Args:
        points: Points of outlines, shape (P, 2).
        first: Numbers of the points at which the lines begin, shape (L,).
        last: Numbers of the points at which the lines end, shape (L,).
    """
    counts = last - first - 1
    begins = np.cumsum(counts) - counts
    line = np.repeat(np.arange(len(first)), counts)
    index = np.arange(len(line)) - begins[line] + first[line] + 1
    start = points[first]
    direction = points[last] - points[first]
    dr, dc = direction[line].T
    r, c = (points[index] - start[line]).T
    to_end_r = r - dr
    to_end_c = c - dc
    beside = (r * dr + c * dc > 0) & (-to_end_r * dr - to_end_c * dc > 0)
    length = np.sqrt((direction**2).sum(axis=1))
    to_start_squared = r * r + c * c
    to_end_squared = to_end_r * to_end_r + to_end_c * to_end_c
    distance = np.sqrt(np.minimum(to_start_squared, to_end_squared))
    np.divide(np.abs(r * dc - c * dr), length[line], out=distance, where=beside)
    largest = np.maximum.reduceat(distance, begins)
    ties = np.flatnonzero(distance >= largest[line] - LENGTH_TIE)
    _, first_tie = np.unique(line[ties], return_index=True)
    return index[ties[first_tie]], largest
