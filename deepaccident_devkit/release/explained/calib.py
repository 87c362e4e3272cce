"""A calib file in words (docs/format.md, calib)."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray
from deepaccident_devkit.errors import CalibError
from deepaccident_devkit.geometry import handedness
from deepaccident_devkit.geometry.se3 import rigid_fault
from deepaccident_devkit.reading import shortened
from deepaccident_devkit.release.calib import KEYS, read_calib, read_unchecked_calib
from deepaccident_devkit.taxonomy import CAMERAS
from deepaccident_devkit.text import columns_text, fixed_text

_LEGEND = """\
maps     target_from_source: p_target = matrix @ p_source, with column vectors (x, y, z, 1)
tx ty tz m, where the source's origin lies in the target frame
angles   deg, of R = Rz(yaw) · Ry(pitch) · Rx(roll), in the file's left-handed axes (positive yaw turns to the right)
off      how far R · Rᵀ is from the identity; about 1e-07 is usual, since the release computes in single precision
Frames   world: the town's, z up. ego: the agent's reference point on the road. lidar: the agent's LiDAR; both have
         x forward, y right, z up. A camera of the file has x depth, y right, z up. All are in m."""
_CAMERA_LEGEND = """\
x y z    m, where the camera stands in the LiDAR frame (left-handed)
looks    deg, its direction in the LiDAR frame: 0 forward, positive to the right
f        px, focal length; fov: deg, horizontal field of view 2·atan(cx / f); cx cy: px, principal point
image    px, width × height, if the principal point is the middle: 2·cx × 2·cy
Pixel of a point in the file's camera frame, in m: u = cx + f·y/x, v = cy − f·z/x"""
_AFTERWORD = """\
In Python: release.read_calib(path) gives right-handed transforms and optical cameras (x right, y down, z forward),
with raw=True the matrices of the file."""
_MOST_UNKNOWN = 300
"""Characters of keys that the devkit does not know."""


def calib_text(path: Path) -> tuple[str, CalibError | None]:
    """What a calib file says, and what is wrong with its numbers, if something is.

    Raises as `read_calib` does for what has not even the right keys and shapes.
    """
    raw = read_unchecked_calib(path)
    try:
        read_calib(path)
        fault = None
    except CalibError as error:
        fault = error
    kinds = ", ".join(sorted({str(raw[key].dtype) for key in KEYS}))
    unknown = sorted(str(key) for key in raw if key not in KEYS)
    parts = [
        f"A calib file: where one agent and its sensors were at one frame. {len(KEYS)} matrices of {kinds}.",
        "Transforms, shape (4, 4)\n" + columns_text(_transform_rows(raw), left=2) + "\n" + _LEGEND,
        "\n".join([*_transform_notes(raw), _devkit_text(raw)]),
        "Cameras: intrinsic_<camera>, shape (3, 3), [[cx, f, 0], [cy, 0, −f], [1, 0, 0]], and lidar_to_<camera>\n"
        + "\n".join([columns_text(_camera_rows(raw)), _CAMERA_LEGEND, *_intrinsic_notes(raw)]),
        *([f"Not known to the devkit: {shortened(', '.join(unknown), _MOST_UNKNOWN)}"] if unknown else []),
        _AFTERWORD,
    ]
    return "\n\n".join(parts), fault


def _transform_rows(raw: Mapping[str, AnyArray]) -> list[list[str]]:
    rows = [["key", "maps", "tx", "ty", "tz", "roll", "pitch", "yaw", "off"], ["", "", *"mmm", *["deg"] * 3, ""]]
    for key, shape in KEYS.items():
        if shape == (4, 4):
            source, target = key.split("_to_")
            matrix = raw[key].astype(np.float64)
            numbers = [*(fixed_text(value, 3) for value in matrix[:3, 3])]
            numbers += [_angle_text(value, 2) for value in _angles(matrix[:3, :3])]
            rows.append([key, f"{target}_from_{source}", *numbers, _off_text(matrix)])
    return rows


def _angles(rotation: FloatArray) -> tuple[float, float, float]:
    """Roll, pitch and yaw in degrees."""
    roll = math.atan2(rotation[2, 1], rotation[2, 2])
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)


def _angle_text(degrees: float, digits: int) -> str:
    """In (−180, 180]: rounding alone decides which sign a half turn has in the file."""
    text = fixed_text(degrees, digits)
    return text.removeprefix("-") if round(degrees, digits) == -180 else text


def _off_text(matrix: FloatArray) -> str:
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    return f"{off:.0e}" if off else "0"


def _transform_notes(raw: Mapping[str, AnyArray]) -> list[str]:
    faults = {key: rigid_fault(raw[key].astype(np.float64)) for key, shape in KEYS.items() if shape == (4, 4)}
    wrong = [f"Not rigid: {key}: {fault}" for key, fault in faults.items() if fault]
    return wrong or ["All of them are rigid, except for rounding."]


def _devkit_text(raw: Mapping[str, AnyArray]) -> str:
    pose = handedness.flip_pose(raw["ego_to_world"])
    x, y, z = (fixed_text(value, 3) for value in pose[:3, 3])
    yaw = _angle_text(_angles(pose[:3, :3])[2], 2)
    return (
        f"What the devkit makes of ego_to_world: world_from_ego with the agent at ({x}, {y}, {z}) m, heading {yaw}°\n"
        "(right-handed: y and yaw have changed their signs; so it does with all of them)"
    )


def _camera_rows(raw: Mapping[str, AnyArray]) -> list[list[str]]:
    rows = [
        ["camera", "x", "y", "z", "looks", "f", "fov", "cx", "cy", "image"],
        ["", "m", "m", "m", "deg", "px", "deg", "px", "px", "px"],
    ]
    for camera in CAMERAS:
        matrix, intrinsic = raw[f"lidar_to_{camera}"].astype(np.float64), raw[f"intrinsic_{camera}"]
        rotation = matrix[:3, :3]
        place = -rotation.T @ matrix[:3, 3]
        looks = math.degrees(math.atan2(rotation[0, 1], rotation[0, 0]))
        (cx, focal), cy = intrinsic[0, :2].tolist(), float(intrinsic[1, 0])
        fov = math.degrees(2 * math.atan2(cx, focal))
        numbers = [fixed_text(value, 3) for value in place]
        numbers += [_angle_text(looks, 1), fixed_text(focal, 2), fixed_text(fov, 1)]
        size = f"{fixed_text(2 * cx, 0)} × {fixed_text(2 * cy, 0)}"
        rows.append([camera, *numbers, fixed_text(cx, 1), fixed_text(cy, 1), size])
    return rows


def _intrinsic_notes(raw: Mapping[str, AnyArray]) -> list[str]:
    notes = []
    for camera in CAMERAS:
        intrinsic = raw[f"intrinsic_{camera}"]
        cx, cy, focal = intrinsic[0, 0], intrinsic[1, 0], intrinsic[0, 1]
        expected = np.array([[cx, focal, 0], [cy, 0, -focal], [1, 0, 0]], dtype=np.float64)
        if not np.allclose(intrinsic, expected, rtol=1e-6):
            notes.append(f"Not of this form: intrinsic_{camera}: {intrinsic.tolist()}")
    return notes
