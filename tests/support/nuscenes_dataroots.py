"""Small handwritten dataroots in nuScenes' format, with keyframes at uneven times, sweeps, and
classes that DeepAccident lacks.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from pyquaternion import Quaternion

CLASSES = (
    *("vehicle.car", "vehicle.truck", "vehicle.bicycle", "human.pedestrian.adult"),
    *("vehicle.bus.rigid", "movable_object.barrier", "movable_object.trafficcone", "animal"),
)
"""Four classes that DeepAccident has, then four that are ignored."""
POINT_COUNTS = CLASSES[:4]
CAMERA_ROTATIONS = {
    "CAM_FRONT": 0,
    "CAM_FRONT_RIGHT": -55,
    "CAM_BACK_RIGHT": -110,
    "CAM_BACK": 180,
    "CAM_BACK_LEFT": 110,
    "CAM_FRONT_LEFT": 55,
}
SENSORS = ("LIDAR_TOP", *CAMERA_ROTATIONS)
WIDTH, HEIGHT = 160, 90
OPTICAL_AXES = Quaternion(matrix=np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
"""Rotation from a camera's axes to x forward, y left."""
Row = dict[str, Any]
EgoPose = tuple[np.ndarray, Quaternion]
"""Position in metres and rotation of the ego vehicle in the world."""
Images = Literal["none", "noise", "fractal"]


@dataclass
class Dataroot:
    """The tables of a dataroot.

    Attributes:
        folder: Dataroot.
        version: Version, which names the folder of the tables.
        tables: Rows by table.
        rng: Source of random numbers.
    """

    folder: Path
    version: str
    tables: dict[str, list[Row]] = field(default_factory=dict)
    rng: np.random.Generator = field(default_factory=np.random.default_rng)

    @property
    def tables_folder(self) -> Path:
        return self.folder / self.version

    def add(self, table: str, token: str, **fields: Any) -> Row:
        row = {"token": token, **fields}
        self.tables.setdefault(table, []).append(row)
        return row

    def write(self) -> Path:
        """Write the tables; instances and annotations get a file even if there are none."""
        self.tables_folder.mkdir(parents=True, exist_ok=True)
        for name in ("instance", "sample_annotation"):
            self.tables.setdefault(name, [])
        for name, rows in self.tables.items():
            (self.tables_folder / f"{name}.json").write_text(json.dumps(rows))
        return self.folder


def write_dataroot(
    folder: Path,
    *,
    version: str = "v1.0-trainval",
    splits: tuple[str, ...] = ("train", "train", "val"),
    keyframes: int = 5,
    boxes: int = 16,
    images: Images = "none",
    points: bool = False,
    seed: int = 0,
) -> Dataroot:
    """Write a scene for each split; without boxes nothing is annotated, as in v1.0-test."""
    dataroot = Dataroot(folder, version, rng=np.random.default_rng(seed))
    for category in CLASSES:
        dataroot.add("category", category, name=category)
    dataroot.add("attribute", "moving", name="vehicle.moving")
    dataroot.add("visibility", "1", level="v0-40")
    road_map = dataroot.add(
        "map", "map", category="semantic_prior", log_tokens=[], filename="maps/road.png"
    )
    for sensor in SENSORS:
        modality = "lidar" if sensor == "LIDAR_TOP" else "camera"
        dataroot.add("sensor", sensor, channel=sensor, modality=modality)

    scenes: dict[str, list[str]] = {}
    for number, split in enumerate(splits):
        scene = f"scene-{number:04d}"
        scenes.setdefault(split, []).append(scene)
        _write_scene(dataroot, scene, keyframes, boxes, images, points=points)
        road_map["log_tokens"].append(f"{scene}-log")
    dataroot.write()
    (folder / "maps").mkdir()
    cv2.imwrite(str(folder / "maps" / "road.png"), np.zeros((8, 8), dtype=np.uint8))
    (dataroot.tables_folder / "splits.json").write_text(json.dumps(scenes))
    return dataroot


