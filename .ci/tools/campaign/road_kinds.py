"""Kinds of files of a dataroot in nuScenes' format: its tables, and the list of its splits."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from campaign import road_mutations
from campaign.kind import Action, Kind, Room
from deepaccident_devkit.plugins.nuscenes import open_nuscenes

assert road_mutations  # made for these


def _opened(room: Room) -> dict[str, Any]:
    """What the tables say of each keyframe, by nuScenes' token, and each scene's split."""
    road = open_nuscenes(room.tree, room.scratch / "index")
    moments = {}
    for record in road.sample:
        if record["token"].rpartition("/")[2] in _KEYS:
            boxes = road.with_ignored.boxes(record["token"])
            place = road.world_from(record["token"], "ego").translation
            moments[road.nuscenes_token(record["token"])] = (
                boxes.center,
                boxes.size,
                place,
                record["timestamp"],
            )
    return {
        "moments": moments,
        "splits": {record["name"]: record["split"] for record in road.scenario},
    }


_KEYS = {f"{number:03d}" for number in range(1, 100, 5)}


def _judge_tables(room: Room, read: Mapping[str, Any]) -> str | None:
    """What was read of keyframes stands in the tables; rows that no keyframe uses may be
    anything.
    """
    names = (
        "sample",
        "sample_data",
        "sample_annotation",
        "ego_pose",
        "calibrated_sensor",
        "sensor",
    )
    tables = {name: _rows(room.tree, name) for name in names}
    by_token = {name: {row["token"]: row for row in rows} for name, rows in tables.items()}
    starts: dict[str, float] = {}
    for token, (centers, sizes, place, time) in read["moments"].items():
        sample = by_token["sample"][token]
        boxes = [row for row in tables["sample_annotation"] if row["sample_token"] == token]
        if not np.allclose(
            centers, np.reshape([row["translation"] for row in boxes], (-1, 3)), atol=1e-3
        ):
            return f"{token}: other boxes"
        if not np.allclose(
            sizes, np.reshape([np.take(row["size"], [1, 0, 2]) for row in boxes], (-1, 3))
        ):
            return f"{token}: other sizes"
        files = [
            row
            for row in tables["sample_data"]
            if row["sample_token"] == token and row["is_key_frame"]
        ]
        mounts = [by_token["calibrated_sensor"][row["calibrated_sensor_token"]] for row in files]
        channels = [by_token["sensor"][mount["sensor_token"]]["channel"] for mount in mounts]
        pose = by_token["ego_pose"][files[channels.index("LIDAR_TOP")]["ego_pose_token"]]
        if not np.allclose(place, pose["translation"], atol=1e-3):
            return f"{token}: another pose"
        since = (
            sample["timestamp"] - starts.setdefault(sample["scene_token"], sample["timestamp"])
        ) * 1e-6
        if not np.isclose(time, since, atol=1e-5):
            return f"{token}: another time"
    return None


def _rows(tree: Path, table: str) -> list[Any]:
    return list(json.loads(next(tree.glob(f"*/{table}.json")).read_bytes()))


def _judge_splits(room: Room, read: Mapping[str, Any]) -> str | None:
    if not room.victim.exists():
        return None
    listed = json.loads(room.victim.read_bytes())
    wrong = [name for name, split in read["splits"].items() if split and name not in listed[split]]
    return f"{wrong[0]} is not listed" if wrong else None


KINDS = (
    Kind("nuScenes tables", "tables", "road", "*/*[!s].json", (Action(_opened, _judge_tables),)),
    Kind("nuScenes splits", "tables", "road", "*/splits.json", (Action(_opened, _judge_splits),)),
)
