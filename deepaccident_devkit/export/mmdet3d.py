"""The infos of mmdet3d from 1.1 on, beside a nuScenes export with the files that they name.

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.export.bulk import export_release
    from deepaccident_devkit.export.mmdet3d import Mmdet3d
    from deepaccident_devkit.export.nuscenes import NuScenes

    da = DeepAccident(dataroot="data/DeepAccident")
    export_release(da, "data/nuscenes", NuScenes(split="val"))
    export_release(da, "data/nuscenes", Mmdet3d(split="val"))

docs/exports.md describes the mapping, and what is lost.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from deepaccident_devkit.errors import ExportError
from deepaccident_devkit.export.bulk import Manifest
from deepaccident_devkit.export.frames import keyframes, stored_camera
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.export.nuscenes.scenes import (
    AXES_ROTATIONS,
    CAMERA_CHANNELS,
    NUSCENES_VERSION,
    sensor_path,
    token,
)
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.release.pickles import pickled_items, write_joined
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.taxonomy import LIDAR, OWN_ACTOR_ID

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset
    from deepaccident_devkit.export.bulk import Output, Unit
    from deepaccident_devkit.export.nuscenes.scenes import AgentScene, Van

NUSCENES_CLASSES: Final = (
    *(
        "car",
        "truck",
        "trailer",
        "bus",
        "construction_vehicle",
        "bicycle",
        "motorcycle",
        "pedestrian",
    ),
    *("traffic_cone", "barrier"),
)
"""NuScenes' ten classes, in the order of the client's labels."""
LABELS: Final = MappingProxyType(
    {"car": 0, "truck": 1, "cyclist": 5, "motorcycle": 6, "pedestrian": 7}
)
"""Class of DeepAccident → its label; vans are labelled as cars or trucks."""
# Largest number of clouds before a keyframe that an info names: one second.
_MAX_SWEEPS: Final = 10
_INFOS_FILE: Final = "infos.jsonl"


@dataclass(frozen=True, kw_only=True)
class Mmdet3d(NuScenes):
    """`deepaccident_infos_train.pkl`, `…_val.pkl` and `…_test.pkl`.

    It has the settings of the nuScenes export in the same folder.
    """

    name: ClassVar[str] = "mmdet3d"
    beside: ClassVar[tuple[str, ...]] = ("nuscenes",)

    def check(self, dataset: Dataset, folder: Path) -> None:
        """Raise an error for a folder without a complete nuScenes export of the same settings.

        Raises:
            ExportError: there is none.
            ConfigError: its settings differ.
        """
        settings = {**self.settings(), "version": dataset.version}
        manifest = Manifest.of(folder, NuScenes, settings)
        if manifest.release is None:
            raise ExportError(
                f"{folder}: holds no complete nuscenes export, whose files the infos name; write "
                "it there first, with the same settings"
            )

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write the infos of a scenario into its part, a line each."""
        lines = []
        for scene in self.scenes(dataset, unit):
            for info in _infos(scene, self, output):
                lines.append(f"{json.dumps(info)}\n")
        output.tally.samples += len(lines)
        write_bytes(output.parts / _INFOS_FILE, "".join(lines).encode())

    def finish(
        self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]
    ) -> None:
        """Join the infos of each non-empty split; `sample_idx` is an info's index in its file."""
        folders: dict[str, list[Path]] = {}
        for unit in units:
            split = dataset.get("scenario", unit.scenarios[0])["split"] or "unknown"
            folders.setdefault(split, []).append(parts(unit))
        metainfo = {
            "categories": {name: label for label, name in enumerate(NUSCENES_CLASSES)},
            "dataset": "nuscenes",
            "version": NUSCENES_VERSION,
            "info_version": "1.1",
        }
        for split, split_folders in sorted(folders.items()):
            pieces = (pickled_items([info]) for info in _numbered_infos(split_folders))
            name = f"deepaccident_infos_{split}.pkl"
            with output.file(name) as temporary, temporary.open("wb") as file:
                write_joined(file, "data_list", pieces, {"metainfo": metainfo})


def _numbered_infos(folders: Iterable[Path]) -> Iterator[dict[str, Any]]:
    """Yield the infos in the units' folders of parts, with their indices."""
    index = 0
    for folder in folders:
        text = read_bytes(folder / _INFOS_FILE, "bundle").decode()
        for line in text.splitlines():
            yield {"sample_idx": index, **json.loads(line)}
            index += 1


