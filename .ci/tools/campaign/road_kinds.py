"""Kinds of files of a dataroot in nuScenes' format: its tables, and the list of its splits."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from campaign import plain, road_mutations
from campaign.kind import Action, Kind, Output, Workspace
from deepaccident_devkit.plugins.nuscenes import open_nuscenes

assert road_mutations  # importing it registers the mutations for these kinds

_KEYFRAMES = {f"{number:03d}" for number in range(1, 100, 5)}
_TABLES = (
    "sample",
    "sample_data",
    "sample_annotation",
    "ego_pose",
    "calibrated_sensor",
    "sensor",
)
_SECONDS_PER_MICROSECOND = 1e-6
_LENGTH_TOLERANCE_M = 1e-3
_TIME_TOLERANCE_S = 1e-5


def _read_dataroot(workspace: Workspace) -> Output:
    """Return each keyframe's boxes, ego position and time, and each scene's split."""
    dataset = open_nuscenes(workspace.folder, workspace.scratch / "index")
    keyframes = {}
    for record in dataset.sample:
        token = record["token"]
        if token.rpartition("/")[2] in _KEYFRAMES:
            boxes = dataset.with_ignored.boxes(token)
            position = dataset.world_from(token, "ego").translation
            values = (boxes.center, boxes.size, position, record["timestamp"])
            keyframes[dataset.nuscenes_token(token)] = values
    splits = {record["name"]: record["split"] for record in dataset.scenario}
    return {"keyframes": keyframes, "splits": splits}


def _judge_tables(workspace: Workspace, output: Output) -> str | None:
    """Compare keyframes with the tables, in which rows that no keyframe uses may be anything."""
    tables = {name: _read_table(workspace.folder, name) for name in _TABLES}
    rows_by_token = {}
    for name, rows in tables.items():
        rows_by_token[name] = {row["token"]: row for row in rows}
    starts: dict[str, float] = {}
    for token, keyframe in output["keyframes"].items():
        sample = rows_by_token["sample"][token]
        start = starts.setdefault(sample["scene_token"], sample["timestamp"])
        time_s = (sample["timestamp"] - start) * _SECONDS_PER_MICROSECOND
        annotations = [row for row in tables["sample_annotation"] if row["sample_token"] == token]
        sensor_rows = [row for row in tables["sample_data"] if row["sample_token"] == token]
        pose = _find_lidar_pose(sensor_rows, rows_by_token)
        fault = _find_keyframe_fault(keyframe, annotations, pose, time_s)
        if fault:
            return f"{token}: {fault}"
    return None


def _find_keyframe_fault(
    keyframe: tuple[Any, ...], annotations: list[Any], pose: Any, expected_time_s: float
) -> str | None:
    centers, sizes, position, time_s = keyframe
    expected_centers = np.reshape([row["translation"] for row in annotations], (-1, 3))
    if not np.allclose(centers, expected_centers, atol=_LENGTH_TOLERANCE_M):
        return "other boxes"
    expected_sizes = [np.take(row["size"], plain.NUSCENES_SIZE_ORDER) for row in annotations]
    if not np.allclose(sizes, np.reshape(expected_sizes, (-1, 3))):
        return "other sizes"
    if not np.allclose(position, pose["translation"], atol=_LENGTH_TOLERANCE_M):
        return "another pose"
    is_same_time = np.isclose(time_s, expected_time_s, atol=_TIME_TOLERANCE_S)
    if is_same_time:
        return None
    return "another time"


def _find_lidar_pose(sensor_rows: list[Any], rows_by_token: Mapping[str, Output]) -> Any:
    """Return the row of the ego pose at the time of a keyframe's LiDAR."""
    mounts = rows_by_token["calibrated_sensor"]
    sensors = rows_by_token["sensor"]
    poses_by_channel = {}
    for row in sensor_rows:
        if row["is_key_frame"]:
            mount = mounts[row["calibrated_sensor_token"]]
            channel = sensors[mount["sensor_token"]]["channel"]
            poses_by_channel.setdefault(channel, row["ego_pose_token"])
    return rows_by_token["ego_pose"][poses_by_channel["LIDAR_TOP"]]


def _read_table(folder: Path, name: str) -> list[Any]:
    return list(json.loads(next(folder.glob(f"*/{name}.json")).read_bytes()))


def _judge_splits(workspace: Workspace, output: Output) -> str | None:
    """Check that all scenes with a split are listed in the file of splits."""
    if not workspace.changed_file.exists():
        return None
    listed_names = json.loads(workspace.changed_file.read_bytes())
    for name, split in output["splits"].items():
        if split and name not in listed_names[split]:
            return f"{name} is not listed"
    return None


_TABLE_ACTION = Action(_read_dataroot, _judge_tables)
_SPLIT_ACTION = Action(_read_dataroot, _judge_splits)
KINDS = (
    Kind("nuScenes tables", "tables", "road", "*/*[!s].json", (_TABLE_ACTION,)),
    Kind("nuScenes splits", "tables", "road", "*/splits.json", (_SPLIT_ACTION,)),
)
