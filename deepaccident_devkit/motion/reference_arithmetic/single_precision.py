"""Small rigid matrices and the sample points of warps, in the released code's float32 (torch).

A nearest warp rounds a sample point to a cell. For points close to a border between cells, the last
bit of the matrix decides. The label warps therefore reproduce each rounding: products are summed in
the order of the inner index, without fused multiply-add; the inverse is computed by elimination, as
in LAPACK's getrf and getrs; sine and cosine are computed by a polynomial. Checked against torch
2.13 on random poses: all bits are equal.

The sample points of target cells follow a protocol's rule, explained in `motion.warping`:
`stretched_lines`, `exact_lines` or `fiery_lines`.
"""

import functools
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepaccident_devkit.support.arrays import AnyArray, Float32Array, FloatArray, IntArray

# Start, end and cell size, metres.
_Axis = tuple[float, float, float]
CellIndices = NDArray[np.intp]
OUTSIDE: Final = -1
"""Cell index of a sample point outside the grid, where there is no value to read."""

_SINE = (
    2.605780704850265e-06,
    -0.00019809602928568679,
    0.008333066246354204,
    -0.16666659550431576,
    1.0,
)
"""Coefficients of sin t / t as a polynomial of t², the highest power first.

torch rounds 2–5 % of all sines and cosines to the neighbour of the nearest float32, because it uses
a polynomial of ninth degree. The coefficients were fitted to its results, so that they give the
same results: of 24 million angles in [−π, π] very few differ.
"""


def pose_matrices(vectors: ArrayLike) -> Float32Array:
    """Return the matrices (…, 4, 4) of 6-vectors (…, 6): (Rx · Ry) · Rz.

    The devkit's own function computes the same matrices in float64.
    """
    vector = np.asarray(vectors, dtype=np.float32)
    sines, cosines = sines_and_cosines(vector[..., 3:])
    cx, cy, cz = np.moveaxis(cosines, -1, 0)
    sx, sy, sz = np.moveaxis(sines, -1, 0)
    sx_sy = sx * sy
    cx_sy = cx * sy
    rows = (
        (cy * cz, -cy * sz, sy),
        (sx_sy * cz + cx * sz, cx * cz - sx_sy * sz, -sx * cy),
        (sx * sz - cx_sy * cz, cx_sy * sz + sx * cz, cx * cy),
    )
    matrix = _make_transforms(np.float32(0), vector[..., :3])
    for row, values in enumerate(rows):
        for column, value in enumerate(values):
            matrix[..., row, column] = value
    return matrix


def sines_and_cosines(angle: ArrayLike) -> Float32Array:
    """Return sines and cosines of float32 angles (…), radians, shape (2, …).

    Cosines are computed as sines of the angle plus a quarter turn.
    """
    radians = np.asarray(angle, dtype=np.float32).astype(np.float64)
    turns = radians / np.pi
    half_turns = np.rint(np.array([turns, turns + 0.5]))
    sine_angle = radians - half_turns[0] * np.pi
    cosine_angle = radians - (half_turns[1] - 0.5) * np.pi
    reduced = np.array([sine_angle, cosine_angle])  # in [−π/2, π/2]
    square = reduced * reduced
    ratio = square * _SINE[0] + _SINE[1]
    for factor in _SINE[2:]:
        ratio *= square
        ratio += factor
    ratio *= reduced
    is_even = half_turns % 2 == 0
    values: Float32Array = np.where(is_even, ratio, -ratio).astype(np.float32)
    return values


def product(first: Float32Array, second: Float32Array) -> Float32Array:
    """Return matrix products (…, I, K) · (…, K, J), summed in the order of the inner index."""
    total: Float32Array = first[..., :, 0, None] * second[..., None, 0, :]
    for inner in range(1, first.shape[-1]):
        total = total + first[..., :, inner, None] * second[..., None, inner, :]
    return total


