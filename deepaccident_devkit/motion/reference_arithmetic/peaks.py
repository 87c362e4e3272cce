"""The highest cells of a map, and the nearest of them for each point.

Every rounding is that of torch's float32. The released code takes its instances' centres from
`max_pool2d`, and groups cells by the norm of their distances.
"""

from typing import Final

import numpy as np

from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray

# Distances that are computed at once: they fit into a processor's caches.
_DISTANCES_AT_ONCE: Final = 1 << 15
# From this number of distances on it is faster to exclude the peaks that cannot be nearest.
_MIN_DISTANCES_FOR_TILES: Final = 1 << 18
# Number of tiles along each axis; the peaks that can be nearest are found for each tile.
_TILES_PER_AXIS: Final = 12
# Squared distances that differ by a smaller share may change their order in float32 (its steps are
# 1.2e-7).
_ROUNDING_SHARE: Final = 1e-5


def find_peaks(centerness: AnyArray, threshold: float, max_peaks: int) -> IntArray:
    """Return the peaks of a map (H, W): rows and columns of cells, shape (K, 2).

    A peak is above `threshold` and not below any of its 8 neighbours. All cells of a plateau are
    peaks. If there are more than `max_peaks`, the result has the first ones in row-major order, not
    the highest.
    """
    height, width = centerness.shape
    padded = np.full((height + 2, width + 2), -np.inf, dtype=np.float32)
    padded[1:-1, 1:-1] = centerness
    column_maxima = np.maximum(padded[:-2], padded[2:])
    np.maximum(column_maxima, padded[1:-1], out=column_maxima)
    maxima = np.maximum(column_maxima[:, :-2], column_maxima[:, 2:])
    np.maximum(maxima, column_maxima[:, 1:-1], out=maxima)
    is_peak = (centerness == maxima) & (centerness > np.float32(threshold))
    return np.argwhere(is_peak)[:max_peaks]


def nearest_peaks(points: AnyArray, peaks: AnyArray) -> IntArray:
    """Return the number of the peak nearest to each point, shape (P,); the first one of ties.

    Every distance is rounded to float32 at each step, the root included, so that some different
    distances become equal.

    Args:
        points: Rows and columns, shape (2, P), float32.
        peaks: Rows and columns, shape (K, 2).
    """
    count = points.shape[1]
    if count == 0:
        return np.zeros(0, dtype=np.int64)
    if count * len(peaks) < _MIN_DISTANCES_FOR_TILES:
        tile = np.zeros(count, dtype=np.int64)
        candidates = np.arange(len(peaks))[None]
    else:
        tile, candidates = _candidates(points, peaks)
    rows = peaks[:, 0][candidates]
    columns = peaks[:, 1][candidates]
    nearest = np.empty(count, dtype=np.int64)
    step = max(1, _DISTANCES_AT_ONCE // candidates.shape[1])
    for start in range(0, count, step):
        block = slice(start, start + step)
        block_tile = tile[block]
        down = rows.take(block_tile, axis=0)
        across = columns.take(block_tile, axis=0)
        down -= points[0, block, None]
        across -= points[1, block, None]
        down *= down
        across *= across
        down += across
        np.sqrt(down, out=down)  # squares one float32 step apart can have the same root
        nearest[block] = candidates[block_tile, down.argmin(axis=1)]
    return nearest


def _candidates(points: AnyArray, peaks: AnyArray) -> tuple[IntArray, IntArray]:
    """Return the tile of each point, and the peaks that can be nearest in each tile.

    Returns:
        Tiles of the points, shape (P,), and numbers of peaks, shape (R, C), ascending in each row.
    """
    low = points.min(axis=1).astype(np.float64)
    size = np.maximum(points.max(axis=1) - low, 1) / _TILES_PER_AXIS
    offsets = (points - low[:, None]) / size[:, None]
    row, column = np.minimum(offsets, _TILES_PER_AXIS - 1).astype(np.int64)
    lines = low[:, None] + np.arange(_TILES_PER_AXIS + 1) * size[:, None]
    possible = _can_be_nearest(lines, peaks)
    counts = possible.sum(axis=1)
    candidates = np.argsort(~possible, axis=1, kind="stable")[:, : counts.max()]
    # Short rows are filled with their first peak, which a later equal one never replaces.
    is_candidate = np.arange(candidates.shape[1]) < counts[:, None]
    candidates = np.where(is_candidate, candidates, candidates[:, :1])
    return row * _TILES_PER_AXIS + column, candidates


def _can_be_nearest(lines: FloatArray, peaks: AnyArray) -> BoolArray:
    """Return whether a peak can be the nearest to some point of a tile, shape (R, K).

    It cannot if another one is nearer to all four corners: the difference of two squared distances
    is linear.

    Args:
        lines: Bounds of the tiles along both axes, shape (2, tiles + 1).
        peaks: Rows and columns, shape (K, 2).
    """
    down, across = (lines[..., None] - peaks.T[:, None].astype(np.float64)) ** 2
    squared = down[:, None] + across
    corners = np.stack([squared[:-1, :-1], squared[1:, :-1], squared[:-1, 1:], squared[1:, 1:]])
    rival = corners.sum(axis=0).argmin(axis=-1)[None, ..., None]
    rival_corners = np.take_along_axis(corners, rival, axis=-1)
    limit = rival_corners + _ROUNDING_SHARE * squared.max()
    possible: BoolArray = (corners <= limit).any(axis=0)
    return possible.reshape(-1, len(peaks))
