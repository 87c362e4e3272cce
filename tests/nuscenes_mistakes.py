"""Mistakes that sources made by hand have, planted into tables of nuScenes' format."""

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
def rows_of(folder: Path, table: str) -> Iterator[Rows]:
    """A table's rows, which are written back."""
    path = folder / VERSION / f"{table}.json"
    rows = json.loads(path.read_text())
    yield rows
    path.write_text(json.dumps(rows))


def copied(folder: Path, out: Path) -> Path:
    """The same tables, and links to the files."""
    (out / VERSION).mkdir(parents=True)
    for table in (folder / VERSION).glob("*.json"):
        shutil.copy(table, out / VERSION)
    for name in ("samples", "maps"):
        (out / name).symlink_to(folder / name)
    return out


def matrix_of(row: dict[str, Any]) -> np.ndarray:
    matrix = Quaternion(row["rotation"]).transformation_matrix
    matrix[:3, 3] = row["translation"]
    return matrix


def put(row: dict[str, Any], matrix: np.ndarray) -> None:
    row["translation"] = matrix[:3, 3].tolist()
    row["rotation"] = Quaternion(matrix=matrix, rtol=1e-4, atol=1e-4).elements.tolist()


def _lidars(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Ego pose → `ego_from_lidar`; sample → its ego pose."""
    with rows_of(folder, "sample_data") as files, rows_of(folder, "calibrated_sensor") as sensors:
        mounted = {row["token"]: matrix_of(row) for row in sensors}
        clouds = [row for row in files if "/LIDAR_TOP/" in row["filename"] and row["is_key_frame"]]
    return (
        {row["ego_pose_token"]: mounted[row["calibrated_sensor_token"]] for row in clouds},
        {row["sample_token"]: row["ego_pose_token"] for row in clouds},
    )


def mirror_y(folder: Path) -> None:
    """Boxes' y changes its sign in the ego frame."""
    _, pose_of = _lidars(folder)
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    with rows_of(folder, "ego_pose") as poses, rows_of(folder, "sample_annotation") as boxes:
        world_from = {row["token"]: matrix_of(row) for row in poses}
        for box in boxes:
            pose = world_from[pose_of[box["sample_token"]]]
            put(box, pose @ flip @ np.linalg.inv(pose) @ matrix_of(box) @ flip)


def lidar_for_ego(folder: Path) -> None:
    """The LiDAR's frame is called the ego's."""
    lidar_of, _ = _lidars(folder)
    some = next(iter(lidar_of.values()))
    with rows_of(folder, "sample_data") as files:
        moved = {
            row["calibrated_sensor_token"]: lidar_of.get(row["ego_pose_token"], some)
            for row in files
        }
    with rows_of(folder, "ego_pose") as poses:
        for row in poses:
            put(row, matrix_of(row) @ lidar_of.get(row["token"], some))
    with rows_of(folder, "calibrated_sensor") as sensors:
        for row in sensors:
            put(row, np.linalg.inv(moved.get(row["token"], some)) @ matrix_of(row))


def other_order(folder: Path) -> None:
    """Images of five cameras change places."""
    order = ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK", "CAM_BACK_LEFT")
    places = dict(zip(order, (*order[1:], order[0]), strict=True))
    with rows_of(folder, "sample_data") as files:
        for row in files:
            name = row["filename"].split("/")[1]
            row["filename"] = row["filename"].replace(name, places.get(name, name))


def other_names(folder: Path) -> None:
    """The cameras' names change places, with their images and where they look."""
    names = {"CAM_FRONT_LEFT": "CAM_FRONT_RIGHT", "CAM_FRONT_RIGHT": "CAM_FRONT_LEFT"}
    with rows_of(folder, "sensor") as sensors:
        for row in sensors:
            row["channel"] = names.get(row["channel"], row["channel"])


def sunk(folder: Path) -> None:
    """All lies 1.9 m deeper in the ego frame."""
    with rows_of(folder, "ego_pose") as poses:
        for row in poses:
            row["translation"][2] += 1.9
    with rows_of(folder, "calibrated_sensor") as sensors:
        for row in sensors:
            row["translation"][2] -= 1.9


def boxes_sunk(folder: Path) -> None:
    """Boxes lie 1.9 m too deep."""
    with rows_of(folder, "sample_annotation") as boxes:
        for row in boxes:
            row["translation"][2] -= 1.9


MISTAKES: dict[str, tuple[Callable[[Path], None], str]] = {
    "mirrored": (mirror_y, r"y is mirrored"),
    "LiDAR for ego": (lidar_for_ego, r"the LiDAR's frame stands for the ego's"),
    "images in another order": (
        other_order,
        r"cameras are in another order: .*Camera_FrontLeft shows",
    ),
    "names in another order": (
        other_names,
        r"cameras are in another order: .*Camera_FrontLeft looks where",
    ),
    "sunk": (sunk, r"sunk by 1\.[89] m"),
    "boxes sunk": (boxes_sunk, r"sunk by 1\.9 m"),
}
"""Name → what plants it, and the words of the error."""
