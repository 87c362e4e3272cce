"""A scene, what one agent recorded of a scenario, in nuScenes' words: its own rows, its boxes, its sensor files.

mmdet3d's infos refer to the same files by the same names. All names follow from the release alone, so that exports of
parts agree with one of the whole.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from deepaccident_devkit.export.frames import keyframe_after, keyframes, sensor_files, stored_camera
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.release import read_lidar
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.tables.tokens import agent_token, sample_data_token, sample_token
from deepaccident_devkit.taxonomy import (
    AGENTS,
    BEV_CAMERA,
    CAMERAS,
    LIDAR,
    OWN_ACTOR_ID,
    STATIC_ACTOR_ID,
    UNTRACKED_ID,
)
from deepaccident_devkit.v2x.agents import agents_of

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset
    from deepaccident_devkit.export.bulk import Output
    from deepaccident_devkit.geometry import PinholeCamera

NUSCENES_VERSION: Final = "v1.0-deepaccident"
LIDAR_CHANNEL: Final = "LIDAR_TOP"
CAMERA_CHANNELS: Final = MappingProxyType(
    dict(
        zip(
            CAMERAS,
            (
                "CAM_FRONT",
                "CAM_FRONT_LEFT",
                "CAM_FRONT_RIGHT",
                "CAM_BACK",
                "CAM_BACK_LEFT",
                "CAM_BACK_RIGHT",
            ),
            strict=True,
        )
    )
)
"""Our camera → nuScenes' channel."""
CHANNEL_NAMES: Final = MappingProxyType({**CAMERA_CHANNELS, LIDAR: LIDAR_CHANNEL})
_ENDINGS: Final = MappingProxyType({**dict.fromkeys(CAMERAS, "jpg"), LIDAR: "pcd.bin"})
_EPOCH: Final = 1_600_000_000_000_000
_HOUR: Final = 3_600_000_000
_PERIOD: Final = 100_000
NuScenesRow = dict[str, Any]
# Table → rows in their order.
_RowsByTable = Mapping[str, Sequence[NuScenesRow]]
Van = Literal["car", "truck"]
NUSCENES_CATEGORIES: Final = MappingProxyType(
    {
        "car": "vehicle.car",
        "truck": "vehicle.truck",
        "motorcycle": "vehicle.motorcycle",
        "cyclist": "vehicle.bicycle",
        "pedestrian": "human.pedestrian.adult",
    }
)
"""Our class → nuScenes' category; vans are said to be one of the first two."""
# Whether a camera of the agent sees a box → nuScenes' visibility; the levels between cannot be known.
_SEEN: Final = MappingProxyType({True: "4", False: "1"})
# m/s, above which an actor moves.
_MOVING: Final = 0.2
LidarAxes = Literal["ego", "nuscenes"]
AXES_ROTATIONS: Final = {
    "ego": np.eye(3),
    "nuscenes": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
"""Axes → what turns points with x forward and y left into them; nuScenes' LiDAR has x right and y forward."""


def token(kind: str, *parts: object) -> str:
    """A token of 32 hexadecimal digits for a row of a table, from what it is."""
    return hashlib.md5(
        "/".join(map(str, (kind, *parts))).encode(), usedforsecurity=False
    ).hexdigest()


def sensor_path(scene: str, channel: str, stamp: int, *, key: bool) -> str:
    """The path of a sensor file below the folder; `channel` is ours."""
    name = CHANNEL_NAMES[channel]
    return f"{'samples' if key else 'sweeps'}/{name}/{scene}__{name}__{stamp}.{_ENDINGS[channel]}"


@dataclass(frozen=True)
class AgentScene:
    """One agent's recording of a scenario.

    Attributes:
        dataset: the release.
        scenario: token.
        agent: name.
        sweeps: whether the frames between keyframes are exported too.
    """

    dataset: Dataset
    scenario: str
    agent: str
    sweeps: bool

    @property
    def name(self) -> str:
        """As in the table `scene` and in `splits.json`: `<type>-<scenario>-<agent>`."""
        return f"{self.scenario.replace('/', '-')}-{self.agent}"

    @cached_property
    def last(self) -> int:
        """The number of the last frame."""
        count: int = self.dataset.scenario.get(self.scenario)["num_frames"]
        return count

    @cached_property
    def frames(self) -> range:
        """The numbers of the frames that are exported."""
        return range(1, self.last + 1) if self.sweeps else keyframes(self.last)

    @cached_property
    def files(self) -> Mapping[str, Mapping[int, tuple[ReleasePath, int]]]:
        """Channel → number of an exported frame → path and bytes of the file, where it is there."""
        files = {}
        for channel in CHANNEL_NAMES:
            there = sensor_files(self.dataset, self.scenario, self.agent, channel)
            files[channel] = {number: there[number] for number in self.frames if number in there}
        return files

    def is_key(self, number: int) -> bool:
        """Whether a frame is a keyframe."""
        return keyframe_after(number, self.last) == number

    def key_of(self, number: int) -> str:
        """The devkit's token of the sample that a frame belongs to: the keyframe's that it leads to.

        The nuScenes devkit interpolates boxes of a sweep from the keyframe before its sample to its sample.
        """
        return self.sample(keyframe_after(number, self.last))

    def sample(self, number: int) -> str:
        """The devkit's token of a frame's sample."""
        return sample_token(self.scenario, self.agent, number)

    def stamp(self, number: int) -> int:
        """Microseconds of a frame: a scenario has an hour of its own, an agent starts a microsecond after the other.

        The devkit of nuScenes sorts scenes by their first one, so no two are the same.
        """
        hours = self.dataset.getind("scenario", self.scenario) + 1
        return _EPOCH + hours * _HOUR + number * _PERIOD + AGENTS.index(self.agent)

    def rows(self) -> _RowsByTable:
        """The rows of `scene`, `log`, `sample` and `ego_pose`."""
        about = self.dataset.scenario.get(self.scenario)
        scene, log = (
            token(table, agent_token(self.scenario, self.agent)) for table in ("scene", "log")
        )
        samples = linked([self._sample_row(number, scene) for number in keyframes(self.last)])
        facts = (about["town"], about["weather"], about["time_of_day"], about["road_type"])
        scene_row = {
            "token": scene,
            "log_token": log,
            "nbr_samples": len(samples),
            "first_sample_token": samples[0]["token"],
            "last_sample_token": samples[-1]["token"],
            "name": self.name,
            "description": ", ".join(
                filter(None, (*facts, "collision" if about["collision"] else None))
            ),
            "agent": self.agent,
            "split": about["split"],
        }
        log_row = {
            "token": log,
            "logfile": self.scenario,
            "vehicle": self.agent,
            "date_captured": "",
            "location": about["town"],
        }
        poses = [self._pose_row(number) for number in self.frames]
        return {"scene": [scene_row], "log": [log_row], "sample": samples, "ego_pose": poses}

    def _sample_row(self, number: int, scene: str) -> NuScenesRow:
        sample = self.sample(number)
        return {
            "token": token("sample", sample),
            "timestamp": self.stamp(number),
            "scene_token": scene,
            "agent": self.agent,
            "time_to_impact": self.dataset.sample.get(sample)["time_to_impact"],
            "deepaccident_token": sample,
        }

    def _pose_row(self, number: int) -> NuScenesRow:
        pose = self.dataset.ego_pose.get(self.sample(number))
        return {
            "token": token("ego_pose", self.sample(number)),
            "timestamp": self.stamp(number),
            "translation": pose["translation"],
            "rotation": pose["rotation"],
        }


def scenes_of(
    dataset: Dataset, scenario: str, agents: Sequence[str], *, sweeps: bool
) -> Iterator[AgentScene]:
    """The scenes of those of the agents that recorded a scenario."""
    return (
        AgentScene(dataset, scenario, agent, sweeps)
        for agent in agents_of(dataset, scenario)
        if agent in agents
    )


def linked(rows: list[NuScenesRow]) -> list[NuScenesRow]:
    """The same rows, each with the tokens of the one before and after it as `prev` and `next`; "" at the ends."""
    tokens = ["", *(row["token"] for row in rows), ""]
    for row, before, after in zip(rows, tokens, tokens[2:], strict=False):
        row["prev"], row["next"] = before, after
    return rows


def box_rows(scene: AgentScene, van: Van, output: Output) -> _RowsByTable:
    """The rows of `instance` and `sample_annotation`: an actor has an instance of its own in each scene.

    The agent's own row is left out, as nuScenes does not annotate the ego. An untracked row is an instance by itself,
    and so is one whose id stands in its label already.
    """
    rows: list[NuScenesRow] = []
    tracks: dict[str, list[NuScenesRow]] = {}
    for number in range(1, scene.last + 1):
        sample = scene.dataset.sample.get(scene.sample(number))
        if not scene.is_key(number):
            output.leave_out(
                "boxes between keyframes, which readers interpolate", sample["num_annotations"]
            )
            continue
        output.leave_out("labels that are not in this release", not sample["labelled"])
        for row in _annotations(scene, number, output):
            rows.append(row)
            tracks.setdefault(row["instance_token"], []).append(row)
    for track in tracks.values():
        linked(track)
    return {
        "instance": [_instance(track, van) for track in tracks.values()],
        "sample_annotation": rows,
    }


def _annotations(scene: AgentScene, number: int, output: Output) -> Iterator[NuScenesRow]:
    """The row of each box of a keyframe, without the boxes before and after it."""
    sample = scene.sample(number)
    boxes = scene.dataset.boxes(sample)
    derived = scene.dataset.boxes(sample, velocity="derived").velocity
    velocity = np.where(
        np.isnan(derived), boxes.velocity, derived
    )  # an untracked actor has the label's alone
    speed = np.hypot(velocity[:, 0], velocity[:, 1]).tolist()
    seen = {OWN_ACTOR_ID}
    for index, (actor, category) in enumerate(
        zip(boxes.actor_id.tolist(), boxes.category_names, strict=True)
    ):
        if actor == OWN_ACTOR_ID:
            output.leave_out("boxes of the recording agents themselves")
            continue
        own = token("sample_annotation", sample, boxes.row.item(index))
        alone = actor == UNTRACKED_ID or actor in seen
        output.leave_out("tracks of untracked boxes (each is an instance of its own)", alone)
        seen.add(actor)
        length, width, height = boxes.size[index].tolist()
        yield {
            "token": own,
            "sample_token": token("sample", sample),
            "instance_token": token(
                "instance", *((own,) if alone else (scene.scenario, scene.agent, actor))
            ),
            "visibility_token": _SEEN[boxes.camera_visible.item(index)],
            "attribute_tokens": [
                token("attribute", name) for name in _attributes(category, actor, speed[index])
            ],
            "translation": boxes.center[index].tolist(),
            "size": [width, length, height],
            "rotation": boxes.rotation[index].tolist(),
            "num_lidar_pts": boxes.num_lidar_pts.item(index),
            "num_radar_pts": 0,
            "actor_id": actor,
            "category_deepaccident": category,
        }


def _attributes(category: str, actor: int, speed: float) -> list[str]:
    """The word of nuScenes for what an actor of our class does, as a list; none where an unknown speed would decide."""
    if category in ("motorcycle", "cyclist"):
        return ["cycle.with_rider"]
    if category != "pedestrian" and actor >= STATIC_ACTOR_ID:
        return ["vehicle.parked"]
    if np.isnan(speed):
        return []
    if category == "pedestrian":
        return ["pedestrian.moving" if speed > _MOVING else "pedestrian.standing"]
    return ["vehicle.moving" if speed > _MOVING else "vehicle.stopped"]


def _instance(rows: list[NuScenesRow], van: Van) -> NuScenesRow:
    """The row of an actor in a scene; its class is that of its first box."""
    category = rows[0]["category_deepaccident"]
    return {
        "token": rows[0]["instance_token"],
        "category_token": token(
            "category", NUSCENES_CATEGORIES[van if category == "van" else category]
        ),
        "nbr_annotations": len(rows),
        "first_annotation_token": rows[0]["token"],
        "last_annotation_token": rows[-1]["token"],
        "actor_id": rows[0]["actor_id"],
        "category_deepaccident": category,
    }


def write_sensors(scene: AgentScene, axes: LidarAxes, output: Output) -> _RowsByTable:
    """Write the clouds of a scene, link its images, and return the rows of `sample_data` and `calibrated_sensor`.

    Files that are missing in a partial release have rows too, as those of a partial nuScenes download: evaluations look
    up every keyframe's `LIDAR_TOP`, but open no cloud. A missing image has the size of the camera's first one.
    """
    data: list[NuScenesRow] = []
    calibrated: dict[str, NuScenesRow] = {}
    for channel, files in scene.files.items():
        rows, any_file = [], next(iter(files.values()), None)
        for number in scene.frames:
            source = sample_data_token(scene.sample(number), channel)
            record = scene.dataset.sample_data.get(source)
            lens = (
                None
                if channel == LIDAR
                else stored_camera(scene.dataset, source, files.get(number, any_file))
            )
            sensor = record["calibrated_sensor_token"]
            if lens is not None and (lens.width, lens.height) != (
                record["width"],
                record["height"],
            ):
                sensor = f"{sensor} {lens.width} x {lens.height}"  # with a K of its own
            if sensor not in calibrated:
                calibrated[sensor] = _calibrated_row(
                    scene, record["calibrated_sensor_token"], sensor, lens, axes
                )
            path = sensor_path(scene.name, channel, scene.stamp(number), key=scene.is_key(number))
            rows.append(_data_row(scene, number, channel, sensor, path, lens))
            if number not in files:
                continue
            if channel == LIDAR:
                output.write(path, _cloud(files[number][0], axes))
            else:
                output.link(files[number][0], path)
        data += linked(rows)
        what = "point clouds" if channel == LIDAR else "images"
        output.leave_out(
            f"{what} that are not in this release (the tables name them)", len(rows) - len(files)
        )
    bev = sensor_files(scene.dataset, scene.scenario, scene.agent, BEV_CAMERA)
    output.leave_out("files of the BEV camera", len(bev))
    return {"sample_data": data, "calibrated_sensor": list(calibrated.values())}


def _data_row(
    scene: AgentScene, number: int, channel: str, sensor: str, path: str, lens: PinholeCamera | None
) -> NuScenesRow:
    sample = scene.sample(number)
    return {
        "token": token("sample_data", sample, channel),
        "sample_token": token("sample", scene.key_of(number)),
        "ego_pose_token": token("ego_pose", sample),
        "calibrated_sensor_token": token("calibrated_sensor", sensor),
        "timestamp": scene.stamp(number),
        "fileformat": _ENDINGS[channel].removesuffix(".bin"),
        "is_key_frame": scene.is_key(number),
        "height": 0 if lens is None else lens.height,
        "width": 0 if lens is None else lens.width,
        "filename": path,
    }


def _calibrated_row(
    scene: AgentScene, source: str, name: str, lens: PinholeCamera | None, axes: LidarAxes
) -> NuScenesRow:
    """The row of our calibrated sensor `source`, whose token is made of `name`; a camera has the K of its images."""
    record = scene.dataset.calibrated_sensor.get(source)
    rotation, intrinsic = record["rotation"], []
    if lens is None:
        rotation = quaternions.from_matrix(
            quaternions.to_matrix(rotation) @ AXES_ROTATIONS[axes].T
        ).tolist()
    else:
        intrinsic = lens.intrinsic.tolist()
    return {
        "token": token("calibrated_sensor", name),
        "sensor_token": token("sensor", CHANNEL_NAMES[record["sensor_token"]]),
        "translation": record["translation"],
        "rotation": rotation,
        "camera_intrinsic": intrinsic,
    }


def _cloud(path: ReleasePath, axes: LidarAxes) -> bytes:
    """The content of a `.pcd.bin`: x, y, z, intensity, ring (0), in the LiDAR's frame with these axes."""
    cloud = read_lidar(path)
    points = np.zeros((len(cloud), 5), dtype="<f4")
    points[:, :3] = cloud.xyz @ AXES_ROTATIONS[axes].T
    points[:, 3] = cloud.intensity
    return points.tobytes()
