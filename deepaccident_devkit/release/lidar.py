"""`lidar01/*.npz`: one point cloud a file (docs/format.md, LiDAR)."""

from pathlib import Path
from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import AnyArray, checked
from deepaccident_devkit.errors import SensorFileError
from deepaccident_devkit.geometry import LidarPointCloud
from deepaccident_devkit.geometry.handedness import flip_points
from deepaccident_devkit.release._content import REMEDY, in_range
from deepaccident_devkit.release.npz import read_npz, write_npz
from deepaccident_devkit.release.store import ReleasePath

_LEVEL = 1
"""Of compression: the numbers have single precision, so half of each is zeros; a higher level saves little more."""


@overload
def read_lidar(path: ReleasePath, *, raw: Literal[False] = False) -> LidarPointCloud: ...
@overload
def read_lidar(path: ReleasePath, *, raw: Literal[True]) -> AnyArray: ...
def read_lidar(path: ReleasePath, *, raw: bool = False) -> LidarPointCloud | AnyArray:
    """A point cloud in its LiDAR frame, right-handed, metres; NaN where the file has infinity or a number beyond 1e9.

    Args:
        path: the file.
        raw: return the file's own array (N, 4) instead: x, y **right**, z, intensity, in the file's float type.

    Raises:
        MissingFileError: there is no such file.
        SensorFileError: the archive cannot be read or its array is not (N, 4) of floats.
    """
    data = read_npz(path, "lidar")
    if data.ndim != 2 or data.shape[1] != 4 or data.dtype.kind != "f":
        raise SensorFileError(
            f"{path}: expected points (N, 4) of floats, found shape {data.shape} of {data.dtype}; {REMEDY}"
        )
    if raw:
        return data
    data = np.where(in_range(data), data, np.nan)
    return LidarPointCloud(flip_points(data[:, :3]), data[:, 3].astype(np.float32), "lidar")


def write_lidar(path: Path, xyz: ArrayLike, intensity: ArrayLike) -> None:
    """Write points (N, 3) of the right-handed LiDAR frame, metres, and their intensity (N,).

    As in the release: numbers of single precision, stored as float64.
    """
    points = flip_points(checked("xyz", xyz, (None, 3)))
    values = checked("intensity", intensity, (len(points),))
    write_npz(path, np.column_stack([points, values]).astype(np.float32).astype(np.float64), level=_LEVEL)
