"""Small rigid matrices, and where a warp samples its raster, in float32 as the released code's torch computes them.

A nearest warp decides by rounding which cell a sample point lies in. For points close to a border between cells the
last bit of the matrix decides. So the labels' warps repeat each rounding: products summed in order of the inner index,
without fused multiply-add, the inverse by elimination as LAPACK's getrf and getrs do it, and sine and cosine by a
polynomial. Checked against torch 2.13 on random poses: all bits are equal.

Where target cells sample comes from a protocol's rule (`motion.warping` has their story): `stretched_lines`,
`exact_lines` or `fiery_lines`.
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
"""In indices of cells: the sample point is outside the grid and has no value."""

_SINE: Final = (
    2.605780704850265e-06,
    -0.00019809602928568679,
    0.008333066246354204,
    -0.16666659550431576,
    1.0,
)
"""sin t / t as a polynomial of t², the highest power first.

torch rounds 2–5 % of all sines and cosines to the neighbour of the nearest float32, because it uses a polynomial of
ninth degree. The coefficients were found only from its results, so that they give the same results: of 24 million
angles in [−π, π] very few differ.
"""


def pose_matrices(six: ArrayLike) -> Float32Array:
    """6-vectors (…, 6) → matrices (…, 4, 4): (Rx · Ry) · Rz, what the devkit does in float64."""
    vector = np.asarray(six, dtype=np.float32)
    sines, cosines = sines_and_cosines(vector[..., 3:])
    (cx, cy, cz), (sx, sy, sz) = np.moveaxis(cosines, -1, 0), np.moveaxis(sines, -1, 0)
    xy, yx = sx * sy, cx * sy
    rows = (
        (cy * cz, -cy * sz, sy),
        (xy * cz + cx * sz, cx * cz - xy * sz, -sx * cy),
        (sx * sz - yx * cz, yx * sz + sx * cz, cx * cy),
    )
    result = _rigid(np.float32(0), vector[..., :3])
    for row, values in enumerate(rows):
        for column, value in enumerate(values):
            result[..., row, column] = value
    return result


def sines_and_cosines(angle: ArrayLike) -> Float32Array:
    """(2, …) sines and cosines of float32 angles (…), radians; cosines are sines of the angles plus a quarter turn."""
    radians = np.asarray(angle, dtype=np.float32).astype(np.float64)
    turns = radians / np.pi
    half_turns = np.rint(np.array([turns, turns + 0.5]))
    within = np.array(
        [radians - half_turns[0] * np.pi, radians - (half_turns[1] - 0.5) * np.pi]
    )  # [−π/2, π/2]
    square = within * within
    ratio = square * _SINE[0] + _SINE[1]
    for factor in _SINE[2:]:
        ratio *= square
        ratio += factor
    ratio *= within
    result: Float32Array = np.where(half_turns % 2 == 0, ratio, -ratio).astype(np.float32)
    return result


def product(first: Float32Array, second: Float32Array) -> Float32Array:
    """Matrix products (…, I, K) · (…, K, J), summed from the first inner index to the last."""
    total: Float32Array = first[..., :, 0, None] * second[..., None, 0, :]
    for inner in range(1, first.shape[-1]):
        total = total + first[..., :, inner, None] * second[..., None, inner, :]
    return total


def fused_product(first: Float32Array, second: Float32Array) -> Float32Array:
    """`product` with fused multiply-add, which numpy's own products of two matrices use on today's processors."""
    total = np.zeros((*first.shape[:-1], second.shape[-1]), dtype=np.float32)
    for inner in range(first.shape[-1]):
        exact = np.multiply(
            first[..., :, inner, None], second[..., None, inner, :], dtype=np.float64
        )
        total = (exact + total).astype(np.float32)
    return total


def rigid_inverse(matrix: Float32Array) -> Float32Array:
    """The inverses of rigid transforms (…, 4, 4), by transposing their rotations."""
    turned_back = np.swapaxes(matrix[..., :3, :3], -1, -2)
    return _rigid(turned_back, -product(turned_back, matrix[..., :3, 3:])[..., 0])


def inverse(matrix: Float32Array) -> Float32Array:
    """The inverses of transforms (N, 4, 4) whose last row is (0, 0, 0, 1), by elimination with row exchanges.

    Of the last row all products are zero, and its own number is one: its steps are left out.
    """
    mixed = matrix.copy()  # the lower and the upper factor in one array
    count = np.arange(len(mixed))
    order = np.tile(np.arange(4), (len(mixed), 1))
    for step in range(2):
        pivot = step + np.abs(mixed[:, step:3, step]).argmax(axis=1)
        if (pivot != step).any():
            for rows in (mixed, order):
                rows[count, step], rows[count, pivot] = rows[count, pivot], rows[count, step]
        below = slice(step + 1, 3)
        # getrf multiplies by the reciprocal of the pivot
        mixed[:, below, step] *= np.float32(1) / mixed[:, step, step, None]
        mixed[:, below, step + 1 :] -= (
            mixed[:, below, step, None] * mixed[:, step, None, step + 1 :]
        )
    solved = np.zeros_like(matrix)
    solved[count[:, None], np.arange(4), order] = 1
    for row, others in ((1, (0,)), (2, (0, 1)), (2, (3,)), (1, (3, 2)), (0, (3, 2, 1))):
        total = mixed[:, row, others[0], None] * solved[:, others[0]]
        for other in others[1:]:
            total += mixed[:, row, other, None] * solved[:, other]
        solved[:, row] -= total
        if others[0] == 3:
            solved[:, row] *= np.float32(1) / mixed[:, row, row, None]
    return solved


def _rigid(rotation: NDArray[Any] | np.float32, translation: NDArray[Any]) -> Float32Array:
    result = np.zeros((*translation.shape[:-1], 4, 4), dtype=np.float32)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = translation
    result[..., 3, 3] = 1
    return result


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

    def points(self, matrix: int) -> AnyArray:
        """(H, W), of all target cells with one of the matrices."""
        point = np.add.outer(self.of_row[matrix], self.of_column[matrix])
        point += self.shift[matrix]
        return self.finish(point)

    def points_of(
        self, matrix: IntArray, row: IntArray, column: IntArray, run: IntArray
    ) -> AnyArray:
        """(P,), bit by bit those of `points`, of the target cells in `column` (P,) of `run` (P,).

        `matrix` and `row` (R,) are those of the runs; the columns of matrix m count from m · W.
        """
        point = self.of_row[matrix, row].take(run)
        point += self.of_column.reshape(-1).take(column)
        point += self.shift[matrix].take(run)
        return self.finish(point)


def stretched_lines(
    planes: Float32Array, axes: tuple[_Axis, _Axis]
) -> tuple[SamplingLine, SamplingLine]:
    """Rows and columns at which the released warp samples a raster with these axes of rows and columns.

    `planes` (N, 2, 3) are, for rows and for columns, factors of the target's metres along both, and a shift.
    """
    rows, columns = _released_coordinates(axes[0]), _released_coordinates(axes[1])
    lines = []
    for axis, plane in zip(axes, planes.swapaxes(0, 1), strict=True):
        finish = functools.partial(_stretched, axis)
        lines.append(
            SamplingLine(plane[:, :1] * rows, plane[:, 1:2] * columns, plane[:, 2], finish)
        )
    return lines[0], lines[1]


def _stretched(axis: _Axis, point: AnyArray) -> AnyArray:
    """Sums of metres (…) as cells along an axis, in place, as BEVerse's grid_sample takes the outermost points."""
    low, high, size = axis
    middle = (low + high) / 2
    if middle:
        point -= np.float32(middle)
    point /= np.float32((high - low) / 2)
    point += np.float32(1)
    point *= np.float32((round((high - low) / size) - 1) / 2)
    return point


