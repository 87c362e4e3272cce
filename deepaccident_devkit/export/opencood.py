"""The folders of OPV2V and V2XSet, which OpenCOOD, V2X-ViT, CoAlign and HEAL can read.

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.export.bulk import export_release
    from deepaccident_devkit.export.opencood import OpenCood

    da = DeepAccident(dataroot="data/DeepAccident")
    export_release(da, "data/opv2v", OpenCood(split="val"))

`OpenCood` describes the mapping, docs/exports.md what is lost.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.export.format import Format, Output, Unit, check_names
from deepaccident_devkit.export.frames import FrameFiles, load_camera, select_files, sensor_files
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.conventions import (
    camera_from_lidar_to_raw,
    flip_pose,
    inverses,
    stored_transforms,
)
from deepaccident_devkit.geometry.quaternions import to_matrix
from deepaccident_devkit.release import read_lidar
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import (
    BEV_CAMERA,
    CAMERAS,
    CATEGORIES,
    CHANNELS,
    FRAME_PERIOD,
    INFRASTRUCTURE,
    LIDAR,
    OWN_ACTOR_ID,
    UNTRACKED_ID,
    VEHICLE_AGENTS,
)
from deepaccident_devkit.v2x.agents import agents_of

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

logger = logging.getLogger(__name__)

# Existing files by agent, then by channel.
_AgentFiles: TypeAlias = "dict[str, dict[str, FrameFiles]]"
# Folder in OPV2V for each split.
_SPLITS = {
    "train": "train",
    "val": "validate",
    "test": "test",
    None: "unknown",
}
_AGENTS_FILE = "agents.json"
# Name of each camera in OPV2V, which has four: front, right rear, left rear, back. Loaders ignore
# the other two.
_CAMERA_NAMES = {
    "Camera_Front": "camera0",
    "Camera_BackRight": "camera1",
    "Camera_BackLeft": "camera2",
    "Camera_Back": "camera3",
    "Camera_FrontLeft": "camera4",
    "Camera_FrontRight": "camera5",
}
# Factor from m/s to km/h.
_KMH_PER_MPS = 3.6
_POINT_DTYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])


@dataclass(frozen=True, kw_only=True)
class OpenCood(Format):
    """Folders of OPV2V, in which agents are called 1 to 4, and the pole −1.

    They are numbered because loaders take the vehicle with the first name for the ego. The files
    of OPV2V contain:

    - Splits: train, val and test are the folders `train`, `validate` and `test`.
    - Scenario: the folder `<type>__<scenario>`, with its source in `data_protocol.yaml`.
    - Agents: ego_vehicle, ego_vehicle_behind, other_vehicle, other_vehicle_behind and
      infrastructure are the folders `1`, `2`, `3`, `4` and `-1`.
    - Frame 31: `000031.yaml`, the same as `000031.json`, `000031.pcd`, `000031_camera0.png` and
      other images.
    - Poses and boxes: in CARLA's left-handed world, with degrees, km/h and half lengths.
    - Cameras: Front, BackRight, BackLeft, Back, FrontLeft and FrontRight are `camera0` to
      `camera5`; loaders open the first four.
    - LiDAR intensity: the red channel of `rgb`, with 8 bits.

    Attributes:
        classes: Classes of boxes that become vehicles, which is the only class of OpenCOOD.
        ego: Vehicle that is called 1; the others follow in their usual order.
        without_clouds: Whether to also write agents and moments that lack a point cloud, for models
            that use only cameras. Loaders of clouds treat them as moments without any LiDAR hit,
            with true boxes.
    """

    classes: tuple[str, ...] = ("car", "truck", "van")
    ego: str = "ego_vehicle"
    without_clouds: bool = False
    name: ClassVar[str] = "opencood"
    empty_reason: ClassVar[str] = (
        "no moment of these scenarios and agents has its point clouds; unpack the archives of "
        "lidar01, exclude the agents without it (agents, --agents), or write only images "
        "(without_clouds, --without-clouds)"
    )

    def __post_init__(self) -> None:
        """Raise ChoiceError unless all settings have possible values; put classes in order."""
        super().__post_init__()
        settle_choices(self, {"ego": VEHICLE_AGENTS})
        object.__setattr__(self, "classes", check_names("classes", self.classes, CATEGORIES))

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write the folder of a scenario, which appears once it is complete."""
        recording = _Recording(
            dataset, unit.scenarios[0], self.agents, self.ego, self.without_clouds
        )
        recording.count_data(output)
        folders = []
        if recording.frames:  # Loaders stop at a scenario without agents.
            split_folder = _SPLITS[recording.record["split"]]
            with output.whole_folder(f"{split_folder}/{unit.name}") as folder:
                folder.write("data_protocol.yaml", _encode_yaml(recording.describe_source()))
                for agent in recording.agents:
                    self._write_agent(recording, agent, folder)
            folders = [recording.folders[agent] for agent in recording.agents]
        facts = {"folders": folders, "written": recording.written, "samples": recording.samples}
        write_bytes(output.parts / _AGENTS_FILE, json.dumps(facts).encode())

    def finish(
        self,
        dataset: Dataset,  # noqa: ARG002
        units: Sequence[Unit],
        output: Output,
        parts: Callable[[Unit], Path],
    ) -> None:
        """Write HEAL's assignment, which gives all agents the same sensors."""
        assignment = {}
        num_written = 0
        num_samples = 0
        for unit in units:
            facts = parsed_json(read_bytes(parts(unit) / _AGENTS_FILE, "bundle"))
            num_written += facts["written"]
            num_samples += facts["samples"]
            if facts["folders"]:
                assignment[unit.name] = dict.fromkeys(facts["folders"], "m1")
        text = f"{json.dumps(assignment, indent=1)}\n"
        output.write("heter_modality_assign.json", text.encode())
        if 2 * num_written < num_samples:
            logger.warning(
                "%d of %d samples, most of the export, are excluded as they have no point clouds; "
                "unpack the archives of lidar01, exclude the agents without it (agents, "
                "--agents), or write only images (without_clouds, --without-clouds)",
                num_samples - num_written,
                num_samples,
            )

    def _write_agent(self, recording: _Recording, agent: str, output: Output) -> None:
        """Write the folder of an agent."""
        frames = _AgentFrames(recording, agent, self.classes)
        files = recording.files[agent]
        for number in recording.frames:
            stem = f"{recording.folders[agent]}/{number:06d}"
            facts = frames.make_facts(number, output)
            output.write(f"{stem}.yaml", _encode_yaml(facts))
            # CoAlign and HEAL read this file instead of the YAML.
            output.write(f"{stem}.json", json.dumps(facts).encode())
            if number in files[LIDAR]:
                cloud_path, _ = files[LIDAR][number]
                output.write(f"{stem}.pcd", encode_pcd(read_lidar(cloud_path, raw=True)))
            for camera, name in _CAMERA_NAMES.items():
                if number in files[camera]:
                    image_path, _ = files[camera][number]
                    output.link(image_path, f"{stem}_{name}.png")


