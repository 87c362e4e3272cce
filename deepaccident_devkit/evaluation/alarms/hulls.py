"""Convex hulls of sets of cells, and how far they are apart; points and straight lines are hulls like any other.

With whole numbers as coordinates everything that is compared is exact, so that equal distances are equal floats.
"""

from __future__ import annotations

import numpy as np

from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray

_PAIRS_AT_ONCE = 1 << 18
"""The number of pairs of corner and side in one batch: bounds the memory."""


def convex_hulls(points: IntArray, group: IntArray) -> FloatArray:
    """The convex hulls of N groups of points.

    Args:
        points: (P, 2) int64 whole coordinates.
        group: (P,) int64 which group each belongs to: 0 to N − 1, each at least once.

    Returns:
        (N, V, 2) corners in order around each hull, without those on a straight side; hulls of fewer than V corners
        repeat their last one. A single point has 1 corner, a straight line 2.
    """
    if not len(points):
        return np.zeros((0, 1, 2))
    chain, along, aside = _both_sides(points, group)
    kept = _lower_envelope(chain, along, aside)
    group, right = chain[kept] // 2, chain[kept] % 2
    along, aside = along[kept], np.where(right, -aside[kept], aside[kept])
    # up the left side and down the right one, without the right one's end where both meet in a point
    order = np.lexsort((np.where(right, -along, along), right, group))
    group, corners = group[order], np.stack([along, aside], axis=1)[order]
    again = np.zeros(len(group), dtype=bool)
    again[1:] = (group[1:] == group[:-1]) & (corners[1:] == corners[:-1]).all(axis=1)
    last = np.append(group[1:] != group[:-1], True)
    first = np.concatenate([[0], np.flatnonzero(last)[:-1] + 1])
    again[last] |= (corners[last] == corners[first]).all(axis=1) & (first != np.flatnonzero(last))
    return _padded(corners[~again], group[~again])


def hull_distances(first: FloatArray, second: FloatArray) -> FloatArray:
    """The shortest ways between hulls, pair by pair, 0 where they touch or overlap: (P, V, 2), (P, W, 2) → (P,)."""
    result = np.zeros(len(first))
    step = max(1, _PAIRS_AT_ONCE // max(1, first.shape[1] * second.shape[1]))
    for start in range(0, len(first), step):
        part = slice(start, start + step)
        result[part] = _distances(first[part], second[part])
    return result


def _both_sides(points: IntArray, group: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """The leftmost and the rightmost points of each row of each group, the latter mirrored.

    Returns:
        Chains (2 · group for the left, 2 · group + 1 for the right side), rows and columns, by chain and row.
    """
    low = points.min(axis=0)
    rows, columns = (points.max(axis=0) - low + 1).tolist()
    key = np.sort((group * rows + points[:, 0] - low[0]) * columns + points[:, 1] - low[1])
    line, column = np.divmod(key, columns)
    begins = np.append(True, line[1:] != line[:-1])
    ends = np.append(begins[1:], True)
    group, row = np.divmod(line[begins], rows)
    chain = np.concatenate([2 * group, 2 * group + 1])
    aside = np.concatenate([column[begins] + low[1], -(column[ends] + low[1])])
    order = np.argsort(chain, kind="stable")
    return chain[order], np.tile(row + low[0], 2)[order], aside[order]


def _lower_envelope(chain: IntArray, along: IntArray, aside: IntArray) -> IntArray:
    """Which points of each chain, ascending in `along`, are corners of its convex lower side; its ends always are.

    A point on or above the line between any two others is no corner. So all points above the line between their
    neighbours are removed at once, again and again, until there are none.
    """
    kept = np.arange(len(chain))
    while True:
        part, a, b = chain[kept], along[kept], aside[kept]
        inner = np.zeros(len(kept), dtype=bool)
        inner[1:-1] = (part[2:] == part[:-2]) & (
            (b[1:-1] - b[:-2]) * (a[2:] - a[:-2]) >= (b[2:] - b[:-2]) * (a[1:-1] - a[:-2])
        )
        if not inner.any():
            return kept
        kept = kept[~inner]


def _padded(corners: IntArray, group: IntArray) -> FloatArray:
    count = np.bincount(group)
    first = np.cumsum(count) - count
    which = np.minimum(np.arange(count.max()), count[:, None] - 1)
    return np.asarray(corners[first[:, None] + which].astype(np.float64))


def _distances(first: FloatArray, second: FloatArray) -> FloatArray:
    there, way_there = _to_sides(first, second)
    back, way_back = _to_sides(second, first)
    way = np.where((there <= back)[:, None], way_there, -way_back)
    nearest = np.minimum(there, back)
    return np.where(_parts(way, first, second), np.sqrt(nearest), 0.0)


def _to_sides(points: FloatArray, hull: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The shortest way from a side of hulls (P, W, 2) to a corner (P, V, 2): its square, and a vector of any length."""
    side = np.roll(hull, -1, axis=1) - hull
    apart = points[:, :, None] - hull[:, None]
    length = (side * side).sum(axis=-1)[:, None]
    along = (apart * side[:, None]).sum(axis=-1)
    across = side[:, None, :, 0] * apart[..., 1] - side[:, None, :, 1] * apart[..., 0]
    beside = (along > 0) & (along < length)
    # beyond a side's ends the way to the end itself is the nearest; each end is some side's start
    squared = np.where(beside, across * across / np.where(beside, length, 1.0), (apart * apart).sum(axis=-1))
    pair = np.arange(len(points))
    flat = squared.reshape(len(points), -1)
    best = np.argmin(flat, axis=1)
    corner, edge = np.divmod(best, hull.shape[1])
    to_end, chosen = apart[pair, corner, edge], side[pair, edge]
    normal = np.stack([-chosen[:, 1], chosen[:, 0]], axis=1) * across[pair, corner, edge, None]
    return flat[pair, best], np.where(beside[pair, corner, edge, None], normal, to_end)


def _parts(way: FloatArray, first: FloatArray, second: FloatArray) -> BoolArray:
    """Whether a line across `way`, from second to first, has each hull on a side of its own.

    Of hulls that are apart the shortest way between corners and sides is the shortest of all, and such a line crosses
    it; hulls that overlap cannot be separated.
    """
    near = np.einsum("pvk,pk->pv", first, way).min(axis=1)
    far = np.einsum("pvk,pk->pv", second, way).max(axis=1)
    return np.asarray(near > far)
