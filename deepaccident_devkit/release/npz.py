"""Arrays in npz files: point clouds, and images of BEV cameras."""

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepaccident_devkit.errors import MAX_REASON_LENGTH, SensorFileError, shortened
from deepaccident_devkit.geometry import LidarPointCloud
from deepaccident_devkit.geometry.conventions import flip_points
from deepaccident_devkit.release.store import REMEDY, ReleasePath, read_content
from deepaccident_devkit.support.arrays import (
    AnyArray,
    ByteArray,
    ShortRepr,
    checked,
    freeze_arrays,
    in_range,
)
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.reading import (
    DAMAGED_ARCHIVE,
    FileKind,
    array_of,
    open_zip,
    read_member,
    reason_text,
)
from deepaccident_devkit.taxonomy import BEV_RESOLUTION, BEV_SHAPE

KEY = "data"
_NPY_SUFFIX = ".npy"
# First bytes of a `.npy` file.
_NPY_SIGNATURE = b"\x93NUMPY"
_COMPRESSION_LEVEL = 1
"""Level of zlib's compression.

Compressing a BEV array of 4.3 MB takes 10 ms; zlib's default level takes 20 to 30 ms, for a quarter
of the size. Half of a cloud's bytes are zeros, because its numbers have single precision; a higher
level saves little.
"""
# CARLA's semantic tags that the reference renderer uses.
TAGS: dict[str, int] = {"pedestrian": 4, "road_line": 6, "road": 7, "sidewalk": 8, "vehicle": 10}


def read_npz(path: ReleasePath, kind: FileKind) -> AnyArray:
    """Read the numeric array named `data`, or the only array in the file.

    MissingFileError is raised if the file does not exist, SensorFileError if it cannot be read.
    """
    content = read_content(path, kind, SensorFileError)
    try:
        with open_zip(content) as archive:
            member = _find_array_member(path, archive)
            return array_of(read_member(archive, member, kind), kind)
    except SensorFileError:
        raise
    except DAMAGED_ARCHIVE as error:
        if content.startswith(_NPY_SIGNATURE):
            fault = "expected an npz archive, found a bare array"
        else:
            fault = (
                f"not a readable npz archive ({shortened(reason_text(error), MAX_REASON_LENGTH)})"
            )
        raise SensorFileError(f"{path}: {fault}; {REMEDY}") from error


def write_npz(path: Path, array: AnyArray, *, level: int = _COMPRESSION_LEVEL) -> None:
    """Write an array named `data`; equal arrays always produce equal bytes.

    Args:
        path: The file.
        array: The array.
        level: zlib's compression level, 0 to 9.
    """
    member = io.BytesIO()
    np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)
    archive = io.BytesIO()
    entry = zipfile.ZipInfo(f"{KEY}{_NPY_SUFFIX}")
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=level) as file:
        file.writestr(entry, member.getvalue(), zipfile.ZIP_DEFLATED, level)
    write_bytes(path, archive.getvalue())


def _find_array_member(path: ReleasePath, archive: zipfile.ZipFile) -> zipfile.ZipInfo:
    """Return the entry of `data`, or of the only array; raise SensorFileError without one."""
    entries = [entry for entry in archive.infolist() if entry.filename.endswith(_NPY_SUFFIX)]
    candidates = [entry for entry in entries if entry.filename == f"{KEY}{_NPY_SUFFIX}"] or entries
    if len(candidates) != 1:
        array_names = [entry.filename.removesuffix(_NPY_SUFFIX) for entry in entries]
        names = ", ".join(array_names) or "no array"
        raise SensorFileError(
            f"{path}: expected an array named '{KEY}', found {shortened(names)}; {REMEDY}"
        )
    return candidates[0]


