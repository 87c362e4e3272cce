"""How near instances of one frame are, as the released code measures it: between outlines, as scikit-image finds them.

The released code takes `find_contours(mask * id, 0.1)[0]` and then `approximate_polygon(…, tolerance=0.5)`. Both are
written out here (scikit-image 0.20, BSD), the first to the last bit. The second decides ties at exactly its tolerance
by the last bit of trigonometric functions, which differs between machines; here lengths that differ by less than
`LENGTH_TIE` are the same.

Points are (row, column), whole numbers in the middle of cells, counted in the whole image.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from deepaccident_devkit.support.arrays import AnyArray, FloatArray, IntArray

LEVEL: Final = 0.1
"""The level, between 0 outside the instance and its id inside, at which the outline runs: the higher the id, the
farther out.
"""
TOLERANCE: Final = 0.5
"""The largest error of a simplified outline, cells."""
LENGTH_TIE: Final = 1e-9
"""Lengths that differ by less, in cells, are equal."""
NO_OUTLINE: Final = 1e11
"""Cells: the released code's distance to an instance that is not in the map, or too small there for an outline."""
# Rows and columns.
_Place = tuple[slice, slice]
_TOP, _LEFT, _BOTTOM, _RIGHT = range(4)
_OUTSIDE: Final = 16
# By which of a square's four cells are in the mask (1 top left, 2 top right, 4 bottom left, 8 bottom right): where an
# outline that comes in at an edge goes out, the mask to its right. Of two the first is scikit-image's first.
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
_ENTRIES: Final = tuple({way_out: way_in for way_in, way_out in exits.items()} for exits in _EXITS)
_OPPOSITE: Final = (_BOTTOM, _RIGHT, _TOP, _LEFT)


def pair_gaps(
    image: AnyArray, ids: IntArray, *, below: float = np.inf
) -> tuple[IntArray, FloatArray]:
    """Pairs (P, 2) of `ids`, ascending, and the distances (P,) between their outlines in a map (H, W), cells.

    0 where outlines overlap, `NO_OUTLINE` where one has none; pairs that cannot be nearer than `below` are left out.
    """
    places = _places(image, ids)
    first, second = np.triu_indices(len(ids), 1)
    near = _box_gaps(places)[first, second] < below
    first, second = first[near], second[near]
    shapes = _shapes(image, ids, places, np.unique([first, second]))
    return np.stack([ids[first], ids[second]], axis=1), _distances(shapes[first], shapes[second])


def first_outline(image: AnyArray, name: int, place: _Place) -> FloatArray:
    """The outline (P, 2) of an instance that scikit-image lists first: around its part with the highest cell.

    It lies in `place`. Cells that touch at a corner alone are two parts. Rows and columns as `find_contours` has them:
    beginning where the last segment in row-major order ends.
    """
    rows, columns = place
    top, left = max(rows.start - 1, 0), max(columns.start - 1, 0)
    mask = (image[top : rows.stop + 1, left : columns.stop + 1] == name).view(np.uint8)
    squares = np.full((mask.shape[0] + 1, mask.shape[1] + 1), _OUTSIDE, dtype=np.uint8)
    inner = squares[1:-1, 1:-1]
    inner[:] = mask[:-1, :-1]
    inner += 2 * mask[:-1, 1:]
    inner += 4 * mask[1:, :-1]
    inner += 8 * mask[1:, 1:]
    passed = np.flatnonzero((squares > 0) & (squares < 15))
    if not len(passed):
        return np.zeros((0, 2))
    width = squares.shape[1]
    cells, edges = _follow(squares.tobytes(), width, int(passed[0]))
    row, column = np.divmod(np.array(cells), width)
    return _points(row + (top - 1), column + (left - 1), np.array(edges), name)


def simplified_outlines(outlines: list[FloatArray]) -> list[FloatArray]:
    """Outlines with the corners that Douglas and Peucker keep at `TOLERANCE`; all at once."""
    lengths = np.array([len(outline) for outline in outlines], dtype=np.int64)
    if not lengths.any():
        return outlines
    points = np.concatenate(outlines)
    ends = np.cumsum(lengths)
    first, last = (ends - lengths)[lengths > 0], ends[lengths > 0] - 1
    kept = np.zeros(len(points), dtype=bool)
    kept[first] = kept[last] = True
    while True:
        inside = last - first > 1
        first, last = first[inside], last[inside]
        if not len(first):
            break
        farthest, distance = _farthest(points, first, last)
        split = distance > TOLERANCE + LENGTH_TIE
        first, farthest, last = first[split], farthest[split], last[split]
        kept[farthest] = True
        first, last = np.concatenate([first, farthest]), np.concatenate([farthest, last])
    return [
        outline[keep] for outline, keep in zip(outlines, np.split(kept, ends[:-1]), strict=True)
    ]


def _places(image: AnyArray, ids: IntArray) -> list[_Place | None]:
    """Where instances are; None for those that are not in the map. Renumbered, since ids may be of any size."""
    from scipy.ndimage import find_objects

    cells = np.flatnonzero(image > 0)
    names = image.reshape(-1)[cells]
    rank = np.searchsorted(ids, names)
    known = np.append(ids, -1)[rank] == names
    ranks = np.zeros(image.shape, dtype=np.int32)
    ranks.reshape(-1)[cells[known]] = rank[known] + 1
    found: list[Any] = find_objects(ranks, len(ids)) if len(ids) else []
    return found


