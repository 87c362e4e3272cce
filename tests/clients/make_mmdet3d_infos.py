"""Make the input of `mmdet3d_infos.py`: `python -m tests.clients.make_mmdet3d_infos FOLDER`.

FOLDER gets a small release, its exports with both conventions of the LiDAR's axes, and
`expected.json`: our boxes, clouds and cameras at every keyframe, and the dataset class of
docs/exports.md.
"""

import json
import re
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.frames import keyframes
from deepaccident_devkit.export.mmdet3d import Mmdet3d
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.release import read_calib, write_calib
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

AGENTS = ("ego_vehicle", "infrastructure")
ROTATIONS = {"ego": np.eye(3), "nuscenes": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])}
"""Rotation of the LiDAR's axes by the name of their convention."""
PAGE = Path(__file__).parents[2] / "docs" / "exports.md"


def main(folder: Path) -> None:
    config = SynthConfig(
        scenarios=2,
        frames=17,
        image_size=(320, 180),
        seed=3,
        unplanned=0,
        exact=True,
        designed=True,
    )
    turn_the_ego(make_release(folder / "release", config))
    dataset = DeepAccident("v1", folder / "release", verbose=False)
    expected = {}
    for axes, rotation in ROTATIONS.items():
        for kind in (NuScenes, Mmdet3d):
            export_release(dataset, folder / axes, kind(agents=AGENTS, lidar_axes=axes))
        expected[axes] = {}
        for record, agent in product(dataset.scenario, AGENTS):
            for frame in keyframes(record["num_frames"]):
                sample = f"{record['token']}/{agent}/{frame:03d}"
                expected[axes][sample] = describe_sample(dataset, sample, rotation)

    assert any("van" in facts["classes"] for facts in expected["ego"].values())

    page = PAGE.read_text(encoding="utf-8")
    (code,) = re.findall(r"^    from mmdet3d.*?(?=^\S)", page, re.DOTALL | re.MULTILINE)
    (folder / "expected.json").write_text(json.dumps({"exports": expected, "class": dedent(code)}))


def turn_the_ego(release: Path) -> None:
    """Turn the ego by 3° a frame; without a rotation, misplaced sweeps may look right."""
    for path in release.glob("*/ego_vehicle/calib/*/*.pkl"):
        calib = read_calib(path)
        turn = SE3.from_yaw(np.radians(3 * int(path.stem[-3:])))
        write_calib(path, replace(calib, world_from_ego=calib.world_from_ego @ turn))


def describe_sample(dataset: DeepAccident, sample: str, rotation: np.ndarray) -> dict[str, Any]:
    """Describe what the client must read, in the rotated LiDAR frame and in metres."""
    boxes = dataset.boxes(sample, "lidar", velocity="derived")
    boxes = boxes.select((boxes.actor_id != OWN_ACTOR_ID) & (boxes.num_lidar_pts > 0))
    velocity = np.nan_to_num(boxes.velocity) @ rotation.T
    yaw = boxes.yaw + np.arctan2(rotation[1, 0], rotation[0, 0])
    columns = [
        boxes.center @ rotation.T,
        boxes.size,
        yaw,
        velocity[:, :2],
    ]

    frame = int(sample[-3:])
    clouds = {}
    for number in range(frame, max(frame - 11, 0), -1):
        age_s = f"{(frame - number) / 10:.1f}"
        clouds[age_s] = describe_cloud(
            dataset,
            f"{sample[:-3]}{number:03d}",
            sample,
            rotation,
        )

    point_in_camera = [[1.0, 0.5, 10.0]]  # right, down, forward
    point_in_world = dataset.world_from(sample, "Camera_BackLeft").apply(point_in_camera)
    lidar_from_world = dataset.world_from(sample, "lidar").inverse()
    camera = dataset.camera(sample, "Camera_BackLeft")
    return {
        "boxes": np.column_stack(columns).tolist(),
        "classes": boxes.category_names,
        "points": boxes.num_lidar_pts.tolist(),
        "clouds": clouds,
        "ahead": (lidar_from_world.apply(point_in_world)[0] @ rotation.T).tolist(),
        "pixel": camera.project(point_in_camera)[0][0].tolist(),
    }


def describe_cloud(
    dataset: DeepAccident, sample: str, present: str, rotation: np.ndarray
) -> list[Any]:
    """Return a cloud's number of points and their mean in the LiDAR frame of another moment."""
    points = dataset.load_point_cloud(sample).xyz
    lidar_from_world = dataset.world_from(present, "lidar").inverse()
    mean = lidar_from_world.apply(points).mean(axis=0)
    return [len(points), (mean @ rotation.T).tolist()]


if __name__ == "__main__":
    main(Path(sys.argv[1]))