def _encode_yaml(content: ReadOnlyValues) -> bytes:
    import yaml

    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # Most builds have the one in C.
    text = yaml.dump(content, Dumper=dumper, default_flow_style=None)
    return str(text).encode()


class _Recording:
    """A scenario's agents, their folders and their sensor files.

    Attributes:
        dataset: The release.
        token: Token of the scenario.
        record: Record of the scenario.
        agents: Agents that are written, which have at least one point cloud.
        frames: Numbers of the frames that are written. Loaders look up one agent's moments in
            all agents, and treat a missing cloud as one without points. So a frame is written for
            all agents, with their clouds, or for none.
        folders: Folder name of each agent, by agent. Loaders sort the names as text and take the
            first one for the ego.
        files: Path and bytes of each existing file that is written, by agent, channel and frame.
        samples: Number of samples in the release.
        written: Number of samples that are written; fewer than `samples` if clouds are missing.
    """

    def __init__(
        self,
        dataset: Dataset,
        token: str,
        agents: Sequence[str],
        ego: str,
        without_clouds: bool,  # noqa: FBT001
    ) -> None:
        """Find these agents' files, and select what is written; raise TokenError if unknown."""
        self.dataset = dataset
        self.token = token
        self.record: ScenarioRecord = dataset.scenario[dataset.getind("scenario", token)]
        numbers = range(1, self.record["num_frames"] + 1)
        self._all_files: _AgentFiles = {}
        for agent in agents_of(dataset, token):
            if agent in agents:
                self._all_files[agent] = {
                    channel: sensor_files(dataset, token, agent, channel) for channel in CHANNELS
                }
        self._num_absent_agents = len(agents) - len(self._all_files)
        self.samples = len(self._all_files) * len(numbers)
        self.agents: list[str] = []
        common_frames = set(numbers)
        for recorder, files in self._all_files.items():
            agent_frames = set(numbers if without_clouds else files[LIDAR])
            if agent_frames:
                self.agents.append(recorder)
                common_frames &= agent_frames
        self.frames = sorted(common_frames) if self.agents else []
        self.written = len(self.agents) * len(self.frames)
        self.files: _AgentFiles = {}
        for recorder in self.agents:
            self.files[recorder] = {
                channel: select_files(files, self.frames)
                for channel, files in self._all_files[recorder].items()
            }
        ego_first = sorted(VEHICLE_AGENTS, key=lambda agent: agent != ego)
        self.folders = {INFRASTRUCTURE: "-1"}
        for number, vehicle in enumerate(ego_first, start=1):
            self.folders[vehicle] = str(number)

    def describe_source(self) -> NamedValues:
        """Describe where the scenario comes from; no loader reads this."""
        agents = {}
        for agent in self.agents:
            actor_id = self.dataset.get("agent", f"{self.token}/{agent}")["actor_id"]
            agents[self.folders[agent]] = {"name": agent, "actor_id": actor_id}
        return {"source": "DeepAccident", "scenario": self.token, "agents": agents}

    def count_data(self, output: Output) -> None:
        """Count the samples, and all data that is not written except boxes."""
        output.tally.samples += self.written
        num_images = sum(map(self._count_files, CAMERAS))
        num_missing_images = len(CAMERAS) * self.samples - num_images
        num_missing_clouds = self.samples - self._count_files(LIDAR)
        absent_agents = "agents of scenarios that are not in this release"
        output.leave_out(absent_agents, self._num_absent_agents)
        output.leave_out("images that are not in this release", num_missing_images)
        output.leave_out("point clouds that are not in this release", num_missing_clouds)
        output.leave_out(
            "samples of agents or moments without point clouds", self.samples - self.written
        )
        output.leave_out("files of the BEV camera", self._count_files(BEV_CAMERA))

    def _count_files(self, channel: str) -> int:
        """Return the number of existing files of a channel."""
        counts = [len(files[channel]) for files in self._all_files.values()]
        return sum(counts)


