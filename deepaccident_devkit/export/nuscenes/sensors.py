"""The sensor files of a scene: clouds written, images linked; their rows in `sample_data` and `calibrated_sensor`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from deepaccident_devkit.export.nuscenes.names import CHANNEL_NAMES, ENDINGS, sensor_path, token
from deepaccident_devkit.export.nuscenes.scenes import Row, Rows, Scene, linked
from deepaccident_devkit.export.sensor_files import sensor_files
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.release import read_lidar
from deepaccident_devkit.release.images import read_jpeg
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.tables.tokens import sample_data_token
from deepaccident_devkit.taxonomy import BEV_CAMERA, LIDAR

if TYPE_CHECKING:
    from deepaccident_devkit.arrays import FloatArray
    from deepaccident_devkit.dataset import Dataset
    from deepaccident_devkit.export.bulk import Output

LidarAxes = Literal["ego", "nuscenes"]
POINT_BYTES: Final = 20
"""Of a point in a cloud: x, y, z, intensity and ring, float32."""
TURNS: Final = {
    "ego": np.eye(3),
    "nuscenes": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
"""Axes → what turns points with x forward and y left into them; nuScenes' LiDAR has x right and y forward."""


def write_sensors(scene: Scene, axes: LidarAxes, output: Output) -> Rows:
    """Write the clouds of a scene, link its images, and return the rows of `sample_data` and `calibrated_sensor`.

    Files that are missing in a partial release have rows too, as those of a partial nuScenes download: evaluations look
    up every keyframe's `LIDAR_TOP`, but open no cloud.

    Raises:
        SensorFileError: a file cannot be read.
    """
    data: list[Row] = []
    calibrated: dict[str, Row] = {}
    for channel, files in scene.files.items():
        size = (0, 0) if channel == LIDAR else image_size(scene, channel)
        rows = []
        for number in scene.frames:
            source = sample_data_token(scene.sample(number), channel)
            sensor = scene.dataset.sample_data.get(source)["calibrated_sensor_token"]
            if sensor not in calibrated:
                calibrated[sensor] = _calibrated_row(scene, sensor, source, size, axes)
            path = sensor_path(scene.name, channel, scene.stamp(number), key=scene.is_key(number))
            rows.append(_data_row(scene, number, channel, sensor, path, size))
            if number not in files:
                continue
            if channel == LIDAR:
                output.write(path, _cloud(files[number][0], axes))
            else:
                output.link(files[number][0], path)
        data += linked(rows)
        what = "point clouds" if channel == LIDAR else "images"
        output.leave_out(f"{what} that are not in this release (the tables name them)", len(rows) - len(files))
    bev = sensor_files(scene.dataset, scene.scenario, scene.agent, BEV_CAMERA)
    output.leave_out("files of the BEV camera", len(bev))
    return {"sample_data": data, "calibrated_sensor": list(calibrated.values())}


def image_size(scene: Scene, camera: str) -> tuple[int, int]:
    """Width and height of the first of a camera's images, as all of a recording are; without one, as calib says."""
    files = scene.files[camera]
    if files:
        return read_jpeg(next(iter(files.values()))[0])[1]
    lens = scene.dataset.camera(scene.sample(scene.last), camera)
    return lens.width, lens.height


def scaled_intrinsic(dataset: Dataset, data: str, size: tuple[int, int]) -> FloatArray:
    """K (3, 3) of a camera's file for images of `size` (width, height): they may be smaller than calib says."""
    lens = dataset.camera(data)
    return np.diag([size[0] / lens.width, size[1] / lens.height, 1.0]) @ lens.intrinsic


def _data_row(scene: Scene, number: int, channel: str, sensor: str, path: str, size: tuple[int, int]) -> Row:
    sample = scene.sample(number)
    return {
        "token": token("sample_data", sample, channel),
        "sample_token": token("sample", scene.key_of(number)),
        "ego_pose_token": token("ego_pose", sample),
        "calibrated_sensor_token": token("calibrated_sensor", sensor),
        "timestamp": scene.stamp(number),
        "fileformat": ENDINGS[channel].removesuffix(".bin"),
        "is_key_frame": scene.is_key(number),
        "height": size[1],
        "width": size[0],
        "filename": path,
    }


def _calibrated_row(scene: Scene, sensor: str, source: str, size: tuple[int, int], axes: LidarAxes) -> Row:
    """The row of a calibrated sensor, which made the file `source`, with K for images of `size` (width, height)."""
    record = scene.dataset.calibrated_sensor.get(sensor)
    rotation, intrinsic = record["rotation"], []
    if record["camera_intrinsic"] is None:
        rotation = quaternions.from_matrix(quaternions.to_matrix(rotation) @ TURNS[axes].T).tolist()
    else:
        intrinsic = scaled_intrinsic(scene.dataset, source, size).tolist()
    return {
        "token": token("calibrated_sensor", sensor),
        "sensor_token": token("sensor", CHANNEL_NAMES[record["sensor_token"]]),
        "translation": record["translation"],
        "rotation": rotation,
        "camera_intrinsic": intrinsic,
    }


def _cloud(path: ReleasePath, axes: LidarAxes) -> bytes:
    """The content of a `.pcd.bin`: x, y, z, intensity, ring (0), in the LiDAR's frame with these axes."""
    cloud = read_lidar(path)
    points = np.zeros((len(cloud), 5), dtype="<f4")
    points[:, :3] = cloud.xyz @ TURNS[axes].T
    points[:, 3] = cloud.intensity
    return points.tobytes()