def fused_product(first: Float32Array, second: Float32Array) -> Float32Array:
    """Return `product` with fused multiply-add.

    Numpy's matrix products use it on today's processors.
    """
    total = np.zeros((*first.shape[:-1], second.shape[-1]), dtype=np.float32)
    for inner in range(first.shape[-1]):
        column = first[..., :, inner, None]
        row = second[..., None, inner, :]
        exact = np.multiply(column, row, dtype=np.float64)
        total = (exact + total).astype(np.float32)
    return total


def rigid_inverse(matrix: Float32Array) -> Float32Array:
    """Return the inverses of rigid transforms (…, 4, 4), by transposing their rotations."""
    rotation = np.swapaxes(matrix[..., :3, :3], -1, -2)
    rotated_translation = product(rotation, matrix[..., :3, 3:])
    translation = -rotated_translation[..., 0]
    return _make_transforms(rotation, translation)


def inverse(matrix: Float32Array) -> Float32Array:
    """Return the inverses of transforms with a last row of (0, 0, 0, 1), shape (N, 4, 4).

    The method is elimination with row exchanges. The steps for the last row are skipped, because
    all products with it are zero and its diagonal element is one.
    """
    factors = matrix.copy()  # the lower and the upper factor in one array
    index = np.arange(len(factors))
    order = np.tile(np.arange(4), (len(factors), 1))
    for step in range(2):
        pivot = step + np.abs(factors[:, step:3, step]).argmax(axis=1)
        if (pivot != step).any():
            for rows in (factors, order):
                rows[index, step], rows[index, pivot] = rows[index, pivot], rows[index, step]
        lower = slice(step + 1, 3)
        # getrf multiplies by the reciprocal of the pivot.
        factors[:, lower, step] *= np.float32(1) / factors[:, step, step, None]
        change = factors[:, lower, step, None] * factors[:, step, None, step + 1 :]
        factors[:, lower, step + 1 :] -= change
    solution = np.zeros_like(matrix)
    solution[index[:, None], np.arange(4), order] = 1
    for row, solved_rows in ((1, (0,)), (2, (0, 1)), (2, (3,)), (1, (3, 2)), (0, (3, 2, 1))):
        total = factors[:, row, solved_rows[0], None] * solution[:, solved_rows[0]]
        for solved_row in solved_rows[1:]:
            total += factors[:, row, solved_row, None] * solution[:, solved_row]
        solution[:, row] -= total
        if solved_rows[0] == 3:
            solution[:, row] *= np.float32(1) / factors[:, row, row, None]
    return solution


def _make_transforms(
    rotation: NDArray[Any] | np.float32, translation: NDArray[Any]
) -> Float32Array:
    """Build rigid transforms (…, 4, 4) from rotations (…, 3, 3) and translations (…, 3)."""
    result = np.zeros((*translation.shape[:-1], 4, 4), dtype=np.float32)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = translation
    result[..., 3, 3] = 1
    return result


class SamplingLine(NamedTuple):
    """The rows, or the columns, at which target cells sample the source, for N matrices.

    Each is computed as `finish(of_row + of_column + shift)`.

    Attributes:
        of_row: Contribution of a target cell's row, shape (N, H).
        of_column: Contribution of a target cell's column, shape (N, W).
        shift: Contribution to every cell, shape (N,).
        finish: Converts these sums to cells of the source, where 0 is the first cell's centre; may
            overwrite its argument.
    """

    of_row: AnyArray
    of_column: AnyArray
    shift: AnyArray
    finish: Callable[[AnyArray], AnyArray]

    def points(self, matrix: int) -> AnyArray:
        """Return the sample points of all target cells for one of the matrices, shape (H, W)."""
        sums = np.add.outer(self.of_row[matrix], self.of_column[matrix])
        sums += self.shift[matrix]
        return self.finish(sums)

    def points_of(
        self, matrix: IntArray, row: IntArray, column: IntArray, run: IntArray
    ) -> AnyArray:
        """Return the sample points of some target cells, shape (P,), bit-identical to `points`.

        Args:
            matrix: Index of each run's matrix, shape (R,).
            row: Row of each run, shape (R,).
            column: Columns of the cells, shape (P,); the columns of matrix m count from m · W.
            run: Index of each cell's run, shape (P,).
        """
        sums = self.of_row[matrix, row].take(run)
        sums += self.of_column.reshape(-1).take(column)
        sums += self.shift[matrix].take(run)
        return self.finish(sums)


