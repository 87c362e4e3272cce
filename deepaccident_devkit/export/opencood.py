"""The folders of OPV2V and V2XSet, which OpenCOOD, V2X-ViT, CoAlign and HEAL read.

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.export.bulk import export_release
    from deepaccident_devkit.export.opencood import OpenCood

    da = DeepAccident(dataroot="data/DeepAccident")
    export_release(da, "data/opv2v", OpenCood(split="val"))

docs/exports.md says what becomes what, and what is lost.
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
from deepaccident_devkit.export.format import Format, Output, Unit, some_of
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

# Our split → their folder.
_SPLITS: Final[Mapping[str | None, str]] = {
    "train": "train",
    "val": "validate",
    "test": "test",
    None: "unknown",
}
_AGENTS: Final = "agents.json"
# Our camera → theirs. OPV2V has four: front, right rear, left rear, back; loaders leave out the other two.
_CAMERA_NAMES: Final[Mapping[str, str]] = {
    "Camera_Front": "camera0",
    "Camera_BackRight": "camera1",
    "Camera_BackLeft": "camera2",
    "Camera_Back": "camera3",
    "Camera_FrontLeft": "camera4",
    "Camera_FrontRight": "camera5",
}
_KMH: Final = 3.6
_POINT: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])


@dataclass(frozen=True, kw_only=True)
class OpenCood(Format):
    """OPV2V's folders. Loaders take the first vehicle by name for the ego; agents are therefore 1 to 4, the pole −1.

    Attributes:
        classes: which boxes are vehicles; OpenCOOD has one class, so all of these become it.
        ego: the vehicle that is 1; the others follow in their usual order.
        without_clouds: whether to write agents and moments that lack a point cloud, too, for models of cameras alone.
            Loaders of clouds take them for moments at which nothing was hit, with true boxes.
    """

    classes: tuple[str, ...] = ("car", "truck", "van")
    ego: str = "ego_vehicle"
    without_clouds: bool = False
    name: ClassVar[str] = "opencood"
    nothing: ClassVar[str] = (
        "no moment of these scenarios and agents has its point clouds; unpack the archives of lidar01, leave out the "
        "agents without it (agents, --agents), or write images alone (without_clouds, --without-clouds)"
    )

    def __post_init__(self) -> None:
        """Check the choices."""
        super().__post_init__()
        settle_choices(self, {"ego": VEHICLE_AGENTS})
        object.__setattr__(self, "classes", some_of("classes", self.classes, CATEGORIES))

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a scenario's folder, which appears when it is whole."""
        recording = _Recording(
            dataset, unit.scenarios[0], self.agents, self.ego, self.without_clouds
        )
        recording.count(output)
        if recording.frames:  # loaders stop at a scenario without agents
            with output.whole_folder(f"{_SPLITS[recording.record['split']]}/{unit.name}") as folder:
                folder.write("data_protocol.yaml", _yaml(recording.protocol()))
                for agent in recording.agents:
                    self._write_agent(recording, agent, folder)
        folders = (
            [recording.folders[agent] for agent in recording.agents] if recording.frames else []
        )
        facts = {"folders": folders, "written": recording.written, "samples": recording.samples}
        write_bytes(output.parts / _AGENTS, json.dumps(facts).encode())

    def finish(
        self,
        dataset: Dataset,  # noqa: ARG002
        units: Sequence[Unit],
        output: Output,
        parts: Callable[[Unit], Path],
    ) -> None:
        """Write HEAL's assignment, by which all agents have the same sensors."""
        facts = {
            unit.name: parsed_json(read_bytes(parts(unit) / _AGENTS, "bundle")) for unit in units
        }
        found = {
            name: dict.fromkeys(each["folders"], "m1")
            for name, each in facts.items()
            if each["folders"]
        }
        output.write("heter_modality_assign.json", f"{json.dumps(found, indent=1)}\n".encode())

        written, samples = (
            sum(each[name] for each in facts.values()) for name in ("written", "samples")
        )
        if 2 * written < samples:
            logger.warning(
                "%d of %d samples, most of the export, are left out for lack of point clouds; unpack the archives of "
                "lidar01, leave out the agents without it (agents, --agents), or write images alone "
                "(without_clouds, --without-clouds)",
                samples - written,
                samples,
            )

    def _write_agent(self, recording: _Recording, agent: str, output: Output) -> None:
        moments = _Moments(recording, agent, self.classes)
        files = recording.files[agent]
        for number in recording.frames:
            stem, facts = f"{recording.folders[agent]}/{number:06d}", moments.facts(number, output)
            output.write(f"{stem}.yaml", _yaml(facts))
            output.write(
                f"{stem}.json", json.dumps(facts).encode()
            )  # CoAlign and HEAL read it in place of the yaml
            if number in files[LIDAR]:
                output.write(
                    f"{stem}.pcd", pcd_bytes(read_lidar(files[LIDAR][number][0], raw=True))
                )
            for camera, name in _CAMERA_NAMES.items():
                if number in files[camera]:
                    output.link(files[camera][number][0], f"{stem}_{name}.png")


