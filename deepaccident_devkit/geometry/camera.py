"""Pinhole cameras with ordinary optical axes: x right, y down, z forward."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import BoolArray, FloatArray, as_floats, checked, readonly


@dataclass(frozen=True, slots=True, eq=False)
class PinholeCamera:
    """A camera without distortion.

    Attributes:
        intrinsic: (3, 3) float64, K = [[f, 0, cx], [0, f, cy], [0, 0, 1]], pixels.
        width: of the image, pixels.
        height: of the image, pixels.
    """

    intrinsic: FloatArray
    width: int
    height: int

    def __post_init__(self) -> None:
        """Check the intrinsic's shape; raises GeometryError."""
        object.__setattr__(
            self, "intrinsic", readonly(checked("PinholeCamera.intrinsic", self.intrinsic, (3, 3)).copy())
        )

    @classmethod
    def from_field_of_view(cls, width: int, height: int, horizontal: float) -> PinholeCamera:
        """A camera with its optical axis in the middle and a horizontal field of view in radians."""
        focal = width / 2 / np.tan(horizontal / 2)
        return cls(np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), width, height)

    def project(self, points: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Points (N, 3) of the optical frame → pixels (N, 2) as (u, v), and depths (N,) metres.

        Pixels of points that are not in front of the camera (depth ≤ 0) are NaN.
        """
        given = checked("points", points, (None, 3))
        depth: FloatArray = given[:, 2]
        safe = np.where(depth > 0, depth, np.nan)
        return as_floats((given / safe[:, None]) @ self.intrinsic[:2].T), depth

    def in_image(self, pixels: ArrayLike) -> BoolArray:
        """Which pixels (N, 2) lie in the image; NaN does not."""
        uv = checked("pixels", pixels, (None, 2))
        inside: BoolArray = np.all((uv >= 0) & (uv < (self.width, self.height)), axis=1)
        return inside
