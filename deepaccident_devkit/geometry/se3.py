"""Rigid transforms between coordinate frames, always named `target_from_source`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, overload, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import conventions, quaternions
from deepaccident_devkit.geometry.conventions import LAST_ROW, inverses
from deepaccident_devkit.support.arrays import (
    FloatArray,
    FrozenArrays,
    as_numbers,
    checked,
    checked_number,
    readonly,
)

if TYPE_CHECKING:
    from pyquaternion import Quaternion

RIGID_TOLERANCE = 1e-3
"""Largest difference of a rotation from an orthonormal one: files have poses in single precision,
or rounded ones."""


@runtime_checkable
class Movable(Protocol):
    """Object that a transform can convert to another frame: boxes, a box, a point cloud."""

    @property
    def frame(self) -> str:
        """Name of its coordinate frame."""
        ...

    def transform(self: MovableT, target_from_source: SE3, frame: str) -> MovableT:
        """Return the same object in another coordinate frame."""
        ...


MovableT = TypeVar("MovableT", bound=Movable)


@dataclass(frozen=True, slots=True, eq=False)
class SE3(FrozenArrays):
    """A rigid transform, right-handed: `target_from_source.apply(p_source)` is `p_target`.

    A rotation that differs a little from an orthonormal one, as in files, is not changed. `inverse`
    is nevertheless the true inverse, so that a transform and then its inverse give the same point.

    Attributes:
        matrix: (4, 4) float64, column-vector convention, read-only.
    """

    matrix: FloatArray

    def __post_init__(self) -> None:
        """Check the matrix; raises GeometryError if it is not a rigid transform."""
        matrix = checked("SE3.matrix", self.matrix, (4, 4)).copy()
        fault = rigid_fault(matrix)
        if fault:
            raise GeometryError(f"SE3.matrix: {fault}")
        matrix[3] = LAST_ROW
        object.__setattr__(self, "matrix", readonly(matrix))

    @classmethod
    def identity(cls) -> SE3:
        """Return the transform that changes nothing."""
        return trusted_se3(np.eye(4))

    @classmethod
    def from_rotation(cls, rotation: ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)) -> SE3:
        """Return the transform of a rotation matrix (3, 3) and a translation (3,), metres."""
        matrix = np.eye(4)
        matrix[:3, :3] = checked("rotation", rotation, (3, 3))
        matrix[:3, 3] = checked("translation", translation, (3,))
        return cls(matrix)

    @classmethod
    def from_quaternion(
        cls, quaternion: Quaternion, translation: ArrayLike = (0.0, 0.0, 0.0)
    ) -> SE3:
        """Return the transform of a unit quaternion and a translation (3,), metres.

        Args:
            quaternion: A quaternion of pyquaternion, or four numbers w, x, y, z.
            translation: (3,) metres.

        Raises:
            GeometryError: the quaternion has no direction.
        """
        wxyz = checked("quaternion", getattr(quaternion, "elements", quaternion), (4,))
        norm = float(np.linalg.norm(wxyz))
        if not np.isfinite(norm) or norm < RIGID_TOLERANCE:
            raise GeometryError(
                f"quaternion: {wxyz.tolist()} has no direction; give a unit quaternion w, x, y, z"
            )
        return cls.from_rotation(quaternions.to_matrix(wxyz / norm), translation)

    @classmethod
    def from_yaw(cls, yaw: float, translation: ArrayLike = (0.0, 0.0, 0.0)) -> SE3:
        """Return the transform of an angle about z and a translation (3,), metres.

        Args:
            yaw: Radians, counter-clockwise.
            translation: (3,) metres.

        Raises:
            GeometryError: the angle is not finite.
        """
        angle = checked_number("yaw", yaw, "an angle in radians")
        if not math.isfinite(angle):
            raise GeometryError(f"yaw: expected a finite angle in radians, found {yaw}")
        return cls.from_rotation(quaternions.to_matrix(quaternions.from_yaw(angle)), translation)

    @classmethod
    def from_six(cls, vector: ArrayLike) -> SE3:
        """Return the transform of (6,) tx, ty, tz, rx, ry, rz: R = Rx(rx) · Ry(ry) · Rz(rz).

        See docs/released_code.md, Poses. The vector is right-handed, like all of SE3; convert one
        of the released code with `conventions.flip_six_vector` first. Raises GeometryError if a
        number is not finite.

        Args:
            vector: (6,) metres and radians.
        """
        six = checked("vector", vector, (6,))
        if not np.isfinite(six).all():
            raise GeometryError(f"vector: {six.tolist()} holds NaN or infinity")
        return trusted_se3(conventions.matrices_of_six(six))

    @property
    def rotation(self) -> FloatArray:
        """Rotation matrix (3, 3), read-only."""
        return self.matrix[:3, :3]

    @property
    def translation(self) -> FloatArray:
        """Position of the source's origin in the target frame, (3,), metres, read-only."""
        return self.matrix[:3, 3]

    @property
    def quaternion(self) -> Quaternion:
        """Rotation as a pyquaternion unit quaternion with w ≥ 0."""
        from pyquaternion import Quaternion

        return Quaternion(*quaternions.single_from_matrix(self.rotation))

    @property
    def yaw(self) -> float:
        """Heading of the source's x axis in the target frame, radians in (−π, π]."""
        x = self.matrix[0, 0]
        y = self.matrix[1, 0]
        return float(np.arctan2(y, x))

    def to_six(self) -> FloatArray:
        """Return the 6-vector (6,) tx, ty, tz, rx, ry, rz for `from_six`, metres and radians.

        It is right-handed. ry is in [−π/2, π/2]; at its ends (the source's x axis points straight
        up or down) there are many pairs of rx and rz for the same rotation.
        """
        return conventions.six_vectors_of(self.matrix)

    def inverse(self) -> SE3:
        """Return the inverse transform, `source_from_target`."""
        return trusted_se3(inverses(self.matrix))

    @overload
    def apply(self, points: MovableT, frame: str | None = None) -> MovableT: ...
    @overload
    def apply(self, points: ArrayLike) -> FloatArray: ...
    def apply(self, points: Any, frame: str | None = None) -> Any:
        """Return points or objects of the source frame in the target frame.

        Args:
            points: (N, 3) or one point (3,), metres; or `Boxes`, a `Box` or a `LidarPointCloud`.
                NaN stays NaN, and infinity becomes NaN in a rotation.
            frame: Name of the target frame of boxes and clouds, because a transform does not know
                the names of its frames. Without it they keep their name, as after a motion within
                one frame.

        Returns:
            Points as a new array of their shape; boxes and clouds as the result of their
            `transform`.

        Raises:
            GeometryError: `points` is none of these, or `frame` is passed for an array.
        """
        if not isinstance(points, np.ndarray) and isinstance(points, Movable):
            return points.transform(self, points.frame if frame is None else frame)
        if frame is not None:
            raise GeometryError(
                f"frame: points of an array carry no name of a frame, found {frame!r}; leave it out"
            )
        xyz = as_numbers("points", points, "points of shape (N, 3) or (3,), boxes or a point cloud")
        if xyz.ndim == 0 or xyz.ndim > 2 or xyz.shape[-1] != 3:
            hint = ""
            if xyz.ndim == 2 and xyz.shape[0] == 3:
                hint = "; transpose it (.T)"
            elif xyz.shape == (4, 4):
                hint = "; of a matrix (4, 4) make SE3(matrix)"
            raise GeometryError(f"points: expected shape (N, 3) or (3,), found {xyz.shape}{hint}")
        with np.errstate(invalid="ignore"):
            return xyz @ self.rotation.T + self.translation

    def rotate(self, vectors: ArrayLike) -> FloatArray:
        """Return free vectors (…, 3) of the source frame, such as velocities, in the target frame.

        Raises GeometryError.
        """
        free_vectors = as_numbers("vectors", vectors, "vectors of shape (…, 3)")
        if free_vectors.ndim == 0 or free_vectors.shape[-1] != 3:
            raise GeometryError(f"vectors: expected shape (…, 3), found {free_vectors.shape}")
        with np.errstate(invalid="ignore"):
            return free_vectors @ self.rotation.T

    @overload
    def __matmul__(self, other: SE3) -> SE3: ...
    @overload
    def __matmul__(self, other: MovableT) -> MovableT: ...
    @overload
    def __matmul__(self, other: ArrayLike) -> FloatArray: ...
    def __matmul__(self, other: Any) -> Any:
        """Compose: `a_from_b @ b_from_c` is `a_from_c`; with points, boxes or a cloud, `apply`."""
        if isinstance(other, SE3):
            return trusted_se3(self.matrix @ other.matrix)
        return self.apply(other)

    def __repr__(self) -> str:
        """Return translation and yaw."""
        x, y, z = self.translation.tolist()
        translation = f"[{x:.3f}, {y:.3f}, {z:.3f}]"
        return f"SE3(translation={translation}, yaw={self.yaw:.4f})"


