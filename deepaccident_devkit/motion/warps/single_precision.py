"""Small rigid matrices in float32, step by step as the released code's torch computes them on a CPU.

A nearest warp decides by rounding which cell a sample point lies in. For points close to a border between cells the
last bit of the matrix decides. So the labels' warps repeat each rounding: products summed in order of the inner index,
without fused multiply-add, the inverse by elimination as LAPACK's getrf and getrs do it, and sine and cosine by a
polynomial. Checked against torch 2.13 on random poses: all bits are equal, except for the angles of `six_vectors`.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepaccident_devkit.geometry import six_vectors as geometry_six_vectors
from deepaccident_devkit.support.arrays import Float32Array, FloatArray, IntArray

_SINE: Final = (2.605780704850265e-06, -0.00019809602928568679, 0.008333066246354204, -0.16666659550431576, 1.0)
"""sin t / t as a polynomial of t², the highest power first.

torch rounds 2–5 % of all sines and cosines to the neighbour of the nearest float32, because it uses a polynomial of
ninth degree. The coefficients were found only from its results, so that they give the same results: of 24 million
angles in [−π, π] very few differ.
"""


def pose_matrices(six: ArrayLike) -> Float32Array:
    """6-vectors (…, 6) → matrices (…, 4, 4): (Rx · Ry) · Rz, what `geometry.six_vectors` does in float64."""
    vector = np.asarray(six, dtype=np.float32)
    sines, cosines = sines_and_cosines(vector[..., 3:])
    cx, cy, cz = (cosines[..., axis] for axis in range(3))
    sx, sy, sz = (sines[..., axis] for axis in range(3))
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
    cosines = half_turns[1] - 0.5
    return _sine_within(np.array([radians - half_turns[0] * np.pi, radians - cosines * np.pi]), half_turns)


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
        exact = np.multiply(first[..., :, inner, None], second[..., None, inner, :], dtype=np.float64)
        total = (exact + total).astype(np.float32)
    return total


def six_vectors(matrix: Float32Array) -> Float32Array:
    """Matrices (…, 4, 4) → 6-vectors (…, 6), through float64: translations as they are, angles rounded once.

    torch's atan2 in float32 is not correctly rounded, so its angles can differ in the last bit. At a tie, where a
    sample point lies on a border between cells, that can change the cell: in three of about 330 warped outputs of the
    released code one cell was different.
    """
    return geometry_six_vectors.from_matrices(matrix).astype(np.float32)


def rigid_inverse(matrix: Float32Array) -> Float32Array:
    """The inverses of rigid transforms (…, 4, 4), by transposing their rotations."""
    turned_back = np.swapaxes(matrix[..., :3, :3], -1, -2)
    return _rigid(turned_back, -product(turned_back, matrix[..., :3, 3:])[..., 0])


def inverse(matrix: Float32Array) -> Float32Array:
    """The inverses of transforms (N, 4, 4) whose last row is (0, 0, 0, 1), by elimination with row exchanges.

    Of the last row all products are zero, and its own number is one: its steps change nothing and are left out.
    """
    mixed, order = _eliminated(matrix)
    every = np.arange(len(matrix))[:, None]
    solved = np.zeros_like(matrix)
    solved[every, np.arange(4), order] = 1
    for row, others in ((1, (0,)), (2, (0, 1)), (2, (3,)), (1, (3, 2)), (0, (3, 2, 1))):
        total = mixed[:, row, others[0], None] * solved[:, others[0]]
        for other in others[1:]:
            total += mixed[:, row, other, None] * solved[:, other]
        solved[:, row] -= total
        if others[0] == 3:
            solved[:, row] *= np.float32(1) / mixed[:, row, row, None]
    return solved


def _eliminated(matrix: Float32Array) -> tuple[Float32Array, IntArray]:
    """Lower and upper factor in one array, (N, 4, 4), and the order of the rows, (N, 4)."""
    mixed = matrix.copy()
    count = np.arange(len(mixed))
    order: IntArray = np.empty((len(mixed), 4), dtype=np.int64)
    order[:] = np.arange(4)
    for step in range(2):
        pivot = step + np.abs(mixed[:, step:3, step]).argmax(axis=1)
        if (pivot != step).any():
            for rows in (mixed, order):
                rows[count, step], rows[count, pivot] = rows[count, pivot], rows[count, step]
        below = slice(step + 1, 3)
        # getrf multiplies by the reciprocal of the pivot
        mixed[:, below, step] *= np.float32(1) / mixed[:, step, step, None]
        mixed[:, below, step + 1 :] -= mixed[:, below, step, None] * mixed[:, step, None, step + 1 :]
    return mixed, order


def _sine_within(radians: FloatArray, half_turns: FloatArray) -> Float32Array:
    """Sines of angles in [−π/2, π/2], after so many half turns."""
    square = radians * radians
    ratio = square * _SINE[0] + _SINE[1]
    for factor in _SINE[2:]:
        ratio *= square
        ratio += factor
    ratio *= radians
    return np.where(half_turns % 2 == 0, ratio, -ratio).astype(np.float32)


def _rigid(rotation: NDArray[Any] | np.float32, translation: NDArray[Any]) -> Float32Array:
    result = np.zeros((*translation.shape[:-1], 4, 4), dtype=np.float32)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = translation
    result[..., 3, 3] = 1
    return result
