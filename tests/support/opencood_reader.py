"""Read OPV2V's folders as OpenCOOD's loaders interpret each field, without the devkit.

The first agent by name is the ego, `location` and `center` are added without a rotation, `extent`
holds half lengths, angles are in degrees, and the world is CARLA's left-handed one.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

Facts = Mapping[str, Any]


def read_agents(scenario: Path) -> list[str]:
    """List a scenario's agents in the order of the loaders: sorted as text, except that a pole (a
    negative number) comes last.
    """
    names = sorted(path.name for path in scenario.iterdir() if path.is_dir())
    if int(names[0]) < 0:
        return [*names[1:], names[0]]
    return names


def read_timestamps(scenario: Path, agent: str) -> list[str]:
    paths = (scenario / agent).glob("*.yaml")
    return sorted(path.stem for path in paths if "additional" not in path.name)


def read_facts(scenario: Path, agent: str, timestamp: str, suffix: str = "yaml") -> Facts:
    content = (scenario / agent / f"{timestamp}.{suffix}").read_text()
    loaded: Facts = yaml.safe_load(content) if suffix == "yaml" else json.loads(content)
    return loaded


def read_points(scenario: Path, agent: str, timestamp: str) -> np.ndarray:
    """Read points (N, 4): x, y, z and the intensity, which is the red channel from 0 to 1."""
    content = (scenario / agent / f"{timestamp}.pcd").read_bytes()
    header, _, body = content.partition(b"DATA binary\n")
    lines = [line for line in header.decode().splitlines() if not line.startswith("#")]
    fields = dict(line.split(" ", 1) for line in lines)
    assert fields["FIELDS"] == "x y z rgb"
    assert fields["TYPE"] == "F F F U"
    assert fields["SIZE"] == "4 4 4 4"

    rows = np.frombuffer(body, dtype=[("xyz", "<f4", 3), ("rgb", "<u4")])
    assert len(rows) == int(fields["POINTS"])
    red = rows["rgb"] >> 16 & 255
    return np.column_stack([rows["xyz"].astype(float), red / 255])


def world_from(carla_pose: Any) -> np.ndarray:
    """Return the (4, 4) matrix that `carla.Transform.get_matrix` gives for x, y, z in metres and
    roll, yaw, pitch in degrees, in CARLA's left-handed world.
    """
    angles = np.radians(carla_pose[3:])
    cr, cy, cp = np.cos(angles)
    sr, sy, sp = np.sin(angles)
    matrix = np.eye(4)
    matrix[:3, 3] = carla_pose[:3]
    matrix[:3, :3] = [
        [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr],
        [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr],
        [sp, -cp * sr, cp * cr],
    ]
    return matrix


def count_contents(facts: Facts, points: np.ndarray, margin: float = 0.0) -> dict[int, int]:
    """Count the agent's own points in each vehicle's box, which grows by `margin` metres.

    Returns:
        Number of points by actor.
    """
    lidar_rotation = world_from(facts["lidar_pose"])[:3, :3]
    in_world = points[:, :3] @ lidar_rotation.T + facts["lidar_pose"][:3]
    counts = {}
    for actor, vehicle in facts["vehicles"].items():
        center = np.add(vehicle["location"], vehicle["center"])
        rotation = world_from([*center, *vehicle["angle"]])[:3, :3]
        in_box = (in_world - center) @ rotation
        inside = np.abs(in_box) <= np.add(vehicle["extent"], margin)
        counts[int(actor)] = int(inside.all(axis=1).sum())
    return counts
