"""Calib files `calib/*.pkl`: poses and cameras of an agent in a frame (docs/format.md, Calib)."""

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias, overload

import numpy as np

from deepaccident_devkit.errors import CalibError
from deepaccident_devkit.geometry import SE3, conventions
from deepaccident_devkit.geometry.se3 import RIGID_TOLERANCE, rigid_fault
from deepaccident_devkit.release.pickles import load_arrays, load_stacked, pickled
from deepaccident_devkit.release.store import REMEDY, ReleasePath, read_content
from deepaccident_devkit.support.arrays import (
    LARGEST_NUMBER,
    AnyArray,
    BoolArray,
    FloatArray,
    ShortRepr,
    freeze_arrays,
    in_range,
    readonly,
)
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.taxonomy import CAMERAS

_EGO_KEYS = ("lidar_to_ego", "ego_to_world")
_CAMERA_KEYS = tuple(f"lidar_to_{camera}" for camera in CAMERAS)
_INTRINSIC_KEYS = tuple(f"intrinsic_{camera}" for camera in CAMERAS)
# Key → array of a calib file, with CARLA's signs and axes.
RawCalib: TypeAlias = dict[str, AnyArray]
# Every key of a calib file and the shape of its array.
KEYS: dict[str, tuple[int, int]] = {
    **dict.fromkeys((*_EGO_KEYS, *_CAMERA_KEYS), (4, 4)),
    **dict.fromkeys(_INTRINSIC_KEYS, (3, 3)),
}
_POSE_KEYS = (*_EGO_KEYS, *_CAMERA_KEYS)
_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibs(ShortRepr):
    """Calibration of F frames, right-handed, with optical camera frames; arrays are read-only.

    Attributes:
        ego_from_lidar: Poses of the LiDAR on the agent, shape (F, 4, 4), float64.
        world_from_ego: Poses of the agent, shape (F, 4, 4), float64.
        camera_from_lidar: Transforms to the cameras in the order of `taxonomy.CAMERAS`, shape (F,
            6, 4, 4), float64.
        intrinsic: Matrices K = [[f, 0, cx], [0, f, cy], [0, 0, 1]], shape (F, 6, 3, 3), float64,
            pixels.
    """

    ego_from_lidar: FloatArray
    world_from_ego: FloatArray
    camera_from_lidar: FloatArray
    intrinsic: FloatArray

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        freeze_arrays(self)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.world_from_ego)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calib(ShortRepr):
    """Calibration of one agent in one frame, right-handed.

    Attributes:
        ego_from_lidar: Pose of the LiDAR on the agent.
        world_from_ego: Pose of the agent.
        camera_from_lidar: Camera channel → transform from the LiDAR frame to the camera's optical
            frame.
        intrinsic: Camera channel → matrix K, shape (3, 3), pixels.
    """

    ego_from_lidar: SE3
    world_from_ego: SE3
    camera_from_lidar: Mapping[str, SE3]
    intrinsic: Mapping[str, FloatArray]


@overload
def read_calib(path: ReleasePath, *, raw: Literal[False] = False) -> Calib: ...
@overload
def read_calib(path: ReleasePath, *, raw: Literal[True]) -> RawCalib: ...
def read_calib(path: ReleasePath, *, raw: bool = False) -> Calib | RawCalib:
    """Read the calibration in one file.

    Args:
        path: The file.
        raw: Whether to return the file's dictionary unchanged: left-handed matrices, camera axes x
            depth, y right, z up.

    Raises:
        MissingFileError: If the file does not exist.
        CalibError: If the file is damaged, lacks a key, or contains an array of the wrong shape,
            NaN, a number beyond 1e9, a transform that is not rigid, or objects other than numpy
            arrays (nothing in the file is executed).
    """
    raw_arrays = read_unchecked_calib(path)
    calibs = _convert_arrays([path], _stack_files([raw_arrays]))
    if raw:
        return raw_arrays
    camera_from_lidar = {}
    intrinsic = {}
    for index, name in enumerate(CAMERAS):
        camera_from_lidar[name] = SE3(calibs.camera_from_lidar[0, index])
        intrinsic[name] = readonly(calibs.intrinsic[0, index])
    return Calib(
        ego_from_lidar=SE3(calibs.ego_from_lidar[0]),
        world_from_ego=SE3(calibs.world_from_ego[0]),
        camera_from_lidar=camera_from_lidar,
        intrinsic=intrinsic,
    )


def read_calibs(paths: Sequence[ReleasePath]) -> Calibs:
    """Read the calibrations of several files as stacked arrays, with the errors of `read_calib`."""
    contents = [read_content(path, "calib", CalibError) for path in paths]
    # Load the first file to check its keys and shapes; files with the same layout are stacked.
    files = [
        _load_file(path, content) for path, content in zip(paths[:1], contents[:1], strict=True)
    ]
    arrays = load_stacked(contents)
    if arrays is None:
        for path, content in zip(paths[1:], contents[1:], strict=True):
            files.append(_load_file(path, content))
        arrays = _stack_files(files)
    return _convert_arrays(paths, arrays)


