"""A reader of OPV2V's folders, written from what OpenCOOD's loaders do with each field, without the
devkit.

It takes the first agent by name for the ego, adds `location` and `center` unturned, takes `extent`
for half lengths and angles for degrees, and the world for CARLA's left-handed one.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

Facts = Mapping[str, Any]


def agents_of(scenario: Path) -> list[str]:
    """The folders of a scenario in the order that loaders have: sorted as words, a first pole at
    the end.
    """
    names = sorted(each.name for each in scenario.iterdir() if each.is_dir())
    return [*names[1:], names[0]] if int(names[0]) < 0 else names


def timestamps_of(scenario: Path, agent: str) -> list[str]:
    return sorted(
        each.stem for each in (scenario / agent).glob("*.yaml") if "additional" not in each.name
    )


def facts_of(scenario: Path, agent: str, timestamp: str, suffix: str = "yaml") -> Facts:
    content = (scenario / agent / f"{timestamp}.{suffix}").read_text()
    loaded: Facts = yaml.safe_load(content) if suffix == "yaml" else json.loads(content)
    return loaded


def points_of(scenario: Path, agent: str, timestamp: str) -> np.ndarray:
    """(N, 4) x, y, z and intensity: the share of red, as Open3D gives colours."""
    content = (scenario / agent / f"{timestamp}.pcd").read_bytes()
    header, _, body = content.partition(b"DATA binary\n")
    told = dict(
        line.split(" ", 1) for line in header.decode().splitlines() if not line.startswith("#")
    )
    assert (told["FIELDS"], told["TYPE"], told["SIZE"]) == ("x y z rgb", "F F F U", "4 4 4 4")
    rows = np.frombuffer(body, dtype=[("xyz", "<f4", 3), ("rgb", "<u4")])
    assert len(rows) == int(told["POINTS"])
    return np.column_stack([rows["xyz"].astype(float), (rows["rgb"] >> 16 & 255) / 255])


def world_from(six: Any) -> np.ndarray:
    """(4, 4) of x, y, z, roll, yaw, pitch in degrees, as CARLA turns: left-handed, roll and pitch
    against the screw.
    """
    roll, yaw, pitch = np.radians(six[3:])
    cr, sr, cy, sy, cp, sp = (
        np.cos(roll),
        np.sin(roll),
        np.cos(yaw),
        np.sin(yaw),
        np.cos(pitch),
        np.sin(pitch),
    )
    matrix = np.eye(4)
    matrix[:3, 3] = six[:3]
    matrix[:3, :3] = [
        [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr],
        [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr],
        [sp, -cp * sr, cp * cr],
    ]
    return matrix


def counts_of(facts: Facts, points: np.ndarray, margin: float = 0.0) -> dict[int, int]:
    """Vehicle → how many of the agent's own points lie in its box, which is larger by a margin
    (metres).
    """
    world = points[:, :3] @ world_from(facts["lidar_pose"])[:3, :3].T + facts["lidar_pose"][:3]
    found = {}
    for actor, vehicle in facts["vehicles"].items():
        middle = np.add(vehicle["location"], vehicle["center"])
        pose = world_from([*middle, *vehicle["angle"]])
        inside = np.abs((world - middle) @ pose[:3, :3]) <= np.add(vehicle["extent"], margin)
        found[int(actor)] = int(inside.all(axis=1).sum())
    return found
