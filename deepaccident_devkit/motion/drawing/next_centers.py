"""Where instances are at the next frame, seen from this one: the centres of their warped cells.

Warping whole maps would sample every cell of the grid, most of which show nobody. Only the cells around each footprint
are sampled here, by the same numbers.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from deepaccident_devkit.exact.single_precision import SamplingLine
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion.config import MotionLabelConfig
from deepaccident_devkit.motion.drawing.label_maps import CoveredCells
from deepaccident_devkit.motion.protocols import LabelProtocol
from deepaccident_devkit.motion.warps.warping import nearest_indices, sampling_lines
from deepaccident_devkit.support.arrays import AnyArray, Float32Array, FloatArray, IntArray

_MARGIN: Final = 0.75
"""In cells, around a footprint: half a cell for the nearest sampling, and some for the rounding of the points."""
_FARTHEST: Final = 2.0**16
"""In cells: with the first sample point farther away, the rounding of float32 would outgrow the margin."""


class Footprints(NamedTuple):
    """Rasterised polygons of all frames in the order of their frames, in native orientation.

    Attributes:
        corners: (n, V, 2) int64, column and row.
        frame: (n,) int64, ascending.
        identity: (n,) int64, ids from 1.
        top: (frames · cells,) int32, 1 + the polygon on top of each cell, 0 where there is none.
    """

    corners: IntArray
    frame: IntArray
    identity: IntArray
    top: AnyArray


class _Runs(NamedTuple):
    """Cells of target frames that can sample a footprint, in R pieces of rows; a footprint's cells appear only once.

    Attributes:
        polygon: (R,) the footprint.
        frame: (R,) the target frame.
        row: (R,) the row there.
        first: (R,) the first column.
        length: (R,) how many cells.
    """

    polygon: IntArray
    frame: IntArray
    row: IntArray
    first: IntArray
    length: IntArray


def following_centers(
    footprints: Footprints, next_from_this: AnyArray, config: MotionLabelConfig, ids: int
) -> Float32Array:
    """(T, 1 + ids, 2) centres of the instances at the next frame, warped to each frame; NaN where they are not seen.

    Args:
        footprints: of the T frames.
        next_from_this: (T − 1, 4, 4) as `sampling_matrix` gives them, finite.
        config: of the labels.
        ids: the highest id.
    """
    grid, rules = config.grid.with_orientation(config.rules.native), config.rules
    lines = sampling_lines(next_from_this, grid, rules)
    spread = _spread(lines, grid)
    runs = None if spread is None else _runs_near(footprints, *spread, grid)
    polygon, row, column = (
        _seen_anywhere(footprints, next_from_this, grid, rules)
        if runs is None
        else _seen_near(footprints, runs, lines, grid)
    )
    warped = CoveredCells(
        frame=footprints.frame[polygon] - 1,
        row=row,
        column=column,
        identity=footprints.identity[polygon],
        frames=len(next_from_this) + 1,
        ids=ids,
    )
    return warped.centers()


def _seen_anywhere(
    footprints: Footprints, matrices: AnyArray, grid: BevGrid, rules: LabelProtocol
) -> tuple[IntArray, IntArray, IntArray]:
    """Footprints that cells of the frames before sample, and the cells' rows and columns; all cells are looked at."""
    maps = footprints.top.reshape(-1, grid.cells)[1:]
    sampled = [
        np.append(top, np.int32(0)).take(nearest_indices(matrix, grid, rules))
        for matrix, top in zip(matrices, maps, strict=True)
    ]
    joined = np.concatenate([np.zeros(0, dtype=np.int64), *sampled])
    cell = np.flatnonzero(joined)
    row, column = np.divmod(cell % grid.cells, grid.shape[1])
    return joined[cell] - 1, row, column


def _seen_near(
    footprints: Footprints, runs: _Runs, lines: tuple[SamplingLine, SamplingLine], grid: BevGrid
) -> tuple[IntArray, IntArray, IntArray]:
    """The same; only the runs' cells are looked at."""
    rows, columns = grid.shape
    run = np.repeat(np.arange(len(runs.length)), runs.length)
    before = np.cumsum(runs.length) - runs.length
    column = np.arange(len(run)) + (runs.first + runs.frame * columns - before).take(run)
    # the points are near the grid, so int32 holds them; below 0, uint32 is large
    down, along = (np.rint(line.points_of(runs.frame, runs.row, column, run)).astype(np.int32) for line in lines)
    inside = down.view(np.uint32) < rows
    inside &= along.view(np.uint32) < columns
    source = ((runs.frame + 1) * grid.cells).take(run)
    source += down * np.int32(columns)
    source += along
    inside &= footprints.top.take(source, mode="clip") == (runs.polygon + 1).astype(np.int32).take(run)
    seen = np.flatnonzero(inside)
    of_run = run[seen]
    return runs.polygon[of_run], runs.row[of_run], column[seen] - runs.frame[of_run] * columns


def _runs_near(footprints: Footprints, origin: FloatArray, inverse: FloatArray, grid: BevGrid) -> _Runs | None:
    """The cells around the footprints of all frames but the first; None if these are more than a few frames' cells."""
    polygon = np.flatnonzero(footprints.frame > 0)
    corners, frame = footprints.corners[polygon, :, ::-1], footprints.frame[polygon] - 1
    last = np.array(grid.shape) - 1
    low, high = (np.minimum(np.maximum(ends, 0), last) for ends in (corners.min(axis=1), corners.max(axis=1)))
    center = (inverse[frame] @ ((low + high) / 2 - origin[frame])[..., None])[..., 0]
    reach = (np.abs(inverse)[frame] @ ((high - low) / 2 + _MARGIN)[..., None])[..., 0]
    first = np.maximum(np.ceil(center - reach), 0).astype(np.int64)
    count = np.maximum(np.minimum(np.floor(center + reach), last).astype(np.int64) - first + 1, 0)
    if (count[:, 0] * count[:, 1]).sum() > len(footprints.top):
        return None
    of_run = np.repeat(np.arange(len(count)), count[:, 0])
    before = np.cumsum(count[:, 0]) - count[:, 0]
    return _Runs(
        polygon=polygon[of_run],
        frame=frame[of_run],
        row=np.arange(len(of_run)) + (first[:, 0] - before)[of_run],
        first=first[of_run, 1],
        length=count[of_run, 1],
    )


def _spread(lines: tuple[SamplingLine, SamplingLine], grid: BevGrid) -> tuple[FloatArray, FloatArray] | None:
    """The first cells' sample points (N, 2), and (N, 2, 2) how far target cells lie apart for each cell of the source.

    None where the points are too far away, or too near to each other or too far apart, for what is done with it.
    """
    rows, columns = grid.shape
    if min(rows, columns) < 2:
        return None
    points = np.array(
        [
            line.finish(line.of_row[:, [0, -1, 0]] + line.of_column[:, [0, 0, -1]] + line.shift[:, None])
            for line in lines
        ],
        dtype=np.float64,
    )
    steps = (points[..., 1:] - points[..., :1]) / (rows - 1, columns - 1)
    (down, along), (down_column, along_column) = steps.transpose(0, 2, 1)
    scale = down * along_column - along * down_column
    if not (np.abs(points) < _FARTHEST).all() or not ((np.abs(scale) > 0.25) & (np.abs(scale) < 4)).all():
        return None
    inverse = np.array([[along_column, -along], [-down_column, down]]) / scale
    return points[..., 0].T, inverse.transpose(2, 0, 1)