def _yaml(content: Mapping[str, Any]) -> bytes:
    import yaml

    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # the one in C is there with most builds
    return str(yaml.dump(content, Dumper=dumper, default_flow_style=None)).encode()


class _Recording:
    """A scenario's agents, their folders and their sensor files.

    Attributes:
        dataset: the release.
        token: the scenario's.
        record: the scenario's.
        agents: that are written; without a point cloud in the whole scenario an agent is not.
        frames: numbers of those that are written. Loaders look up the moments of one agent in all of them, and a cloud
            that is not there is for them one without points. So all have a frame, and its cloud, or none has.
        folders: agent → name of its folder; loaders sort them as words and take the first for the ego.
        files: agent → channel → frame → path and bytes of what is there and written.
        samples: agents at moments that the release has.
        written: how many of them are written: not all if clouds are missing.
    """

    def __init__(
        self,
        dataset: Dataset,
        token: str,
        agents: Sequence[str],
        ego: str,
        without_clouds: bool,  # noqa: FBT001
    ) -> None:
        """Look which files of these agents are there, and choose what is written. Raises TokenError."""
        self.dataset, self.token = dataset, token
        self.record: ScenarioRecord = dataset.scenario[dataset.getind("scenario", token)]
        numbers = range(1, self.record["num_frames"] + 1)
        self._there: dict[str, dict[str, dict[int, tuple[ReleasePath, int]]]] = {
            agent: {channel: sensor_files(dataset, token, agent, channel) for channel in CHANNELS}
            for agent in agents_of(dataset, token)
            if agent in agents
        }
        self._absent, self.samples = len(agents) - len(self._there), len(self._there) * len(numbers)
        moments = {
            agent: set(numbers if without_clouds else files[LIDAR])
            for agent, files in self._there.items()
        }
        self.agents = [agent for agent in self._there if moments[agent]]
        common = set(numbers).intersection(*(moments[agent] for agent in self.agents))
        self.frames = sorted(common) if self.agents else []
        self.written = len(self.agents) * len(self.frames)
        self.files = {
            agent: {
                channel: {number: found[number] for number in self.frames if number in found}
                for channel, found in self._there[agent].items()
            }
            for agent in self.agents
        }
        order = sorted(VEHICLE_AGENTS, key=lambda agent: agent != ego)
        self.folders: dict[str, str] = {
            **{agent: str(number) for number, agent in enumerate(order, 1)},
            INFRASTRUCTURE: "-1",
        }

    def protocol(self) -> dict[str, Any]:
        """Where the scenario comes from; no loader reads it."""
        actors = {
            agent: self.dataset.get("agent", f"{self.token}/{agent}")["actor_id"]
            for agent in self.agents
        }
        return {
            "source": "DeepAccident",
            "scenario": self.token,
            "agents": {
                self.folders[agent]: {"name": agent, "actor_id": actor}
                for agent, actor in actors.items()
            },
        }

    def count(self, output: Output) -> None:
        """Count the samples, and what of the scenario is not written; boxes are counted moment by moment."""
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
        return sum(len(files[channel]) for files in self._there.values())


