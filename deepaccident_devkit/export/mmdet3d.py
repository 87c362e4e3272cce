"""The infos of mmdet3d from 1.1 on, beside a nuScenes export, whose files they name.

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.export.bulk import export_release
    from deepaccident_devkit.export.mmdet3d import Mmdet3d
    from deepaccident_devkit.export.nuscenes import NuScenes

    da = DeepAccident(dataroot="data/DeepAccident")
    export_release(da, "data/nuscenes", NuScenes(split="val"))
    export_release(da, "data/nuscenes", Mmdet3d(split="val"))

docs/exports.md says what becomes what, and what is lost.
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
"""Our class → its label; vans are said to be cars or trucks."""
# How many clouds before a keyframe an info names at most: one second.
_SWEEPS: Final = 10
_PART: Final = "infos.jsonl"


@dataclass(frozen=True, kw_only=True)
class Mmdet3d(NuScenes):
    """`deepaccident_infos_train.pkl`, `…_val.pkl` and `…_test.pkl`, with the settings of the nuScenes export there."""

    name: ClassVar[str] = "mmdet3d"
    beside: ClassVar[tuple[str, ...]] = ("nuscenes",)

    def check(self, dataset: Dataset, folder: Path) -> None:
        """Refuse a folder without a complete nuScenes export of the same settings.

        Raises:
            ExportError: there is none.
            ConfigError: its settings differ.
        """
        if (
            Manifest.of(folder, NuScenes, {**self.settings(), "version": dataset.version}).release
            is None
        ):
            raise ExportError(
                f"{folder}: holds no complete nuscenes export, whose files the infos name; write it there first, with "
                "the same settings"
            )

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Keep the infos of a scenario, a line each."""
        infos = [
            info for scene in self.scenes(dataset, unit) for info in _infos(scene, self, output)
        ]
        output.tally.samples += len(infos)
        write_bytes(
            output.parts / _PART, "".join(f"{json.dumps(info)}\n" for info in infos).encode()
        )

    def finish(
        self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]
    ) -> None:
        """Join the infos of each split that has some; `sample_idx` is an info's place in its file."""
        folders: dict[str, list[Path]] = {}
        for unit in units:
            split = dataset.get("scenario", unit.scenarios[0])["split"] or "unknown"
            folders.setdefault(split, []).append(parts(unit))
        about = {
            "categories": {name: label for label, name in enumerate(NUSCENES_CLASSES)},
            "dataset": "nuscenes",
            "version": NUSCENES_VERSION,
            "info_version": "1.1",
        }
        for split, places in sorted(folders.items()):
            pieces = (pickled_items([info]) for info in _placed(places))
            with (
                output.file(f"deepaccident_infos_{split}.pkl") as temporary,
                temporary.open("wb") as file,
            ):
                write_joined(file, "data_list", pieces, {"metainfo": about})


def _placed(folders: Iterable[Path]) -> Iterator[dict[str, Any]]:
    """The infos that units left in these folders, with their places."""
    lines = (
        line
        for folder in folders
        for line in read_bytes(folder / _PART, "bundle").decode().splitlines()
    )
    return ({"sample_idx": place, **json.loads(line)} for place, line in enumerate(lines))