def exact_lines(planes: FloatArray, axes: tuple[_Axis, _Axis]) -> tuple[SamplingLine, SamplingLine]:
    """`stretched_lines` by the cells' own centres, in float64."""
    rows, columns = (_centers(each) for each in axes)
    first, second = (
        SamplingLine(
            plane[:, :1] / size * rows,
            plane[:, 1:2] / size * columns,
            (plane[:, 2] - low) / size - 0.5,
            lambda point: point,
        )
        for plane, (low, _, size) in zip(planes.swapaxes(0, 1), axes, strict=True)
    )
    return first, second


def fiery_lines(
    tx: Float32Array, ty: Float32Array, yaw: Float32Array, x: _Axis, y: _Axis
) -> tuple[SamplingLine, SamplingLine]:
    """Rows and columns at which FIERY's warp samples, by the three numbers (N, 1) of its 6-vectors that count."""
    sine, cosine = sines_and_cosines(yaw)
    half = np.float32((x[1] - x[0]) / 2)
    ahead, beside = (_fiery_coordinates(axis, float(half)) for axis in (x, y))

    def finish(axis: _Axis, point: AnyArray) -> AnyArray:
        point -= np.float32(axis[0] / half)
        # torch fuses these two steps: one rounding
        return (point.astype(np.float64) * float(half / axis[2]) - 0.5).astype(np.float32)

    return (
        SamplingLine(cosine * ahead, sine * beside, -tx[:, 0] / half, functools.partial(finish, x)),
        SamplingLine(-sine * ahead, cosine * beside, ty[:, 0] / half, functools.partial(finish, y)),
    )


