"""A reader of nuScenes' tables that knows nuScenes' conventions and not the devkit: plain JSON and
quaternions.
"""

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pyquaternion import Quaternion

TABLES = (
    *(
        "category",
        "attribute",
        "visibility",
        "instance",
        "sensor",
        "calibrated_sensor",
        "ego_pose",
        "log",
        "scene",
    ),
    *("sample", "sample_data", "sample_annotation", "map"),
)
Tables = dict[str, dict[str, dict[str, Any]]]
"""Table → token → row."""


def tables_of(folder: Path) -> Tables:
    """The 13 tables in a folder."""
    tables: Tables = {}
    for name in TABLES:
        rows = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
        tables[name] = {row["token"]: row for row in rows}
        assert len(tables[name]) == len(rows), f"{name}: a token stands twice"
    return tables


def channel_of(tables: Tables, data: dict[str, Any]) -> str:
    """The channel of a row of sample_data."""
    calibrated = tables["calibrated_sensor"][data["calibrated_sensor_token"]]
    return str(tables["sensor"][calibrated["sensor_token"]]["channel"])


def faults_of(tables: Tables) -> Iterator[str]:
    """What nuScenes' devkit would stumble over: references to nothing, broken chains, maps,
    times.
    """
    for name, rows in tables.items():
        for row in rows.values():
            for field, value in row.items():
                target = field.removesuffix("_token").removeprefix("first_").removeprefix("last_")
                target = {"annotation": "sample_annotation"}.get(target, target)
                if (
                    field.endswith("_token")
                    and field != "deepaccident_token"
                    and value not in tables[target]
                ):
                    yield f"{name}.{field} of {row['token']} leads nowhere"
            if any(word not in tables["attribute"] for word in row.get("attribute_tokens", ())):
                yield f"{name}: no such attribute"
    for name, group in (
        ("sample", "scene_token"),
        ("sample_annotation", "instance_token"),
        ("sample_data", None),
    ):
        yield from _chain_faults(tables, name, group)
    mapped = {token for row in tables["map"].values() for token in row["log_tokens"]}
    yield from (f"log {token} is in no map" for token in tables["log"].keys() - mapped)
    first = Counter(
        tables["sample"][row["first_sample_token"]]["timestamp"] for row in tables["scene"].values()
    )
    yield from (f"{count} scenes begin at {moment}" for moment, count in first.items() if count > 1)
    for scene in tables["scene"].values():
        own = [row for row in tables["sample"].values() if row["scene_token"] == scene["token"]]
        ends = [row["token"] for row in own if not row["prev"]] + [
            row["token"] for row in own if not row["next"]
        ]
        if (len(own), ends) != (
            scene["nbr_samples"],
            [scene["first_sample_token"], scene["last_sample_token"]],
        ):
            yield f"scene {scene['name']} says other samples than it has"


def _chain_faults(tables: Tables, name: str, group: str | None) -> Iterator[str]:
    """Of a table's prev and next: they must lead back, forward in time, and stay in a group."""
    rows, samples = tables[name], tables["sample"]
    for row in rows.values():
        for way, back in (("prev", "next"), ("next", "prev")):
            if not row[way]:
                continue
            other = rows.get(row[way])
            if other is None or other[back] != row["token"]:
                yield f"{name}.{way} of {row['token']} does not lead back"
                continue
            times = [
                each.get("timestamp", samples[each.get("sample_token", each["token"])]["timestamp"])
                for each in (row, other)
            ]
            if (times[1] > times[0]) != (way == "next"):
                yield f"{name}.{way} of {row['token']} goes the wrong way in time"
            groups = [each[group] if group else channel_of(tables, each) for each in (row, other)]
            if groups[0] != groups[1]:
                yield f"{name}.{way} of {row['token']} leaves its chain"


def boxes_in(
    tables: Tables, data: dict[str, Any]
) -> Iterator[tuple[dict[str, Any], np.ndarray, Quaternion]]:
    """The annotations of a keyframe's sensor file, with centre and rotation in the sensor's
    frame.
    """
    calibrated = tables["calibrated_sensor"][data["calibrated_sensor_token"]]
    pose = tables["ego_pose"][data["ego_pose_token"]]
    for row in tables["sample_annotation"].values():
        if row["sample_token"] == data["sample_token"]:
            center, rotation = np.array(row["translation"]), Quaternion(row["rotation"])
            for frame in (pose, calibrated):
                back = Quaternion(frame["rotation"]).inverse
                center, rotation = back.rotate(center - frame["translation"]), back * rotation
            yield row, center, rotation


def points_of(path: Path) -> np.ndarray:
    """(N, 5) of a `.pcd.bin`."""
    return np.fromfile(path, dtype="<f4").reshape(-1, 5)


def count_points(
    points: np.ndarray, size: list[float], center: np.ndarray, rotation: Quaternion
) -> int:
    """How many points lie in a box; size is width, length, height."""
    local = (points[:, :3] - center) @ rotation.rotation_matrix
    return int((np.abs(local) <= np.array(size)[[1, 0, 2]] / 2).all(axis=1).sum())
