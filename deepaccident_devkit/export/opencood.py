"""The folders of OPV2V and V2XSet, which OpenCOOD, V2X-ViT, CoAlign and HEAL read.

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.export.bulk import export_release
    from deepaccident_devkit.export.opencood import OpenCood

    da = DeepAccident(dataroot="data/DeepAccident")
    export_release(da, "data/opv2v", OpenCood(split="val"))

docs/exports.md describes the mapping, and what is lost.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.export.format import Format, Output, Unit, checked_names
from deepaccident_devkit.export.frames import sensor_files, stored_camera
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.conventions import (
    camera_from_lidar_to_raw,
    flip_pose,
    inverses,
    stored_transforms,
)
from deepaccident_devkit.geometry.quaternions import to_matrix
from deepaccident_devkit.release import read_lidar
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.support.text import settle_choices
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

# Split → folder in OPV2V.
_SPLITS: Final[Mapping[str | None, str]] = {
    "train": "train",
    "val": "validate",
    "test": "test",
    None: "unknown",
}
_AGENTS_FILE: Final = "agents.json"
# Camera → its name in OPV2V, which has four: front, right rear, left rear, back; loaders leave out
# the other two.
_CAMERA_NAMES: Final[Mapping[str, str]] = {
    "Camera_Front": "camera0",
    "Camera_BackRight": "camera1",
    "Camera_BackLeft": "camera2",
    "Camera_Back": "camera3",
    "Camera_FrontLeft": "camera4",
    "Camera_FrontRight": "camera5",
}
# Factor from m/s to km/h.
_KMH_PER_MPS: Final = 3.6
_POINT_DTYPE: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])


@dataclass(frozen=True, kw_only=True)
class OpenCood(Format):
    """OPV2V's folders. Loaders take the first vehicle by name for the ego.

    Agents are therefore called 1 to 4, the pole −1.

    Attributes:
        classes: Classes of boxes that are vehicles; OpenCOOD has one class, so they all become it.
        ego: The vehicle that is called 1; the others follow in their usual order.
        without_clouds: Whether to also write agents and moments that lack a point cloud, for models
            that use only cameras. Loaders of clouds treat them as moments without any LiDAR hit,
            with true boxes.
    """

    classes: tuple[str, ...] = ("car", "truck", "van")
    ego: str = "ego_vehicle"
    without_clouds: bool = False
    name: ClassVar[str] = "opencood"
    nothing: ClassVar[str] = (
        "no moment of these scenarios and agents has its point clouds; unpack the archives of "
        "lidar01, leave out the agents without it (agents, --agents), or write images alone "
        "(without_clouds, --without-clouds)"
    )

    def __post_init__(self) -> None:
        """Check the choices."""
        super().__post_init__()
        settle_choices(self, {"ego": VEHICLE_AGENTS})
        object.__setattr__(self, "classes", checked_names("classes", self.classes, CATEGORIES))

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a scenario's folder, which appears when it is complete."""
        recording = _Recording(
            dataset, unit.scenarios[0], self.agents, self.ego, self.without_clouds
        )
        recording.count(output)
        folders = []
        if recording.frames:  # loaders stop at a scenario without agents
            split_folder = _SPLITS[recording.record["split"]]
            with output.whole_folder(f"{split_folder}/{unit.name}") as folder:
                folder.write("data_protocol.yaml", _yaml(recording.protocol()))
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
        """Write HEAL's assignment, by which all agents have the same sensors."""
        assignment = {}
        written = samples = 0
        for unit in units:
            facts = parsed_json(read_bytes(parts(unit) / _AGENTS_FILE, "bundle"))
            written += facts["written"]
            samples += facts["samples"]
            if facts["folders"]:
                assignment[unit.name] = dict.fromkeys(facts["folders"], "m1")
        text = f"{json.dumps(assignment, indent=1)}\n"
        output.write("heter_modality_assign.json", text.encode())
        if 2 * written < samples:
            logger.warning(
                "%d of %d samples, most of the export, are left out for lack of point clouds; "
                "unpack the archives of lidar01, leave out the agents without it (agents, "
                "--agents), or write images alone (without_clouds, --without-clouds)",
                samples - written,
                samples,
            )

    def _write_agent(self, recording: _Recording, agent: str, output: Output) -> None:
        """Write the folder of an agent."""
        frames = _AgentFrames(recording, agent, self.classes)
        files = recording.files[agent]
        for number in recording.frames:
            stem = f"{recording.folders[agent]}/{number:06d}"
            facts = frames.facts(number, output)
            output.write(f"{stem}.yaml", _yaml(facts))
            # CoAlign and HEAL read this instead of the YAML
            output.write(f"{stem}.json", json.dumps(facts).encode())
            if number in files[LIDAR]:
                cloud_path, _ = files[LIDAR][number]
                output.write(f"{stem}.pcd", pcd_bytes(read_lidar(cloud_path, raw=True)))
            for camera, name in _CAMERA_NAMES.items():
                if number in files[camera]:
                    image_path, _ = files[camera][number]
                    output.link(image_path, f"{stem}_{name}.png")


