"""A scene of nuScenes, which is one agent's recording of a scenario: its rows, boxes and files.

mmdet3d's infos refer to the same files by the same names. All names depend only on the release, so
that partial exports agree with a complete one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from deepaccident_devkit.export.frames import (
    FrameFiles,
    SensorFile,
    keyframes,
    load_camera,
    next_keyframe,
    select_files,
    sensor_files,
)
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
"""nuScenes' channel for each camera."""
CHANNEL_NAMES: Final = MappingProxyType({**CAMERA_CHANNELS, LIDAR: LIDAR_CHANNEL})
_SUFFIXES = MappingProxyType({**dict.fromkeys(CAMERAS, "jpg"), LIDAR: "pcd.bin"})
_EPOCH_US = 1_600_000_000_000_000
_HOUR_US = 3_600_000_000
_FRAME_PERIOD_US = 100_000
NuScenesRow = dict[str, Any]
# Rows of each table in order, by table.
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
"""nuScenes' category for each DeepAccident class; vans become one of the first two."""
# nuScenes' visibility token, by whether a camera of the agent sees the box; the levels in between
# cannot be known.
_VISIBILITY_TOKENS = MappingProxyType({True: "4", False: "1"})
# Speed above which an actor moves.
_MIN_MOVING_SPEED_MPS = 0.2
LidarAxes = Literal["ego", "nuscenes"]
AXES_ROTATIONS: Final = {
    "ego": np.eye(3),
    "nuscenes": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
"""Rotation from x forward, y left to each kind of axes; nuScenes' are x right, y forward."""


def token(kind: str, *parts: object) -> str:
    """Return a token of 32 hexadecimal digits for a row of a table, made from its identity.

    Args:
        kind: Name of the table.
        *parts: Values that identify the row.
    """
    identity = "/".join(map(str, (kind, *parts)))
    return hashlib.md5(identity.encode(), usedforsecurity=False).hexdigest()


def build_sensor_path(scene: str, channel: str, timestamp: int, *, is_key: bool) -> str:
    """Return the path of a sensor file within the export; `channel` is DeepAccident's name."""
    name = CHANNEL_NAMES[channel]
    if is_key:
        folder = "samples"
    else:
        folder = "sweeps"
    return f"{folder}/{name}/{scene}__{name}__{timestamp}.{_SUFFIXES[channel]}"


@dataclass(frozen=True)
class AgentScene:
    """One agent's recording of a scenario.

    Attributes:
        dataset: The release.
        scenario: Token of the scenario.
        agent: Name of the agent.
        sweeps: Whether to also export the frames between keyframes.
    """

    dataset: Dataset
    scenario: str
    agent: str
    sweeps: bool

    @property
    def name(self) -> str:
        """Name in the table `scene` and in `splits.json`: `<type>-<scenario>-<agent>`."""
        prefix = self.scenario.replace("/", "-")
        return f"{prefix}-{self.agent}"

    @cached_property
    def last_frame(self) -> int:
        """Number of the last frame of the scenario."""
        count: int = self.dataset.scenario.get(self.scenario)["num_frames"]
        return count

    @cached_property
    def frames(self) -> range:
        """Numbers of the exported frames."""
        if self.sweeps:
            return range(1, self.last_frame + 1)
        return keyframes(self.last_frame)

    @cached_property
    def files(self) -> Mapping[str, FrameFiles]:
        """Path and bytes of each existing file, by channel, then by exported frame."""
        files = {}
        for channel in CHANNEL_NAMES:
            all_files = sensor_files(self.dataset, self.scenario, self.agent, channel)
            files[channel] = select_files(all_files, self.frames)
        return files

    def is_key(self, number: int) -> bool:
        """Return whether a frame is a keyframe."""
        return next_keyframe(number, self.last_frame) == number

    def find_key_sample(self, number: int) -> str:
        """Return the devkit's token of a frame's keyframe: the frame itself or the next keyframe.

        The nuScenes devkit interpolates the boxes of a sweep between the keyframe before its sample
        and its sample.
        """
        return self.sample(next_keyframe(number, self.last_frame))

    def sample(self, number: int) -> str:
        """Return the devkit's token of the sample at a frame."""
        return sample_token(self.scenario, self.agent, number)

    def timestamp(self, number: int) -> int:
        """Return the time of a frame in microseconds.

        Each scenario starts in a different hour, and each agent starts a microsecond after the
        previous one. All times are therefore different, which matters because the nuScenes devkit
        sorts scenes by their first timestamp.
        """
        scenario_number = self.dataset.getind("scenario", self.scenario) + 1
        start = _EPOCH_US + scenario_number * _HOUR_US
        return start + number * _FRAME_PERIOD_US + AGENTS.index(self.agent)

    def make_rows(self) -> _RowsByTable:
        """Return the rows of `scene`, `log`, `sample` and `ego_pose`."""
        record = self.dataset.scenario.get(self.scenario)
        recording = agent_token(self.scenario, self.agent)
        scene = token("scene", recording)
        log = token("log", recording)
        samples = link_rows(
            [self._make_sample_row(number, scene) for number in keyframes(self.last_frame)]
        )
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
        poses = list(map(self._make_pose_row, self.frames))
        return {"scene": [scene_row], "log": [log_row], "sample": samples, "ego_pose": poses}

    def _make_sample_row(self, number: int, scene: str) -> NuScenesRow:
        sample = self.sample(number)
        return {
            "token": token("sample", sample),
            "timestamp": self.timestamp(number),
            "scene_token": scene,
            "agent": self.agent,
            "time_to_impact": self.dataset.sample.get(sample)["time_to_impact"],
            "deepaccident_token": sample,
        }

    def _make_pose_row(self, number: int) -> NuScenesRow:
        pose = self.dataset.ego_pose.get(self.sample(number))
        return {
            "token": token("ego_pose", self.sample(number)),
            "timestamp": self.timestamp(number),
            "translation": pose["translation"],
            "rotation": pose["rotation"],
        }


def find_scenes(
    dataset: Dataset, scenario: str, agents: Sequence[str], *, sweeps: bool
) -> Iterator[AgentScene]:
    """Yield the scenes of the agents that recorded a scenario."""
    for agent in agents_of(dataset, scenario):
        if agent in agents:
            yield AgentScene(dataset, scenario, agent, sweeps)


def link_rows(rows: list[NuScenesRow]) -> list[NuScenesRow]:
    """Add the tokens of the neighbours to rows as `prev` and `next`, and return the rows.

    At the ends the token is empty.
    """
    tokens = ["", *(row["token"] for row in rows), ""]
    for row, before, after in zip(rows, tokens, tokens[2:], strict=False):
        row["prev"] = before
        row["next"] = after
    return rows


def make_box_rows(scene: AgentScene, van: Van, output: Output) -> _RowsByTable:
    """Return the rows of `instance` and `sample_annotation`.

    An actor is a different instance in each scene. The agent's own box is left out, since nuScenes
    does not annotate the ego. An untracked box is an instance by itself, as is a box with an id
    that its label already has.
    """
    rows = []
    tracks: dict[str, list[NuScenesRow]] = {}
    for number in range(1, scene.last_frame + 1):
        sample = scene.dataset.sample.get(scene.sample(number))
        if not scene.is_key(number):
            output.leave_out(
                "boxes between keyframes, which readers interpolate", sample["num_annotations"]
            )
            continue
        output.leave_out("labels that are not in this release", not sample["labelled"])
        for row in _make_annotations(scene, number, output):
            rows.append(row)
            tracks.setdefault(row["instance_token"], []).append(row)
    for track in tracks.values():
        link_rows(track)
    instances = [_make_instance(track, van) for track in tracks.values()]
    return {"instance": instances, "sample_annotation": rows}


def _make_annotations(scene: AgentScene, number: int, output: Output) -> Iterator[NuScenesRow]:
    """Yield the row of each box of a keyframe, without links to the boxes before and after it."""
    sample = scene.sample(number)
    boxes = scene.dataset.boxes(sample)
    derived = scene.dataset.boxes(sample, velocity="derived").velocity
    # An untracked actor only has the velocity of the label.
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
        attributes = _choose_attributes(category, actor, speeds[index])
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


def _choose_attributes(category: str, actor: int, speed: float) -> list[str]:
    """Return a list with the nuScenes attribute of an actor.

    The list is empty if the attribute depends on the speed, and the speed is unknown.

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


def _make_instance(rows: list[NuScenesRow], van: Van) -> NuScenesRow:
    """Make the `instance` row of an actor in a scene, with the class of its first box."""
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
    release have rows too, as in a partial nuScenes download, because evaluations look up the
    `LIDAR_TOP` of every keyframe but open no cloud. A missing image has the size of the camera's
    first image.
    """
    data: list[NuScenesRow] = []
    calibrated: dict[str, NuScenesRow] = {}
    for channel, files in scene.files.items():
        rows = []
        default_file = next(iter(files.values()), None)
        for number in scene.frames:
            file = files.get(number, default_file)
            sensor, lens = _add_sensor(scene, number, channel, file, axes, calibrated)
            path = build_sensor_path(
                scene.name, channel, scene.timestamp(number), is_key=scene.is_key(number)
            )
            rows.append(_make_data_row(scene, number, channel, sensor, path, lens))
            if number not in files:
                continue
            source_path, _ = files[number]
            if channel == LIDAR:
                output.write(path, _encode_cloud(source_path, axes))
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
    file: SensorFile | None,
    axes: LidarAxes,
    calibrated: dict[str, NuScenesRow],
) -> tuple[str, PinholeCamera | None]:
    """Add the row of the calibrated sensor of a file, if it is new.

    Returns:
        The name of the sensor, and the camera; None for the LiDAR.
    """
    source = sample_data_token(scene.sample(number), channel)
    record = scene.dataset.sample_data.get(source)
    lens = None if channel == LIDAR else load_camera(scene.dataset, source, file)
    sensor = record["calibrated_sensor_token"]
    if lens is not None and (lens.width, lens.height) != (record["width"], record["height"]):
        sensor = f"{sensor} {lens.width} x {lens.height}"  # It has a K of its own.
    if sensor not in calibrated:
        calibrated[sensor] = _make_calibrated_row(
            scene, record["calibrated_sensor_token"], sensor, lens, axes
        )
    return sensor, lens


