"""Warping a raster into another ego frame: which source cell or point each target cell takes its value from.

Sampling is done in a protocol's `native` orientation, with matrices of that orientation's handedness, by one of
three rules (`WarpRule`):

- `stretched`: the released `FeatureWarper` (docs/released_code.md, Warps), which is BEVerse's. Sample points stand at
  linspace(−49.75, 50, 200) along either axis instead of at the cells' centres, and the outermost of them are treated
  as the grid's ends: without motion, cell i samples 0.4975 + 0.9975 i, which nearest sampling rounds to i, and which
  blurs bilinear sampling by up to half a cell. Each rounding to float32 is repeated, since the last bit decides for
  points that lie on the border between two cells (except for the angles of the egomotion:
  `chains.egomotion`). Grids that are not centred on the ego have no meaning in the released code; they are
  stretched about their own middle.
- `exact`: cell centres, in float64; without motion every cell gets its own value, in either mode.
- `fiery`: FIERY's (docs/released_code.md, FIERY's own labels), native in `fiery`. Cell centres; of the motion only
  the 6-vector's yaw and planar translation count, combined as source = Rot(−yaw) · target + (−tx, +ty): the sideways
  shift has the wrong sign, and neither shift is turned. FIERY has only square grids centred on the ego; on others we
  measure in metres from the ego.

The transform is rigid (or A · rigid · A⁻¹ with an augmentation A). Points lie on the plane z = 0; only x and y of the
transformed points count. `source_from_target` maps points of the result's frame to points of the raster's frame:
`sampling_matrix` gets it from the released code's arguments, which go the other way.
"""

import functools
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.exact.single_precision import (
    OUTSIDE,
    CellIndices,
    SamplingLine,
    blend_cells,
    exact_lines,
    fiery_lines,
    inverse,
    stretched_lines,
    take_cells,
)
from deepaccident_devkit.geometry import BevGrid, conventions
from deepaccident_devkit.geometry.bev_grid import Orientation, axes_of
from deepaccident_devkit.motion.protocols import LabelProtocol
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, checked
from deepaccident_devkit.support.text import choice

WarpMode = Literal["nearest", "bilinear"]
_COUNTABLE: Final = 2**24
"""How many cells float32 can number."""


def sampling_matrix(target_from_source: ArrayLike, rules: LabelProtocol) -> AnyArray:
    """`source_from_target` of transforms (N, 4, 4), as the protocol computes it: float32, by elimination, or float64.

    Raises:
        GeometryError: another shape.
    """
    if rules.warp == "stretched":
        return inverse(checked("target_from_source", target_from_source, (None, 4, 4), np.float32))
    result: FloatArray = np.linalg.inv(checked("target_from_source", target_from_source, (None, 4, 4)))
    return result


def nearest_indices(
    source_from_target: ArrayLike, grid: BevGrid, rules: LabelProtocol, *, orientation: Orientation | None = None
) -> CellIndices:
    """The source cell of each target cell.

    Points half-way between two cells go to the even one.

    Args:
        source_from_target: (4, 4) metres, in the protocol's handedness.
        grid: the cells of both rasters; its own orientation does not matter.
        rules: the protocol that says how to sample.
        orientation: of the rasters that the indices are for; None for the protocol's native orientation.

    Returns:
        (H·W,) intp, row · W + column of the source cell, in the order of the target's cells; −1 (`OUTSIDE`) where the
        sample point is outside the grid.

    Raises:
        GeometryError: the matrix has another shape or is not finite, or the grid has more than 2²⁴ cells.
    """
    return rounded_points(sample_points(source_from_target, grid, rules), grid, rules, orientation)


def rounded_points(
    points: tuple[AnyArray, AnyArray], grid: BevGrid, rules: LabelProtocol, orientation: Orientation | None = None
) -> CellIndices:
    """`nearest_indices` from the sample points."""
    if grid.cells > _COUNTABLE:
        raise GeometryError(f"grid: {grid.cells} cells are more than a warp can number; choose at most {_COUNTABLE}")
    row, column = (np.rint(point) for point in points)
    rows, columns = row.shape
    beside = (row < 0) | (row >= rows)
    beside |= column < 0
    beside |= column >= columns
    native = rules.native
    lying = native if orientation is None else orientation
    first, down, along = _numbering(grid.with_orientation(lying), native)
    row *= down
    column *= along
    row += column
    row += first
    np.copyto(row, OUTSIDE, where=beside)
    cells = row.astype(np.int32)  # first to int32, then to intp: three times as fast
    return grid.with_orientation(native).reorient(cells, lying).astype(np.intp).ravel()


