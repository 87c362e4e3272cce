"""Unit quaternions (w, x, y, z) over arrays; the public API uses pyquaternion for single ones."""

import math

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.support.arrays import FloatArray, as_floats


def from_yaw(yaw: ArrayLike) -> FloatArray:
    """Return rotations about z as quaternions (…, 4), from angles (…) in radians."""
    half = as_floats(yaw) / 2
    result = np.zeros((*half.shape, 4))
    result[..., 0], result[..., 3] = np.cos(half), np.sin(half)
    return result


def from_matrix(rotation: ArrayLike) -> FloatArray:
    """Return the unit quaternions (…, 4) with w ≥ 0 of rotation matrices (…, 3, 3).

    There are four formulas; each row uses the one that divides by its largest component.
    """
    m = as_floats(rotation)
    xx = m[..., 0, 0]
    yy = m[..., 1, 1]
    zz = m[..., 2, 2]
    four_squares = np.stack(
        [1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], axis=-1
    )
    wx = m[..., 2, 1] - m[..., 1, 2]
    wy = m[..., 0, 2] - m[..., 2, 0]
    wz = m[..., 1, 0] - m[..., 0, 1]
    xy = m[..., 1, 0] + m[..., 0, 1]
    xz = m[..., 0, 2] + m[..., 2, 0]
    yz = m[..., 2, 1] + m[..., 1, 2]
    s = four_squares
    candidates = np.stack(
        [
            np.stack([s[..., 0], wx, wy, wz], axis=-1),
            np.stack([wx, s[..., 1], xy, xz], axis=-1),
            np.stack([wy, xy, s[..., 2], yz], axis=-1),
            np.stack([wz, xz, yz, s[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(four_squares, axis=-1)
    quaternion = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return as_floats(np.where(quaternion[..., :1] < 0, -quaternion, quaternion))


def to_matrix(quaternion: ArrayLike) -> FloatArray:
    """Return the rotation matrices (…, 3, 3) of unit quaternions (…, 4)."""
    q = as_floats(quaternion)
    w = q[..., 0]
    x = q[..., 1]
    y = q[..., 2]
    z = q[..., 3]
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def single_from_matrix(rotation: FloatArray) -> tuple[float, float, float, float]:
    """Return `from_matrix` of one rotation (3, 3), with Python's floats: twenty times faster.

    If the matrix differs from a rotation by a small e, for example in single precision, the result
    is the quaternion of the nearest rotation, with an error of about e².
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    rows = (
        (1 + xx + yy + zz, zy - yz, xz - zx, yx - xy),
        (zy - yz, 1 + xx - yy - zz, yx + xy, xz + zx),
        (xz - zx, yx + xy, 1 - xx + yy - zz, zy + yz),
        (yx - xy, xz + zx, zy + yz, 1 - xx - yy + zz),
    )
    best = max(range(4), key=lambda part: rows[part][part])
    # the nearest rotation's quaternion is the first eigenvector of these rows: each row is near it,
    # a product nearer
    w, x, y, z = rows[best]
    w, x, y, z = (a * w + b * x + c * y + d * z for a, b, c, d in rows)
    norm = math.copysign(math.sqrt(w * w + x * x + y * y + z * z), w)
    return w / norm, x / norm, y / norm, z / norm


def single_left_multiplier(rotation: FloatArray) -> FloatArray:
    """Return the `left_multiplier` of the quaternion of one rotation matrix (3, 3)."""
    w, x, y, z = single_from_matrix(rotation)
    rows = (
        (w, -x, -y, -z),
        (x, w, -z, y),
        (y, z, w, -x),
        (z, -y, x, w),
    )
    return np.array(rows)


def left_multiplier(quaternion: ArrayLike) -> FloatArray:
    """Return the matrices L (…, 4, 4) with L @ r = q ⊗ r: one product rotates many quaternions."""
    q = as_floats(quaternion)
    w = q[..., 0]
    x = q[..., 1]
    y = q[..., 2]
    z = q[..., 3]
    rows = [
        [w, -x, -y, -z],
        [x, w, -z, y],
        [y, z, w, -x],
        [z, -y, x, w],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def yaw_of(quaternion: ArrayLike) -> FloatArray:
    """Return the heading of the rotated x axis about z, radians in (−π, π].

    Args:
        quaternion: (…, 4).
    """
    q = as_floats(quaternion)
    w = q[..., 0]
    x = q[..., 1]
    y = q[..., 2]
    z = q[..., 3]
    sine = 2 * (x * y + w * z)
    cosine = 1 - 2 * (y * y + z * z)
    return np.arctan2(sine, cosine)
