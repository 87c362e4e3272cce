"""Warping a raster into another ego frame: which source cell or point each target cell takes its value from.

Sampling is done in a protocol's `native` orientation, with matrices of that orientation's handedness, by one of
three rules (`WarpRule`):

- `stretched`: the released `FeatureWarper` (docs/released_code.md, Warps), which is BEVerse's. Sample points stand at
  linspace(−49.75, 50, 200) along either axis instead of at the cells' centres, and the outermost of them are treated
  as the grid's ends: without motion, cell i samples 0.4975 + 0.9975 i, which nearest sampling rounds to i, and which
  blurs bilinear sampling by up to half a cell. Each rounding to float32 is repeated, since the last bit decides for
  points that lie on the border between two cells (except for the angles of the egomotion:
  `single_precision.six_vectors`). Grids that are not centred on the ego have no meaning in the released code; they are
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
from collections.abc import Callable
from typing import Final, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import BevGrid, six_vectors
from deepaccident_devkit.geometry.bev_grid import Axis, Orientation
from deepaccident_devkit.motion.orientations import axes_of
from deepaccident_devkit.motion.protocols import LabelProtocol
from deepaccident_devkit.motion.warps import single_precision
from deepaccident_devkit.support.arrays import AnyArray, Float32Array, FloatArray, IntArray, checked
from deepaccident_devkit.support.text import choice

WarpMode = Literal["nearest", "bilinear"]
CellIndices = NDArray[np.intp]
OUTSIDE: Final = -1
"""In `nearest_indices`: the sample point is outside the grid and has no value."""
_COUNTABLE: Final = 2**24
"""How many cells float32 can number."""


def sampling_matrix(target_from_source: ArrayLike, rules: LabelProtocol) -> AnyArray:
    """`source_from_target` of transforms (N, 4, 4), as the protocol computes it: float32, by elimination, or float64.

    Raises:
        GeometryError: another shape.
    """
    if rules.warp == "stretched":
        return single_precision.inverse(checked("target_from_source", target_from_source, (None, 4, 4), np.float32))
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


def take_cells(cells: AnyArray, indices: CellIndices, fill: float = 0) -> AnyArray:
    """The cells (…, H·W) that `nearest_indices` says, `fill` where it says `OUTSIDE`."""
    padded = np.empty((*cells.shape[:-1], cells.shape[-1] + 1), dtype=cells.dtype)
    padded[..., :-1] = cells
    padded[..., OUTSIDE] = fill
    taken: AnyArray = padded.take(indices, axis=-1)
    return taken


def blend_cells(raster: AnyArray, points: tuple[AnyArray, AnyArray], fill: float = 0) -> Float32Array:
    """The values (…, H, W) of a raster at sample points, each the weighted mean of the four cells around."""
    rows, columns = raster.shape[-2:]
    wide = columns + 3
    padded = np.full((*raster.shape[:-2], rows + 3, wide), fill, dtype=np.float32)
    padded[..., 1:-2, 1:-2] = raster
    cells = padded.reshape(*raster.shape[:-2], -1)
    above, down = _parted(points[0], rows)
    left, right = _parted(points[1], columns)
    above *= wide
    above += left
    above += wide + 1
    index = above.astype(np.int32).astype(np.intp)  # in two steps: three times as fast
    up, back = 1 - down, 1 - right
    result: Float32Array = cells.take(index, axis=-1, mode="clip")
    value = np.empty_like(result)
    result *= up * back
    for shift, weight in ((1, up * right), (wide, down * back), (wide + 1, down * right)):
        cells[..., shift:].take(index, axis=-1, mode="clip", out=value)
        value *= weight
        result += value
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


class SamplingLine(NamedTuple):
    """The rows, or the columns, at which target cells sample with N matrices: `finish(of_row + of_column + shift)`.

    Attributes:
        of_row: (N, H) what a target cell's row adds.
        of_column: (N, W) what its column adds.
        shift: (N,) what every cell adds.
        finish: from sums to cells of the source, 0 the first cell's centre; may write into its argument.
    """

    of_row: AnyArray
    of_column: AnyArray
    shift: AnyArray
    finish: Callable[[AnyArray], AnyArray]

    def points(self) -> AnyArray:
        """(H, W), of all target cells with the first matrix."""
        point = np.add.outer(self.of_row[0], self.of_column[0])
        point += self.shift[0]
        return self.finish(point)

    def points_of(self, matrix: IntArray, row: IntArray, column: IntArray, run: IntArray) -> AnyArray:
        """(P,), bit by bit those of `points`, of the target cells in `column` (P,) of `run` (P,).

        `matrix` and `row` (R,) are those of the runs; the columns of matrix m count from m · W.
        """
        point = self.of_row[matrix, row].take(run)
        point += self.of_column.reshape(-1).take(column)
        point += self.shift[matrix].take(run)
        return self.finish(point)


def sampling_lines(matrices: AnyArray, grid: BevGrid, rules: LabelProtocol) -> tuple[SamplingLine, SamplingLine]:
    """What `sample_points` computes its rows and columns from, for matrices (N, 4, 4): to sample only some cells."""
    if rules.warp == "fiery":
        return _fiery_lines(matrices, grid)
    native = grid.with_orientation(rules.native)
    planes = _planes(matrices if rules.warp == "exact" else matrices.astype(np.float32), native)
    line = _exact_line if rules.warp == "exact" else _stretched_line
    first, second = axes_of(native)
    return line(native, first, planes[:, 0]), line(native, second, planes[:, 1])


def _stretched_line(grid: BevGrid, axis: Axis, plane: AnyArray) -> SamplingLine:
    low, high, size = axis
    middle, half = (low + high) / 2, np.float32((high - low) / 2)
    scale = np.float32((round((high - low) / size) - 1) / 2)

    def finish(point: AnyArray) -> AnyArray:
        if middle:
            point -= np.float32(middle)
        point /= half
        point += np.float32(1)
        point *= scale
        return point

    rows, columns = (_released_coordinates(each) for each in axes_of(grid))
    return SamplingLine(plane[:, :1] * rows, plane[:, 1:2] * columns, plane[:, 2], finish)


def _exact_line(grid: BevGrid, axis: Axis, plane: AnyArray) -> SamplingLine:
    low, _, size = axis
    rows, columns = (_centers(each) for each in axes_of(grid))
    shift = (plane[:, 2] - low) / size - 0.5
    return SamplingLine(plane[:, :1] / size * rows, plane[:, 1:2] / size * columns, shift, _as_they_are)


def _as_they_are(point: AnyArray) -> AnyArray:
    return point


def _planes(matrices: AnyArray, grid: BevGrid) -> AnyArray:
    """(N, 2, 3) the parts that count on the plane z = 0, metres along rows and columns: factors and shift."""
    order = [0, 1] if grid.orientation == "fiery" else [1, 0]
    planes: AnyArray = matrices[:, order][:, :, [*order, 3]]
    return planes


def _fiery_lines(matrices: AnyArray, grid: BevGrid) -> tuple[SamplingLine, SamplingLine]:
    tx, ty, _, _, _, yaw = six_vectors.from_matrices(np.linalg.inv(matrices)).astype(np.float32).T[..., None]
    sine, cosine = single_precision.sines_and_cosines(yaw)
    half = np.float32((grid.x[1] - grid.x[0]) / 2)
    x, y = (_fiery_coordinates(axis, float(half)) for axis in (grid.x, grid.y))

    def finish(axis: Axis, point: AnyArray) -> AnyArray:
        point -= np.float32(axis[0] / half)
        # torch fuses these two steps: one rounding
        return (point.astype(np.float64) * float(half / axis[2]) - 0.5).astype(np.float32)

    return (
        SamplingLine(cosine * x, sine * y, -tx[:, 0] / half, functools.partial(finish, grid.x)),
        SamplingLine(-sine * x, cosine * y, ty[:, 0] / half, functools.partial(finish, grid.y)),
    )


def _parted(points: AnyArray, count: int) -> tuple[AnyArray, Float32Array]:
    """The cell before each point, from −1 (padding) to `count` (padding), and how far beyond it the point is."""
    clipped = np.clip(points, -1, count)
    before = np.floor(clipped)
    clipped -= before
    return before, clipped.astype(np.float32, copy=False)


@functools.lru_cache(maxsize=64)
def _numbering(grid: BevGrid, native: Orientation) -> tuple[int, int, int]:
    """How `grid`'s orientation numbers the cells of the native one: the first, the step of a row, of a column."""
    numbers = grid.reorient(np.arange(grid.cells).reshape(grid.shape), native)
    first, below, beside = (int(corner) for corner in (numbers[0, 0], numbers[-1, 0], numbers[0, -1]))
    rows, columns = (max(count - 1, 1) for count in numbers.shape)
    return first, (below - first) // rows, (beside - first) // columns


