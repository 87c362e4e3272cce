"""What one agent's files say of a moment: CARLA's left-handed world, degrees, km/h, half extents."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray
from deepaccident_devkit.export.bulk import Output
from deepaccident_devkit.export.opencood.recording import Recording
from deepaccident_devkit.export.poses import carla_six
from deepaccident_devkit.export.sensor_files import stored_camera
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.handedness import camera_from_lidar_to_raw, flip_pose
from deepaccident_devkit.geometry.quaternions import to_matrix
from deepaccident_devkit.geometry.se3 import inverses, stored_transforms
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import CATEGORIES, CHANNELS, FRAME_PERIOD, LIDAR, OWN_ACTOR_ID, UNTRACKED_ID

CAMERA_NAMES: Final[Mapping[str, str]] = {
    "Camera_Front": "camera0",
    "Camera_BackRight": "camera1",
    "Camera_BackLeft": "camera2",
    "Camera_Back": "camera3",
    "Camera_FrontLeft": "camera4",
    "Camera_FrontRight": "camera5",
}
"""Our camera → theirs. OPV2V has four: front, right rear, left rear, back; loaders leave out the other two."""
_KMH: Final = 3.6


class Moments:
    """The moments of one agent of a scenario, computed at once.

    Attributes:
        samples: tokens, by frame.
    """

    def __init__(self, recording: Recording, agent: str, classes: tuple[str, ...]) -> None:
        """Take an agent, and the classes that count as vehicles; raises TokenError."""
        self._dataset = dataset = recording.dataset
        self._files, numbers = recording.files[agent], [CATEGORIES.index(name) for name in classes]
        self._kept: dict[str, Callable[[Boxes], BoolArray]] = {
            "boxes of the agents themselves": lambda boxes: boxes.actor_id != OWN_ACTOR_ID,
            "boxes of other classes": lambda boxes: np.isin(boxes.category, numbers),
            "untracked boxes": lambda boxes: boxes.actor_id != UNTRACKED_ID,
            "boxes without LiDAR points": lambda boxes: boxes.num_lidar_pts > 0,
        }
        count = recording.record["num_frames"]
        self.samples = [sample_token(recording.token, agent, number) for number in range(1, count + 1)]
        first = dataset.getind("sample", self.samples[0])
        self._world_from_ego = stored_transforms(dataset.columns("ego_pose")["matrix"][first : first + count])
        rows = slice(first * len(CHANNELS), (first + count) * len(CHANNELS))
        sensors = stored_transforms(dataset.columns("sample_data")["matrix"][rows])
        self._ego_from = sensors.reshape(count, len(CHANNELS), 4, 4)
        samples = dataset.columns("sample")
        self._velocity, self._labelled = (samples[name][first : first + count] for name in ("velocity", "labelled"))
        self._extrinsic = {name: self._camera_from_lidar(name) for name in CAMERA_NAMES}

    def facts(self, number: int, output: Output) -> dict[str, Any]:
        """All that the file of a frame says; frames are counted from 1. What it leaves out is counted in `output`."""
        at = number - 1
        ego = carla_six(self._world_from_ego[at]).tolist()
        world_from_lidar = self._world_from_ego[at] @ self._ego_from[at, CHANNELS.index(LIDAR)]
        cameras = {theirs: self._camera(ours, at, flip_pose(world_from_lidar)) for ours, theirs in CAMERA_NAMES.items()}
        return {
            **cameras,
            "ego_speed": self._speed(at),
            "lidar_pose": carla_six(world_from_lidar).tolist(),
            "plan_trajectory": [  # where it went; a recording has no planned speed
                [x, y, 0.0] for x, y in carla_six(self._world_from_ego[number:])[:, :2].tolist()
            ],
            "predicted_ego_pos": list(ego),  # no noise
            "true_ego_pos": ego,
            "vehicles": self._vehicles(at, output),
        }

    def _vehicles(self, at: int, output: Output) -> dict[int, dict[str, Any]]:
        """Those that the agent's LiDAR hits, without the agent itself, as in OPV2V, which merges boxes by id."""
        if not self._labelled[at]:
            output.leave_out("labels that are not in this release")
        boxes = self._dataset.boxes(self.samples[at], "world")
        for what, is_kept in self._kept.items():
            kept = is_kept(boxes)
            output.leave_out(what, int(np.count_nonzero(~kept)))
            boxes = boxes.select(kept)
        pose = np.zeros((len(boxes), 4, 4))
        pose[:, :3, :3], pose[:, :3, 3], pose[:, 3, 3] = to_matrix(boxes.rotation), boxes.center, 1
        six = carla_six(pose)
        half = boxes.size / 2
        # loaders add `center` to `location` without turning it
        center = np.column_stack([np.zeros((len(boxes), 2)), half[:, 2]])
        speed = np.linalg.norm(np.nan_to_num(boxes.velocity), axis=1) * _KMH
        return {
            actor: {"angle": angle, "center": middle, "extent": extent, "location": location, "speed": kmh}
            for actor, angle, middle, extent, location, kmh in zip(
                boxes.actor_id.tolist(),
                six[:, 3:].tolist(),
                center.tolist(),
                half.tolist(),
                (six[:, :3] - center).tolist(),
                speed.tolist(),
                strict=True,
            )
        }

    def _camera(self, name: str, at: int, raw_world_from_lidar: FloatArray) -> dict[str, Any]:
        lidar_to_camera = self._extrinsic[name][at]
        lens = stored_camera(self._dataset, f"{self.samples[at]}/{name}", self._files[name].get(at + 1))
        world_from_camera = raw_world_from_lidar @ inverses(lidar_to_camera)
        return {
            "cords": carla_six(flip_pose(world_from_camera)).tolist(),
            "extrinsic": lidar_to_camera.tolist(),
            "intrinsic": lens.intrinsic.tolist(),
        }

    def _camera_from_lidar(self, name: str) -> FloatArray:
        """(N, 4, 4) LiDAR → camera in CARLA's axes, as calib files have it."""
        ego_from_camera = self._ego_from[:, CHANNELS.index(name)]
        return camera_from_lidar_to_raw(inverses(ego_from_camera) @ self._ego_from[:, CHANNELS.index(LIDAR)])

    def _speed(self, at: int) -> float:
        """The agent's, in km/h: the label's; without a label by its positions."""
        velocity = self._velocity[at]
        if np.isnan(velocity).any():
            near = self._world_from_ego[max(at - 1, 0) : at + 2, :2, 3]
            seconds = max(len(near) - 1, 1) * FRAME_PERIOD
            velocity = (near[-1] - near[0]) / seconds
        return float(np.hypot(*velocity)) * _KMH
