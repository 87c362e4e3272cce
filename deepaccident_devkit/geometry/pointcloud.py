"""LiDAR point clouds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry.bev_grid import BevGrid
from deepaccident_devkit.geometry.conventions import checked_frame
from deepaccident_devkit.geometry.se3 import SE3, checked_transform
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    FrozenArrays,
    checked,
    checked_number,
    readonly,
)
from deepaccident_devkit.support.nuscenes_names import CLOUD, with_keywords_named, without_names
from deepaccident_devkit.support.text import Pictured

CoordinateRange = tuple[float, float]
# Columns that only some clouds have, and their dtypes.
_OPTIONAL_COLUMNS: Final = {"agent": np.int8, "time_lag": np.float32}


@without_names(CLOUD)
@dataclass(frozen=True, slots=True, eq=False)
class LidarPointCloud(FrozenArrays, Pictured):
    """N points in one right-handed coordinate frame; arrays are read-only views.

    Clouds are large, so arrays of the right type are not copied: a change of the caller's array
    changes the cloud.

    Attributes:
        xyz: (N, 3) float64, metres.
        intensity: (N,) float32.
        frame: `world`, `ego` or `lidar`.
        agent: (N,) int8, agent that recorded each point, as a position in `taxonomy.AGENTS`;
            None if it is not known. `aggregate_point_cloud` sets it.
        time_lag: (N,) float32, seconds from the recording of each point to the sample's moment: 0
            at the present, positive for earlier points, like the times of nuScenes'
            `from_file_multisweep`; None if it is not known.
    """

    xyz: FloatArray
    intensity: AnyArray
    frame: str = "lidar"
    agent: AnyArray | None = None
    time_lag: AnyArray | None = None

    def __post_init__(self) -> None:
        """Check the shapes; raises GeometryError."""
        checked_frame("LidarPointCloud.frame", self.frame)
        xyz = checked("LidarPointCloud.xyz", self.xyz, (None, 3))
        intensity = checked("LidarPointCloud.intensity", self.intensity, (len(xyz),), np.float32)
        object.__setattr__(self, "xyz", readonly(xyz))
        object.__setattr__(self, "intensity", readonly(intensity))
        for name, dtype in _OPTIONAL_COLUMNS.items():
            column = getattr(self, name)
            if column is not None:
                column = checked(f"LidarPointCloud.{name}", column, (len(xyz),), dtype)
                object.__setattr__(self, name, readonly(column))

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.xyz)

    def __repr__(self) -> str:
        """Return number, frame and ranges of the points."""
        finite = self.xyz[np.isfinite(self.xyz).all(axis=1)]
        title = f"{len(self):,} points in {self.frame}"
        if not len(finite):
            return f"LidarPointCloud({title})"
        ranges = []
        for axis, values in zip("xyz", finite.T, strict=True):
            ranges.append(f"{axis} {values.min():.1f} to {values.max():.1f} m")
        return f"LidarPointCloud({title}: {', '.join(ranges)})"

    @property
    def points(self) -> FloatArray:
        """(N, 4) float64 x, y, z and intensity in one new array."""
        return np.column_stack([self.xyz, self.intensity])

    @with_keywords_named
    def transform(self, target_from_source: SE3, frame: str) -> LidarPointCloud:
        """Return the same points in another frame. Raises GeometryError."""
        checked_transform("target_from_source", target_from_source)
        return replace(self, xyz=target_from_source.apply(self.xyz), frame=frame)

    def select(self, rows: ArrayLike) -> LidarPointCloud:
        """Return the points of a mask (N,) or of an integer array of rows. Raises GeometryError."""
        selection = np.asarray(rows)
        if not selection.size:
            selection = np.zeros(0, dtype=np.int64)
        try:
            columns = {name: column[selection] for name, column in self._columns().items()}
            return replace(self, **columns)
        except IndexError as error:
            raise GeometryError(
                f"{rows!r} does not pick from {len(self)} points: {error}"
            ) from error

    def crop(
        self,
        grid: BevGrid | None = None,
        *,
        x: CoordinateRange | None = None,
        y: CoordinateRange | None = None,
        z: CoordinateRange | None = None,
    ) -> LidarPointCloud:
        """Return the points over the cells of `grid` (at any height) and within ranges, in order.

        Args:
            grid: Cells, x forward and y left in the cloud's own coordinate frame; its orientation
                does not matter.
            x: Start (included) and end (not included), metres, as in a grid's cells; the same for
                `y` and `z`. None for all.
            y: See `x`.
            z: See `x`.
        """
        if grid is not None and not isinstance(grid, BevGrid):
            raise GeometryError(
                f"grid: expected a BevGrid, found {grid!r}; ranges go by name, x=(start, end)"
            )
        keep = np.ones(len(self), dtype=bool) if grid is None else grid.index_of(self.xyz)[1]
        for name, values, limits in zip("xyz", self.xyz.T, (x, y, z), strict=True):
            if limits is not None:
                keep &= _within(name, values, limits)
        return self.select(keep)

    def remove_close(self, radius: float, sensor: ArrayLike | None = None) -> LidarPointCloud:
        """Return the points that are `radius` or more from the sensor, in order.

        Distances are on the ground (x and y). The nuScenes devkit removes the points in a square
        with this half side; here it is a circle.

        Args:
            radius: Metres.
            sensor: (3,) position of the sensor in the cloud's coordinate frame, metres; by default
                the origin.

        Raises:
            GeometryError: the cloud is in the world frame and `sensor` is missing, or the radius is
                negative.
        """
        distance = checked_number("radius", radius, "metres from 0 on")
        if not distance >= 0:
            raise GeometryError(f"radius: expected metres from 0 on, found {radius}")
        if sensor is None and self.frame == "world":
            raise GeometryError(
                "a cloud in the world frame does not know its sensor; give sensor=(x, y, z), or "
                "load the cloud with "
                "frame='lidar' and remove there"
            )
        position = checked("sensor", (0.0, 0.0, 0.0) if sensor is None else sensor, (3,))
        offset = self.xyz[:, :2] - position[:2]
        return self.select(np.hypot(*offset.T) >= distance)

    def _columns(self) -> dict[str, Any]:
        """Return the arrays of N rows that the cloud has, by attribute."""
        columns = {"xyz": self.xyz, "intensity": self.intensity}
        for name in _OPTIONAL_COLUMNS:
            column = getattr(self, name)
            if column is not None:
                columns[name] = column
        return columns


def concatenate_clouds(parts: Sequence[LidarPointCloud], frame: str) -> LidarPointCloud:
    """Return all points of `parts`, in order.

    A column that not every part has, such as `time_lag`, is None. Raises GeometryError if a part is
    not in `frame`.
    """
    for part in parts:
        if part.frame != frame:
            raise GeometryError(
                f"points of frame {part.frame!r} cannot join those of {frame!r}; transform them "
                "first"
            )
    empty = LidarPointCloud(np.zeros((0, 3)), np.zeros(0), frame, np.zeros(0), np.zeros(0))
    columns = [part._columns() for part in (empty, *parts)]  # noqa: SLF001 - its own kind
    joined = {}
    for name in columns[0]:
        if all(name in part for part in columns):
            joined[name] = np.concatenate([part[name] for part in columns])
    return LidarPointCloud(**joined, frame=frame)


def _within(name: str, values: FloatArray, limits: CoordinateRange) -> BoolArray:
    """Return which values are within limits, the end not included; raises GeometryError."""
    low, high = checked(name, limits, (2,)).tolist()
    if not low <= high:
        raise GeometryError(f"{name}: expected a start and an end not before it, found {limits}")
    return np.asarray((values >= low) & (values < high))
