"""Make what `mmdet3d_infos.py` opens: `python -m tests.clients.make_mmdet3d_infos FOLDER`.

FOLDER gets a small release, its exports with both axes of the LiDAR, and `expected.json`: our
boxes, clouds and cameras at every keyframe, and the dataset class of docs/exports.md.
"""

import json
import re
import sys
from dataclasses import replace
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
TURNS = {"ego": np.eye(3), "nuscenes": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])}
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
    for axes in ("ego", "nuscenes"):
        for kind in (NuScenes, Mmdet3d):
            export_release(dataset, folder / axes, kind(agents=AGENTS, lidar_axes=axes))
        expected[axes] = {
            f"{record['token']}/{agent}/{number:03d}": moment_of(
                dataset, record["token"], agent, number, TURNS[axes]
            )
            for record in dataset.scenario
            for agent in AGENTS
            for number in keyframes(record["num_frames"])
        }
    (code,) = re.findall(
        r"^    from mmdet3d.*?(?=^\S)", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )
    assert any("van" in moment["classes"] for moment in expected["ego"].values())
    (folder / "expected.json").write_text(json.dumps({"exports": expected, "class": dedent(code)}))


def turn_the_ego(release: Path) -> None:
    """Let the ego turn by 3° a frame: where nobody turns, a wrong way to place sweeps may be
    right.
    """
    for path in release.glob("*/ego_vehicle/calib/*/*.pkl"):
        calib = read_calib(path)
        turned = calib.world_from_ego @ SE3.from_yaw(np.radians(3 * int(path.stem[-3:])))
        write_calib(path, replace(calib, world_from_ego=turned))


def moment_of(
    dataset: DeepAccident, scenario: str, agent: str, number: int, turn: np.ndarray
) -> dict[str, Any]:
    """What the client must find, in the LiDAR's frame with its axes turned; distances in metres."""
    sample = f"{scenario}/{agent}/{number:03d}"
    boxes = dataset.boxes(sample, "lidar", velocity="derived")
    boxes = boxes.select((boxes.actor_id != OWN_ACTOR_ID) & (boxes.num_lidar_pts > 0))
    velocity = np.nan_to_num(boxes.velocity) @ turn.T
    yaw = boxes.yaw + np.arctan2(turn[1, 0], turn[0, 0])
    lidar = dataset.world_from(sample, "lidar").inverse()
    ahead = dataset.world_from(sample, "Camera_BackLeft").apply(
        [[1.0, 0.5, 10.0]]
    )  # right, down, forward
    return {
        "boxes": np.column_stack(
            [boxes.center @ turn.T, boxes.size, yaw, velocity[:, :2]]
        ).tolist(),
        "classes": boxes.category_names,
        "points": boxes.num_lidar_pts.tolist(),
        "clouds": {
            f"{(number - each) / 10:.1f}": cloud_of(
                dataset, f"{sample[:-3]}{each:03d}", sample, turn
            )
            for each in range(number, max(number - 11, 0), -1)
        },
        "ahead": (lidar.apply(ahead)[0] @ turn.T).tolist(),
        "pixel": dataset.camera(sample, "Camera_BackLeft")
        .project([[1.0, 0.5, 10.0]])[0][0]
        .tolist(),
    }


def cloud_of(dataset: DeepAccident, sample: str, present: str, turn: np.ndarray) -> list[Any]:
    """The number of points of a cloud, and their mean in the LiDAR's frame of another moment."""
    points = dataset.load_point_cloud(sample).xyz
    mean = dataset.world_from(present, "lidar").inverse().apply(points).mean(axis=0)
    return [len(points), (mean @ turn.T).tolist()]


if __name__ == "__main__":
    main(Path(sys.argv[1]))
