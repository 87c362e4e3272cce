"""The squares around the ego in which metrics are counted, such as `30x30`."""

from __future__ import annotations

import math
from typing import Final

from deepaccident_devkit.geometry import BevGrid

_TINY: Final = 1e-6
"""Cells: edges of a range fall on edges of cells but for rounding."""


def cells_within(grid: BevGrid, extent: float) -> tuple[slice, slice]:
    """Rows and columns of the cells whose centres are in a square of `extent` metres around the ego."""
    spans = [
        [min(max(math.ceil((edge - low) / size - 0.5 - _TINY), 0), round((high - low) / size)) for edge in edges]
        for (low, high, size), edges in ((axis, (-extent / 2, extent / 2)) for axis in (grid.x, grid.y))
    ]
    along_x, along_y = (slice(first, stop) for first, stop in spans)
    if grid.orientation == "fiery":
        return along_x, along_y
    if grid.orientation == "released":
        rows = grid.shape[0]
        along_y = slice(rows - along_y.stop, rows - along_y.start)
    return along_y, along_x
