"""An independent reader of nuScenes' tables, which needs only JSON and quaternions and not the
devkit.
"""

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pyquaternion import Quaternion

TABLES = (
    "category",
    "attribute",
    "visibility",
    "instance",
    "sensor",
    "calibrated_sensor",
    "ego_pose",
    "log",
    "scene",
    "sample",
    "sample_data",
    "sample_annotation",
    "map",
)
Tables = dict[str, dict[str, dict[str, Any]]]
"""Rows by table and token."""


def read_tables(folder: Path) -> Tables:
    tables: Tables = {}
    for name in TABLES:
        rows = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
        tables[name] = {row["token"]: row for row in rows}
        assert len(tables[name]) == len(rows), f"{name}: a token stands twice"
    return tables


def sample_channel(tables: Tables, data: dict[str, Any]) -> str:
    calibrated = tables["calibrated_sensor"][data["calibrated_sensor_token"]]
    return str(tables["sensor"][calibrated["sensor_token"]]["channel"])


def find_faults(tables: Tables) -> Iterator[str]:
    """Find faults that nuScenes' devkit would fail on: dangling references, broken chains, logs
    without a map, scenes at the same time.
    """
    yield from _reference_faults(tables)
    yield from _chain_faults(tables, "sample", "scene_token")
    yield from _chain_faults(tables, "sample_annotation", "instance_token")
    yield from _chain_faults(tables, "sample_data", None)
    mapped_logs = {token for row in tables["map"].values() for token in row["log_tokens"]}
    for log in tables["log"].keys() - mapped_logs:
        yield f"log {log} is in no map"
    yield from _scene_faults(tables)


def _reference_faults(tables: Tables) -> Iterator[str]:
    for name, rows in tables.items():
        for row in rows.values():
            for field, value in row.items():
                if not field.endswith("_token") or field == "deepaccident_token":
                    continue
                target = field.removesuffix("_token").removeprefix("first_").removeprefix("last_")
                target = {"annotation": "sample_annotation"}.get(target, target)
                if value not in tables[target]:
                    yield f"{name}.{field} of {row['token']} leads nowhere"
            attributes = row.get("attribute_tokens", ())
            if any(token not in tables["attribute"] for token in attributes):
                yield f"{name}: no such attribute"


def _scene_faults(tables: Tables) -> Iterator[str]:
    samples = tables["sample"]
    scenes = tables["scene"].values()
    begins = Counter(samples[scene["first_sample_token"]]["timestamp"] for scene in scenes)
    for timestamp, count in begins.items():
        if count > 1:
            yield f"{count} scenes begin at {timestamp}"
    for scene in scenes:
        own_samples = [row for row in samples.values() if row["scene_token"] == scene["token"]]
        ends = [row["token"] for row in own_samples if not row["prev"]]
        ends += [row["token"] for row in own_samples if not row["next"]]
        expected_ends = [scene["first_sample_token"], scene["last_sample_token"]]
        if (len(own_samples), ends) != (scene["nbr_samples"], expected_ends):
            yield f"scene {scene['name']} says other samples than it has"


def _chain_faults(tables: Tables, name: str, group_field: str | None) -> Iterator[str]:
    """Check that a table's prev and next lead back, go in the right direction in time and stay in
    their group.
    """
    rows = tables[name]

    def timestamp(row: dict[str, Any]) -> int:
        sample = tables["sample"][row.get("sample_token", row["token"])]
        return row.get("timestamp", sample["timestamp"])

    def group(row: dict[str, Any]) -> str:
        return row[group_field] if group_field else sample_channel(tables, row)

    for row in rows.values():
        for direction, opposite in (("prev", "next"), ("next", "prev")):
            if not row[direction]:
                continue
            link = f"{name}.{direction} of {row['token']}"
            neighbour = rows.get(row[direction])
            if neighbour is None or neighbour[opposite] != row["token"]:
                yield f"{link} does not lead back"
                continue
            is_later = timestamp(neighbour) > timestamp(row)
            if is_later != (direction == "next"):
                yield f"{link} goes the wrong way in time"
            if group(neighbour) != group(row):
                yield f"{link} leaves its chain"


def boxes_in_sensor(
    tables: Tables, data: dict[str, Any]
) -> Iterator[tuple[dict[str, Any], np.ndarray, Quaternion]]:
    """Yield the annotations of a keyframe's sensor file, with centre and rotation in the sensor's
    frame.
    """
    calibrated = tables["calibrated_sensor"][data["calibrated_sensor_token"]]
    pose = tables["ego_pose"][data["ego_pose_token"]]
    for row in tables["sample_annotation"].values():
        if row["sample_token"] != data["sample_token"]:
            continue
        center = np.array(row["translation"])
        rotation = Quaternion(row["rotation"])
        for frame in (pose, calibrated):
            inverse = Quaternion(frame["rotation"]).inverse
            center = inverse.rotate(center - frame["translation"])
            rotation = inverse * rotation
        yield row, center, rotation


def read_points(path: Path) -> np.ndarray:
    """Read the points of a `.pcd.bin` file, shape (N, 5)."""
    return np.fromfile(path, dtype="<f4").reshape(-1, 5)


def count_points(
    points: np.ndarray, size: list[float], center: np.ndarray, rotation: Quaternion
) -> int:
    """Count the points in a box; size is width, length, height."""
    in_box = (points[:, :3] - center) @ rotation.rotation_matrix
    half_extents = np.array(size)[[1, 0, 2]] / 2
    is_inside = (np.abs(in_box) <= half_extents).all(axis=1)
    return int(is_inside.sum())