def _make_data_row(
    scene: AgentScene, number: int, channel: str, sensor: str, path: str, lens: PinholeCamera | None
) -> NuScenesRow:
    sample = scene.sample(number)
    return {
        "token": token("sample_data", sample, channel),
        "sample_token": token("sample", scene.find_key_sample(number)),
        "ego_pose_token": token("ego_pose", sample),
        "calibrated_sensor_token": token("calibrated_sensor", sensor),
        "timestamp": scene.timestamp(number),
        "fileformat": _SUFFIXES[channel].removesuffix(".bin"),
        "is_key_frame": scene.is_key(number),
        "height": 0 if lens is None else lens.height,
        "width": 0 if lens is None else lens.width,
        "filename": path,
    }


def _make_calibrated_row(
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
    rotation = record["rotation"]
    intrinsic = []
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


def _encode_cloud(path: ReleasePath, axes: LidarAxes) -> bytes:
    """Encode a cloud as a `.pcd.bin` file, in the LiDAR frame with these axes.

    Each point has the values x, y, z, intensity and ring (always 0).
    """
    cloud = read_lidar(path)
    points = np.zeros((len(cloud), 5), dtype="<f4")
    points[:, :3] = cloud.xyz @ AXES_ROTATIONS[axes].T
    points[:, 3] = cloud.intensity
    return points.tobytes()