class _Moments:
    """The moments of one agent of a scenario, computed at once.

    Attributes:
        samples: tokens, by frame.
    """

    def __init__(self, recording: _Recording, agent: str, classes: tuple[str, ...]) -> None:
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
        self.samples = [
            sample_token(recording.token, agent, number) for number in range(1, count + 1)
        ]
        first = dataset.getind("sample", self.samples[0])
        self._world_from_ego = stored_transforms(
            dataset.columns("ego_pose")["matrix"][first : first + count]
        )
        rows = slice(first * len(CHANNELS), (first + count) * len(CHANNELS))
        sensors = stored_transforms(dataset.columns("sample_data")["matrix"][rows])
        self._ego_from = sensors.reshape(count, len(CHANNELS), 4, 4)
        samples = dataset.columns("sample")
        self._velocity, self._labelled = (
            samples[name][first : first + count] for name in ("velocity", "labelled")
        )
        self._extrinsic = {name: self._camera_from_lidar(name) for name in _CAMERA_NAMES}

    def facts(self, number: int, output: Output) -> dict[str, Any]:
        """All that the file of a frame says; frames are counted from 1. What it leaves out is counted in `output`."""
        at = number - 1
        ego = carla_six(self._world_from_ego[at]).tolist()
        world_from_lidar = self._world_from_ego[at] @ self._ego_from[at, CHANNELS.index(LIDAR)]
        return {
            **{
                theirs: self._camera(ours, at, flip_pose(world_from_lidar))
                for ours, theirs in _CAMERA_NAMES.items()
            },
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
            actor: {
                "angle": angle,
                "center": middle,
                "extent": extent,
                "location": location,
                "speed": kmh,
            }
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
        lens = stored_camera(
            self._dataset, f"{self.samples[at]}/{name}", self._files[name].get(at + 1)
        )
        return {
            "cords": carla_six(
                flip_pose(raw_world_from_lidar @ inverses(lidar_to_camera))
            ).tolist(),
            "extrinsic": lidar_to_camera.tolist(),
            "intrinsic": lens.intrinsic.tolist(),
        }

    def _camera_from_lidar(self, name: str) -> FloatArray:
        """(N, 4, 4) LiDAR → camera in CARLA's axes, as calib files have it."""
        ego_from_camera = self._ego_from[:, CHANNELS.index(name)]
        return camera_from_lidar_to_raw(
            inverses(ego_from_camera) @ self._ego_from[:, CHANNELS.index(LIDAR)]
        )

    def _speed(self, at: int) -> float:
        """The agent's, in km/h: the label's; without a label by its positions."""
        velocity = self._velocity[at]
        if np.isnan(velocity).any():
            near = self._world_from_ego[max(at - 1, 0) : at + 2, :2, 3]
            seconds = max(len(near) - 1, 1) * FRAME_PERIOD
            velocity = (near[-1] - near[0]) / seconds
        return float(np.hypot(*velocity)) * _KMH


def carla_six(pose: ArrayLike) -> FloatArray:
    """Right-handed rigid matrices (…, 4, 4) → CARLA's (…, 6): x, y, z in metres, roll, yaw, pitch in degrees.

    Left-handed, as CARLA's `Transform` and OpenCOOD's `x_to_world` have them: yaw clockwise from above, pitch upwards.
    """
    m = flip_pose(pose)
    roll = np.arctan2(-m[..., 2, 1], m[..., 2, 2])
    yaw = np.arctan2(m[..., 1, 0], m[..., 0, 0])
    pitch = np.arcsin(np.clip(m[..., 2, 0], -1.0, 1.0))
    angles = np.degrees(np.stack([roll, yaw, pitch], axis=-1))
    return np.concatenate([m[..., :3, 3], angles], axis=-1)


def pcd_bytes(points: AnyArray) -> bytes:
    """A binary `.pcd` of points (N, 4): x, y, z, intensity in [0, 1], which gets the 8 bits of red.

    A field `intensity` would not do: Open3D ignores it, and OpenCOOD reads the red channel.
    """
    cloud = np.zeros(len(points), dtype=_POINT)
    cloud["x"], cloud["y"], cloud["z"] = points[:, :3].T
    cloud["rgb"] = np.round(255 * np.clip(points[:, 3], 0, 1)).astype(np.uint32) << 16
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\n"
        f"COUNT 1 1 1 1\nWIDTH {len(cloud)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(cloud)}\nDATA binary\n"
    )
    return header.encode() + cloud.tobytes()