def trusted_se3(matrix: FloatArray) -> SE3:
    """Return an SE3 of a new matrix without checks: it must be rigid, or checked when read."""
    result = object.__new__(SE3)
    matrix.setflags(write=False)
    object.__setattr__(result, "matrix", matrix)
    return result


def checked_transform(name: str, transform: object) -> SE3:
    """Return `transform` if it is an SE3; raises GeometryError otherwise."""
    if not isinstance(transform, SE3):
        raise GeometryError(
            f"{name}: expected an SE3, found {type(transform).__name__}; of a matrix (4, 4) make "
            "SE3(matrix)"
        )
    return transform


def rigid_fault(matrix: FloatArray) -> str | None:
    """Return why `matrix` (4, 4) is not a rigid transform, in words; None if it is one."""
    if not np.isfinite(matrix).all():
        return "holds NaN or infinity"
    if not np.allclose(matrix[3], LAST_ROW, atol=RIGID_TOLERANCE):
        return f"its last row is {matrix[3].tolist()}, expected 0 0 0 1"
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if not error <= RIGID_TOLERANCE:  # NaN, where numbers overflow
        return f"its rotation is not orthonormal (off by {error:.2g})"
    if np.linalg.det(rotation) < 0:
        return "its rotation is a mirror image (determinant −1)"
    return None
