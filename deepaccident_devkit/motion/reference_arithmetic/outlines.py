"""Gaps between the outlines of one frame's instances, as the released code measures them.

The released code takes `find_contours(mask * id, 0.1)[0]` and then `approximate_polygon(…,
tolerance=0.5)`. Both are written out here (scikit-image 0.20, BSD); the first is bit-exact. The
second decides ties at exactly its tolerance by the last bit of trigonometric functions, which
differs between machines; here lengths that differ by less than `LENGTH_TIE` count as equal.

Points are (row, column) in the full image; integers are cell centres.
"""

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
"""Lengths that differ by less than this count as equal, cells."""
NO_OUTLINE: Final = 1e11
"""Distance that the released code assumes to an instance without an outline, cells.

An instance has no outline if it is absent from the map or too small in it.
"""
# Row slice and column slice.
_Window = tuple[slice, slice]
# Edges of a square.
_TOP, _LEFT, _BOTTOM, _RIGHT = range(4)
# Marks the squares at the image's border; the others hold a sum of cells from 0 to 15.
_BORDER_SQUARE = 16
# Edge where an outline leaves a square, by the edge where it enters, with the mask to its
# right. The index is the sum of the square's cells in the mask: 1 top left, 2 top right, 4 bottom
# left, 8 bottom right. Where there are two entries, scikit-image tries the first one first.
_EXITS: tuple[dict[int, int], ...] = (
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
# Edge where an outline enters a square, by the edge where it leaves.
_ENTRIES = tuple(dict(zip(exits.values(), exits, strict=True)) for exits in _EXITS)
_OPPOSITE = (_BOTTOM, _RIGHT, _TOP, _LEFT)


def pair_gaps(
    image: AnyArray, ids: IntArray, *, below: float = np.inf
) -> tuple[IntArray, FloatArray]:
    """Return the pairs of instances in a map, and the distances between their outlines.

    Args:
        image: Instance ids, shape (H, W).
        ids: Ids of the instances, ascending.
        below: Distance, cells; pairs that cannot be nearer are left out.

    Returns:
        Pairs of ids, shape (P, 2), ascending; and distances, shape (P,), cells: 0 where the
        outlines overlap, `NO_OUTLINE` where an instance has no outline.
    """
    windows = _find_windows(image, ids)
    first, second = np.triu_indices(len(ids), 1)
    close = _measure_window_gaps(windows)[first, second] < below
    first = first[close]
    second = second[close]
    shapes = _make_polygons(image, ids, windows, np.unique([first, second]))
    pairs = np.stack([ids[first], ids[second]], axis=1)
    return pairs, _measure_distances(shapes[first], shapes[second])


def first_outline(image: AnyArray, instance_id: int, window: _Window) -> FloatArray:
    """Return the outline of an instance that scikit-image lists first, shape (P, 2).

    The outline runs around the part of the instance that contains the topmost cell; cells that
    touch only at a corner belong to different parts. Rows and columns are as in `find_contours`.
    The outline begins where the last segment in row-major order ends.

    Args:
        image: Instance ids, shape (H, W).
        instance_id: Id of the instance.
        window: Rows and columns that contain the instance.
    """
    rows, columns = window
    top = max(rows.start - 1, 0)
    left = max(columns.start - 1, 0)
    is_instance = image[top : rows.stop + 1, left : columns.stop + 1] == instance_id
    mask = is_instance.view(np.uint8)
    height, width = mask.shape
    width += 1
    squares = np.full((height + 1, width), _BORDER_SQUARE, dtype=np.uint8)
    inner = squares[1:-1, 1:-1]
    inner[:] = mask[:-1, :-1]
    inner += 2 * mask[:-1, 1:]
    inner += 4 * mask[1:, :-1]
    inner += 8 * mask[1:, 1:]
    crossed = np.flatnonzero((squares > 0) & (squares < 15))
    if not len(crossed):
        return np.zeros((0, 2))
    cells, edges = _follow_outline(squares.tobytes(), width, int(crossed[0]))
    row, column = np.divmod(np.array(cells), width)
    return _place_crossings(row + (top - 1), column + (left - 1), np.array(edges), instance_id)


def simplified_outlines(outlines: list[FloatArray]) -> list[FloatArray]:
    """Simplify outlines (each (P, 2)) with the Douglas–Peucker algorithm, all at once.

    The tolerance is `TOLERANCE`, in cells.
    """
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
    is_corner[first] = True
    is_corner[last] = True
    while True:
        has_inner = last - first > 1
        first = first[has_inner]
        last = last[has_inner]
        if not len(first):
            break
        farthest, distance = _find_farthest(points, first, last)
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


def _find_windows(image: AnyArray, ids: IntArray) -> list[_Window | None]:
    """Return each instance's bounding rows and columns; None for instances that are not in the map.

    The instances are renumbered, since ids may be of any size.
    """
    from scipy.ndimage import find_objects

    cells = np.flatnonzero(image > 0)
    cell_ids = image.reshape(-1)[cells]
    rank = np.searchsorted(ids, cell_ids)
    known = np.append(ids, -1)[rank] == cell_ids
    ranks = np.zeros(image.shape, dtype=np.int32)
    ranks.reshape(-1)[cells[known]] = rank[known] + 1
    if not len(ids):
        return []
    windows: list[Any] = find_objects(ranks, len(ids))
    return windows


def _measure_window_gaps(windows: Sequence[_Window | None]) -> FloatArray:
    """Return lower bounds of the distances between outlines of instances, shape (N, N), cells.

    These are the gaps between the windows of the instances, each widened by a cell on all sides.
    """
    lowest, highest = np.full((2, len(windows), 2), np.nan)
    for index, window in enumerate(windows):
        if window is not None:
            lowest[index] = [span.start - 1 for span in window]
            highest[index] = [span.stop for span in window]
    gaps = np.maximum(lowest[:, None] - highest, lowest - highest[:, None])
    gaps = np.maximum(gaps, 0)
    distances: FloatArray = np.sqrt((gaps**2).sum(axis=-1))
    return np.where(np.isnan(distances), NO_OUTLINE, distances)


def _make_polygons(
    image: AnyArray, ids: IntArray, windows: Sequence[_Window | None], indices: IntArray
) -> AnyArray:
    """Return shapely's polygons of some instances, shape (N,).

    The entry is None for instances that are not in `indices` or have no outline.
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
        if _count_corners(points) >= 3:
            owners.append(index)
            rings.append(points)
    shapes = np.full(len(ids), None)
    if rings:
        ring_lengths = [len(points) for points in rings]
        ring_numbers = np.repeat(np.arange(len(rings)), ring_lengths)
        linear_rings = shapely.linearrings(np.concatenate(rings), indices=ring_numbers)
        shapes[owners] = shapely.polygons(linear_rings)
    return shapes


def _count_corners(outline: FloatArray) -> int:
    """Count the corners of an outline; a closing point equal to the first one does not count."""
    count = len(outline)
    is_closed = count > 1 and bool((outline[0] == outline[-1]).all())
    return count - int(is_closed)


def _measure_distances(first: AnyArray, second: AnyArray) -> FloatArray:
    """Return the distances between paired polygons; `NO_OUTLINE` where either one is missing."""
    import shapely

    distances = shapely.distance(first, second)
    return np.where(np.isnan(distances), NO_OUTLINE, distances)


def _follow_outline(squares: bytes, width: int, start: int) -> tuple[list[int], list[int]]:
    """Return the squares of an outline, and the edges at which it leaves them.

    `start` is the outline's first square in row-major order.
    """
    moves = (-width, -1, width, 1)
    first_entry = next(iter(_EXITS[squares[start]]))
    cells = []
    edges = []
    ranks = []
    cell = start
    entry = first_entry
    while squares[cell] != _BORDER_SQUARE:
        exits = _EXITS[squares[cell]]
        leave = exits[entry]
        cells.append(cell)
        edges.append(leave)
        is_second_entry = entry != next(iter(exits))
        ranks.append(2 * cell + is_second_entry)
        cell += moves[leave]
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
        cell += moves[entry]
        leave = _OPPOSITE[entry]
    previous_cells.append(cell)
    previous_edges.append(leave)
    return previous_cells[::-1] + cells, previous_edges[::-1] + edges


def _place_crossings(
    row: IntArray, column: IntArray, edge: IntArray, instance_id: int
) -> FloatArray:
    """Return the points where the outline crosses edges of squares, shape (P, 2).

    `row` and `column` locate the squares' top left cells.
    """
    # The fraction of the way from a cell next to the instance to one of its cells, and back.
    inwards = LEVEL / instance_id
    outwards = (LEVEL - instance_id) / -instance_id
    across = np.array([inwards, 0.0, outwards, 1.0])
    down = np.array([0.0, outwards, 1.0, inwards])
    return np.stack([row + down[edge], column + across[edge]], axis=1)


def _find_farthest(
    points: FloatArray, first: IntArray, last: IntArray
) -> tuple[IntArray, FloatArray]:
    """Return the point farthest from each line (the first one in a tie), and its distance.

    Args:
        points: Points of outlines, shape (P, 2).
        first: Indices of the first points of the lines, shape (L,).
        last: Indices of the last points of the lines, shape (L,).
    """
    counts = last - first - 1
    begins = np.cumsum(counts) - counts
    line = np.repeat(np.arange(len(first)), counts)
    index = np.arange(len(line)) - begins[line] + first[line] + 1
    start = points[first]
    direction = points[last] - start
    # Down the rows and across the columns.
    line_down, line_across = direction[line].T
    down, across = (points[index] - start[line]).T
    end_down = down - line_down
    end_across = across - line_across
    is_after_start = down * line_down + across * line_across > 0
    is_before_end = -end_down * line_down - end_across * line_across > 0
    start_squared = down * down + across * across
    end_squared = end_down * end_down + end_across * end_across
    distance = np.sqrt(np.minimum(start_squared, end_squared))
    length = np.sqrt((direction**2).sum(axis=1))
    area = np.abs(down * line_across - across * line_down)
    np.divide(area, length[line], out=distance, where=is_after_start & is_before_end)
    largest = np.maximum.reduceat(distance, begins)
    ties = np.flatnonzero(distance >= largest[line] - LENGTH_TIE)
    _, first_tie = np.unique(line[ties], return_index=True)
    return index[ties[first_tie]], largest
