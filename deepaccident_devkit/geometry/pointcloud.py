"""LiDAR point clouds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry.bev_grid import BevGrid
from deepaccident_devkit.geometry.conventions import checked_frame
from deepaccident_devkit.geometry.se3 import SE3, checked_transform
from deepaccident_devkit.support.arrays import (
    NO_INDICES,
    AnyArray,
    BoolArray,
    FloatArray,
    FrozenArrays,
    checked,
    checked_number,
    readonly,
)
from deepaccident_devkit.support.nuscenes_names import CLOUD, with_keywords_named, without_names
from deepaccident_devkit.support.text import PictureRepr
from deepaccident_devkit.support.values import NamedValues

CoordinateRange = tuple[float, float]
# Columns that only some clouds have, and their dtypes.
_OPTIONAL_COLUMNS = {"agent": np.int8, "time_lag": np.float32}


@without_names(CLOUD)
@dataclass(frozen=True, slots=True, eq=False)
class LidarPointCloud(FrozenArrays, PictureRepr):
    """N points in one right-handed coordinate frame, as read-only views of the arrays.

    Clouds are large, so arrays of the right type are not copied: if you change your array, the
    cloud changes too.

    Attributes:
        xyz: (N, 3) float64 positions, metres.
        intensity: (N,) float32 intensities.
        frame: Coordinate frame: `world`, `ego` or `lidar`.
        agent: (N,) int8, the agent that recorded each point, as an index into `taxonomy.AGENTS`;
            None if unknown. `aggregate_point_cloud` sets it.
        time_lag: (N,) float32, age of each point in seconds at the time of the sample: 0 for points
            of the sample's frame, positive for earlier points, as in nuScenes'
            `from_file_multisweep`; None if unknown.
    """

    xyz: FloatArray
    intensity: AnyArray
    frame: str = "lidar"
    agent: AnyArray | None = None
    time_lag: AnyArray | None = None

    def __post_init__(self) -> None:
        """Raise GeometryError if the arrays have wrong shapes or the frame is no name."""
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
        is_finite = np.isfinite(self.xyz).all(axis=1)
        title = f"{len(self):,} points in {self.frame}"
        if not is_finite.any():
            return f"LidarPointCloud({title})"
        ranges = []
        for axis, values in zip("xyz", self.xyz[is_finite].T, strict=True):
            ranges.append(f"{axis} {values.min():.1f} to {values.max():.1f} m")
        return f"LidarPointCloud({title}: {', '.join(ranges)})"

    @property
    def points(self) -> FloatArray:
        """(N, 4) float64 x, y, z and intensity, as a new array."""
        return np.column_stack([self.xyz, self.intensity])

    @with_keywords_named
    def transform(self, target_from_source: SE3, frame: str) -> LidarPointCloud:
        """Transform the points to `frame`; raise GeometryError if an argument is invalid."""
        checked_transform("target_from_source", target_from_source)
        return replace(self, xyz=target_from_source.apply(self.xyz), frame=frame)

    def select(self, rows: ArrayLike) -> LidarPointCloud:
        """Return the points that a mask (N,) or an array of rows selects.

        Raises:
            GeometryError: If `rows` is neither of the two, or a row does not exist.
        """
        selection = np.asarray(rows)
        if not selection.size:
            selection = NO_INDICES
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
        """Return the points above or below `grid` and within the ranges, in their order.

        Args:
            grid: Area to keep, x forward and y left in the cloud's coordinate frame, at any height;
                the grid's orientation does not matter. None keeps all points.
            x: Start (inclusive) and end (exclusive) of the range along x, metres; None keeps all
                points.
            y: Range along y, in the same form.
            z: Range along z, in the same form.

        Raises:
            GeometryError: If the grid is not a `BevGrid`, or a range ends before its start.
        """
        if grid is not None and not isinstance(grid, BevGrid):
            raise GeometryError(
                f"grid: expected a BevGrid, found {grid!r}; pass ranges by name, such "
                "as x=(start, end)"
            )
        is_kept = np.ones(len(self), dtype=bool)
        if grid is not None:
            _, is_kept = grid.index_of(self.xyz)
        for name, values, limits in zip("xyz", self.xyz.T, (x, y, z), strict=True):
            if limits is not None:
                is_kept &= _is_within(name, values, limits)
        return self.select(is_kept)

    def remove_close(self, radius: float, sensor: ArrayLike | None = None) -> LidarPointCloud:
        """Return the points at least `radius` away from the sensor, in their order.

        Distances are horizontal (x and y). This removes the points in a circle; the nuScenes devkit
        removes the ones in the square around it.

        Args:
            radius: Radius of the circle, metres.
            sensor: (3,) position of the sensor in the cloud's coordinate frame, metres; None for
                the origin.

        Raises:
            GeometryError: If the cloud is in the world frame and `sensor` is missing, or the radius
                is negative.
        """
        distance = checked_number("radius", radius, "0 m or more")
        if not distance >= 0:
            raise GeometryError(f"radius: expected 0 m or more, found {radius}")
        if sensor is None and self.frame == "world":
            raise GeometryError(
                "a cloud in the world frame does not know its sensor; give sensor=(x, y, z), or "
                "load the cloud with frame='lidar' and remove the points in that frame"
            )
        position = np.zeros(3)
        if sensor is not None:
            position = checked("sensor", sensor, (3,))
        dx, dy = (self.xyz[:, :2] - position[:2]).T
        return self.select(np.hypot(dx, dy) >= distance)

    def _columns(self) -> NamedValues:
        """Return the cloud's arrays of N rows by attribute name, without the ones that are None."""
        columns = {"xyz": self.xyz, "intensity": self.intensity}
        for name in _OPTIONAL_COLUMNS:
            column = getattr(self, name)
            if column is not None:
                columns[name] = column
        return columns


def concatenate_clouds(parts: Sequence[LidarPointCloud], frame: str) -> LidarPointCloud:
    """Join clouds into one cloud, in order.

    An optional column, such as `time_lag`, is None unless every cloud has it.

    Raises:
        GeometryError: If a cloud is not in `frame`.
    """
    for part in parts:
        if part.frame != frame:
            raise GeometryError(
                f"points of frame {part.frame!r} cannot join those of {frame!r}; transform them "
                "first"
            )
    empty = LidarPointCloud(np.zeros((0, 3)), np.zeros(0), frame, np.zeros(0), np.zeros(0))
    columns_of_parts = [part._columns() for part in (empty, *parts)]  # noqa: SLF001 - its own kind
    columns = {}
    for name in columns_of_parts[0]:
        if all(name in part_columns for part_columns in columns_of_parts):
            arrays = [part_columns[name] for part_columns in columns_of_parts]
            columns[name] = np.concatenate(arrays)
    return LidarPointCloud(**columns, frame=frame)


def _is_within(name: str, values: FloatArray, limits: CoordinateRange) -> BoolArray:
    """Return whether start ≤ value < end; raise GeometryError if the limits are invalid."""
    low, high = checked(name, limits, (2,)).tolist()
    if not low <= high:
        raise GeometryError(
            f"{name}: expected (start, end) with end not less than start, found {limits}"
        )
    return np.asarray((values >= low) & (values < high))