class _AgentFrames:
    """Frames of one agent of a scenario, with poses that are computed for all frames at once.

    Attributes:
        samples: Tokens of the samples, frame by frame.
    """

    def __init__(self, recording: _Recording, agent: str, classes: tuple[str, ...]) -> None:
        """Read an agent's poses and speeds; raise TokenError for unknown tokens.

        Args:
            recording: The scenario.
            agent: The agent.
            classes: Classes that count as vehicles.
        """
        dataset = recording.dataset
        self._dataset = dataset
        self._files = recording.files[agent]
        class_numbers = list(map(CATEGORIES.index, classes))
        self._filters: dict[str, Callable[[Boxes], BoolArray]] = {
            "boxes of the agents themselves": lambda boxes: boxes.actor_id != OWN_ACTOR_ID,
            "boxes of other classes": lambda boxes: np.isin(boxes.category, class_numbers),
            "untracked boxes": lambda boxes: boxes.actor_id != UNTRACKED_ID,
            "boxes without LiDAR points": lambda boxes: boxes.num_lidar_pts > 0,
        }
        count = recording.record["num_frames"]
        numbers = range(1, count + 1)
        self.samples = [sample_token(recording.token, agent, number) for number in numbers]
        first = dataset.getind("sample", self.samples[0])
        rows = slice(first, first + count)
        self._world_from_ego = stored_transforms(dataset.columns("ego_pose")["matrix"][rows])
        sensor_rows = slice(first * len(CHANNELS), (first + count) * len(CHANNELS))
        sensors = stored_transforms(dataset.columns("sample_data")["matrix"][sensor_rows])
        self._ego_from = sensors.reshape(count, len(CHANNELS), 4, 4)
        samples = dataset.columns("sample")
        self._velocity = samples["velocity"][rows]
        self._labelled = samples["labelled"][rows]
        self._extrinsic = {name: self._compute_extrinsic(name) for name in _CAMERA_NAMES}

    def make_facts(self, number: int, output: Output) -> NamedValues:
        """Return the content of the file of a frame, and count the boxes that it leaves out.

        Args:
            number: Number of the frame, from 1.
            output: Output that counts the boxes.
        """
        index = number - 1
        ego = carla_poses(self._world_from_ego[index]).tolist()
        ego_from_lidar = self._ego_from[index, CHANNELS.index(LIDAR)]
        world_from_lidar = self._world_from_ego[index] @ ego_from_lidar
        raw_world_from_lidar = flip_pose(world_from_lidar)
        cameras = {}
        for camera, name in _CAMERA_NAMES.items():
            cameras[name] = self._make_camera(camera, index, raw_world_from_lidar)
        # The plan is the driven path. A recording has no planned speeds, so they are 0.
        driven_path = carla_poses(self._world_from_ego[number:])[:, :2].tolist()
        return {
            **cameras,
            "ego_speed": self._compute_speed(index),
            "lidar_pose": carla_poses(world_from_lidar).tolist(),
            "plan_trajectory": [[x, y, 0.0] for x, y in driven_path],
            "predicted_ego_pos": list(ego),  # It has no noise.
            "true_ego_pos": ego,
            "vehicles": self._make_vehicles(index, output),
        }

    def _make_vehicles(self, index: int, output: Output) -> dict[int, NamedValues]:
        """Return the vehicles that the agent's LiDAR hits, except the agent itself, by actor id.

        OPV2V selects boxes in the same way, and merges the boxes of all agents by their ids.
        """
        if not self._labelled[index]:
            output.leave_out("labels that are not in this release")
        boxes = self._dataset.boxes(self.samples[index], "world")
        for kind, is_retained in self._filters.items():
            retained = is_retained(boxes)
            output.leave_out(kind, int(np.count_nonzero(~retained)))
            boxes = boxes.select(retained)
        pose = np.zeros((len(boxes), 4, 4))
        pose[:, :3, :3] = to_matrix(boxes.rotation)
        pose[:, :3, 3] = boxes.center
        pose[:, 3, 3] = 1
        raw_pose = carla_poses(pose)
        half_size = boxes.size / 2
        # Loaders add `center` to `location` without rotating it.
        center = np.zeros((len(boxes), 3))
        center[:, 2] = half_size[:, 2]
        speed = np.linalg.norm(np.nan_to_num(boxes.velocity), axis=1) * _KMH_PER_MPS
        columns = {
            "angle": raw_pose[:, 3:].tolist(),
            "center": center.tolist(),
            "extent": half_size.tolist(),
            "location": (raw_pose[:, :3] - center).tolist(),
            "speed": speed.tolist(),
        }
        vehicles = {}
        for row, actor in enumerate(boxes.actor_id.tolist()):
            vehicles[actor] = {name: values[row] for name, values in columns.items()}
        return vehicles

    def _make_camera(self, name: str, index: int, raw_world_from_lidar: FloatArray) -> NamedValues:
        """Return the pose, extrinsic and intrinsic of a camera at a frame."""
        token = f"{self.samples[index]}/{name}"
        lens = load_camera(self._dataset, token, self._files[name].get(index + 1))
        lidar_to_camera = self._extrinsic[name][index]
        raw_world_from_camera = raw_world_from_lidar @ inverses(lidar_to_camera)
        world_from_camera = flip_pose(raw_world_from_camera)
        return {
            "cords": carla_poses(world_from_camera).tolist(),
            "extrinsic": lidar_to_camera.tolist(),
            "intrinsic": lens.intrinsic.tolist(),
        }

    def _compute_extrinsic(self, name: str) -> FloatArray:
        """Return `camera_from_lidar` (N, 4, 4) in CARLA's axes, as in calib files."""
        ego_from_camera = self._ego_from[:, CHANNELS.index(name)]
        ego_from_lidar = self._ego_from[:, CHANNELS.index(LIDAR)]
        return camera_from_lidar_to_raw(inverses(ego_from_camera) @ ego_from_lidar)

    def _compute_speed(self, index: int) -> float:
        """Return the agent's speed in km/h from its label or, without one, from its positions."""
        velocity = self._velocity[index]
        if np.isnan(velocity).any():
            first = max(index - 1, 0)
            positions = self._world_from_ego[first : index + 2, :2, 3]
            steps = max(len(positions) - 1, 1)
            velocity = (positions[-1] - positions[0]) / (steps * FRAME_PERIOD)
        return float(np.hypot(*velocity)) * _KMH_PER_MPS


