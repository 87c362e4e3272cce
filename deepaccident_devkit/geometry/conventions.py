"""Conversions between CARLA, the released code and the devkit (docs/conventions.md): sign changes.

CARLA's frames have x forward, y **right**, z up, and yaw clockwise seen from above. The devkit's
have x forward, y **left**, z up, yaw counter-clockwise. With S = diag(1, −1, 1) every conversion of
a point, a pose or an angle is its own inverse, so each `flip_*` works in both directions. Cameras
also change from CARLA's axes (x depth, y right, z up) to optical axes (x right, y down, z forward),
which is not its own inverse: each of these two functions has a counterpart `*_to_raw`.

The released code writes rigid transforms as 6-vectors (tx, ty, tz, rx, ry, rz)
(docs/released_code.md, Poses) with R = Rx(rx) · Ry(ry) · Rz(rz): about z first, then y, then x,
each about a fixed axis of the target frame; radians, ry in [−π/2, π/2]. At ry = ±π/2 only rx ± rz
is determined, and rounding errors decide how it is split. A raw matrix yields the raw vector, a
right-handed matrix the right-handed vector.

All functions take arrays with any leading axes, return new float64 arrays and do not change their
arguments.
"""

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry.quaternions import stack_rows
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, as_floats

LAST_ROW = (0.0, 0.0, 0.0, 1.0)
# Signs that flip the handedness of points, poses (S4) and 6-vectors.
_S: FloatArray = np.array([1.0, -1.0, 1.0])
_S4: FloatArray = np.array([1.0, -1.0, 1.0, 1.0])
_SIX: FloatArray = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
# Q: a camera frame with x forward, y left, z up → the optical frame.
_OPTICAL_FROM_FORWARD: FloatArray = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
# Q·S: CARLA's camera axes → the optical frame.
_OPTICAL_FROM_RAW: FloatArray = _OPTICAL_FROM_FORWARD * _S


def checked_frame(name: str, frame: object) -> str:
    """Return `frame` if it is a non-empty text; otherwise raise a GeometryError that names it."""
    if not isinstance(frame, str) or not frame:
        raise GeometryError(
            f"{name}: expected the name of a frame, such as 'world', 'ego' or 'lidar', found "
            f"{frame!r}"
        )
    return frame


def flip_points(points: ArrayLike) -> FloatArray:
    """Convert points or vectors (…, 3) to the other handedness: y changes its sign."""
    return as_floats(points) * _S


def flip_vectors2(vectors: ArrayLike) -> FloatArray:
    """Convert horizontal vectors (…, 2), such as label velocities, to the other handedness."""
    return as_floats(vectors) * _S[:2]


def flip_yaw(yaw: ArrayLike) -> FloatArray:
    """Convert angles about z (…), radians, to the other handedness."""
    return -as_floats(yaw)


def flip_pose(pose: ArrayLike) -> FloatArray:
    """Convert transforms (…, 4, 4) between two frames to the other handedness: S4·T·S4."""
    signs = np.outer(_S4, _S4)
    return as_floats(pose) * signs


def flip_six_vector(six: ArrayLike) -> FloatArray:
    """Convert poses (…, 6: tx, ty, tz, rx, ry, rz) to the other handedness.

    See docs/released_code.md, Poses.
    """
    return as_floats(six) * _SIX


def camera_from_lidar(lidar_to_cam: ArrayLike) -> FloatArray:
    """Return right-handed transforms (…, 4, 4) from LiDAR to the optical camera: Q·S·T·S.

    Args:
        lidar_to_cam: CARLA's `lidar_to_<Camera>` (…, 4, 4).
    """
    flipped = as_floats(lidar_to_cam) * _S4
    result = flipped.copy()
    result[..., :3, :] = _OPTICAL_FROM_RAW @ flipped[..., :3, :]
    return as_floats(result)


def camera_from_lidar_to_raw(camera_from_lidar: ArrayLike) -> FloatArray:
    """Return CARLA's `lidar_to_<Camera>` (…, 4, 4): the inverse of `camera_from_lidar`."""
    flipped = as_floats(camera_from_lidar) * _S4
    result = flipped.copy()
    result[..., :3, :] = _OPTICAL_FROM_RAW.T @ flipped[..., :3, :]
    return as_floats(result)


