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
"""Largest accepted deviation from an orthonormal rotation: poses in files are rounded."""


@runtime_checkable
class Movable(Protocol):
    """An object that a transform can move to another frame: boxes, a box, a point cloud."""

    @property
    def frame(self) -> str:
        """Name of the object's coordinate frame."""
        ...

    def transform(self: MovableT, target_from_source: SE3, frame: str) -> MovableT:
        """Return the same object in another coordinate frame."""
        ...


MovableT = TypeVar("MovableT", bound=Movable)


@dataclass(frozen=True, slots=True, eq=False)
class SE3(FrozenArrays):
    """A rigid transform, right-handed: `target_from_source.apply(p_source)` is `p_target`.

    A rotation that is not quite orthonormal, as in files, is not changed. `inverse` is nevertheless
    the true inverse, so a transform followed by its inverse returns the same point.

    Attributes:
        matrix: (4, 4) float64, column-vector convention, read-only.
    """

    matrix: FloatArray

    def __post_init__(self) -> None:
        """Check the matrix.

        Raises:
            GeometryError: If the matrix is not a rigid transform.
        """
        matrix = checked("SE3.matrix", self.matrix, (4, 4)).copy()
        fault = rigid_fault(matrix)
        if fault:
            raise GeometryError(f"SE3.matrix: {fault}")
        matrix[3] = LAST_ROW
        object.__setattr__(self, "matrix", readonly(matrix))

    @classmethod
    def identity(cls) -> SE3:
        """Return the identity transform."""
        return trusted_se3(np.eye(4))

    @classmethod
    def from_rotation(cls, rotation: ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)) -> SE3:
        """Make a transform from a rotation matrix (3, 3) and a translation (3,), metres."""
        matrix = np.eye(4)
        matrix[:3, :3] = checked("rotation", rotation, (3, 3))
        matrix[:3, 3] = checked("translation", translation, (3,))
        return cls(matrix)

    @classmethod
    def from_quaternion(
        cls, quaternion: Quaternion, translation: ArrayLike = (0.0, 0.0, 0.0)
    ) -> SE3:
        """Make a transform from a unit quaternion and a translation (3,), metres.

        Args:
            quaternion: A pyquaternion object, or four numbers w, x, y, z.
            translation: (3,) metres.

        Raises:
            GeometryError: If the quaternion is zero or not finite.
        """
        wxyz = checked("quaternion", getattr(quaternion, "elements", quaternion), (4,))
        norm = float(np.linalg.norm(wxyz))
        if not np.isfinite(norm) or norm < RIGID_TOLERANCE:
            raise GeometryError(
                f"quaternion: {wxyz.tolist()} has no direction; give a unit quaternion w, x, y, z"
            )
        rotation = quaternions.to_matrix(wxyz / norm)
        return cls.from_rotation(rotation, translation)

    @classmethod
    def from_yaw(cls, yaw: float, translation: ArrayLike = (0.0, 0.0, 0.0)) -> SE3:
        """Make a transform from an angle about z and a translation (3,), metres.

        Args:
            yaw: Radians, counter-clockwise.
            translation: (3,) metres.

        Raises:
            GeometryError: If the angle is not finite.
        """
        angle = checked_number("yaw", yaw, "an angle in radians")
        if not math.isfinite(angle):
            raise GeometryError(f"yaw: expected a finite angle in radians, found {yaw}")
        quaternion = quaternions.from_yaw(angle)
        return cls.from_rotation(quaternions.to_matrix(quaternion), translation)

    @classmethod
    def from_six(cls, vector: ArrayLike) -> SE3:
        """Make a transform from (6,) tx, ty, tz, rx, ry, rz: R = Rx(rx) · Ry(ry) · Rz(rz).

        See docs/released_code.md, Poses. The vector is right-handed, like everything in SE3; first
        convert the released code's vectors with `conventions.flip_six_vector`.

        Args:
            vector: (6,) metres and radians.

        Raises:
            GeometryError: If a number is not finite.
        """
        six = checked("vector", vector, (6,))
        if not np.isfinite(six).all():
            raise GeometryError(f"vector: {six.tolist()} contains NaN or infinity")
        matrix = conventions.matrices_of_six(six)
        return trusted_se3(matrix)

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

        The vector is right-handed. ry is in [−π/2, π/2]; at these limits (the source's x axis
        points straight up or down) many pairs of rx and rz describe the same rotation.
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
        """Transform points or objects from the source frame to the target frame.

        Args:
            points: (N, 3) points or one point (3,), metres; or `Boxes`, a `Box` or a
                `LidarPointCloud`. NaN stays NaN, and infinity becomes NaN in a rotation.
            frame: Name of the target frame, for boxes and clouds only: a transform does not know
                the names of its frames. If None, they keep their frame's name, as after a motion
                within one frame.

        Returns:
            A new array of the points' shape, or what `transform` of the boxes or the cloud returns.

        Raises:
            GeometryError: If `points` is none of these, or `frame` is passed for an array.
        """
        if not isinstance(points, np.ndarray) and isinstance(points, Movable):
            target_frame = points.frame if frame is None else frame
            return points.transform(self, target_frame)
        if frame is not None:
            raise GeometryError(
                f"frame: points in an array have no frame, found {frame!r}; omit this argument"
            )
        xyz = as_numbers("points", points, "points of shape (N, 3) or (3,), boxes or a point cloud")
        if xyz.ndim == 0 or xyz.ndim > 2 or xyz.shape[-1] != 3:
            hint = ""
            if xyz.ndim == 2 and xyz.shape[0] == 3:
                hint = "; transpose it (.T)"
            elif xyz.shape == (4, 4):
                hint = "; make an SE3 from a matrix (4, 4) with SE3(matrix)"
            raise GeometryError(f"points: expected shape (N, 3) or (3,), found {xyz.shape}{hint}")
        with np.errstate(invalid="ignore"):
            return xyz @ self.rotation.T + self.translation

    def rotate(self, vectors: ArrayLike) -> FloatArray:
        """Rotate vectors (…, 3), such as velocities, from the source frame to the target frame.

        They are not translated.

        Raises:
            GeometryError: If the vectors have the wrong shape.
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
        """Compose with a transform, or apply to points, boxes or a cloud.

        `a_from_b @ b_from_c` is `a_from_c`.
        """
        if isinstance(other, SE3):
            return trusted_se3(self.matrix @ other.matrix)
        return self.apply(other)

    def __repr__(self) -> str:
        """Return translation and yaw."""
        x, y, z = self.translation.tolist()
        translation = f"[{x:.3f}, {y:.3f}, {z:.3f}]"
        return f"SE3(translation={translation}, yaw={self.yaw:.4f})"


def trusted_se3(matrix: FloatArray) -> SE3:
    """Wrap a new matrix without checking it: it must be rigid, or checked when it was read."""
    transform = object.__new__(SE3)
    matrix.setflags(write=False)
    object.__setattr__(transform, "matrix", matrix)
    return transform


def checked_transform(name: str, transform: object) -> SE3:
    """Return `transform` if it is an SE3; otherwise raise a GeometryError that names `name`."""
    if not isinstance(transform, SE3):
        raise GeometryError(
            f"{name}: expected an SE3, found {type(transform).__name__}; make an SE3 from a "
            "matrix (4, 4) with SE3(matrix)"
        )
    return transform


def rigid_fault(matrix: FloatArray) -> str | None:
    """Describe why `matrix` (4, 4) is not a rigid transform; None if it is one."""
    if not np.isfinite(matrix).all():
        return "contains NaN or infinity"
    if not np.allclose(matrix[3], LAST_ROW, atol=RIGID_TOLERANCE):
        return f"its last row is {matrix[3].tolist()}, expected 0 0 0 1"
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        product = rotation @ rotation.T
        error = float(np.abs(product - np.eye(3)).max())
    if not error <= RIGID_TOLERANCE:  # also true for NaN, after an overflow
        return f"its rotation is not orthonormal (off by {error:.2g})"
    if np.linalg.det(rotation) < 0:
        return "its rotation is a mirror image (determinant −1)"
    return None