def _infos(scene: AgentScene, form: NuScenes, output: Output) -> Iterator[dict[str, Any]]:
    """The infos of a scene's keyframes, without `sample_idx`."""
    ours_from_theirs = SE3.from_rotation(AXES_ROTATIONS[form.lidar_axes]).inverse()
    for number in keyframes(scene.last):
        sample = scene.sample(number)
        ego_from_lidar = scene.dataset.ego_from(sample, LIDAR) @ ours_from_theirs
        lidar_from_world = (scene.dataset.world_from(sample, "lidar") @ ours_from_theirs).inverse()
        images = {}
        for camera, channel in CAMERA_CHANNELS.items():
            file = scene.files[camera].get(number)
            if file is None:
                output.leave_out("images that are not in this release")
                continue
            ego_from_camera = scene.dataset.ego_from(sample, camera)
            images[channel] = {
                "img_path": _file(scene, camera, number).name,
                "cam2img": stored_camera(
                    scene.dataset, f"{sample}/{camera}", file
                ).intrinsic.tolist(),
                "lidar2cam": (ego_from_camera.inverse() @ ego_from_lidar).matrix.tolist(),
                "cam2ego": ego_from_camera.matrix.tolist(),
                "sample_data_token": token("sample_data", sample, camera),
                "timestamp": scene.stamp(number) / 1e6,
            }
        if number not in scene.files[LIDAR]:
            output.leave_out("point clouds that are not in this release (the infos name them)")
        before = [
            each
            for each in range(number - 1, max(number - 1 - _SWEEPS, 0), -1)
            if each in scene.files[LIDAR]
        ]
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
                _sweep(scene, each, lidar_from_world, ours_from_theirs) for each in before
            ],
            "instances": list(
                _instances(scene, sample, form.van, ours_from_theirs.inverse(), output)
            ),
            "cam_instances": {},
            "deepaccident": {"scenario": scene.scenario, "agent": scene.agent, "frame": number},
        }


def _sweep(
    scene: AgentScene, number: int, lidar_from_world: SE3, ours_from_theirs: SE3
) -> dict[str, Any]:
    """A cloud before a keyframe, whose LiDAR frame is given.

    The client turns points by the transpose of `lidar2sensor` and subtracts its fourth column unturned. So that column
    is the way of the sensor, and not what the inverse would have.
    """
    sample = scene.sample(number)
    lidar_from_sensor = (
        lidar_from_world @ scene.dataset.world_from(sample, "lidar") @ ours_from_theirs
    )
    lidar_to_sensor = np.eye(4)
    lidar_to_sensor[:3, :3], lidar_to_sensor[:3, 3] = (
        lidar_from_sensor.rotation.T,
        -lidar_from_sensor.translation,
    )
    return {
        "lidar_points": {
            "lidar_path": str(
                _file(scene, LIDAR, number)
            ),  # with its folder, by which the client knows keyframes
            "lidar2ego": (scene.dataset.ego_from(sample, LIDAR) @ ours_from_theirs).matrix.tolist(),
            "lidar2sensor": lidar_to_sensor.tolist(),
        },
        "ego2global": scene.dataset.world_from(sample, "ego").matrix.tolist(),
        "timestamp": scene.stamp(number) / 1e6,
        "sample_data_token": token("sample_data", sample, LIDAR),
    }


def _instances(
    scene: AgentScene, sample: str, van: Van, theirs_from_ours: SE3, output: Output
) -> Iterator[dict[str, Any]]:
    """The boxes of a keyframe as in the nuScenes export, without the agent's own; the client makes NaN velocities 0."""
    boxes = scene.dataset.boxes(sample, "lidar", velocity="derived")
    others = boxes.select(boxes.actor_id != OWN_ACTOR_ID).transform(theirs_from_ours, "lidar")
    output.leave_out("boxes of the recording agents themselves", len(boxes) - len(others))
    numbers = np.column_stack([others.center, others.size, others.yaw]).tolist()
    points = others.num_lidar_pts.tolist()
    for index, category in enumerate(others.category_names):
        label = LABELS[van if category == "van" else category]
        yield {
            "bbox_3d": numbers[index],
            "bbox_label_3d": label,
            "bbox_label": label,
            "velocity": others.velocity[index, :2].tolist(),
            "num_lidar_pts": points[index],
            "num_radar_pts": 0,
            "bbox_3d_isvalid": points[index] > 0,
            "category": category,
        }


def _file(scene: AgentScene, channel: str, number: int) -> PurePosixPath:
    """The path of a sensor file in the folder of the nuScenes export."""
    return PurePosixPath(
        sensor_path(scene.name, channel, scene.stamp(number), key=scene.is_key(number))
    )
