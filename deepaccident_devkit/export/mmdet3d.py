"""Infos for mmdet3d 1.1 or later, next to a nuScenes export with the files that they name.

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.export.bulk import export_release
    from deepaccident_devkit.export.mmdet3d import Mmdet3d
    from deepaccident_devkit.export.nuscenes import NuScenes

    da = DeepAccident(dataroot="data/DeepAccident")
    export_release(da, "data/nuscenes", NuScenes(split="val"))
    export_release(da, "data/nuscenes", Mmdet3d(split="val"))

`Mmdet3d` describes the mapping, docs/exports.md what is lost.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Final, TypeAlias

import numpy as np

from deepaccident_devkit.errors import ExportError
from deepaccident_devkit.export.bulk import Manifest
from deepaccident_devkit.export.frames import keyframes, load_camera
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.export.nuscenes.scenes import (
    AXES_ROTATIONS,
    CAMERA_CHANNELS,
    NUSCENES_VERSION,
    build_sensor_path,
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
    "car",
    "truck",
    "trailer",
    "bus",
    "construction_vehicle",
    "bicycle",
    "motorcycle",
    "pedestrian",
    "traffic_cone",
    "barrier",
)
"""The ten classes of nuScenes, in the order of mmdet3d's labels."""
LABELS: Final = MappingProxyType(
    {"car": 0, "truck": 1, "cyclist": 5, "motorcycle": 6, "pedestrian": 7}
)
"""Label of each DeepAccident class; vans are labelled as cars or trucks."""
# Largest number of clouds before a keyframe that an info names, which is one second.
_MAX_SWEEPS = 10
_INFOS_FILE = "infos.jsonl"
# An info, or a part of one.
_Info: TypeAlias = "dict[str, Any]"


@dataclass(frozen=True, kw_only=True)
class Mmdet3d(NuScenes):
    """The files `deepaccident_infos_train.pkl`, `…_val.pkl` and `…_test.pkl`.

    Their settings must equal the nuScenes export's in the same folder. An info contains:

    - `instances`: the boxes of a keyframe, right-handed in the LiDAR frame, with centre, full
      length, width and height, and counter-clockwise yaw.
    - Labels: car, truck, cyclist, motorcycle and pedestrian are 0, 1, 5, 6 and 7 of nuScenes' ten
      classes, and a van is what `van` sets. `category` has our class.
    - Velocities: from positions at 10 Hz; mmdet3d makes an unknown velocity 0.
    - `lidar_sweeps`: up to ten clouds before the keyframe. `lidar2sensor` is what the loader of
      mmdet3d 1.4 needs, not the inverse of the sensor's pose.
    - `deepaccident`: agent, scenario and frame.
    """

    name: ClassVar[str] = "mmdet3d"
    compatible_formats: ClassVar[tuple[str, ...]] = ("nuscenes",)

    def check(self, dataset: Dataset, folder: Path) -> None:
        """Check that a folder has a complete nuScenes export with the same settings.

        Raises:
            ExportError: If there is no such export.
            ConfigError: If the settings of that export differ.
        """
        settings = {**self.settings(), "version": dataset.version}
        manifest = Manifest.of(folder, NuScenes, settings)
        if manifest.release is None:
            raise ExportError(
                f"{folder}: contains no complete nuscenes export, which the infos refer to; write "
                "it there first, with the same settings"
            )

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write the infos of a scenario into its part, one on each line."""
        lines = []
        for scene in self.scenes(dataset, unit):
            for info in _make_infos(scene, self, output):
                lines.append(f"{json.dumps(info)}\n")
        output.tally.samples += len(lines)
        write_bytes(output.parts / _INFOS_FILE, "".join(lines).encode())

    def finish(
        self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]
    ) -> None:
        """Join the infos of each split that has any; `sample_idx` is their index in the file."""
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
            pieces = (pickled_items([info]) for info in _number_infos(split_folders))
            name = f"deepaccident_infos_{split}.pkl"
            with output.file(name) as temporary, temporary.open("wb") as file:
                write_joined(file, "data_list", pieces, {"metainfo": metainfo})


def _number_infos(folders: Iterable[Path]) -> Iterator[_Info]:
    """Yield the infos from the units' part folders, numbered from 0."""
    index = 0
    for folder in folders:
        text = read_bytes(folder / _INFOS_FILE, "bundle").decode()
        for line in text.splitlines():
            yield {"sample_idx": index, **json.loads(line)}
            index += 1


