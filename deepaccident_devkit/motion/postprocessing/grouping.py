"""Instances of one frame from a model's maps: peaks of the centerness, and the nearest peak of each foreground cell.

The rules are the released ones (docs/released_code.md, Post-processing), FIERY's: everything in float32, cells in
row-major order, and of equals the first one counts. Arrays here are in the orientation of `PostProcessing.scan`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray, IntArray
from deepaccident_devkit.motion.postprocessing.nearest_peaks import nearest_peaks


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