def carla_poses(pose: ArrayLike) -> FloatArray:
    """Convert right-handed rigid matrices (…, 4, 4) to CARLA poses (…, 6).

    A pose is x, y, z in metres and roll, yaw, pitch in degrees, left-handed as in CARLA's
    `Transform` and OpenCOOD's `x_to_world`: yaw is clockwise from above, pitch is upwards.
    """
    matrix = flip_pose(pose)
    forward = matrix[..., 0]
    roll = np.arctan2(-matrix[..., 2, 1], matrix[..., 2, 2])
    yaw = np.arctan2(forward[..., 1], forward[..., 0])
    pitch = np.arcsin(np.clip(forward[..., 2], -1.0, 1.0))
    angles = np.degrees(np.stack([roll, yaw, pitch], axis=-1))
    position = matrix[..., :3, 3]
    return np.concatenate([position, angles], axis=-1)


def encode_pcd(points: AnyArray) -> bytes:
    """Encode points (N, 4: x, y, z, intensity in [0, 1]) as a binary `.pcd`.

    The intensity goes into the 8 bits of red, because Open3D ignores a field `intensity`, and
    OpenCOOD reads the red channel.
    """
    cloud = np.zeros(len(points), dtype=_POINT_DTYPE)
    cloud["x"], cloud["y"], cloud["z"] = points[:, :3].T
    red = np.round(255 * np.clip(points[:, 3], 0, 1))
    cloud["rgb"] = red.astype(np.uint32) << 16
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 "
        f"4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH {len(cloud)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 "
        f"0\nPOINTS {len(cloud)}\nDATA binary\n"
    )
    return header.encode() + cloud.tobytes()