def _box_gaps(places: Sequence[_Place | None]) -> FloatArray:
    """(N, N) the least distances of the outlines of instances, cells: of their boxes, each a cell wider all around."""
    lowest, highest = np.full((2, len(places), 2), np.nan)
    for index, place in enumerate(places):
        if place is not None:
            lowest[index] = [along.start - 1 for along in place]
            highest[index] = [along.stop for along in place]
    apart = np.maximum(lowest[:, None] - highest, lowest - highest[:, None])
    gaps: FloatArray = np.sqrt((np.maximum(apart, 0) ** 2).sum(axis=-1))
    return np.where(np.isnan(gaps), NO_OUTLINE, gaps)


def _shapes(
    image: AnyArray, ids: IntArray, places: Sequence[_Place | None], wanted: IntArray
) -> AnyArray:
    """(N,) shapely's polygons of the instances number `wanted`; None for the others and those without an outline."""
    import shapely

    there = [index for index in wanted.tolist() if places[index] is not None]
    outlines = simplified_outlines(
        [first_outline(image, ids.item(index), places[index]) for index in there]
    )
    broad = [
        (index, points)
        for index, points in zip(there, outlines, strict=True)
        if _corners(points) >= 3
    ]
    shapes = np.full(len(ids), None)
    if broad:
        owner = np.repeat(np.arange(len(broad)), [len(points) for _, points in broad])
        rings = shapely.linearrings(np.concatenate([points for _, points in broad]), indices=owner)
        shapes[[index for index, _ in broad]] = shapely.polygons(rings)
    return shapes


def _corners(outline: FloatArray) -> int:
    """How many corners an outline has, whether or not its first is also its last point."""
    return len(outline) - int(len(outline) > 1 and bool((outline[0] == outline[-1]).all()))


def _distances(first: AnyArray, second: AnyArray) -> FloatArray:
    import shapely

    distances = shapely.distance(first, second)
    return np.where(np.isnan(distances), NO_OUTLINE, distances)


def _follow(squares: bytes, width: int, start: int) -> tuple[list[int], list[int]]:
    """Squares and edges that the outline in square `start`, the first one in row-major order, leaves them through."""
    moves = (-width, -1, width, 1)
    first = next(iter(_EXITS[squares[start]]))
    cells, edges, places = [], [], []
    here, entry = start, first
    while squares[here] != _OUTSIDE:
        case = squares[here]
        way_out = _EXITS[case][entry]
        cells.append(here)
        edges.append(way_out)
        places.append(2 * here + (len(_EXITS[case]) > 1 and entry != next(iter(_EXITS[case]))))
        here, entry = here + moves[way_out], _OPPOSITE[way_out]
        if here == start and entry == first:
            latest = places.index(max(places))
            return cells[latest:] + cells[: latest + 1], edges[latest:] + edges[: latest + 1]
    before: list[tuple[int, int]] = []
    here, way_out = start + moves[first], _OPPOSITE[first]
    while squares[here] != _OUTSIDE:
        before.append((here, way_out))
        entry = _ENTRIES[squares[here]][way_out]
        here, way_out = here + moves[entry], _OPPOSITE[entry]
    before.append((here, way_out))
    return [cell for cell, _ in before[::-1]] + cells, [edge for _, edge in before[::-1]] + edges


def _points(row: IntArray, column: IntArray, edge: IntArray, name: int) -> FloatArray:
    """(P, 2) where the outline crosses edges of squares, their top left cells at `row` and `column`."""
    near, far = LEVEL / name, (LEVEL - name) / -name
    """From a cell beside the instance to one of its own, and the other way."""
    across, down = np.array([near, 0.0, far, 1.0]), np.array([0.0, far, 1.0, near])
    return np.stack([row + down[edge], column + across[edge]], axis=1)


def _farthest(points: FloatArray, first: IntArray, last: IntArray) -> tuple[IntArray, FloatArray]:
    """Of the points between the ends of lines, which is the farthest from its line (the first of ties), and how far."""
    counts = last - first - 1
    begins = np.cumsum(counts) - counts
    line = np.repeat(np.arange(len(first)), counts)
    index = np.arange(len(line)) - begins[line] + first[line] + 1
    start, along = points[first], points[last] - points[first]
    dr, dc = along[line].T
    r, c = (points[index] - start[line]).T
    to_end_r, to_end_c = r - dr, c - dc
    beside = (r * dr + c * dc > 0) & (-to_end_r * dr - to_end_c * dc > 0)
    length = np.sqrt((along**2).sum(axis=1))
    distance = np.sqrt(np.minimum(r * r + c * c, to_end_r * to_end_r + to_end_c * to_end_c))
    np.divide(np.abs(r * dc - c * dr), length[line], out=distance, where=beside)
    most = np.maximum.reduceat(distance, begins)
    ties = np.flatnonzero(distance >= most[line] - LENGTH_TIE)
    _, first_tie = np.unique(line[ties], return_index=True)
    return index[ties[first_tie]], most
