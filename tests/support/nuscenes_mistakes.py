"""Typical mistakes of hand-made sources, planted into tables in nuScenes' format."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from pyquaternion import Quaternion

VERSION = "v1.0-deepaccident"
Rows = list[dict[str, Any]]


@contextmanager
def read_rows(folder: Path, table: str) -> Iterator[Rows]:
    """Open a table's rows; changes are written back at the end."""
    path = folder / VERSION / f"{table}.json"
    rows = json.loads(path.read_text())
    yield rows
    path.write_text(json.dumps(rows))


def copy_dataroot(folder: Path, out: Path) -> Path:
    (out / VERSION).mkdir(parents=True)
    for table in (folder / VERSION).glob("*.json"):
        shutil.copy(table, out / VERSION)
    for name in ("samples", "maps"):
        (out / name).symlink_to(folder / name)
    return out


def pose_matrix(row: dict[str, Any]) -> np.ndarray:
    matrix = Quaternion(row["rotation"]).transformation_matrix
    matrix[:3, 3] = row["translation"]
    return matrix


def set_pose(row: dict[str, Any], matrix: np.ndarray) -> None:
    row["translation"] = matrix[:3, 3].tolist()
    row["rotation"] = Quaternion(matrix=matrix, rtol=1e-4, atol=1e-4).elements.tolist()


def _lidars(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return `ego_from_lidar` by ego pose, and the ego pose of each sample's keyframe."""
    with (
        read_rows(folder, "sample_data") as files,
        read_rows(folder, "calibrated_sensor") as sensors,
    ):
        mounts = {row["token"]: pose_matrix(row) for row in sensors}
        clouds = [row for row in files if "/LIDAR_TOP/" in row["filename"] and row["is_key_frame"]]
    ego_from_lidar = {
        row["ego_pose_token"]: mounts[row["calibrated_sensor_token"]] for row in clouds
    }
    pose_tokens = {row["sample_token"]: row["ego_pose_token"] for row in clouds}
    return ego_from_lidar, pose_tokens


def mirror_y(folder: Path) -> None:
    """Change the sign of the boxes' y in the ego frame."""
    _, pose_tokens = _lidars(folder)
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    with read_rows(folder, "ego_pose") as poses, read_rows(folder, "sample_annotation") as boxes:
        world_from_ego = {row["token"]: pose_matrix(row) for row in poses}
        for box in boxes:
            pose = world_from_ego[pose_tokens[box["sample_token"]]]
            set_pose(box, pose @ flip @ np.linalg.inv(pose) @ pose_matrix(box) @ flip)


def lidar_for_ego(folder: Path) -> None:
    """Store the LiDAR's frame as if it was the ego's."""
    ego_from_lidar, _ = _lidars(folder)
    default = next(iter(ego_from_lidar.values()))
    with read_rows(folder, "sample_data") as files:
        shifts = {
            row["calibrated_sensor_token"]: ego_from_lidar.get(row["ego_pose_token"], default)
            for row in files
        }
    with read_rows(folder, "ego_pose") as poses:
        for row in poses:
            set_pose(row, pose_matrix(row) @ ego_from_lidar.get(row["token"], default))
    with read_rows(folder, "calibrated_sensor") as sensors:
        for row in sensors:
            shift = shifts.get(row["token"], default)
            set_pose(row, np.linalg.inv(shift) @ pose_matrix(row))


def reorder_images(folder: Path) -> None:
    """Exchange the images of five cameras in a cycle."""
    channels = ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK", "CAM_BACK_LEFT")
    next_channel = dict(zip(channels, (*channels[1:], channels[0]), strict=True))
    with read_rows(folder, "sample_data") as files:
        for row in files:
            channel = row["filename"].split("/")[1]
            row["filename"] = row["filename"].replace(channel, next_channel.get(channel, channel))


def exchange_channels(folder: Path) -> None:
    """Exchange the names of two cameras, which keep their images and directions."""
    names = {"CAM_FRONT_LEFT": "CAM_FRONT_RIGHT", "CAM_FRONT_RIGHT": "CAM_FRONT_LEFT"}
    with read_rows(folder, "sensor") as sensors:
        for row in sensors:
            row["channel"] = names.get(row["channel"], row["channel"])


def sink_poses(folder: Path) -> None:
    """Sink everything by 1.9 m in the ego frame."""
    with read_rows(folder, "ego_pose") as poses:
        for row in poses:
            row["translation"][2] += 1.9
    with read_rows(folder, "calibrated_sensor") as sensors:
        for row in sensors:
            row["translation"][2] -= 1.9


def sink_boxes(folder: Path) -> None:
    with read_rows(folder, "sample_annotation") as boxes:
        for row in boxes:
            row["translation"][2] -= 1.9


MISTAKES: dict[str, tuple[Callable[[Path], None], str]] = {
    "mirrored": (mirror_y, r"y is mirrored"),
    "LiDAR for ego": (lidar_for_ego, r"the LiDAR frame is used as the ego frame"),
    "images in another order": (
        reorder_images,
        r"cameras are in another order: .*Camera_FrontLeft shows",
    ),
    "names in another order": (
        exchange_channels,
        r"cameras are in another order: .*Camera_FrontLeft looks where",
    ),
    "sunk": (sink_poses, r"everything lies 1\.[89] m too low: the road lies at -1\.[89] m"),
    "boxes sunk": (
        sink_boxes,
        r"the boxes lie 1\.9 m too low: the road lies at 0\.0 m, boxes stand at -1\.9 m",
    ),
}
"""Function that plants a mistake, and pattern of the error, by name of the mistake."""