def stretched_lines(
    planes: Float32Array, axes: tuple[_Axis, _Axis]
) -> tuple[SamplingLine, SamplingLine]:
    """Return the rows and columns at which the released warp samples a raster.

    Args:
        planes: Affine maps from the target's to the source's metres along rows and along columns:
            two factors and a shift each, shape (N, 2, 3).
        axes: Axes of the raster's rows and columns.
    """
    row_axis, column_axis = axes
    rows = _space_released_points(row_axis)
    columns = _space_released_points(column_axis)
    lines = []
    for axis, plane in zip(axes, planes.swapaxes(0, 1), strict=True):
        of_row = plane[:, :1] * rows
        of_column = plane[:, 1:2] * columns
        finish = functools.partial(_stretch_points, axis)
        lines.append(SamplingLine(of_row, of_column, plane[:, 2], finish))
    return lines[0], lines[1]


def _stretch_points(axis: _Axis, sums: AnyArray) -> AnyArray:
    """Convert sums of metres (…) to cells along an axis, in place.

    The outermost points are treated as in BEVerse's grid_sample.
    """
    low, high, size = axis
    middle = (low + high) / 2
    count = round((high - low) / size)
    if middle:
        sums -= np.float32(middle)
    sums /= np.float32((high - low) / 2)
    sums += np.float32(1)
    sums *= np.float32((count - 1) / 2)
    return sums


def exact_lines(planes: FloatArray, axes: tuple[_Axis, _Axis]) -> tuple[SamplingLine, SamplingLine]:
    """Return the same lines as `stretched_lines`, but for the true cell centres and in float64."""
    row_axis, column_axis = axes
    rows = _space_centers(row_axis)
    columns = _space_centers(column_axis)
    lines = []
    for plane, (low, _, size) in zip(planes.swapaxes(0, 1), axes, strict=True):
        of_row = plane[:, :1] / size * rows
        of_column = plane[:, 1:2] / size * columns
        shift = (plane[:, 2] - low) / size - 0.5
        lines.append(SamplingLine(of_row, of_column, shift, lambda sums: sums))
    return lines[0], lines[1]


def fiery_lines(
    tx: Float32Array, ty: Float32Array, yaw: Float32Array, x: _Axis, y: _Axis
) -> tuple[SamplingLine, SamplingLine]:
    """Return the rows and columns at which FIERY's warp samples.

    Args:
        tx: First component of the 6-vectors, shape (N, 1).
        ty: Second component of the 6-vectors, shape (N, 1).
        yaw: Last component of the 6-vectors, shape (N, 1).
        x: Axis of the grid's rows.
        y: Axis of the grid's columns.
    """
    sine, cosine = sines_and_cosines(yaw)
    low, high, _ = x
    half = np.float32((high - low) / 2)
    forward = _space_fiery_points(x, float(half))
    sideways = _space_fiery_points(y, float(half))

    finish_row = functools.partial(_finish_fiery_points, x, half)
    finish_column = functools.partial(_finish_fiery_points, y, half)
    row_line = SamplingLine(cosine * forward, sine * sideways, -tx[:, 0] / half, finish_row)
    column_line = SamplingLine(-sine * forward, cosine * sideways, ty[:, 0] / half, finish_column)
    return row_line, column_line


def _finish_fiery_points(axis: _Axis, half: np.float32, sums: AnyArray) -> AnyArray:
    """Convert sums in units of `half` metres to cells along an axis; overwrites the sums."""
    low, _, size = axis
    sums -= np.float32(low / half)
    # torch fuses these two steps, with one rounding.
    cells = sums.astype(np.float64) * float(half / size) - 0.5
    return cells.astype(np.float32)