@functools.lru_cache(maxsize=64)
def _released_coordinates(axis: Axis) -> Float32Array:
    """(n,) metres: from the first cell's centre to the last one's *end*, evenly."""
    low, high, size = axis
    return _linspace(low + size / 2, high, round((high - low) / size))


@functools.lru_cache(maxsize=64)
def _centers(axis: Axis) -> FloatArray:
    """(n,) metres: the cells' centres."""
    low, high, size = axis
    centers: FloatArray = low + (np.arange(round((high - low) / size), dtype=np.float64) + 0.5) * size
    return centers


@functools.lru_cache(maxsize=64)
def _fiery_coordinates(axis: Axis, half: float) -> Float32Array:
    """(n,) the cells' centres in units of `half` metres; from −half to half as torch's affine_grid, in float32."""
    low, high, size = axis
    count = round((high - low) / size)
    if (low, high) != (-half, half):
        return (_centers(axis) / half).astype(np.float32)
    return _linspace(-1, 1, count) * np.float32(count - 1) / np.float32(count)


def _linspace(start: float, end: float, count: int) -> Float32Array:
    """(count,) as torch makes it in float32: a rounded step, from either end to the middle with one rounding each."""
    first, last = np.float32(start), np.float32(end)
    step = np.float64((last - first) / np.float32(max(count - 1, 1)))
    index = np.arange(count)
    rising, falling = first + index * step, last - (count - 1 - index) * step
    return np.where(index < max(count // 2, 1), rising, falling).astype(np.float32)
