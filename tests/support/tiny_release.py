"""Write a small release without the devkit's writers: raw text, pickles and CARLA's own signs
(docs/format.md).
"""

import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

SCENARIO_TYPE = "type1_subtype1_accident"
SCENARIO_NAME = "Town03_type001_subtype0001_scenario00024"
SCENARIO_TOKEN = f"{SCENARIO_TYPE}/{SCENARIO_NAME}"
AGENTS = (
    "ego_vehicle",
    "ego_vehicle_behind",
    "other_vehicle",
    "other_vehicle_behind",
    "infrastructure",
)
CAMERA_YAW_DEG = {
    "Front": 0,
    "FrontLeft": -55,
    "FrontRight": 55,
    "Back": 180,
    "BackLeft": -110,
    "BackRight": 110,
}
META_TEXT = """HardRainNoon 1223 car 1212 car 6790.168605131015 same front_side 14
 colliding agents: ego other
 agents id: 1223 1236 1212 1237
 road_type: four-way junction
 another_vehicle_spawn_side: left
 ego_vehicle_direction: straight
 other_vehicle_direction: straight
"""


def pose(yaw: float = 0.0, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """Return a left-handed CARLA pose; the yaw is in degrees, clockwise from above (y is right, so
    the matrix looks usual).
    """
    cosine = np.cos(np.radians(yaw))
    sine = np.sin(np.radians(yaw))
    matrix = np.eye(4)
    matrix[:2, :2] = [[cosine, -sine], [sine, cosine]]
    matrix[:3, 3] = x, y, z
    return matrix


def make_calib(ego_to_world: np.ndarray, *, height: float) -> dict[str, np.ndarray]:
    arrays = {"lidar_to_ego": pose(z=height), "ego_to_world": ego_to_world}
    for name, yaw_deg in CAMERA_YAW_DEG.items():
        yaw = np.radians(yaw_deg)
        camera_to_lidar = pose(yaw_deg, x=2.0 * np.cos(yaw), y=2.0 * np.sin(yaw), z=-0.3)
        focal = 560.166 if name == "Back" else 1142.5184
        intrinsic = np.array([[800, focal, 0], [450, 0, -focal], [1, 0, 0]], dtype=float)
        arrays[f"lidar_to_Camera_{name}"] = np.linalg.inv(camera_to_lidar)
        arrays[f"intrinsic_Camera_{name}"] = intrinsic
    return arrays


def lidar_height(agent: str) -> float:
    """Return the height of an agent's LiDAR; the pole's is its ego frame (docs/format.md)."""
    return 0.0 if agent == "infrastructure" else 1.94


def ego_to_world(agent: str, frame: int) -> np.ndarray:
    """Return an agent's pose: the ego drives at 10 m/s along CARLA's y axis (yaw 90), the others
    stand.
    """
    if agent == "ego_vehicle":
        return pose(90, x=5.0, y=float(frame), z=0.5)
    return pose(0, x=-10.0 * AGENTS.index(agent), z=0.5)


def label_lines(agent: str, frame: int) -> list[str]:
    """Return the lines of a label with a van that drives at 2 m/s along world x.

    As in the release, its velocity is turned once more by its yaw.
    """
    lidar_to_world = ego_to_world(agent, frame) @ pose(z=lidar_height(agent))
    van_in_world = np.array([20.0 + 0.2 * frame, 3.0, 1.3, 1.0])
    x, y, z, _ = (np.linalg.inv(lidar_to_world) @ van_in_world).tolist()
    yaw = float(-np.arctan2(lidar_to_world[1, 0], lidar_to_world[0, 0]))
    velocity_x = 2 * float(np.cos(yaw))
    velocity_y = 2 * float(np.sin(yaw))

    agent_velocity = "0.0 10.0" if agent == "ego_vehicle" else "0.0 0.0"
    lines = [agent_velocity]
    if agent != "infrastructure":
        lines.append(f"car 0.1 0.0 -1.2 4.5 1.9 1.5 0.0 {agent_velocity} -100 900 False")
    lines.append(
        f"van {x!r} {y!r} {z!r} 5.0 2.0 2.2 {yaw!r} {velocity_x!r} {velocity_y!r} 1300 12 True"
    )
    lines.append("pedestrian 30.0 -1.5 -0.9 0.375 0.375 1.86 2.19 0.0 0.0 -1 0 True")
    return lines


def write_tiny_release(
    root: Path,
    *,
    frames: int = 4,
    agents: Sequence[str] = AGENTS,
    scenario_type: str = SCENARIO_TYPE,
    name: str = SCENARIO_NAME,
    meta: str | None = META_TEXT,
    labelled: bool = True,
    lines_of: Callable[[str, int], list[str]] = label_lines,
) -> Path:
    """Write one scenario (labels, calib, meta) below `root`; the calib names an old numpy's
    modules.
    """
    base = root / scenario_type
    if meta is not None:
        _write(base / "meta" / f"{name}.txt", meta.encode())
    for agent in agents:
        for frame in range(1, frames + 1):
            stem = f"{name}/{name}_{frame:03d}"
            calib = make_calib(ego_to_world(agent, frame), height=lidar_height(agent))
            _write(base / agent / "calib" / f"{stem}.pkl", old_pickle(calib))
            if labelled:
                text = "\n".join(lines_of(agent, frame)) + "\n"
                _write(base / agent / "label" / f"{stem}.txt", text.encode())
    return root


def old_pickle(content: Any) -> bytes:
    """Return a pickle that names numpy 1's modules."""
    return pickle.dumps(content, protocol=2).replace(
        b"numpy._core.multiarray", b"numpy.core.multiarray"
    )


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