def _write_scene(
    dataroot: Dataroot, scene: str, keyframes: int, boxes: int, images: Images, *, points: bool
) -> None:
    rng = dataroot.rng
    gaps_us = np.append(0, rng.integers(420_000, 600_000, keyframes - 1))
    times_us = (1_500_000_000_000_000 + np.cumsum(gaps_us)).tolist()
    samples = [f"{scene}-{number}" for number in range(keyframes)]
    _add_samples(dataroot, scene, samples, times_us)
    start = rng.uniform(300, 900, 2)
    speed = rng.uniform(4, 9)
    turn_rate = rng.uniform(-0.1, 0.1)
    start_heading = rng.uniform(-3, 3)

    def ego_pose(time_us: float) -> EgoPose:
        seconds = (time_us - times_us[0]) * 1e-6
        mean_heading = start_heading + turn_rate * seconds / 2
        direction = np.array([np.cos(mean_heading), np.sin(mean_heading)])
        position = np.append(start + speed * seconds * direction, 0.0)
        heading = start_heading + turn_rate * seconds
        return position, Quaternion(axis=[0, 0, 1], radians=heading)

    annotations = []
    for number in range(boxes):
        track = f"{scene}-actor{number}"
        annotations.extend(_write_track(dataroot, track, samples, times_us, start))

    for sensor in SENSORS:
        _write_mount(dataroot, f"{scene}-{sensor}", sensor)
        for number, sample in enumerate(samples):
            time_us = times_us[number]
            keyframe = _add_file(dataroot, scene, sample, sensor, time_us, ego_pose(time_us))
            if number < keyframes - 1:
                sweep_us = time_us + 100_000
                pose = ego_pose(sweep_us)
                _add_file(dataroot, scene, sample, sensor, sweep_us, pose, is_key_frame=False)
            if sensor == "LIDAR_TOP" and points:
                present = [row for row in annotations if row["sample_token"] == sample]
                _write_cloud(dataroot, keyframe, present, ego_pose(time_us))
            elif sensor != "LIDAR_TOP" and images != "none":
                path = dataroot.folder / keyframe["filename"]
                path.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(path), _image(rng, images))


def _add_samples(dataroot: Dataroot, scene: str, samples: list[str], times_us: list[int]) -> None:
    """Add a scene, its log and its samples."""
    dataroot.add("log", f"{scene}-log", location="singapore-onenorth")
    dataroot.add(
        "scene",
        scene,
        name=scene,
        log_token=f"{scene}-log",
        nbr_samples=len(samples),
        first_sample_token=samples[0],
        last_sample_token=samples[-1],
    )
    for number, sample in enumerate(samples):
        dataroot.add(
            "sample",
            sample,
            timestamp=times_us[number],
            scene_token=scene,
            prev=samples[number - 1] if number else "",
            next=(*samples, "")[number + 1],
        )


def _add_file(
    dataroot: Dataroot,
    scene: str,
    sample: str,
    sensor: str,
    time_us: int,
    ego_pose: EgoPose,
    *,
    is_key_frame: bool = True,
) -> Row:
    """Add a sensor file and the ego pose at its time."""
    position, rotation = ego_pose
    is_lidar = sensor == "LIDAR_TOP"
    token = f"{sample}-{sensor}-{time_us}"
    subfolder = "samples" if is_key_frame else "sweeps"
    ending = "pcd.bin" if is_lidar else "jpg"
    dataroot.add(
        "ego_pose", token, translation=position.tolist(), rotation=rotation.elements.tolist()
    )
    return dataroot.add(
        "sample_data",
        token,
        sample_token=sample,
        ego_pose_token=token,
        calibrated_sensor_token=f"{scene}-{sensor}",
        timestamp=time_us,
        is_key_frame=is_key_frame,
        filename=f"{subfolder}/{sensor}/{token}.{ending}",
        width=0 if is_lidar else WIDTH,
        height=0 if is_lidar else HEIGHT,
    )


