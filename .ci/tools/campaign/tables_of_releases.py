"""Comparison of the tables of a small release with its files, as plain readers see them."""

from pathlib import Path
from typing import Any

import numpy as np

from campaign import plain
from campaign.kind import Output, Workspace
from deepaccident_devkit import DeepAccident

_ANGLE_TOLERANCE = 1e-6
"""Distance between two directions on the unit circle."""


def read_tables(dataset: DeepAccident) -> Output:
    """Return all that the tables hold of small files, by the token of the sample or scenario."""
    output: dict[str, Any] = {}
    poses = dataset.columns("ego_pose")["matrix"]
    for sample, pose in zip(dataset.sample, poses, strict=True):
        boxes = dataset.boxes(sample["token"], frame="lidar", velocity="label")
        output[sample["token"]] = (sample["velocity"], boxes, pose)
    return output | {scenario["token"]: scenario for scenario in dataset.scenario}


def judge_tables(workspace: Workspace, output: Output) -> str | None:
    """Compare the samples and scenarios that were read with their files."""
    for token, value in output.items():
        scenario_type, name, *sample = token.split("/")
        folder = workspace.folder / scenario_type
        if sample:
            agent, frame = sample
            fault = _find_sample_fault(value, folder / agent, f"{name}/{name}_{frame}")
        else:
            fault = _find_scenario_fault(value, folder / "meta" / f"{name}.txt")
        if fault:
            return f"{token}: {fault}"
    return None


def _find_sample_fault(sample: tuple[Any, Any, Any], agent_folder: Path, stem: str) -> str | None:
    """Compare velocity, boxes and pose with the label and calib files."""
    velocity, boxes, pose = sample
    label = agent_folder / "label" / f"{stem}.txt"
    if label.is_file():
        fault = _find_label_fault(velocity, boxes, *plain.read_label(label))
    else:
        fault = _find_missing_file_fault(velocity)
    calib = plain.read_calib(agent_folder / "calib" / f"{stem}.pkl")
    expected_pose = plain.LEFT_TO_RIGHT @ calib["ego_to_world"] @ plain.LEFT_TO_RIGHT
    if fault is None and not np.array_equal(pose, expected_pose.ravel()):
        return "ego_to_world"
    return fault


def _find_label_fault(
    velocity: Any, boxes: Any, speed: tuple[float, ...], rows: list[plain.LabelRow]
) -> str | None:
    if not np.array_equal(velocity, [speed[0], -speed[1]], equal_nan=True):
        return f"speed {velocity} and not {speed}"
    if len(boxes) != len(rows):
        return f"{len(boxes)} boxes and not {len(rows)}"
    for box, row in zip(boxes, rows, strict=True):
        category, x, y, z, *size, yaw, _, _, actor_id, point_count, is_visible = row
        is_same_place = np.array_equal([*box.center, *box.size], [x, -y, z, *size])
        turn = abs(np.exp(1j * box.yaw) - np.exp(-1j * yaw))
        facts = (box.category, box.actor_id, box.num_lidar_pts, box.camera_visible)
        expected_facts = (category, actor_id, point_count, is_visible)
        if not is_same_place or turn > _ANGLE_TOLERANCE or facts != expected_facts:
            return f"{box!r} and not {row}"
    return None


def _find_scenario_fault(scenario: Output, path: Path) -> str | None:
    """Compare a scenario with its meta file."""
    if not path.is_file():
        return _find_missing_file_fault(scenario["weather"])
    meta = plain.read_meta(path)
    words = meta["first"]
    expected = None
    if "-1" not in (words[1], words[3]):
        expected = ([int(words[1]), int(words[3])], float(words[5]))
    collision = scenario["collision"]
    if collision is not None:
        collision = (collision["ids"], collision["impact"])
    if expected != collision:
        return f"collision {collision} and not {expected}"
    if f"{scenario['weather']}{scenario['time_of_day'] or ''}" != words[0]:
        return f"weather {scenario['weather']} and not {words[0]}"
    road_type = scenario["road_type"] or ""
    expected_type = meta.get("road_type", "")
    if road_type == expected_type:
        return None
    return f"road type {road_type} and not {expected_type}"


def _find_missing_file_fault(value: Any) -> str | None:
    """Return a fault if a value is known although its file does not exist."""
    if value is None:
        return None
    return f"{value}, though the file is not there"
