"""A scene, one agent's recording of a scenario, as nuScenes rows of it, its boxes and sensor files.

mmdet3d's infos refer to the same files by the same names. All names depend only on the release, so
that exports of parts agree with a complete export.
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
"""Camera → nuScenes' channel."""
CHANNEL_NAMES: Final = MappingProxyType({**CAMERA_CHANNELS, LIDAR: LIDAR_CHANNEL})
_SUFFIXES: Final = MappingProxyType({**dict.fromkeys(CAMERAS, "jpg"), LIDAR: "pcd.bin"})
_EPOCH_US: Final = 1_600_000_000_000_000
_HOUR_US: Final = 3_600_000_000
_FRAME_PERIOD_US: Final = 100_000
NuScenesRow = dict[str, Any]
# Table → its rows in order.
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
"""Class of DeepAccident → nuScenes' category; vans become one of the first two."""
# Whether a camera of the agent sees a box → nuScenes' visibility; the intermediate levels are
# unknown.
_VISIBILITY_TOKENS: Final = MappingProxyType({True: "4", False: "1"})
# Speed above which an actor moves.
_MIN_MOVING_SPEED_MPS: Final = 0.2
LidarAxes = Literal["ego", "nuscenes"]
AXES_ROTATIONS: Final = {
    "ego": np.eye(3),
    "nuscenes": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
"""Axes → rotation into them from x forward and y left; nuScenes' LiDAR has x right, y forward."""


def token(kind: str, *parts: object) -> str:
    """Return a token of 32 hexadecimal digits for a row of a table, from its identity.

    Args:
        kind: Name of the table.
        *parts: Values that identify the row.
    """
    return hashlib.md5(
        "/".join(map(str, (kind, *parts))).encode(), usedforsecurity=False
    ).hexdigest()


def sensor_path(scene: str, channel: str, stamp: int, *, key: bool) -> str:
    """Return the path of a sensor file in the folder; `channel` is DeepAccident's."""
    name = CHANNEL_NAMES[channel]
    folder = "samples" if key else "sweeps"
    return f"{folder}/{name}/{scene}__{name}__{stamp}.{_SUFFIXES[channel]}"


@dataclass(frozen=True)
class AgentScene:
    """One agent's recording of a scenario.

    Attributes:
        dataset: The release.
        scenario: Token of the scenario.
        agent: Name of the agent.
        sweeps: Whether the frames between keyframes are exported too.
    """

    dataset: Dataset
    scenario: str
    agent: str
    sweeps: bool

    @property
    def name(self) -> str:
        """Name in the table `scene` and in `splits.json`: `<type>-<scenario>-<agent>`."""
        return f"{self.scenario.replace('/', '-')}-{self.agent}"

    @cached_property
    def last(self) -> int:
        """Number of the last frame."""
        count: int = self.dataset.scenario.get(self.scenario)["num_frames"]
        return count

    @cached_property
    def frames(self) -> range:
        """Numbers of the exported frames."""
        if self.sweeps:
            return range(1, self.last + 1)
        return keyframes(self.last)

    @cached_property
    def files(self) -> Mapping[str, Mapping[int, tuple[ReleasePath, int]]]:
        """Channel → number of an exported frame → path and bytes of the file, where it exists."""
        files = {}
        for channel in CHANNEL_NAMES:
            all_files = sensor_files(self.dataset, self.scenario, self.agent, channel)
            files[channel] = {
                number: all_files[number] for number in self.frames if number in all_files
            }
        return files

    def is_key(self, number: int) -> bool:
        """Return whether a frame is a keyframe."""
        return keyframe_after(number, self.last) == number

    def key_of(self, number: int) -> str:
        """Return the devkit's token of the sample of a frame: that of the keyframe it leads to.

        The nuScenes devkit interpolates boxes of a sweep from the keyframe before its sample to its
        sample.
        """
        return self.sample(keyframe_after(number, self.last))

    def sample(self, number: int) -> str:
        """Return the devkit's token of a frame's sample."""
        return sample_token(self.scenario, self.agent, number)

    def stamp(self, number: int) -> int:
        """Return the time of a frame in microseconds.

        Each scenario has an hour of its own, and each agent starts a microsecond after the previous
        one. The devkit of nuScenes sorts scenes by their first time, so all times differ.
        """
        hours = self.dataset.getind("scenario", self.scenario) + 1
        return _EPOCH_US + hours * _HOUR_US + number * _FRAME_PERIOD_US + AGENTS.index(self.agent)

    def rows(self) -> _RowsByTable:
        """Return the rows of `scene`, `log`, `sample` and `ego_pose`."""
        record = self.dataset.scenario.get(self.scenario)
        scene = token("scene", agent_token(self.scenario, self.agent))
        log = token("log", agent_token(self.scenario, self.agent))
        samples = link_rows([self._sample_row(number, scene) for number in keyframes(self.last)])
        facts = [record["town"], record["weather"], record["time_of_day"], record["road_type"]]
        if record["collision"]:
            facts.append("collision")
        scene_row = {
            "token": scene,
            "log_token": log,
            "nbr_samples": len(samples),
            "first_sample_token": samples[0]["token"],
            "last_sample_token": samples[-1]["token"],
            "name": self.name,
            "description": ", ".join(filter(None, facts)),
            "agent": self.agent,
            "split": record["split"],
        }
        log_row = {
            "token": log,
            "logfile": self.scenario,
            "vehicle": self.agent,
            "date_captured": "",
            "location": record["town"],
        }
        poses = list(map(self._pose_row, self.frames))
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
    """Return an iterator over the scenes of the selected agents that recorded a scenario."""
    return (
        AgentScene(dataset, scenario, agent, sweeps)
        for agent in agents_of(dataset, scenario)
        if agent in agents
    )


def link_rows(rows: list[NuScenesRow]) -> list[NuScenesRow]:
    """Return the same rows with the tokens of their neighbours as `prev` and `next`.

    They are empty at the ends.
    """
    tokens = ["", *(row["token"] for row in rows), ""]
    for row, before, after in zip(rows, tokens, tokens[2:], strict=False):
        row["prev"], row["next"] = before, after
    return rows


def box_rows(scene: AgentScene, van: Van, output: Output) -> _RowsByTable:
    """Return the rows of `instance` and `sample_annotation`.

    An actor has an instance of its own in each scene. The agent's own row is left out, as nuScenes
    does not annotate the ego. An untracked row is an instance by itself, and so is one with an id
    that its label has already.
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
        link_rows(track)
    instances = [_instance(track, van) for track in tracks.values()]
    return {"instance": instances, "sample_annotation": rows}


def _annotations(scene: AgentScene, number: int, output: Output) -> Iterator[NuScenesRow]:
    """Yield the row of each box of a keyframe, without the boxes before and after it."""
    sample = scene.sample(number)
    boxes = scene.dataset.boxes(sample)
    derived = scene.dataset.boxes(sample, velocity="derived").velocity
    # an untracked actor has only the label's velocity
    velocity = np.where(np.isnan(derived), boxes.velocity, derived)
    speeds = np.hypot(velocity[:, 0], velocity[:, 1]).tolist()
    track_ids = {OWN_ACTOR_ID}
    actors = zip(boxes.actor_id.tolist(), boxes.category_names, strict=True)
    for index, (actor, category) in enumerate(actors):
        if actor == OWN_ACTOR_ID:
            output.leave_out("boxes of the recording agents themselves")
            continue
        annotation = token("sample_annotation", sample, boxes.row.item(index))
        is_untracked = actor == UNTRACKED_ID or actor in track_ids
        output.leave_out("tracks of untracked boxes (each is an instance of its own)", is_untracked)
        track_ids.add(actor)
        instance_key = (annotation,) if is_untracked else (scene.scenario, scene.agent, actor)
        attributes = _attributes(category, actor, speeds[index])
        length, width, height = boxes.size[index].tolist()
        yield {
            "token": annotation,
            "sample_token": token("sample", sample),
            "instance_token": token("instance", *instance_key),
            "visibility_token": _VISIBILITY_TOKENS[boxes.camera_visible.item(index)],
            "attribute_tokens": [token("attribute", name) for name in attributes],
            "translation": boxes.center[index].tolist(),
            "size": [width, length, height],
            "rotation": boxes.rotation[index].tolist(),
            "num_lidar_pts": boxes.num_lidar_pts.item(index),
            "num_radar_pts": 0,
            "actor_id": actor,
            "category_deepaccident": category,
        }


def _attributes(category: str, actor: int, speed: float) -> list[str]:
    """Return nuScenes' attribute of an actor as a list.

    The list is empty if the attribute depends on an unknown speed.

    Args:
        category: Class of DeepAccident.
        actor: Id of the actor.
        speed: Speed in m/s; NaN if unknown.
    """
    if category in ("motorcycle", "cyclist"):
        return ["cycle.with_rider"]
    if category != "pedestrian" and actor >= STATIC_ACTOR_ID:
        return ["vehicle.parked"]
    if np.isnan(speed):
        return []
    is_moving = speed > _MIN_MOVING_SPEED_MPS
    if category == "pedestrian":
        return ["pedestrian.moving" if is_moving else "pedestrian.standing"]
    return ["vehicle.moving" if is_moving else "vehicle.stopped"]


def _instance(rows: list[NuScenesRow], van: Van) -> NuScenesRow:
    """Return the row of an actor in a scene; its class is that of its first box."""
    category = rows[0]["category_deepaccident"]
    nuscenes_category = NUSCENES_CATEGORIES[van if category == "van" else category]
    return {
        "token": rows[0]["instance_token"],
        "category_token": token("category", nuscenes_category),
        "nbr_annotations": len(rows),
        "first_annotation_token": rows[0]["token"],
        "last_annotation_token": rows[-1]["token"],
        "actor_id": rows[0]["actor_id"],
        "category_deepaccident": category,
    }


def write_sensors(scene: AgentScene, axes: LidarAxes, output: Output) -> _RowsByTable:
    """Write the clouds of a scene, link its images, and return their rows.

    The rows belong to `sample_data` and `calibrated_sensor`. Files that are missing in a partial
    release have rows too, as in a partial nuScenes download: evaluations look up every keyframe's
    `LIDAR_TOP`, but open no cloud. A missing image has the size of the camera's first one.
    """
    data: list[NuScenesRow] = []
    calibrated: dict[str, NuScenesRow] = {}
    for channel, files in scene.files.items():
        rows = []
        default_file = next(iter(files.values()), None)
        for number in scene.frames:
            file = files.get(number, default_file)
            sensor, lens = _add_sensor(scene, number, channel, file, axes, calibrated)
            path = sensor_path(scene.name, channel, scene.stamp(number), key=scene.is_key(number))
            rows.append(_data_row(scene, number, channel, sensor, path, lens))
            if number not in files:
                continue
            source_path, _ = files[number]
            if channel == LIDAR:
                output.write(path, _cloud_bytes(source_path, axes))
            else:
                output.link(source_path, path)
        data += link_rows(rows)
        kind = "point clouds" if channel == LIDAR else "images"
        output.leave_out(
            f"{kind} that are not in this release (the tables name them)", len(rows) - len(files)
        )
    bev_files = sensor_files(scene.dataset, scene.scenario, scene.agent, BEV_CAMERA)
    output.leave_out("files of the BEV camera", len(bev_files))
    return {"sample_data": data, "calibrated_sensor": list(calibrated.values())}


def _add_sensor(
    scene: AgentScene,
    number: int,
    channel: str,
    file: tuple[ReleasePath, int] | None,
    axes: LidarAxes,
    calibrated: dict[str, NuScenesRow],
) -> tuple[str, PinholeCamera | None]:
    """Add the row of a file's calibrated sensor if it is new.

    Returns:
        The name of the sensor, and the camera; None for the LiDAR.
    """
    source = sample_data_token(scene.sample(number), channel)
    record = scene.dataset.sample_data.get(source)
    lens = None if channel == LIDAR else stored_camera(scene.dataset, source, file)
    sensor = record["calibrated_sensor_token"]
    if lens is not None and (lens.width, lens.height) != (record["width"], record["height"]):
        sensor = f"{sensor} {lens.width} x {lens.height}"  # with a K of its own
    if sensor not in calibrated:
        calibrated[sensor] = _calibrated_row(
            scene, record["calibrated_sensor_token"], sensor, lens, axes
        )
    return sensor, lens


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
        "fileformat": _SUFFIXES[channel].removesuffix(".bin"),
        "is_key_frame": scene.is_key(number),
        "height": 0 if lens is None else lens.height,
        "width": 0 if lens is None else lens.width,
        "filename": path,
    }


def _calibrated_row(
    scene: AgentScene, source: str, name: str, lens: PinholeCamera | None, axes: LidarAxes
) -> NuScenesRow:
    """Return the row of a calibrated sensor.

    Args:
        scene: The scene.
        source: Token of the sensor in the release.
        name: Name that its nuScenes token is made from.
        lens: The camera, with the K of its images; None for the LiDAR.
        axes: Axes of the LiDAR.
    """
    record = scene.dataset.calibrated_sensor.get(source)
    rotation, intrinsic = record["rotation"], []
    if lens is None:
        matrix = quaternions.to_matrix(rotation) @ AXES_ROTATIONS[axes].T
        rotation = quaternions.from_matrix(matrix).tolist()
    else:
        intrinsic = lens.intrinsic.tolist()
    return {
        "token": token("calibrated_sensor", name),
        "sensor_token": token("sensor", CHANNEL_NAMES[record["sensor_token"]]),
        "translation": record["translation"],
        "rotation": rotation,
        "camera_intrinsic": intrinsic,
    }


def _cloud_bytes(path: ReleasePath, axes: LidarAxes) -> bytes:
    """Return the content of a `.pcd.bin` with points in the LiDAR frame with these axes.

    The values are x, y, z, intensity, and ring (0).
    """
    cloud = read_lidar(path)
    points = np.zeros((len(cloud), 5), dtype="<f4")
    points[:, :3] = cloud.xyz @ AXES_ROTATIONS[axes].T
    points[:, 3] = cloud.intensity
    return points.tobytes()