def take_cells(cells: AnyArray, indices: CellIndices, fill: float = 0) -> AnyArray:
    """Return the values of cells (…, H·W) at indices, and `fill` where an index is `OUTSIDE`."""
    padded = np.empty((*cells.shape[:-1], cells.shape[-1] + 1), dtype=cells.dtype)
    padded[..., :-1] = cells
    padded[..., OUTSIDE] = fill
    values: AnyArray = padded.take(indices, axis=-1)
    return values


def blend_cells(
    raster: AnyArray, points: tuple[AnyArray, AnyArray], fill: float = 0
) -> Float32Array:
    """Return the values of a raster at sample points, shape (…, H, W).

    Each value is the weighted mean of the four cells around a point. The arrays of points are
    overwritten.
    """
    rows, columns = raster.shape[-2:]
    stride = columns + 3
    padded = np.full((*raster.shape[:-2], rows + 3, stride), fill, dtype=np.float32)
    padded[..., 1:-2, 1:-2] = raster
    cells = padded.reshape(*raster.shape[:-2], -1)
    row_before, row_share = _split_points(points[0], rows)
    column_before, column_share = _split_points(points[1], columns)
    row_before *= stride
    row_before += column_before
    row_before += stride + 1
    index = row_before.astype(np.int32).astype(np.intp)  # in two steps: three times as fast
    upper_share = 1 - row_share
    left_share = 1 - column_share
    # All indices are valid; this mode is the fastest.
    result: Float32Array = cells.take(index, axis=-1, mode="wrap")
    result *= upper_share * left_share
    # The memory of the fractions is reused for the weights of the other three cells.
    upper_share *= column_share
    left_share *= row_share
    row_share *= column_share
    value = np.empty_like(result)
    for shift, weight in ((1, upper_share), (stride, left_share), (stride + 1, row_share)):
        cells[..., shift:].take(index, axis=-1, mode="wrap", out=value)
        value *= weight
        result += value
    return result


def _split_points(points: AnyArray, count: int) -> tuple[AnyArray, Float32Array]:
    """Return the cell before each point, and the point's distance from that cell.

    Cells range from −1 to `count`; both ends are padding.
    """
    np.clip(points, -1, count, out=points)
    cell_before = np.floor(points)
    points -= cell_before
    return cell_before, points.astype(np.float32, copy=False)


@functools.lru_cache(maxsize=64)
def _space_released_points(axis: _Axis) -> Float32Array:
    """Return metres from the first cell's centre to the last cell's *end*, evenly, shape (n,)."""
    low, high, size = axis
    first_center = low + size / 2
    count = round((high - low) / size)
    return _linspace(first_center, high, count)


@functools.lru_cache(maxsize=64)
def _space_centers(axis: _Axis) -> FloatArray:
    """Return the cells' centres, shape (n,), metres."""
    low, high, size = axis
    numbers = np.arange(round((high - low) / size), dtype=np.float64)
    centers: FloatArray = low + (numbers + 0.5) * size
    return centers


@functools.lru_cache(maxsize=64)
def _space_fiery_points(axis: _Axis, half: float) -> Float32Array:
    """Return the cell centres in units of `half` metres, shape (n,), float32.

    On an axis from −half to half they equal torch's affine_grid.
    """
    low, high, size = axis
    count = round((high - low) / size)
    if (low, high) != (-half, half):
        return (_space_centers(axis) / half).astype(np.float32)
    return _linspace(-1, 1, count) * np.float32(count - 1) / np.float32(count)


def _linspace(start: float, end: float, count: int) -> Float32Array:
    """Return torch's linspace in float32, shape (count,).

    The step is rounded; values are counted from both ends to the middle, with one rounding each.
    """
    start_value = np.float32(start)
    end_value = np.float32(end)
    step = np.float64((end_value - start_value) / np.float32(max(count - 1, 1)))
    index = np.arange(count)
    rising = start_value + index * step
    falling = end_value - (count - 1 - index) * step
    return np.where(index < max(count // 2, 1), rising, falling).astype(np.float32)
