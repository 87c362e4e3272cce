"""Rigid transforms between frames, always named `target_from_source`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, overload

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import FloatArray, as_floats, checked, readonly
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import quaternions, six_vectors

if TYPE_CHECKING:
    from pyquaternion import Quaternion

RIGID_TOLERANCE = 1e-3
"""How far a rotation may be from orthonormal; files carry single-precision poses."""


@dataclass(frozen=True, slots=True, eq=False)
class SE3:
    """A rigid transform, right-handed: `target_from_source.apply(p_source)` is `p_target`.

    Attributes:
        matrix: (4, 4) float64, column-vector convention, read-only.
    """

    matrix: FloatArray

    def __post_init__(self) -> None:
        """Check the matrix; raises GeometryError if it is not a rigid transform."""
        matrix = checked("SE3.matrix", self.matrix, (4, 4))
        fault = rigid_fault(matrix)
        if fault:
            raise GeometryError(f"SE3.matrix: {fault}")
        object.__setattr__(self, "matrix", readonly(matrix.copy()))

    @classmethod
    def identity(cls) -> SE3:
        """The transform that changes nothing."""
        return trusted_se3(np.eye(4))

    @classmethod
    def from_rotation(cls, rotation: ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)) -> SE3:
        """From a rotation matrix (3, 3) and a translation (3,), metres."""
        matrix = np.eye(4)
        matrix[:3, :3] = checked("rotation", rotation, (3, 3))
        matrix[:3, 3] = checked("translation", translation, (3,))
        return cls(matrix)

    @classmethod
    def from_quaternion(cls, quaternion: Quaternion, translation: ArrayLike = (0.0, 0.0, 0.0)) -> SE3:
        """From a unit quaternion (pyquaternion's, or four numbers w, x, y, z) and a translation (3,), metres."""
        wxyz = checked("quaternion", [float(part) for part in quaternion], (4,))
        norm = float(np.linalg.norm(wxyz))
        if not np.isfinite(norm) or norm < RIGID_TOLERANCE:
            raise GeometryError(f"quaternion: {wxyz.tolist()} has no direction; give a unit quaternion w, x, y, z")
        return cls.from_rotation(quaternions.to_matrix(wxyz / norm), translation)

    @classmethod
    def from_yaw(cls, yaw: float, translation: ArrayLike = (0.0, 0.0, 0.0)) -> SE3:
        """From an angle about z, radians counter-clockwise, and a translation (3,), metres."""
        return cls.from_quaternion(quaternions.from_yaw(yaw), translation)

    @classmethod
    def from_six(cls, vector: ArrayLike) -> SE3:
        """From (6,) tx, ty, tz, rx, ry, rz: metres and radians, R = Rx(rx) · Ry(ry) · Rz(rz) (evaluation.md g).

        The vector is right-handed, as all of SE3; one of the released code goes through
        `handedness.flip_six_vector` first. Raises GeometryError if a number is not finite.
        """
        six = checked("vector", vector, (6,))
        if not np.isfinite(six).all():
            raise GeometryError(f"vector: {six.tolist()} holds NaN or infinity")
        return trusted_se3(six_vectors.to_matrices(six))

    @property
    def rotation(self) -> FloatArray:
        """The rotation matrix (3, 3), read-only."""
        return self.matrix[:3, :3]

    @property
    def translation(self) -> FloatArray:
        """Where the source's origin lies in the target frame (3,), metres, read-only."""
        return self.matrix[:3, 3]

    @property
    def quaternion(self) -> Quaternion:
        """The rotation as a pyquaternion unit quaternion with w ≥ 0."""
        from pyquaternion import Quaternion

        return Quaternion(*quaternions.single_from_matrix(self.rotation))

    @property
    def yaw(self) -> float:
        """Heading of the source's x axis in the target frame, radians in (−π, π]."""
        return float(np.arctan2(self.matrix[1, 0], self.matrix[0, 0]))

    def to_six(self) -> FloatArray:
        """The 6-vector (6,) tx, ty, tz, rx, ry, rz: metres and radians, right-handed, as `from_six` takes it.

        ry is in [−π/2, π/2]; at its ends, a source x axis that points straight up or down, rx and rz are not
        determined one by one.
        """
        return six_vectors.from_matrices(self.matrix)

    def interpolate(self, other: SE3, share: float) -> SE3:
        """The pose at `share` of the way from this one (0) to `other` (1), both between the same two frames.

        The rotation turns evenly about one axis on the shorter way (slerp), the translation goes straight.

        Raises:
            GeometryError: `share` is not between 0 and 1.
        """
        if not 0 <= share <= 1:
            raise GeometryError(f"share: expected a number from 0 to 1, found {share}")
        if share in (0, 1):
            return other if share else self
        mine, theirs = quaternions.from_matrix(self.rotation), quaternions.from_matrix(other.rotation)
        matrix = np.eye(4)
        matrix[:3, :3] = quaternions.to_matrix(quaternions.slerp(mine, theirs, share))
        matrix[:3, 3] = (1 - share) * self.translation + share * other.translation
        return trusted_se3(matrix)

    def inverse(self) -> SE3:
        """The transform the other way, `source_from_target`."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation.T
        matrix[:3, 3] = -self.rotation.T @ self.translation
        return trusted_se3(matrix)

    def apply(self, points: ArrayLike) -> FloatArray:
        """Points (N, 3) or one point (3,) of the source frame in the target frame, metres."""
        given = as_floats(points)
        if given.ndim == 0 or given.ndim > 2 or given.shape[-1] != 3:
            raise GeometryError(f"points: expected shape (N, 3) or (3,), found {given.shape}")
        return as_floats(given @ self.rotation.T + self.translation)

    def rotate(self, vectors: ArrayLike) -> FloatArray:
        """Free vectors (…, 3), such as velocities, of the source frame in the target frame."""
        return as_floats(as_floats(vectors) @ self.rotation.T)

    @overload
    def __matmul__(self, other: SE3) -> SE3: ...
    @overload
    def __matmul__(self, other: ArrayLike) -> FloatArray: ...
    def __matmul__(self, other: SE3 | ArrayLike) -> SE3 | FloatArray:
        """Compose: `a_from_b @ b_from_c` is `a_from_c`; with points (N, 3), apply."""
        if isinstance(other, SE3):
            return trusted_se3(self.matrix @ other.matrix)
        return self.apply(other)

    def __repr__(self) -> str:
        """Translation and yaw, which is what one looks for."""
        x, y, z = self.translation.tolist()
        return f"SE3(translation=[{x:.3f}, {y:.3f}, {z:.3f}], yaw={self.yaw:.4f})"


def trusted_se3(matrix: FloatArray) -> SE3:
    """An SE3 over a fresh matrix that is rigid by construction, or was checked when it was read."""
    result = object.__new__(SE3)
    matrix.setflags(write=False)
    object.__setattr__(result, "matrix", matrix)
    return result


def rigid_fault(matrix: FloatArray) -> str | None:
    """Say why `matrix` (4, 4) is no rigid transform, or None if it is one."""
    if not np.isfinite(matrix).all():
        return "holds NaN or infinity"
    if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), atol=RIGID_TOLERANCE):
        return f"its last row is {matrix[3].tolist()}, expected 0 0 0 1"
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if not error <= RIGID_TOLERANCE:  # NaN, where numbers overflow
        return f"its rotation is not orthonormal (off by {error:.2g})"
    if np.linalg.det(rotation) < 0:
        return "its rotation is a mirror image (determinant −1)"
    return None