def _yaml(content: Mapping[str, Any]) -> bytes:
    import yaml

    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # most builds have the one in C
    return str(yaml.dump(content, Dumper=dumper, default_flow_style=None)).encode()


class _Recording:
    """A scenario's agents, their folders and their sensor files.

    Attributes:
        dataset: The release.
        token: Token of the scenario.
        record: Record of the scenario.
        agents: Agents that are written; an agent without any point cloud is not.
        frames: Numbers of the frames that are written. Loaders look up the moments of one agent in
            all agents, and treat a missing cloud as a moment without points. So either all agents
            have a frame with its cloud, or none has.
        folders: Agent → name of its folder; loaders sort them as words and take the first for the
            ego.
        files: Agent → channel → frame → path and bytes of existing files that are written.
        samples: Number of samples that the release has.
        written: Number of them that are written: not all if clouds are missing.
    """

    def __init__(
        self,
        dataset: Dataset,
        token: str,
        agents: Sequence[str],
        ego: str,
        without_clouds: bool,  # noqa: FBT001
    ) -> None:
        """Find the files of these agents, and select what is written. Raises TokenError."""
        self.dataset, self.token = dataset, token
        self.record: ScenarioRecord = dataset.scenario[dataset.getind("scenario", token)]
        numbers = range(1, self.record["num_frames"] + 1)
        self._all_files: dict[str, dict[str, dict[int, tuple[ReleasePath, int]]]] = {}
        for agent in agents_of(dataset, token):
            if agent in agents:
                self._all_files[agent] = {
                    channel: sensor_files(dataset, token, agent, channel) for channel in CHANNELS
                }
        self._absent = len(agents) - len(self._all_files)
        self.samples = len(self._all_files) * len(numbers)
        self.agents: list[str] = []
        common = set(numbers)
        for name, files in self._all_files.items():
            moments = set(numbers if without_clouds else files[LIDAR])
            if moments:
                self.agents.append(name)
                common &= moments
        self.frames = sorted(common) if self.agents else []
        self.written = len(self.agents) * len(self.frames)
        self.files = {agent: self._written_files(agent) for agent in self.agents}
        order = sorted(VEHICLE_AGENTS, key=lambda agent: agent != ego)
        self.folders: dict[str, str] = {agent: str(number) for number, agent in enumerate(order, 1)}
        self.folders[INFRASTRUCTURE] = "-1"

    def _written_files(self, agent: str) -> dict[str, dict[int, tuple[ReleasePath, int]]]:
        """Return channel → frame → path and bytes of an agent's files in the written frames."""
        written = {}
        for channel, files in self._all_files[agent].items():
            written[channel] = {number: files[number] for number in self.frames if number in files}
        return written

    def protocol(self) -> dict[str, Any]:
        """Return the source of the scenario; no loader reads it."""
        agents = {}
        for agent in self.agents:
            actor_id = self.dataset.get("agent", f"{self.token}/{agent}")["actor_id"]
            agents[self.folders[agent]] = {"name": agent, "actor_id": actor_id}
        return {"source": "DeepAccident", "scenario": self.token, "agents": agents}

    def count(self, output: Output) -> None:
        """Count the samples, and the data that is not written; boxes are counted frame by frame."""
        output.tally.samples += self.written
        images = sum(map(self._count, CAMERAS))
        output.leave_out("agents of scenarios that are not in this release", self._absent)
        output.leave_out(
            "images that are not in this release", len(CAMERAS) * self.samples - images
        )
        output.leave_out(
            "point clouds that are not in this release", self.samples - self._count(LIDAR)
        )
        output.leave_out(
            "samples of agents or moments without point clouds", self.samples - self.written
        )
        output.leave_out("files of the BEV camera", self._count(BEV_CAMERA))

    def _count(self, channel: str) -> int:
        """Return the number of existing files of a channel."""
        return sum(len(files[channel]) for files in self._all_files.values())