def _write_mount(dataroot: Dataroot, token: str, sensor: str) -> None:
    if sensor == "LIDAR_TOP":
        position = [0.9, 0.0, 1.84]
        rotation = Quaternion(axis=[0, 0, 1], degrees=-90)
        intrinsic = []
    else:
        position = [1.0, 0.0, 1.5]
        rotation = Quaternion(axis=[0, 0, 1], degrees=CAMERA_ROTATIONS[sensor]) * OPTICAL_AXES
        intrinsic = [[126.0, 0.0, 80.0], [0.0, 126.0, 45.0], [0.0, 0.0, 1.0]]
    dataroot.add(
        "calibrated_sensor",
        token,
        sensor_token=sensor,
        translation=position,
        rotation=rotation.elements.tolist(),
        camera_intrinsic=intrinsic,
    )


def _write_track(
    dataroot: Dataroot, name: str, samples: list[str], times_us: list[int], scene_start: np.ndarray
) -> list[Row]:
    """Add an actor that drives straight on and is seen at some of the keyframes."""
    rng = dataroot.rng
    category = CLASSES[int(name.rpartition("actor")[2]) % len(CLASSES)]
    numbers = [number for number in range(len(samples)) if rng.random() < 0.9] or [0]
    start = scene_start + rng.uniform(-25, 25, 2)
    heading = rng.uniform(-3, 3)
    speed = rng.uniform(0, 8)
    width, length, height = rng.uniform((1.5, 3.0, 1.2), (2.2, 5.5, 2.2)).tolist()
    tokens = [f"{name}-{number}" for number in numbers]
    dataroot.add("instance", name, category_token=category, nbr_annotations=len(numbers))

    rows = []
    for order, number in enumerate(numbers):
        distance = speed * (times_us[number] - times_us[0]) * 1e-6
        position = start + distance * np.array([np.cos(heading), np.sin(heading)])
        row = dataroot.add(
            "sample_annotation",
            tokens[order],
            sample_token=samples[number],
            instance_token=name,
            visibility_token=str(int(rng.integers(1, 5))),
            attribute_tokens=[],
            translation=[*position.tolist(), height / 2],
            size=[width, length, height],
            rotation=Quaternion(axis=[0, 0, 1], radians=heading).elements.tolist(),
            prev=tokens[order - 1] if order else "",
            next=(*tokens, "")[order + 1],
            num_lidar_pts=int(rng.integers(5, 40)),
            num_radar_pts=0,
        )
        rows.append(row)
    return rows


def _write_cloud(dataroot: Dataroot, row: Row, boxes: list[Row], ego_pose: EgoPose) -> None:
    """Write a point cloud of a flat road with points in each box."""
    rng = dataroot.rng
    position, rotation = ego_pose
    road_points = np.column_stack([rng.uniform(-20, 20, (2000, 2)), np.zeros(2000)])
    parts = [road_points @ rotation.rotation_matrix.T + position]
    for box in boxes:
        length_width_height = np.take(box["size"], [1, 0, 2])
        points = rng.uniform(-0.45, 0.45, (box["num_lidar_pts"], 3)) * length_width_height
        parts.append(points @ Quaternion(box["rotation"]).rotation_matrix.T + box["translation"])

    mounts = {mount["token"]: mount for mount in dataroot.tables["calibrated_sensor"]}
    mount = mounts[row["calibrated_sensor_token"]]
    in_ego = (np.concatenate(parts) - position) @ rotation.rotation_matrix
    in_lidar = (in_ego - mount["translation"]) @ Quaternion(mount["rotation"]).rotation_matrix
    path = dataroot.folder / row["filename"]
    path.parent.mkdir(parents=True, exist_ok=True)
    np.column_stack([in_lidar, np.zeros((len(in_lidar), 2))]).astype("<f4").tofile(path)


def _image(rng: np.random.Generator, images: Images) -> np.ndarray:
    """Draw noise, white or with the falling spectrum of photographs."""
    noise = rng.normal(size=(3, HEIGHT, WIDTH))
    if images == "fractal":
        frequency = np.hypot(np.fft.fftfreq(HEIGHT)[:, None], np.fft.fftfreq(WIDTH))
        frequency[0, 0] = 1
        noise = np.fft.ifft2(np.fft.fft2(noise) / frequency).real
    pixels = np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)
    return pixels.transpose(1, 2, 0)