def _make_infos(scene: AgentScene, form: NuScenes, output: Output) -> Iterator[_Info]:
    """Yield the infos of the keyframes of a scene, without `sample_idx`."""
    lidar_from_client = SE3.from_rotation(AXES_ROTATIONS[form.lidar_axes]).inverse()
    for number in keyframes(scene.last_frame):
        sample = scene.sample(number)
        world_from_lidar = scene.dataset.world_from(sample, "lidar") @ lidar_from_client
        ego_from_lidar = scene.dataset.ego_from(sample, LIDAR) @ lidar_from_client
        lidar_from_world = world_from_lidar.inverse()
        images = _make_image_infos(scene, number, ego_from_lidar, output)
        if number not in scene.files[LIDAR]:
            output.leave_out("point clouds that are not in this release (the infos name them)")
        earlier_numbers = range(number - 1, max(number - 1 - _MAX_SWEEPS, 0), -1)
        sweeps = []
        for earlier in earlier_numbers:
            if earlier in scene.files[LIDAR]:
                sweeps.append(_make_sweep(scene, earlier, lidar_from_world, lidar_from_client))
        instances = _make_instances(scene, sample, form.van, lidar_from_client.inverse(), output)
        yield {
            "token": token("sample", sample),
            "timestamp": scene.timestamp(number) / 1e6,
            "ego2global": scene.dataset.world_from(sample, "ego").matrix.tolist(),
            "lidar_points": {
                "num_pts_feats": 5,
                "lidar_path": _locate_file(scene, LIDAR, number).name,
                "lidar2ego": ego_from_lidar.matrix.tolist(),
            },
            "images": images,
            "lidar_sweeps": sweeps,
            "instances": list(instances),
            "cam_instances": {},
            "deepaccident": {"scenario": scene.scenario, "agent": scene.agent, "frame": number},
        }


def _make_image_infos(
    scene: AgentScene, number: int, ego_from_lidar: SE3, output: Output
) -> dict[str, _Info]:
    """Return the info of each camera's image at a keyframe by channel; count missing images."""
    sample = scene.sample(number)
    images = {}
    for camera, channel in CAMERA_CHANNELS.items():
        file = scene.files[camera].get(number)
        if file is None:
            output.leave_out("images that are not in this release")
            continue
        ego_from_camera = scene.dataset.ego_from(sample, camera)
        camera_from_lidar = ego_from_camera.inverse() @ ego_from_lidar
        lens = load_camera(scene.dataset, f"{sample}/{camera}", file)
        images[channel] = {
            "img_path": _locate_file(scene, camera, number).name,
            "cam2img": lens.intrinsic.tolist(),
            "lidar2cam": camera_from_lidar.matrix.tolist(),
            "cam2ego": ego_from_camera.matrix.tolist(),
            "sample_data_token": token("sample_data", sample, camera),
            "timestamp": scene.timestamp(number) / 1e6,
        }
    return images


def _make_sweep(
    scene: AgentScene, number: int, lidar_from_world: SE3, lidar_from_client: SE3
) -> _Info:
    """Return the info of a cloud before a keyframe.

    mmdet3d rotates points by the transpose of `lidar2sensor` and subtracts its fourth column
    without rotating it. So that column is the displacement of the sensor, not the displacement of
    the inverse transform.

    Args:
        scene: The scene.
        number: Number of the cloud's frame.
        lidar_from_world: Transform to the LiDAR frame of the keyframe.
        lidar_from_client: Rotation from mmdet3d's LiDAR axes.
    """
    sample = scene.sample(number)
    lidar_from_sensor = (
        lidar_from_world @ scene.dataset.world_from(sample, "lidar") @ lidar_from_client
    )
    ego_from_lidar = scene.dataset.ego_from(sample, LIDAR) @ lidar_from_client
    lidar_to_sensor = np.eye(4)
    lidar_to_sensor[:3, :3] = lidar_from_sensor.rotation.T
    lidar_to_sensor[:3, 3] = -lidar_from_sensor.translation
    # The path includes the folder, by which mmdet3d recognises keyframes.
    lidar_path = str(_locate_file(scene, LIDAR, number))
    return {
        "lidar_points": {
            "lidar_path": lidar_path,
            "lidar2ego": ego_from_lidar.matrix.tolist(),
            "lidar2sensor": lidar_to_sensor.tolist(),
        },
        "ego2global": scene.dataset.world_from(sample, "ego").matrix.tolist(),
        "timestamp": scene.timestamp(number) / 1e6,
        "sample_data_token": token("sample_data", sample, LIDAR),
    }


def _make_instances(
    scene: AgentScene, sample: str, van: Van, client_from_lidar: SE3, output: Output
) -> Iterator[_Info]:
    """Yield the boxes of a keyframe as in the nuScenes export, without the agent's own box.

    mmdet3d replaces NaN velocities by 0.
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


def _locate_file(scene: AgentScene, channel: str, number: int) -> PurePosixPath:
    """Return the path of a sensor file within the nuScenes export."""
    return PurePosixPath(
        build_sensor_path(scene.name, channel, scene.timestamp(number), is_key=scene.is_key(number))
    )
