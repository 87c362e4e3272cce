"""The peaks of a map, and the peak nearest to each point.

Every rounding is as in torch's float32. The released code finds the instances' centres with
`max_pool2d`, and assigns each cell to the centre nearest to the point that its offset leads to.
"""

import numpy as np

from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray

# Number of distances that are computed at once: they fit into a processor's caches.
_DISTANCES_AT_ONCE = 1 << 15
# From this number of distances on it is faster to exclude the peaks that cannot be nearest.
_MIN_DISTANCES_FOR_TILES = 1 << 18
# Number of tiles along each axis; the peaks that can be nearest are found for each tile.
_TILES_PER_AXIS = 12
# Squared distances with a smaller relative difference may change their order in float32 (its
# resolution is 1.2e-7).
_ROUNDING_SHARE = 1e-5


def find_peaks(centerness: AnyArray, threshold: float, max_peaks: int) -> IntArray:
    """Return the rows and columns of the peaks of a map (H, W), shape (K, 2).

    A peak is above `threshold` and not lower than any of its 8 neighbours. All cells of a plateau
    are peaks. If there are more than `max_peaks`, the first ones in row-major order are returned,
    not the highest.
    """
    height, width = centerness.shape
    padded = np.full((height + 2, width + 2), -np.inf, dtype=np.float32)
    padded[1:-1, 1:-1] = centerness
    # First the largest of three cells down a column, then the largest of three along a row.
    column_maxima = np.maximum(padded[:-2], padded[2:])
    np.maximum(column_maxima, padded[1:-1], out=column_maxima)
    maxima = np.maximum(column_maxima[:, :-2], column_maxima[:, 2:])
    np.maximum(maxima, column_maxima[:, 1:-1], out=maxima)
    is_peak = (centerness == maxima) & (centerness > np.float32(threshold))
    return np.argwhere(is_peak)[:max_peaks]


def nearest_peaks(points: AnyArray, peaks: AnyArray) -> IntArray:
    """Return the index of the peak nearest to each point, shape (P,); the first one in a tie.

    Distances are rounded to float32 at each step, including the root, so that some different
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
        tile, candidates = _find_candidates(points, peaks)
    peak_rows = peaks[:, 0][candidates]
    peak_columns = peaks[:, 1][candidates]
    nearest = np.empty(count, dtype=np.int64)
    step = max(1, _DISTANCES_AT_ONCE // candidates.shape[1])
    for start in range(0, count, step):
        block = slice(start, start + step)
        block_tile = tile[block]
        down = peak_rows.take(block_tile, axis=0)
        across = peak_columns.take(block_tile, axis=0)
        down -= points[0, block, None]
        across -= points[1, block, None]
        down *= down
        across *= across
        down += across
        np.sqrt(down, out=down)  # squares one float32 step apart can have the same root
        nearest[block] = candidates[block_tile, down.argmin(axis=1)]
    return nearest


def _find_candidates(points: AnyArray, peaks: AnyArray) -> tuple[IntArray, IntArray]:
    """Return the tile of each point, and the peaks that can be nearest to a point in each tile.

    Returns:
        Tile index of each point, shape (P,), and the indices of each tile's candidate peaks, shape
        (R, C) for R tiles, ascending in each row.
    """
    low = points.min(axis=1).astype(np.float64)
    size = np.maximum(points.max(axis=1) - low, 1) / _TILES_PER_AXIS
    offsets = (points - low[:, None]) / size[:, None]
    row, column = np.minimum(offsets, _TILES_PER_AXIS - 1).astype(np.int64)
    bounds = low[:, None] + np.arange(_TILES_PER_AXIS + 1) * size[:, None]
    can_be_nearest = _can_be_nearest(bounds, peaks)
    counts = can_be_nearest.sum(axis=1)
    candidates = np.argsort(~can_be_nearest, axis=1, kind="stable")[:, : counts.max()]
    # Short rows are padded with their first peak, which never wins over itself.
    is_candidate = np.arange(candidates.shape[1]) < counts[:, None]
    candidates = np.where(is_candidate, candidates, candidates[:, :1])
    return row * _TILES_PER_AXIS + column, candidates


def _can_be_nearest(bounds: FloatArray, peaks: AnyArray) -> BoolArray:
    """Return whether each peak can be the nearest one to some point in each tile, shape (R, K).

    A peak cannot be the nearest if another one is nearer to all four corners of the tile, since the
    difference of two squared distances is linear.

    Args:
        bounds: Bounds of the tiles along both axes, shape (2, tiles + 1).
        peaks: Rows and columns, shape (K, 2).
    """
    offsets = bounds[..., None] - peaks.T[:, None].astype(np.float64)
    down, across = offsets**2
    squared = down[:, None] + across
    upper = squared[:-1]
    lower = squared[1:]
    corners = np.stack([upper[:, :-1], lower[:, :-1], upper[:, 1:], lower[:, 1:]])
    rival = corners.sum(axis=0).argmin(axis=-1)[None, ..., None]
    rival_corners = np.take_along_axis(corners, rival, axis=-1)
    limit = rival_corners + _ROUNDING_SHARE * squared.max()
    can_be_nearest: BoolArray = (corners <= limit).any(axis=0)
    return can_be_nearest.reshape(-1, len(peaks))