def warp(
    raster: ArrayLike,
    source_from_target: ArrayLike,
    grid: BevGrid,
    rules: LabelProtocol,
    mode: WarpMode = "nearest",
    *,
    fill: float = 0,
    orientation: Orientation | None = None,
) -> AnyArray:
    """Rasters in another frame; all of them (leading axes) the same way.

    Args:
        raster: (…, H, W) in `orientation`.
        source_from_target: (4, 4) metres, in the protocol's handedness.
        grid: the cells; its own orientation does not matter.
        rules: the protocol that says how to sample.
        mode: the value of the nearest cell, or of the four around the sample point, weighted.
        fill: the value outside the grid; if the mode is bilinear, it mixes with the border's cells.
        orientation: how the rasters lie; None for the protocol's native orientation. Only cells change places: vectors
            do not turn.

    Returns:
        The same shape and orientation; of the same dtype if `nearest`, float32 if `bilinear`.

    Raises:
        GeometryError: a shape that does not fit, or a matrix that is not finite.
        ChoiceError: no such mode.
    """
    native = rules.native
    lying = grid.with_orientation(orientation or native)
    source = np.asarray(raster)
    by_native_rows = lying.reorient(source, native)  # a view; refuses other shapes
    if checked_mode(mode) == "nearest":
        indices = nearest_indices(source_from_target, grid, rules, orientation=orientation)
        return take_cells(source.reshape(*source.shape[:-2], -1), indices, fill).reshape(source.shape)
    result = np.empty(source.shape, dtype=np.float32)
    points = sample_points(source_from_target, grid, rules)
    lying.reorient(result, native)[...] = blend_cells(by_native_rows, points, fill)
    return result


def checked_mode(mode: WarpMode) -> WarpMode:
    """`mode`, or ChoiceError."""
    return choice("mode", mode, get_args(WarpMode))


def sample_points(source_from_target: ArrayLike, grid: BevGrid, rules: LabelProtocol) -> tuple[AnyArray, AnyArray]:
    """Where in the source each target cell samples: rows and columns (H, W), in cells, 0 the first cell's centre.

    Native orientation; float32, but float64 if `exact`. Raises GeometryError.
    """
    matrix = checked("source_from_target", source_from_target, (4, 4))
    if not np.isfinite(matrix).all():
        raise GeometryError("source_from_target: not all numbers are finite; leave out frames without a pose")
    rows, columns = sampling_lines(matrix[None], grid, rules)
    return rows.points(), columns.points()


def sampling_lines(matrices: AnyArray, grid: BevGrid, rules: LabelProtocol) -> tuple[SamplingLine, SamplingLine]:
    """What `sample_points` computes its rows and columns from, for matrices (N, 4, 4): to sample only some cells."""
    if rules.warp == "fiery":
        numbers = conventions.six_vectors_of(np.linalg.inv(matrices)).astype(np.float32).T[..., None]
        return fiery_lines(numbers[0], numbers[1], numbers[5], grid.x, grid.y)
    native = grid.with_orientation(rules.native)
    order = [0, 1] if native.orientation == "fiery" else [1, 0]
    planes = matrices[:, order][:, :, [*order, 3]]  # z = 0: metres along rows and columns
    if rules.warp == "exact":
        return exact_lines(planes, axes_of(native))
    return stretched_lines(planes.astype(np.float32), axes_of(native))


@functools.lru_cache(maxsize=64)
def _numbering(grid: BevGrid, native: Orientation) -> tuple[int, int, int]:
    """How `grid`'s orientation numbers the cells of the native one: the first, the step of a row, of a column."""
    numbers = grid.reorient(np.arange(grid.cells).reshape(grid.shape), native)
    first, below, beside = (int(corner) for corner in (numbers[0, 0], numbers[-1, 0], numbers[0, -1]))
    rows, columns = (max(count - 1, 1) for count in numbers.shape)
    return first, (below - first) // rows, (beside - first) // columns
