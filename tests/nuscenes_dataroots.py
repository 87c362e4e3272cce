"""Small dataroots in nuScenes' format, written by hand: keyframes at odd times, sweeps, and classes
that we lack.
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
"""Ours first, then those that are ignored."""
COUNTED = CLASSES[:4]
LOOKS = {
    "CAM_FRONT": 0,
    "CAM_FRONT_RIGHT": -55,
    "CAM_BACK_RIGHT": -110,
    "CAM_BACK": 180,
    "CAM_BACK_LEFT": 110,
    "CAM_FRONT_LEFT": 55,
}
SENSORS = ("LIDAR_TOP", *LOOKS)
WIDTH, HEIGHT = 160, 90
OPTICAL = Quaternion(matrix=np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
"""From a camera's axes to x forward, y left."""
Row = dict[str, Any]
Images = Literal["none", "noise", "fractal"]


@dataclass
class Dataroot:
    """What is written.

    Attributes:
        folder: the dataroot.
        version: of the tables.
        tables: table → rows.
        rng: random numbers.
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
        """Write the tables, and those that are not used."""
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
    made = Dataroot(folder, version, rng=np.random.default_rng(seed))
    for name in CLASSES:
        made.add("category", name, name=name)
    made.add("attribute", "moving", name="vehicle.moving")
    made.add("visibility", "1", level="v0-40")
    road_map = made.add(
        "map", "map", category="semantic_prior", log_tokens=[], filename="maps/road.png"
    )
    for name in SENSORS:
        made.add(
            "sensor", name, channel=name, modality="lidar" if name == "LIDAR_TOP" else "camera"
        )
    scenes: dict[str, list[str]] = {}
    for number, split in enumerate(splits):
        name = f"scene-{number:04d}"
        scenes.setdefault(split, []).append(name)
        _write_scene(made, name, keyframes, boxes, images, points=points)
        road_map["log_tokens"].append(f"{name}-log")
    made.write()
    (folder / "maps").mkdir()
    cv2.imwrite(str(folder / "maps" / "road.png"), np.zeros((8, 8), dtype=np.uint8))
    (made.tables_folder / "splits.json").write_text(json.dumps(scenes))
    return made


def _write_scene(
    made: Dataroot, name: str, keyframes: int, boxes: int, images: Images, *, points: bool
) -> None:
    rng = made.rng
    gaps = np.append(0, rng.integers(420_000, 600_000, keyframes - 1))
    times = (1_500_000_000_000_000 + np.cumsum(gaps)).tolist()
    samples = [f"{name}-{number}" for number in range(keyframes)]
    made.add("log", f"{name}-log", location="singapore-onenorth")
    made.add(
        "scene",
        name,
        name=name,
        log_token=f"{name}-log",
        nbr_samples=keyframes,
        first_sample_token=samples[0],
        last_sample_token=samples[-1],
    )
    for number, token in enumerate(samples):
        before, after = samples[number - 1] if number else "", (*samples, "")[number + 1]
        made.add(
            "sample", token, timestamp=times[number], scene_token=name, prev=before, next=after
        )
    start, speed, turn = rng.uniform(300, 900, 2), rng.uniform(4, 9), rng.uniform(-0.1, 0.1)
    heading = rng.uniform(-3, 3)

    def ego(time: float) -> tuple[np.ndarray, Quaternion]:
        seconds = (time - times[0]) * 1e-6
        angle = heading + turn * seconds / 2
        place = np.append(start + speed * seconds * np.array([np.cos(angle), np.sin(angle)]), 0.0)
        return place, Quaternion(axis=[0, 0, 1], radians=heading + turn * seconds)

    annotated = [
        row
        for number in range(boxes)
        for row in _write_track(made, f"{name}-actor{number}", samples, times, start)
    ]
    for sensor in SENSORS:
        _write_mount(made, f"{name}-{sensor}", sensor)
        for number, token in enumerate(samples):
            stamps = [times[number], *([times[number] + 100_000] if number < keyframes - 1 else [])]
            for stamp in stamps:
                place, rotation = ego(stamp)
                own = f"{token}-{sensor}-{stamp}"
                made.add(
                    "ego_pose", own, translation=place.tolist(), rotation=rotation.elements.tolist()
                )
                file = f"{'samples' if stamp == times[number] else 'sweeps'}/{sensor}/{own}"
                made.add(
                    "sample_data",
                    own,
                    sample_token=token,
                    ego_pose_token=own,
                    calibrated_sensor_token=f"{name}-{sensor}",
                    timestamp=stamp,
                    is_key_frame=stamp == times[number],
                    filename=f"{file}.{'pcd.bin' if sensor == 'LIDAR_TOP' else 'jpg'}",
                    width=WIDTH if sensor != "LIDAR_TOP" else 0,
                    height=HEIGHT if sensor != "LIDAR_TOP" else 0,
                )
            if sensor == "LIDAR_TOP" and points:
                here = [row for row in annotated if row["sample_token"] == token]
                _write_cloud(
                    made, made.tables["sample_data"][-len(stamps)], here, ego(times[number])
                )
            elif sensor != "LIDAR_TOP" and images != "none":
                path = made.folder / made.tables["sample_data"][-len(stamps)]["filename"]
                path.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(path), _image(rng, images))


def _write_mount(made: Dataroot, token: str, sensor: str) -> None:
    if sensor == "LIDAR_TOP":
        rotation, place, intrinsic = Quaternion(axis=[0, 0, 1], degrees=-90), [0.9, 0.0, 1.84], []
    else:
        rotation = Quaternion(axis=[0, 0, 1], degrees=LOOKS[sensor]) * OPTICAL
        place, intrinsic = (
            [1.0, 0.0, 1.5],
            [[126.0, 0.0, 80.0], [0.0, 126.0, 45.0], [0.0, 0.0, 1.0]],
        )
    made.add(
        "calibrated_sensor",
        token,
        sensor_token=sensor,
        translation=place,
        rotation=rotation.elements.tolist(),
        camera_intrinsic=intrinsic,
    )


def _write_track(
    made: Dataroot, name: str, samples: list[str], times: list[int], start: np.ndarray
) -> list[Row]:
    """An actor that drives straight on, at some of the keyframes."""
    rng = made.rng
    category = CLASSES[int(name.rpartition("actor")[2]) % len(CLASSES)]
    there = [number for number in range(len(samples)) if rng.random() < 0.9] or [0]
    place, angle, speed = start + rng.uniform(-25, 25, 2), rng.uniform(-3, 3), rng.uniform(0, 8)
    width, length, height = rng.uniform((1.5, 3.0, 1.2), (2.2, 5.5, 2.2)).tolist()
    tokens = [f"{name}-{number}" for number in there]
    made.add("instance", name, category_token=category, nbr_annotations=len(there))
    rows = []
    for order, number in enumerate(there):
        way = speed * (times[number] - times[0]) * 1e-6
        here = place + way * np.array([np.cos(angle), np.sin(angle)])
        rows.append(
            made.add(
                "sample_annotation",
                tokens[order],
                sample_token=samples[number],
                instance_token=name,
                visibility_token=str(int(rng.integers(1, 5))),
                attribute_tokens=[],
                translation=[*here.tolist(), height / 2],
                size=[width, length, height],
                rotation=Quaternion(axis=[0, 0, 1], radians=angle).elements.tolist(),
                prev=tokens[order - 1] if order else "",
                next=(*tokens, "")[order + 1],
                num_lidar_pts=int(rng.integers(5, 40)),
                num_radar_pts=0,
            )
        )
    return rows


def _write_cloud(
    made: Dataroot, row: Row, boxes: list[Row], ego: tuple[np.ndarray, Quaternion]
) -> None:
    """A flat road, and points in boxes."""
    rng, (place, rotation) = made.rng, ego
    parts = [
        np.column_stack([rng.uniform(-20, 20, (2000, 2)), np.zeros(2000)])
        @ rotation.rotation_matrix.T
        + place
    ]
    for box in boxes:
        inside = rng.uniform(-0.45, 0.45, (box["num_lidar_pts"], 3)) * np.take(
            box["size"], [1, 0, 2]
        )
        parts.append(inside @ Quaternion(box["rotation"]).rotation_matrix.T + box["translation"])
    mount = next(
        each
        for each in made.tables["calibrated_sensor"]
        if each["token"] == row["calibrated_sensor_token"]
    )
    in_ego = (np.concatenate(parts) - place) @ rotation.rotation_matrix
    in_lidar = (in_ego - mount["translation"]) @ Quaternion(mount["rotation"]).rotation_matrix
    path = made.folder / row["filename"]
    path.parent.mkdir(parents=True, exist_ok=True)
    np.column_stack([in_lidar, np.zeros((len(in_lidar), 2))]).astype("<f4").tofile(path)


def _image(rng: np.random.Generator, images: Images) -> np.ndarray:
    """Noise, or noise whose spectrum falls as that of photographs."""
    noise = rng.normal(size=(3, HEIGHT, WIDTH))
    if images == "fractal":
        frequency = np.hypot(np.fft.fftfreq(HEIGHT)[:, None], np.fft.fftfreq(WIDTH))
        frequency[0, 0] = 1
        noise = np.fft.ifft2(np.fft.fft2(noise) / frequency).real
    return np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8).transpose(1, 2, 0)