def write_calib(path: Path, calib: Calib) -> None:
    """Write one calibration with CARLA's signs and axes; see `write_raw_calib`."""
    raw: RawCalib = {
        "lidar_to_ego": conventions.flip_pose(calib.ego_from_lidar.matrix),
        "ego_to_world": conventions.flip_pose(calib.world_from_ego.matrix),
    }
    for camera in CAMERAS:
        camera_from_lidar = calib.camera_from_lidar[camera].matrix
        raw[f"lidar_to_{camera}"] = conventions.camera_from_lidar_to_raw(camera_from_lidar)
        raw[f"intrinsic_{camera}"] = conventions.intrinsic_to_raw(calib.intrinsic[camera])
    write_raw_calib(path, raw)


def write_raw_calib(path: Path, raw: Mapping[str, AnyArray]) -> None:
    """Write a raw dictionary, as `read_calib(raw=True)` returns it.

    The arrays are not checked, so `read_calib` may refuse the file. Old numpy versions can read the
    file too.
    """
    write_bytes(path, encode_raw_calib(raw))


def encode_raw_calib(raw: Mapping[str, AnyArray]) -> bytes:
    """Return the content of a file that `write_raw_calib` writes."""
    # Adding 0.0 removes negative zeros.
    arrays = {key: np.ascontiguousarray(array) + 0.0 for key, array in raw.items()}
    return pickled(arrays)


def read_unchecked_calib(path: ReleasePath) -> RawCalib:
    """Read a raw dictionary like `read_calib(raw=True)`, without checking its numbers.

    The errors are as in `read_calib`, except that NaN, large numbers and transforms that are not
    rigid are accepted.
    """
    content = read_content(path, "calib", CalibError)
    return _load_file(path, content)


def _load_file(path: ReleasePath, content: bytes) -> RawCalib:
    """Load the arrays in a file's bytes; raise CalibError if they are damaged or incomplete."""
    try:
        value = load_arrays(content)
    except pickle.UnpicklingError as error:
        detail = str(error) if content else "the file is empty"
        raise CalibError(f"{path}: not a readable calibration ({detail}); {REMEDY}") from error
    if not isinstance(value, dict):
        raise CalibError(
            f"{path}: expected a dict of arrays, found {type(value).__name__}; {REMEDY}"
        )
    missing = [key for key in KEYS if key not in value]
    if missing:
        raise CalibError(f"{path}: lacks {', '.join(missing)}; {REMEDY}")
    for key, shape in KEYS.items():
        array = value[key]
        if not isinstance(array, np.ndarray):
            fault = type(array).__name__
        elif array.shape != shape or array.dtype.kind not in "fiu":
            fault = f"{array.shape} of {array.dtype}"
        else:
            continue
        raise CalibError(
            f"{path}: {key}: expected numbers of shape {shape}, found {fault}; {REMEDY}"
        )
    return value


def _stack_files(files: Sequence[Mapping[str, AnyArray]]) -> RawCalib:
    """Return the arrays of several files, stacked by key."""
    stacked = {}
    for key, shape in KEYS.items():
        stacked[key] = np.array([file[key] for file in files]).reshape(-1, *shape)
    return stacked


def _convert_arrays(paths: Sequence[ReleasePath], arrays: Mapping[str, AnyArray]) -> Calibs:
    """Check the numbers of N files, and convert them; raise CalibError if one is invalid."""
    poses = np.stack([arrays[key] for key in _POSE_KEYS], axis=1).astype(np.float64)
    intrinsics = np.stack([arrays[key] for key in _INTRINSIC_KEYS], axis=1).astype(np.float64)
    is_rigid = _find_surely_rigid(poses).all(axis=1)
    is_finite = in_range(intrinsics).all(axis=(1, 2, 3))
    for index in np.flatnonzero(~(is_rigid & is_finite)).tolist():
        fault = _find_first_value_fault(poses[index], intrinsics[index])
        if fault:
            raise CalibError(f"{paths[index]}: {fault}; {REMEDY}")
    ego = conventions.flip_pose(poses[:, :2])
    return Calibs(
        ego_from_lidar=ego[:, 0],
        world_from_ego=ego[:, 1],
        camera_from_lidar=conventions.camera_from_lidar(poses[:, 2:]),
        intrinsic=conventions.intrinsic(intrinsics),
    )


def _find_surely_rigid(poses: FloatArray) -> BoolArray:
    """Return which transforms (…, 4, 4) are certainly rigid; the caller checks the others."""
    rotations = poses[..., :3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        products = rotations @ np.swapaxes(rotations, -1, -2)
        deviations = np.abs(products - np.eye(3)).max(axis=(-1, -2))
        is_orthogonal = deviations < RIGID_TOLERANCE / 2
        is_proper = np.linalg.det(rotations) > 0
    is_finite = in_range(poses).all(axis=(-1, -2))
    has_last_row = (poses[..., 3, :] == _LAST_ROW).all(axis=-1)
    return np.asarray(is_orthogonal & is_proper & is_finite & has_last_row)


def _find_first_value_fault(poses: FloatArray, intrinsics: FloatArray) -> str | None:
    """Return the first fault in a file's numbers, or None."""
    for key, pose in zip(_POSE_KEYS, poses, strict=True):
        fault = rigid_fault(pose)
        if fault:
            return f"{key}: {fault}"
    keys = (*_POSE_KEYS, *_INTRINSIC_KEYS)
    for key, matrix in zip(keys, (*poses, *intrinsics), strict=True):
        if not in_range(matrix).all():
            return f"{key}: contains NaN or infinity, or a number beyond {LARGEST_NUMBER:.0e}"
    return None
