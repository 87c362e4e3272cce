"""What the tables of a small release say, compared with its files as they are read here."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from campaign import plain
from campaign.kind import Room
from deepaccident_devkit import DeepAccident


def tables(dataset: DeepAccident) -> dict[str, Any]:
    """All that the tables say of small files, by the token of the sample or scenario."""
    read: dict[str, Any] = {
        each["token"]: (
            each["velocity"],
            dataset.boxes(each["token"], frame="lidar", velocity="label"),
            pose,
        )
        for each, pose in zip(dataset.sample, dataset.columns("ego_pose")["matrix"], strict=True)
    }
    return read | {each["token"]: each for each in dataset.scenario}


def judge_tables(room: Room, read: Mapping[str, Any]) -> str | None:
    """Compare the scenarios that were read with their files."""
    for token, value in read.items():
        scenario_type, name, *sample = token.split("/")
        folder = room.tree / scenario_type
        if not sample:
            meta = folder / "meta" / f"{name}.txt"
            fault = (
                _meta_fault(value, plain.meta(meta)) if meta.is_file() else _known(value["weather"])
            )
        else:
            stem = f"{name}/{name}_{sample[1]}"
            velocity, boxes, pose = value
            label = folder / sample[0] / "label" / f"{stem}.txt"
            fault = (
                _label_fault(velocity, boxes, *plain.label(label))
                if label.is_file()
                else _known(velocity)
            )
            calib = plain.calib(folder / sample[0] / "calib" / f"{stem}.pkl")
            flipped = plain.LEFT_TO_RIGHT @ calib["ego_to_world"] @ plain.LEFT_TO_RIGHT
            fault = fault or (None if np.array_equal(pose, flipped.ravel()) else "ego_to_world")
        if fault:
            return f"{token}: {fault}"
    return None


def _known(value: Any) -> str | None:
    """A fault if something is known of a file that is not there."""
    return None if value is None else f"{value}, though the file is not there"


def _label_fault(
    velocity: Any, boxes: Any, speed: tuple[float, ...], rows: list[tuple[Any, ...]]
) -> str | None:
    if not np.array_equal(velocity, [speed[0], -speed[1]], equal_nan=True):
        return f"speed {velocity} and not {speed}"
    if len(boxes) != len(rows):
        return f"{len(boxes)} boxes and not {len(rows)}"
    for box, row in zip(boxes, rows, strict=True):
        same = np.array_equal([*box.center, *box.size], [row[1], -row[2], *row[3:7]])
        turn = abs(np.exp(1j * box.yaw) - np.exp(-1j * row[7]))
        facts = (box.category, box.actor_id, box.num_lidar_pts, box.camera_visible)
        if not same or turn > 1e-6 or facts != (row[0], *row[10:]):
            return f"{box!r} and not {row}"
    return None


def _meta_fault(scenario: Mapping[str, Any], said: Mapping[str, Any]) -> str | None:
    first, collision = said["first"], scenario["collision"]
    expected = (
        None if "-1" in (first[1], first[3]) else ([int(first[1]), int(first[3])], float(first[5]))
    )
    found = None if collision is None else (collision["ids"], collision["impact"])
    if expected != found:
        return f"collision {found} and not {expected}"
    if f"{scenario['weather']}{scenario['time_of_day'] or ''}" != first[0]:
        return f"weather {scenario['weather']} and not {first[0]}"
    road = (scenario["road_type"] or "", said.get("road_type", ""))
    return None if road[0] == road[1] else f"road type {road[0]} and not {road[1]}"