@overload
def read_lidar(path: ReleasePath, *, raw: Literal[False] = False) -> LidarPointCloud: ...
@overload
def read_lidar(path: ReleasePath, *, raw: Literal[True]) -> AnyArray: ...
def read_lidar(path: ReleasePath, *, raw: bool = False) -> LidarPointCloud | AnyArray:
    """Read a point cloud in its LiDAR frame, right-handed, metres.

    Infinite numbers and numbers beyond 1e9 become NaN.

    Args:
        path: The file.
        raw: Whether to return the file's array unchanged, (N, 4): x, y **right**, z, intensity, in
            the file's float type.

    Raises:
        MissingFileError: If the file does not exist.
        SensorFileError: If the archive cannot be read, or if its array is not (N, 4) of floats.
    """
    data = read_npz(path, "lidar")
    if data.ndim != 2 or data.shape[1] != 4 or data.dtype.kind != "f":
        raise SensorFileError(
            f"{path}: expected points (N, 4) of floats, "
            f"found shape {data.shape} of {data.dtype}; {REMEDY}"
        )
    if raw:
        return data
    data = np.where(in_range(data), data, np.nan)
    points = flip_points(data[:, :3])
    intensity = data[:, 3].astype(np.float32)
    return LidarPointCloud(points, intensity, "lidar")


def write_lidar(path: Path, xyz: ArrayLike, intensity: ArrayLike) -> None:
    """Write points (N, 3) in the right-handed LiDAR frame, metres, and intensities (N,).

    As in the release, numbers are rounded to single precision and stored as float64.
    """
    points = flip_points(checked("xyz", xyz, (None, 3)))
    intensities = checked("intensity", intensity, (len(points),))
    data = np.column_stack([points, intensities]).astype(np.float32)
    write_npz(path, data.astype(np.float64))


@dataclass(frozen=True, slots=True, eq=False)
class BevImage(ShortRepr):
    """Image of the BEV camera above an agent, as stored: forward is up, and left is left.

    A point (x forward, y left of the agent, metres) is at row 599.5 − x / resolution and at column
    599.5 − y / resolution.

    Attributes:
        semantic: CARLA's semantic tags (`TAGS`), shape (1200, 1200), uint8, read-only.
        instance: The simulator's own object ids (not the labels' actor ids), shape (1200, 1200),
            uint16, read-only.
        resolution: Size of a pixel, metres.
    """

    semantic: ByteArray
    instance: NDArray[np.uint16]
    resolution: float = BEV_RESOLUTION

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        freeze_arrays(self)


@overload
def read_bev(path: ReleasePath, *, raw: Literal[False] = False) -> BevImage: ...
@overload
def read_bev(path: ReleasePath, *, raw: Literal[True]) -> ByteArray: ...
def read_bev(path: ReleasePath, *, raw: bool = False) -> BevImage | ByteArray:
    """Read the image of a BEV camera.

    Args:
        path: The file.
        raw: Whether to return the file's array unchanged, shape (1200, 1200, 3), uint8; channel 2
            is the tag, channels 1 and 0 are the low and the high byte of the id.

    Raises:
        MissingFileError: If the file does not exist.
        SensorFileError: If the archive cannot be read, or if its array has another shape or type.
    """
    data = read_npz(path, "bev")
    if data.shape != (*BEV_SHAPE, 3) or data.dtype != np.uint8:
        raise SensorFileError(
            f"{path}: expected shape {(*BEV_SHAPE, 3)} of uint8, "
            f"found {data.shape} of {data.dtype}; {REMEDY}"
        )
    if raw:
        return data
    high_byte = data[..., 0].astype(np.uint16)
    low_byte = data[..., 1]
    return BevImage(semantic=data[..., 2].copy(), instance=low_byte + high_byte * 256)


def write_bev(
    path: Path,
    semantic: ByteArray,
    instance: NDArray[np.uint16],
    *,
    level: int = _COMPRESSION_LEVEL,
) -> None:
    """Write tags and object ids, both (1200, 1200), forward up; `level` is as in `write_npz`."""
    import cv2

    high_byte = (instance >> 8).astype(np.uint8)
    low_byte = instance.astype(np.uint8)
    channels = cv2.merge([high_byte, low_byte, np.ascontiguousarray(semantic)])
    write_npz(path, np.asarray(channels), level=level)