def _infos(scene: AgentScene, form: NuScenes, output: Output) -> Iterator[dict[str, Any]]:
    """Yield the infos of a scene's keyframes, without `sample_idx`."""
    lidar_from_client = SE3.from_rotation(AXES_ROTATIONS[form.lidar_axes]).inverse()
    for number in keyframes(scene.last):
        sample = scene.sample(number)
        world_from_lidar = scene.dataset.world_from(sample, "lidar") @ lidar_from_client
        ego_from_lidar = scene.dataset.ego_from(sample, LIDAR) @ lidar_from_client
        lidar_from_world = world_from_lidar.inverse()
        images = _images(scene, number, ego_from_lidar, output)
        if number not in scene.files[LIDAR]:
            output.leave_out("point clouds that are not in this release (the infos name them)")
        earlier_numbers = range(number - 1, max(number - 1 - _MAX_SWEEPS, 0), -1)
        sweeps = [earlier for earlier in earlier_numbers if earlier in scene.files[LIDAR]]
        boxes = _instances(scene, sample, form.van, lidar_from_client.inverse(), output)
        yield {
            "token": token("sample", sample),
            "timestamp": scene.stamp(number) / 1e6,
            "ego2global": scene.dataset.world_from(sample, "ego").matrix.tolist(),
            "lidar_points": {
                "num_pts_feats": 5,
                "lidar_path": _file(scene, LIDAR, number).name,
                "lidar2ego": ego_from_lidar.matrix.tolist(),
            },
            "images": images,
            "lidar_sweeps": [
                _sweep(scene, sweep, lidar_from_world, lidar_from_client) for sweep in sweeps
            ],
            "instances": list(boxes),
            "cam_instances": {},
            "deepaccident": {"scenario": scene.scenario, "agent": scene.agent, "frame": number},
        }


def _images(
    scene: AgentScene, number: int, ego_from_lidar: SE3, output: Output
) -> dict[str, dict[str, Any]]:
    """Return channel → info of its image in a keyframe, and count missing images."""
    sample = scene.sample(number)
    images = {}
    for camera, channel in CAMERA_CHANNELS.items():
        file = scene.files[camera].get(number)
        if file is None:
            output.leave_out("images that are not in this release")
            continue
        ego_from_camera = scene.dataset.ego_from(sample, camera)
        camera_from_lidar = ego_from_camera.inverse() @ ego_from_lidar
        lens = stored_camera(scene.dataset, f"{sample}/{camera}", file)
        images[channel] = {
            "img_path": _file(scene, camera, number).name,
            "cam2img": lens.intrinsic.tolist(),
            "lidar2cam": camera_from_lidar.matrix.tolist(),
            "cam2ego": ego_from_camera.matrix.tolist(),
            "sample_data_token": token("sample_data", sample, camera),
            "timestamp": scene.stamp(number) / 1e6,
        }
    return images


def _sweep(
    scene: AgentScene, number: int, lidar_from_world: SE3, lidar_from_client: SE3
) -> dict[str, Any]:
    """Return the info of a cloud before a keyframe.

    The client rotates points by the transpose of `lidar2sensor` and subtracts its fourth column
    without rotation. So that column is the displacement of the sensor, not that of the inverse.

    Args:
        scene: The scene.
        number: Frame of the cloud.
        lidar_from_world: Transform to the LiDAR frame of the keyframe.
        lidar_from_client: Rotation from the client's LiDAR axes.
    """
    sample = scene.sample(number)
    lidar_from_sensor = (
        lidar_from_world @ scene.dataset.world_from(sample, "lidar") @ lidar_from_client
    )
    ego_from_lidar = scene.dataset.ego_from(sample, LIDAR) @ lidar_from_client
    lidar_to_sensor = np.eye(4)
    lidar_to_sensor[:3, :3] = lidar_from_sensor.rotation.T
    lidar_to_sensor[:3, 3] = -lidar_from_sensor.translation
    # with its folder, by which the client recognises keyframes
    lidar_path = str(_file(scene, LIDAR, number))
    return {
        "lidar_points": {
            "lidar_path": lidar_path,
            "lidar2ego": ego_from_lidar.matrix.tolist(),
            "lidar2sensor": lidar_to_sensor.tolist(),
        },
        "ego2global": scene.dataset.world_from(sample, "ego").matrix.tolist(),
        "timestamp": scene.stamp(number) / 1e6,
        "sample_data_token": token("sample_data", sample, LIDAR),
    }


def _instances(
    scene: AgentScene, sample: str, van: Van, client_from_lidar: SE3, output: Output
) -> Iterator[dict[str, Any]]:
    """Yield the boxes of a keyframe as in the nuScenes export, without the agent's own.

    The client replaces NaN velocities by 0.
    """
    all_boxes = scene.dataset.boxes(sample, "lidar", velocity="derived")
    other_actors = all_boxes.select(all_boxes.actor_id != OWN_ACTOR_ID)
    boxes = other_actors.transform(client_from_lidar, "lidar")
    output.leave_out("boxes of the recording agents themselves", len(all_boxes) - len(boxes))
    numbers = np.column_stack([boxes.center, boxes.size, boxes.yaw]).tolist()
    points = boxes.num_lidar_pts.tolist()
    for index, category in enumerate(boxes.category_names):
        label = LABELS[van if category == "van" else category]
        yield {
            "bbox_3d": numbers[index],
            "bbox_label_3d": label,
            "bbox_label": label,
            "velocity": boxes.velocity[index, :2].tolist(),
            "num_lidar_pts": points[index],
            "num_radar_pts": 0,
            "bbox_3d_isvalid": points[index] > 0,
            "category": category,
        }


def _file(scene: AgentScene, channel: str, number: int) -> PurePosixPath:
    """Return the path of a sensor file in the folder of the nuScenes export."""
    return PurePosixPath(
        sensor_path(scene.name, channel, scene.stamp(number), key=scene.is_key(number))
    )
