"""Which points lie in which oriented box, over arrays; a coarse grid quickly excludes most points."""

import numpy as np

from deepaccident_devkit.support.arrays import FloatArray, IntArray

_CELLS = 128
"""Cells of the coarse grid along x and along y, over the ground that the boxes cover."""
_POINTS_AT_ONCE = 1 << 13
"""Points that are processed together: the arrays are so small that their memory is reused, which halves the time."""
_PAIRS_AT_ONCE = 1 << 17
"""Pairs of windows and points that are processed together: their memory fits into the processor's cache."""


def points_in_boxes(
    points: FloatArray, center: FloatArray, half: FloatArray, axes: FloatArray
) -> tuple[IntArray, IntArray]:
    """Every pair of a box and a point in it, faces included: rows of boxes (K,) and rows of points (K,).

    A point p is in a box if |(p − centre) · a| ≤ half for each of its three axes a, with the products summed as
    (x + y) + z. Grid and windows only leave out points that cannot be inside, so the result is exactly that of this
    rule. NaN lies in no box. Pairs are sorted by box, then by point.

    Args:
        points: (P, 3), metres.
        center: (N, 3), metres, in the same coordinate frame.
        half: (N, 3), half of length, width, height, metres.
        axes: (N, 3, 3), rotation matrices: the columns are the box's axes.
    """
    reach = (np.abs(axes) @ half[:, :, None])[:, :, 0] * 1.001 + 1e-6  # wider than any rounding
    low, high = center - reach, center + reach
    near = _near_any(points, low, high)
    x, y, z = np.ascontiguousarray(points[near].T)
    boxes, rows = _in_windows(x, y, low, high)
    dx, dy, dz = x[rows] - center[boxes, 0], y[rows] - center[boxes, 1], z[rows] - center[boxes, 2]
    inside = np.ones(len(rows), dtype=bool)
    for axis in range(3):
        along_x, along_y, along_z = axes[:, :, axis].T
        along = dx * along_x[boxes] + dy * along_y[boxes] + dz * along_z[boxes]
        inside &= np.abs(along) <= half[boxes, axis]
    return boxes[inside], near[rows[inside]]


def _in_windows(x: FloatArray, y: FloatArray, low: FloatArray, high: FloatArray) -> tuple[IntArray, IntArray]:
    """Every pair of a window (N,) and a point (P,) in it, seen from above."""
    step = max(1, _PAIRS_AT_ONCE // max(1, len(x)))
    windows, rows = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for start in range(0, len(low), step):
        first, last = low[start : start + step, :2, None], high[start : start + step, :2, None]
        within = (x >= first[:, 0]) & (x <= last[:, 0])
        within &= (y >= first[:, 1]) & (y <= last[:, 1])
        window, row = np.divmod(np.flatnonzero(within), max(1, len(x)))
        windows.append(window + start)
        rows.append(row)
    return np.concatenate(windows), np.concatenate(rows)


def _near_any(points: FloatArray, low: FloatArray, high: FloatArray) -> IntArray:
    """Rows, ascending, of the points in coarse cells that the window (`low` to `high`) of any box touches."""
    windows = np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1)
    if not windows.any():
        return np.zeros(0, dtype=np.int64)
    low, high = low[windows, :2], high[windows, :2]
    origin, end = low.min(axis=0), high.max(axis=0)
    scale = (_CELLS - 1) / np.maximum(end - origin, 1e-6)  # the width can be 0 after rounding of very large numbers
    touched = np.zeros((_CELLS, _CELLS), dtype=bool)
    # points and windows go through the same rising function, so a point in a window is in a cell of the window
    first, last = ((low - origin) * scale).astype(int), ((high - origin) * scale).astype(int)
    for (column, row), (last_column, last_row) in zip(first.tolist(), last.tolist(), strict=True):
        touched[column : last_column + 1, row : last_row + 1] = True
    found = [np.zeros(0, dtype=np.int64)]
    for start in range(0, len(points), _POINTS_AT_ONCE):
        x, y = np.ascontiguousarray(points[start : start + _POINTS_AT_ONCE, :2].T)
        within = (x >= origin[0]) & (x <= end[0])
        within &= (y >= origin[1]) & (y <= end[1])
        rows = np.flatnonzero(within)
        cell = ((x[rows] - origin[0]) * scale[0]).astype(np.int64) * _CELLS
        cell += ((y[rows] - origin[1]) * scale[1]).astype(np.int64)
        found.append(rows[touched.ravel()[cell]] + start)
    return np.concatenate(found)
