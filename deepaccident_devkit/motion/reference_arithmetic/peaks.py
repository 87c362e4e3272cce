"""The highest cells of a map, and for each point the nearest of them, with every rounding of torch's float32.

The released code takes its instances' centres from `max_pool2d`, and groups cells by the norm of their distances.
"""

from typing import Final

import numpy as np

from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray

# How many distances are computed at once: as many as a processor's caches hold.
_BLOCK: Final = 1 << 15
# With at least so many distances it is faster to leave out the peaks that cannot be nearest.
_MANY: Final = 1 << 18
# Number of tiles along each axis; for each tile such peaks are found.
_TILES: Final = 12
# Squared distances that differ by a smaller share may change their order in float32 (its steps are 1.2e-7).
_ROUNDING: Final = 1e-5


def find_peaks(centerness: AnyArray, threshold: float, most: int) -> IntArray:
    """(K, 2) rows and columns of the cells of a map (H, W) above `threshold` and not below any of their 8 neighbours.

    All cells of a plateau are peaks. Of more than `most` the first ones in row-major order are kept, not the highest.
    """
    height, width = centerness.shape
    framed = np.full((height + 2, width + 2), -np.inf, dtype=np.float32)
    framed[1:-1, 1:-1] = centerness
    highest = np.maximum(framed[:-2], framed[2:])
    np.maximum(highest, framed[1:-1], out=highest)
    around = np.maximum(highest[:, :-2], highest[:, 2:])
    np.maximum(around, highest[:, 1:-1], out=around)
    return np.argwhere((centerness == around) & (centerness > np.float32(threshold)))[:most]


def nearest_peaks(points: AnyArray, peaks: AnyArray) -> IntArray:
    """Which of the peaks (K, 2) is nearest to each of the points (2, P), float32: (P,), the first of ties.

    Every distance is rounded to float32 at each step, the root included, so some different distances become equal.
    """
    count = points.shape[1]
    if count == 0:
        return np.zeros(0, dtype=np.int64)
    if count * len(peaks) < _MANY:
        tile, choice = np.zeros(count, dtype=np.int64), np.arange(len(peaks))[None]
    else:
        tile, choice = _choices(points, peaks)
    rows, columns = peaks[:, 0][choice], peaks[:, 1][choice]
    nearest = np.empty(count, dtype=np.int64)
    step = max(1, _BLOCK // choice.shape[1])
    for start in range(0, count, step):
        block = slice(start, start + step)
        here = tile[block]
        down, across = rows.take(here, axis=0), columns.take(here, axis=0)
        down -= points[0, block, None]
        across -= points[1, block, None]
        down *= down
        across *= across
        down += across
        np.sqrt(down, out=down)  # squares one float32 step apart can have the same root
        nearest[block] = choice[here, down.argmin(axis=1)]
    return nearest


def _choices(points: AnyArray, peaks: AnyArray) -> tuple[IntArray, IntArray]:
    """The tile (P,) of each point, and for each tile the peaks (R, C) that can be nearest in it, ascending."""
    low = points.min(axis=1).astype(np.float64)
    size = np.maximum(points.max(axis=1) - low, 1) / _TILES
    inside = np.minimum((points - low[:, None]) / size[:, None], _TILES - 1).astype(np.int64)
    possible = _possible(low[:, None] + np.arange(_TILES + 1) * size[:, None], peaks)
    counts = possible.sum(axis=1)
    choice = np.argsort(~possible, axis=1, kind="stable")[:, : counts.max()]
    # short rows are filled up with their first peak, which a later equal one never replaces
    choice = np.where(np.arange(choice.shape[1]) < counts[:, None], choice, choice[:, :1])
    return inside[0] * _TILES + inside[1], choice


def _possible(lines: FloatArray, peaks: AnyArray) -> BoolArray:
    """(R, K) whether a peak can be the nearest to some point of a tile; `lines` (2, tiles + 1) bound the tiles.

    It cannot if another one is nearer to all four corners: the difference of two squared distances is linear.
    """
    down, across = (lines[..., None] - peaks.T[:, None].astype(np.float64)) ** 2
    squared = down[:, None] + across
    corners = np.stack([squared[:-1, :-1], squared[1:, :-1], squared[:-1, 1:], squared[1:, 1:]])
    rival = corners.sum(axis=0).argmin(axis=-1)[None, ..., None]
    limit = np.take_along_axis(corners, rival, axis=-1) + _ROUNDING * squared.max()
    possible: BoolArray = (corners <= limit).any(axis=0)
    return possible.reshape(-1, len(peaks))
