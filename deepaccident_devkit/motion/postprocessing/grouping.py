"""Instances of one frame from a model's maps: peaks of the centerness, and the nearest peak of each foreground cell.

The rules are the released ones (docs/released_code.md, Post-processing), FIERY's: everything in float32, cells in
row-major order, and of equals the first one counts. Arrays here are in the orientation of `PostProcessing.scan`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray, FloatArray, IntArray

_BLOCK: Final = 1 << 15
"""How many distances are computed at once: as many as a processor's caches hold."""
_MANY: Final = 1 << 18
"""With at least so many distances it is faster to leave out the peaks that cannot be nearest."""
_TILES: Final = 12
"""Number of tiles along each axis; for each tile such peaks are found."""
_ROUNDING: Final = 1e-5
"""Squared distances that differ by a smaller share may change their order in float32 (its steps are 1.2e-7)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameGroups:
    """The instances of one frame; ids run from 1 to I without gaps, (row, column) are cells.

    Attributes:
        ids: (P,) int64 the instance of each cell of the foreground; 0 for cells that count as background all the same.
        count: (I + 1,) cells of each id.
        position_sum: (2, I + 1) float64 sums of their rows and columns.
        moved_sum: (2, I + 1) float64 sums of where the flow takes them.
    """

    ids: IntArray
    count: FloatArray
    position_sum: FloatArray
    moved_sum: FloatArray

    @property
    def instances(self) -> int:
        """How many instances there are: the highest id."""
        return len(self.count) - 1


def find_peaks(centerness: AnyArray, threshold: float, most: int) -> IntArray:
    """Cells of one frame above `threshold` and not below any of their 8 neighbours; all cells of a plateau are peaks.

    Args:
        centerness: (H, W) float32.
        threshold: peaks are above it, not equal to it; not negative.
        most: how many are kept: the first ones in row-major order, not the highest ones.

    Returns:
        (K, 2) int64 rows and columns, in row-major order.
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
    """The nearest peak of each point; of several equally near ones the first.

    Every distance is rounded to float32 at each step, the root included, so some different distances become equal.

    Args:
        points: (2, P) float32 rows and columns, finite.
        peaks: (K, 2) float32 rows and columns; at least one unless there are no points.

    Returns:
        (P,) int64 indices into `peaks`.
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


def group_cells(
    peaks: IntArray, position: AnyArray, offset: AnyArray, flow: AnyArray, *, all_cells: bool
) -> FrameGroups:
    """Instances of one frame: the foreground's cells by the peak nearest to where their offset points.

    If all cells are foreground, the lowest instance becomes the background: ids are the ranks of all ids that occur,
    from 0.

    Args:
        peaks: (K, 2) rows and columns; at least one unless there are no cells.
        position: (2, P) float32 rows and columns of the foreground's cells.
        offset: (2, P) float32 rows and columns from each to its instance's centre.
        flow: (2, P) float32 rows and columns to where each is at the next frame.
        all_cells: whether these are all cells of the frame.
    """
    nearest = nearest_peaks(position + offset, peaks.astype(np.float32)) + 1
    occurs = np.bincount(nearest, minlength=len(peaks) + 1) > 0
    occurs[0] = not all_cells
    ids = (np.cumsum(occurs) - 1)[nearest]
    length = max(int(occurs.sum()), 1)
    moved = position + flow
    return FrameGroups(
        ids=ids,
        count=np.bincount(ids, minlength=length).astype(np.float64),
        position_sum=np.stack([sums_by(ids, along, length) for along in position]),
        moved_sum=np.stack([sums_by(ids, along, length) for along in moved]),
    )


def sums_by(ids: IntArray, values: AnyArray, length: int) -> FloatArray:
    """(length,) float64 sums of `values` by `ids`; ids from `length` on are left out."""
    return np.bincount(ids, values, length)[:length].astype(np.float64, copy=False)


def means(sums: FloatArray, counts: FloatArray) -> AnyArray:
    """(2, N) sums over (N,) counts → (N, 2) float32 means, equal to torch's of float32 values."""
    return (sums / counts).T.astype(np.float32)
