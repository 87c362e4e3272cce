"""CARLA's left-handed values ↔ the devkit's right-handed ones: the one place where signs change (docs/conventions.md).

CARLA's frames have x forward, y **right**, z up, and yaw clockwise seen from above. The devkit's have x forward,
y **left**, z up, yaw counter-clockwise. With S = diag(1, −1, 1) every conversion of a point, a pose or an angle is its
own inverse, so each `flip_*` works in both directions. Cameras also change from CARLA's axes (x depth, y right, z up)
to optical axes (x right, y down, z forward), which is not its own inverse: these two functions have a `*_to_raw` each.

All functions take arrays with any leading axes, return new float64 arrays and do not change their arguments.
"""

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.support.arrays import FloatArray, as_floats

_S = np.array([1.0, -1.0, 1.0])
_S4 = np.array([1.0, -1.0, 1.0, 1.0])
_SIX = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
_OPTICAL_FROM_FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Q: a camera frame with x forward, y left, z up → the optical frame."""
_OPTICAL_FROM_RAW = _OPTICAL_FROM_FORWARD * _S
"""Q·S: CARLA's camera axes → the optical frame."""


def flip_points(points: ArrayLike) -> FloatArray:
    """Points or vectors (…, 3) in the other handedness: y changes its sign."""
    return as_floats(as_floats(points) * _S)


def flip_vectors2(vectors: ArrayLike) -> FloatArray:
    """Horizontal vectors (…, 2), such as a label's velocity, in the other handedness."""
    return as_floats(as_floats(vectors) * _S[:2])


def flip_yaw(yaw: ArrayLike) -> FloatArray:
    """Angles about z (…), radians, in the other handedness."""
    return -as_floats(yaw)


def flip_pose(pose: ArrayLike) -> FloatArray:
    """Transforms (…, 4, 4) between two frames in the other handedness: S4·T·S4."""
    return as_floats(as_floats(pose) * np.outer(_S4, _S4))


def flip_six_vector(six: ArrayLike) -> FloatArray:
    """Poses (…, 6) as (tx, ty, tz, rx, ry, rz), docs/released_code.md, Poses, in the other handedness."""
    return as_floats(as_floats(six) * _SIX)


def camera_from_lidar(lidar_to_cam: ArrayLike) -> FloatArray:
    """CARLA's `lidar_to_<Camera>` (…, 4, 4) → right-handed LiDAR to optical camera: Q·S·T·S."""
    flipped = as_floats(lidar_to_cam) * _S4
    result = flipped.copy()
    result[..., :3, :] = _OPTICAL_FROM_RAW @ flipped[..., :3, :]
    return as_floats(result)


def camera_from_lidar_to_raw(camera_from_lidar: ArrayLike) -> FloatArray:
    """The inverse of `camera_from_lidar`: CARLA's `lidar_to_<Camera>` (…, 4, 4)."""
    flipped = as_floats(camera_from_lidar) * _S4
    result = flipped.copy()
    result[..., :3, :] = _OPTICAL_FROM_RAW.T @ flipped[..., :3, :]
    return as_floats(result)


def intrinsic(raw_intrinsic: ArrayLike) -> FloatArray:
    """CARLA's permuted intrinsic (…, 3, 3) → the usual K = [[f, 0, cx], [0, f, cy], [0, 0, 1]]."""
    return as_floats(as_floats(raw_intrinsic) @ _OPTICAL_FROM_RAW.T)


def intrinsic_to_raw(intrinsic: ArrayLike) -> FloatArray:
    """The inverse of `intrinsic`: K (…, 3, 3) for CARLA's camera axes (x depth, y right, z up)."""
    return as_floats(as_floats(intrinsic) @ _OPTICAL_FROM_RAW)
