"""Arrays of unit quaternions (w, x, y, z); for single ones the public API uses pyquaternion."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.support.arrays import AnyArray, FloatArray, as_floats


def from_yaw(yaw: ArrayLike) -> FloatArray:
    """Convert angles about z (…), radians, to quaternions (…, 4)."""
    half_angle = as_floats(yaw) / 2
    quaternion = np.zeros((*half_angle.shape, 4))
    quaternion[..., 0] = np.cos(half_angle)
    quaternion[..., 3] = np.sin(half_angle)
    return quaternion


def from_matrix(rotation: ArrayLike) -> FloatArray:
    """Convert rotation matrices (…, 3, 3) to unit quaternions (…, 4) with w ≥ 0.

    There are four formulas; for each matrix the one that divides by the largest component is used.
    """
    rows_of_rotation = np.moveaxis(as_floats(rotation), (-2, -1), (0, 1))
    products = stack_rows(_component_products(rows_of_rotation))
    squares = np.diagonal(products, axis1=-2, axis2=-1)
    largest = np.argmax(squares, axis=-1)
    quaternion = np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return as_floats(np.where(quaternion[..., :1] < 0, -quaternion, quaternion))


def _component_products(rotation: Any) -> list[list[Any]]:
    """Return 4·q·qᵀ, the products of all pairs of w, x, y, z, from the rows of a rotation."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    return [
        [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, 1 + xx - yy - zz, yx + xy, xz + zx],
        [xz - zx, yx + xy, 1 - xx + yy - zz, zy + yz],
        [yx - xy, xz + zx, zy + yz, 1 - xx - yy + zz],
    ]


def stack_rows(rows: Sequence[Sequence[AnyArray]]) -> FloatArray:
    """Stack M rows of N arrays (…) into matrices (…, M, N)."""
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def to_matrix(quaternion: ArrayLike) -> FloatArray:
    """Convert unit quaternions (…, 4) to rotation matrices (…, 3, 3)."""
    w, x, y, z = np.moveaxis(as_floats(quaternion), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return stack_rows(rows)


def single_from_matrix(rotation: FloatArray) -> tuple[float, float, float, float]:
    """Convert one rotation (3, 3) like `from_matrix`, with Python floats: twenty times faster.

    If the matrix differs from a rotation by a small error e, for example because of single
    precision, the result is the quaternion of the nearest rotation, accurate to about e².
    """
    products = _component_products(rotation.tolist())
    largest = max(range(4), key=lambda index: products[index][index])
    # the exact quaternion is the first eigenvector; multiplying a row by all rows approaches it
    row_w, row_x, row_y, row_z = products[largest]
    w, x, y, z = (a * row_w + b * row_x + c * row_y + d * row_z for a, b, c, d in products)
    norm = math.copysign(math.sqrt(w * w + x * x + y * y + z * z), w)
    return w / norm, x / norm, y / norm, z / norm


def single_left_multiplier(rotation: FloatArray) -> FloatArray:
    """Return the `left_multiplier` (4, 4) for the quaternion of one rotation matrix (3, 3)."""
    quaternion = single_from_matrix(rotation)
    return np.array(_left_multiplier_rows(*quaternion))


def left_multiplier(quaternion: ArrayLike) -> FloatArray:
    """Return the matrices L (…, 4, 4) with L @ r = q ⊗ r: one product rotates many quaternions."""
    components = np.moveaxis(as_floats(quaternion), -1, 0)
    rows = _left_multiplier_rows(*components)
    return stack_rows(rows)


def _left_multiplier_rows(w: Any, x: Any, y: Any, z: Any) -> list[list[Any]]:
    """Return the rows of a quaternion's left multiplier; components may be floats or arrays."""
    return [
        [w, -x, -y, -z],
        [x, w, -z, y],
        [y, z, w, -x],
        [z, -y, x, w],
    ]


def yaw_of(quaternion: ArrayLike) -> FloatArray:
    """Return the heading of the rotated x axis about z, radians in (−π, π].

    Args:
        quaternion: (…, 4) unit quaternions.
    """
    w, x, y, z = np.moveaxis(as_floats(quaternion), -1, 0)
    sine = 2 * (x * y + w * z)
    cosine = 1 - 2 * (y * y + z * z)
    yaw: FloatArray = np.arctan2(sine, cosine)
    return yaw
