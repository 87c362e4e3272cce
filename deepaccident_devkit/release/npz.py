"""Arrays in npz files: point clouds, and the pictures of BEV cameras."""

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepaccident_devkit.errors import MOST_TOLD, SensorFileError, shortened
from deepaccident_devkit.geometry import LidarPointCloud
from deepaccident_devkit.geometry.conventions import flip_points
from deepaccident_devkit.release.store import REMEDY, ReleasePath, read_content
from deepaccident_devkit.support.arrays import (
    AnyArray,
    ByteArray,
    ShortRepr,
    checked,
    in_range,
    readonly,
)
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.reading import (
    DAMAGED_ARCHIVE,
    FileKind,
    array_of,
    fault_text,
    open_zip,
    read_member,
)
from deepaccident_devkit.taxonomy import BEV_RESOLUTION, BEV_SHAPE

KEY = "data"
_ENDING = ".npy"
# How a `.npy` file begins.
_BARE_ARRAY = b"\x93NUMPY"
_FAST = 1
"""Level of compression: a BEV array of 4.3 MB takes 10 ms; zlib's default level takes 20 to 30, for a quarter of it.

Of a cloud's numbers, of single precision, half of each is zeros; a higher level saves little more.
"""
# The CARLA semantic tags that the reference renderer uses.
TAGS: dict[str, int] = {"pedestrian": 4, "road_line": 6, "road": 7, "sidewalk": 8, "vehicle": 10}


def read_npz(path: ReleasePath, kind: FileKind) -> AnyArray:
    """The array of numbers under `data`, or the only one in the file; raises MissingFileError and SensorFileError."""
    content = read_content(path, kind, SensorFileError)
    try:
        with open_zip(content) as archive:
            return array_of(read_member(archive, _array_member(path, archive), kind), kind)
    except DAMAGED_ARCHIVE as error:
        if isinstance(error, SensorFileError):
            raise
        detail = (
            "expected an npz archive, found a bare array" if content.startswith(_BARE_ARRAY) else ""
        )
        detail = detail or f"not a readable npz archive ({shortened(fault_text(error), MOST_TOLD)})"
        raise SensorFileError(f"{path}: {detail}; {REMEDY}") from error


def write_npz(path: Path, array: AnyArray, *, level: int = _FAST) -> None:
    """Write `array` under `data`, compressed by zlib's `level`, 0 to 9; the same array gives the same bytes."""
    member = io.BytesIO()
    np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=level) as file:
        file.writestr(
            zipfile.ZipInfo(f"{KEY}{_ENDING}"), member.getvalue(), zipfile.ZIP_DEFLATED, level
        )
    write_bytes(path, archive.getvalue())


def _array_member(path: ReleasePath, archive: zipfile.ZipFile) -> zipfile.ZipInfo:
    entries = [entry for entry in archive.infolist() if entry.filename.endswith(_ENDING)]
    named = [entry for entry in entries if entry.filename == f"{KEY}{_ENDING}"] or entries
    if len(named) != 1:
        found = ", ".join(entry.filename.removesuffix(_ENDING) for entry in entries) or "no array"
        raise SensorFileError(
            f"{path}: expected an array named '{KEY}', found {shortened(found)}; {REMEDY}"
        )
    return named[0]


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
    write_npz(path, np.column_stack([points, values]).astype(np.float32).astype(np.float64))


@dataclass(frozen=True, slots=True, eq=False)
class BevImage(ShortRepr):
    """What lies around an agent, seen from above; as stored, forward is up and left is left.

    A point x forward, y left of the agent, metres, is at row 599.5 − x / resolution, column 599.5 − y / resolution.

    Attributes:
        semantic: (1200, 1200) uint8, CARLA's semantic tag (`TAGS`), read-only.
        instance: (1200, 1200) uint16, the simulator's own object id (not the label's actor id), read-only.
        resolution: metres a pixel.
    """

    semantic: ByteArray
    instance: NDArray[np.uint16]
    resolution: float = BEV_RESOLUTION

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        object.__setattr__(self, "semantic", readonly(self.semantic))
        object.__setattr__(self, "instance", readonly(self.instance))


@overload
def read_bev(path: ReleasePath, *, raw: Literal[False] = False) -> BevImage: ...
@overload
def read_bev(path: ReleasePath, *, raw: Literal[True]) -> ByteArray: ...
def read_bev(path: ReleasePath, *, raw: bool = False) -> BevImage | ByteArray:
    """The BEV camera's array.

    Args:
        path: the file.
        raw: return the file's own array (1200, 1200, 3) uint8 instead; channel 2 is the tag, 1 and 0 the id's low
            and high byte.

    Raises:
        MissingFileError: there is no such file.
        SensorFileError: the archive cannot be read or its array has another shape or type.
    """
    data = read_npz(path, "bev")
    if data.shape != (*BEV_SHAPE, 3) or data.dtype != np.uint8:
        raise SensorFileError(
            f"{path}: expected shape {(*BEV_SHAPE, 3)} of uint8, found {data.shape} of {data.dtype}; {REMEDY}"
        )
    if raw:
        return data
    instance = data[..., 1] + data[..., 0].astype(np.uint16) * 256
    return BevImage(data[..., 2].copy(), instance)


def write_bev(
    path: Path, semantic: ByteArray, instance: NDArray[np.uint16], *, level: int = _FAST
) -> None:
    """Write tags and object ids, both (1200, 1200), forward up; `level` is that of `write_npz`."""
    import cv2

    high, low = (instance >> 8).astype(np.uint8), instance.astype(np.uint8)
    write_npz(path, np.asarray(cv2.merge([high, low, np.ascontiguousarray(semantic)])), level=level)
