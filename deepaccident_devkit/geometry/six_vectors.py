"""The released code's 6-vectors (tx, ty, tz, rx, ry, rz) of rigid transforms, over arrays.

See docs/released_code.md, Poses. R = Rx(rx) · Ry(ry) · Rz(rz): about z first, then y, then x, each about the target
frame's own, fixed axes; angles in radians, ry in [−π/2, π/2]. The functions do not depend on the handedness: a raw
matrix gives the raw vector, a right-handed one the right-handed vector, and `handedness.flip_six_vector` converts one
into the other.

At ry = ±π/2 (gimbal lock) only rx ± rz is determined, and rounding errors decide how it is divided.
"""

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.support.arrays import FloatArray, as_floats


def from_matrices(matrix: ArrayLike) -> FloatArray:
    """Rigid matrices (…, 4, 4) → 6-vectors (…, 6), metres and radians in [−π, π]. Raises GeometryError."""
    m = as_floats(matrix)
    if m.shape[-2:] != (4, 4):
        raise GeometryError(f"matrix: expected shape (…, 4, 4), found {m.shape}")
    m12, m22 = m[..., 1, 2], m[..., 2, 2]
    rx = np.arctan2(-m12, m22)
    ry = np.arctan2(m[..., 0, 2], np.hypot(m12, m22))
    rz = np.arctan2(-m[..., 0, 1], m[..., 0, 0])
    return np.concatenate([m[..., :3, 3], np.stack([rx, ry, rz], axis=-1)], axis=-1)


def to_matrices(six: ArrayLike) -> FloatArray:
    """6-vectors (…, 6), metres and radians → rigid matrices (…, 4, 4); all angles are allowed. Raises GeometryError."""
    vector = as_floats(six)
    if vector.shape[-1:] != (6,):
        raise GeometryError(f"six: expected shape (…, 6), found {vector.shape}")
    cosines, sines = np.cos(vector[..., 3:]), np.sin(vector[..., 3:])
    cx, cy, cz = (cosines[..., axis] for axis in range(3))
    sx, sy, sz = (sines[..., axis] for axis in range(3))
    result = np.zeros((*vector.shape[:-1], 4, 4))
    rows = [
        [cy * cz, -cy * sz, sy],
        [cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy],
        [sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy],
    ]
    result[..., :3, :3] = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    result[..., :3, 3] = vector[..., :3]
    result[..., 3, 3] = 1
    return result