def take_cells(cells: AnyArray, indices: CellIndices, fill: float = 0) -> AnyArray:
    """The cells (…, H·W) at these indices, `fill` where there is `OUTSIDE`."""
    padded = np.empty((*cells.shape[:-1], cells.shape[-1] + 1), dtype=cells.dtype)
    padded[..., :-1] = cells
    padded[..., OUTSIDE] = fill
    taken: AnyArray = padded.take(indices, axis=-1)
    return taken


def blend_cells(
    raster: AnyArray, points: tuple[AnyArray, AnyArray], fill: float = 0
) -> Float32Array:
    """The values (…, H, W) of a raster at sample points, each the weighted mean of the four cells around.

    Nearly all is done in the memory of the points, whose numbers are lost.
    """
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
    result: Float32Array = cells.take(
        index, axis=-1, mode="wrap"
    )  # all are inside; the fastest mode
    result *= up * back
    up *= right
    back *= down
    down *= right
    value = np.empty_like(result)
    for shift, weight in ((1, up), (wide, back), (wide + 1, down)):
        cells[..., shift:].take(index, axis=-1, mode="wrap", out=value)
        value *= weight
        result += value
    return result


def _parted(points: AnyArray, count: int) -> tuple[AnyArray, Float32Array]:
    """The cell before each point, from −1 (padding) to `count` (padding), and how far beyond it the point is."""
    np.clip(points, -1, count, out=points)
    before = np.floor(points)
    points -= before
    return before, points.astype(np.float32, copy=False)


@functools.lru_cache(maxsize=64)
def _released_coordinates(axis: _Axis) -> Float32Array:
    """(n,) metres: from the first cell's centre to the last one's *end*, evenly."""
    low, high, size = axis
    return _linspace(low + size / 2, high, round((high - low) / size))


@functools.lru_cache(maxsize=64)
def _centers(axis: _Axis) -> FloatArray:
    """(n,) metres: the cells' centres."""
    low, high, size = axis
    centers: FloatArray = (
        low + (np.arange(round((high - low) / size), dtype=np.float64) + 0.5) * size
    )
    return centers


@functools.lru_cache(maxsize=64)
def _fiery_coordinates(axis: _Axis, half: float) -> Float32Array:
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
