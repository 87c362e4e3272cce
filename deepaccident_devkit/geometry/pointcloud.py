"""LiDAR point clouds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray, checked, readonly
from deepaccident_devkit.geometry.se3 import SE3


@dataclass(frozen=True, slots=True, eq=False)
class LidarPointCloud:
    """N points in one right-handed frame; immutable, arrays are read-only.

    Attributes:
        xyz: (N, 3) float64, metres.
        intensity: (N,) float32.
        frame: `world`, `ego` or `lidar`.
    """

    xyz: FloatArray
    intensity: AnyArray
    frame: str = "lidar"

    def __post_init__(self) -> None:
        """Check the shapes; raises GeometryError."""
        xyz = checked("LidarPointCloud.xyz", self.xyz, (None, 3))
        intensity = checked("LidarPointCloud.intensity", self.intensity, (len(xyz),), np.float32)
        object.__setattr__(self, "xyz", readonly(xyz))
        object.__setattr__(self, "intensity", readonly(intensity))

    def __len__(self) -> int:
        """Number of points."""
        return len(self.xyz)

    @property
    def points(self) -> FloatArray:
        """x, y, z and intensity in one new array (N, 4) float64."""
        return np.column_stack([self.xyz, self.intensity])

    def transform(self, target_from_source: SE3, frame: str) -> LidarPointCloud:
        """The same points in another frame."""
        return LidarPointCloud(target_from_source.apply(self.xyz), self.intensity, frame)