def intrinsic(raw_intrinsic: ArrayLike) -> FloatArray:
    """Convert CARLA's permuted intrinsic to the usual K = [[f, 0, cx], [0, f, cy], [0, 0, 1]].

    Args:
        raw_intrinsic: Intrinsic matrices (…, 3, 3) for CARLA's camera axes, pixels.
    """
    return as_floats(raw_intrinsic) @ _OPTICAL_FROM_RAW.T


def intrinsic_to_raw(intrinsic: ArrayLike) -> FloatArray:
    """Return K (…, 3, 3) for CARLA's camera axes (x depth, y right, z up).

    This is the inverse function of `intrinsic`.
    """
    return as_floats(intrinsic) @ _OPTICAL_FROM_RAW


def six_vectors_of(matrix: ArrayLike) -> FloatArray:
    """Return the 6-vectors (…, 6) of rigid matrices (…, 4, 4), metres and radians in [−π, π].

    Raises:
        GeometryError: If the matrices have the wrong shape.
    """
    m = as_floats(matrix)
    if m.shape[-2:] != (4, 4):
        raise GeometryError(f"matrix: expected shape (…, 4, 4), found {m.shape}")
    m12 = m[..., 1, 2]
    m22 = m[..., 2, 2]
    rx = np.arctan2(-m12, m22)
    ry = np.arctan2(m[..., 0, 2], np.hypot(m12, m22))
    rz = np.arctan2(-m[..., 0, 1], m[..., 0, 0])
    translation = m[..., :3, 3]
    angles = np.stack([rx, ry, rz], axis=-1)
    return np.concatenate([translation, angles], axis=-1)


def matrices_of_six(six: ArrayLike) -> FloatArray:
    """Return the rigid matrices (…, 4, 4) of 6-vectors (…, 6), metres and radians.

    All angles are allowed.

    Raises:
        GeometryError: If the vectors have the wrong shape.
    """
    vector = as_floats(six)
    if vector.shape[-1:] != (6,):
        raise GeometryError(f"six: expected shape (…, 6), found {vector.shape}")
    angles = vector[..., 3:]
    cx, cy, cz = np.moveaxis(np.cos(angles), -1, 0)
    sx, sy, sz = np.moveaxis(np.sin(angles), -1, 0)
    matrices = np.zeros((*vector.shape[:-1], 4, 4))
    rows = [
        [cy * cz, -cy * sz, sy],
        [cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy],
        [sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy],
    ]
    matrices[..., :3, :3] = stack_rows(rows)
    matrices[..., :3, 3] = vector[..., :3]
    matrices[..., 3, 3] = 1
    return matrices


def stored_transforms(numbers: FloatArray) -> FloatArray:
    """Return the transforms (…, 4, 4) stored as 12 or 16 numbers, in a new array.

    The last row is set to exactly 0, 0, 0, 1.

    Args:
        numbers: (…, 12) or (…, 16) numbers of each matrix, row by row.
    """
    transforms = np.empty((*numbers.shape[:-1], 4, 4))
    transforms[..., :3, :] = numbers[..., :12].reshape(*numbers.shape[:-1], 3, 4)
    transforms[..., 3, :] = LAST_ROW
    return transforms


def inverses(matrix: AnyArray) -> AnyArray:
    """Return the inverses of transforms (…, 4, 4), even if rotations are not quite orthonormal.

    If a rotation with an error of 1e-3 were merely transposed, a point 600 m away would move by 60
    cm.

    Raises:
        GeometryError: If a transform has no inverse.
    """
    try:
        rotation = np.linalg.inv(matrix[..., :3, :3])
    except np.linalg.LinAlgError:
        raise GeometryError("a transform has no inverse: its matrix is not a rotation") from None
    inverse = np.zeros_like(matrix)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -(rotation @ matrix[..., :3, 3, None])[..., 0]
    inverse[..., 3, 3] = 1
    return inverse