class _AgentFrames:
    """The frames of one agent of a scenario, computed at once.

    Attributes:
        samples: Tokens, by frame.
    """

    def __init__(self, recording: _Recording, agent: str, classes: tuple[str, ...]) -> None:
        """Read the poses and speeds of an agent; raises TokenError.

        Args:
            recording: The scenario.
            agent: The agent.
            classes: Classes that count as vehicles.
        """
        self._dataset = dataset = recording.dataset
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
        self._extrinsic = {name: self._camera_from_lidar(name) for name in _CAMERA_NAMES}

    def facts(self, number: int, output: Output) -> dict[str, Any]:
        """Return the content of a frame's file, and count boxes that it leaves out.

        Args:
            number: Number of the frame, from 1.
            output: Output that counts the boxes.
        """
        index = number - 1
        ego = carla_six(self._world_from_ego[index]).tolist()
        world_from_lidar = (
            self._world_from_ego[index] @ self._ego_from[index, CHANNELS.index(LIDAR)]
        )
        raw_world_from_lidar = flip_pose(world_from_lidar)
        cameras = {}
        for camera, name in _CAMERA_NAMES.items():
            cameras[name] = self._camera(camera, index, raw_world_from_lidar)
        # the driven path; a recording has no planned speeds, so they are 0
        driven_path = carla_six(self._world_from_ego[number:])[:, :2].tolist()
        return {
            **cameras,
            "ego_speed": self._speed(index),
            "lidar_pose": carla_six(world_from_lidar).tolist(),
            "plan_trajectory": [[x, y, 0.0] for x, y in driven_path],
            "predicted_ego_pos": list(ego),  # no noise
            "true_ego_pos": ego,
            "vehicles": self._vehicles(index, output),
        }

    def _vehicles(self, index: int, output: Output) -> dict[int, dict[str, Any]]:
        """Return the boxes that the agent's LiDAR hits, without the agent itself.

        So does OPV2V, which merges boxes by id.
        """
        if not self._labelled[index]:
            output.leave_out("labels that are not in this release")
        boxes = self._dataset.boxes(self.samples[index], "world")
        for kind, is_retained in self._filters.items():
            retained = is_retained(boxes)
            output.leave_out(kind, int(np.count_nonzero(~retained)))
            boxes = boxes.select(retained)
        pose = np.zeros((len(boxes), 4, 4))
        pose[:, :3, :3], pose[:, :3, 3], pose[:, 3, 3] = to_matrix(boxes.rotation), boxes.center, 1
        six = carla_six(pose)
        half_size = boxes.size / 2
        # loaders add `center` to `location` without rotating it
        center = np.column_stack([np.zeros((len(boxes), 2)), half_size[:, 2]])
        speed = np.linalg.norm(np.nan_to_num(boxes.velocity), axis=1) * _KMH_PER_MPS
        columns = {
            "angle": six[:, 3:].tolist(),
            "center": center.tolist(),
            "extent": half_size.tolist(),
            "location": (six[:, :3] - center).tolist(),
            "speed": speed.tolist(),
        }
        vehicles = {}
        for row, actor in enumerate(boxes.actor_id.tolist()):
            vehicles[actor] = {name: values[row] for name, values in columns.items()}
        return vehicles

    def _camera(self, name: str, index: int, raw_world_from_lidar: FloatArray) -> dict[str, Any]:
        """Return pose, extrinsic and intrinsic of a camera in a frame."""
        token = f"{self.samples[index]}/{name}"
        lens = stored_camera(self._dataset, token, self._files[name].get(index + 1))
        lidar_to_camera = self._extrinsic[name][index]
        raw_world_from_camera = raw_world_from_lidar @ inverses(lidar_to_camera)
        return {
            "cords": carla_six(flip_pose(raw_world_from_camera)).tolist(),
            "extrinsic": lidar_to_camera.tolist(),
            "intrinsic": lens.intrinsic.tolist(),
        }

    def _camera_from_lidar(self, name: str) -> FloatArray:
        """Return LiDAR → camera (N, 4, 4) in CARLA's axes, as in calib files."""
        ego_from_camera = self._ego_from[:, CHANNELS.index(name)]
        return camera_from_lidar_to_raw(
            inverses(ego_from_camera) @ self._ego_from[:, CHANNELS.index(LIDAR)]
        )

    def _speed(self, index: int) -> float:
        """Return the agent's speed in km/h by its label, or without a label by its positions."""
        velocity = self._velocity[index]
        if np.isnan(velocity).any():
            positions = self._world_from_ego[max(index - 1, 0) : index + 2, :2, 3]
            seconds = max(len(positions) - 1, 1) * FRAME_PERIOD
            velocity = (positions[-1] - positions[0]) / seconds
        return float(np.hypot(*velocity)) * _KMH_PER_MPS


def carla_six(pose: ArrayLike) -> FloatArray:
    """Return CARLA's poses (…, 6) of right-handed rigid matrices (…, 4, 4).

    They are x, y, z in metres, roll, yaw, pitch in degrees, left-handed as in CARLA's `Transform`
    and OpenCOOD's `x_to_world`: yaw clockwise from above, pitch upwards.
    """
    matrix = flip_pose(pose)
    roll = np.arctan2(-matrix[..., 2, 1], matrix[..., 2, 2])
    yaw = np.arctan2(matrix[..., 1, 0], matrix[..., 0, 0])
    pitch = np.arcsin(np.clip(matrix[..., 2, 0], -1.0, 1.0))
    angles = np.degrees(np.stack([roll, yaw, pitch], axis=-1))
    return np.concatenate([matrix[..., :3, 3], angles], axis=-1)


def pcd_bytes(points: AnyArray) -> bytes:
    """Return a binary `.pcd` of points (N, 4): x, y, z, intensity in [0, 1].

    The intensity goes into the 8 bits of red, since Open3D ignores a field `intensity`, and
    OpenCOOD reads the red channel.
    """
    cloud = np.zeros(len(points), dtype=_POINT_DTYPE)
    cloud["x"], cloud["y"], cloud["z"] = points[:, :3].T
    cloud["rgb"] = np.round(255 * np.clip(points[:, 3], 0, 1)).astype(np.uint32) << 16
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 "
        f"4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH {len(cloud)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 "
        f"0\nPOINTS {len(cloud)}\nDATA binary\n"
    )
    return header.encode() + cloud.tobytes()
