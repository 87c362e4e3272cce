"""The sensor files of a scene: clouds written, images linked; their rows in `sample_data` and `calibrated_sensor`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from deepaccident_devkit.export.nuscenes.names import CHANNEL_NAMES, ENDINGS, sensor_path, token
from deepaccident_devkit.export.nuscenes.scenes import Row, Rows, Scene, linked
from deepaccident_devkit.export.sensor_files import sensor_files, stored_camera
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.release import read_lidar
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.tables.tokens import sample_data_token
from deepaccident_devkit.taxonomy import BEV_CAMERA, LIDAR

if TYPE_CHECKING:
    from deepaccident_devkit.export.bulk import Output
    from deepaccident_devkit.geometry import PinholeCamera

LidarAxes = Literal["ego", "nuscenes"]
TURNS: Final = {
    "ego": np.eye(3),
    "nuscenes": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
"""Axes → what turns points with x forward and y left into them; nuScenes' LiDAR has x right and y forward."""


def write_sensors(scene: Scene, axes: LidarAxes, output: Output) -> Rows:
    """Write the clouds of a scene, link its images, and return the rows of `sample_data` and `calibrated_sensor`.

    Files that are missing in a partial release have rows too, as those of a partial nuScenes download: evaluations look
    up every keyframe's `LIDAR_TOP`, but open no cloud. A missing image has the size of the camera's first one.

    Raises:
        SensorFileError: a file cannot be read.
    """
    data: list[Row] = []
    calibrated: dict[str, Row] = {}
    for channel, files in scene.files.items():
        rows, any_file = [], next(iter(files.values()), None)
        for number in scene.frames:
            source = sample_data_token(scene.sample(number), channel)
            record = scene.dataset.sample_data.get(source)
            lens = None if channel == LIDAR else stored_camera(scene.dataset, source, files.get(number, any_file))
            sensor = record["calibrated_sensor_token"]
            if lens is not None and (lens.width, lens.height) != (record["width"], record["height"]):
                sensor = f"{sensor} {lens.width} x {lens.height}"  # with a K of its own
            if sensor not in calibrated:
                calibrated[sensor] = _calibrated_row(scene, record["calibrated_sensor_token"], sensor, lens, axes)
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
        output.leave_out(f"{what} that are not in this release (the tables name them)", len(rows) - len(files))
    bev = sensor_files(scene.dataset, scene.scenario, scene.agent, BEV_CAMERA)
    output.leave_out("files of the BEV camera", len(bev))
    return {"sample_data": data, "calibrated_sensor": list(calibrated.values())}


def _data_row(scene: Scene, number: int, channel: str, sensor: str, path: str, lens: PinholeCamera | None) -> Row:
    sample = scene.sample(number)
    return {
        "token": token("sample_data", sample, channel),
        "sample_token": token("sample", scene.key_of(number)),
        "ego_pose_token": token("ego_pose", sample),
        "calibrated_sensor_token": token("calibrated_sensor", sensor),
        "timestamp": scene.stamp(number),
        "fileformat": ENDINGS[channel].removesuffix(".bin"),
        "is_key_frame": scene.is_key(number),
        "height": 0 if lens is None else lens.height,
        "width": 0 if lens is None else lens.width,
        "filename": path,
    }


def _calibrated_row(scene: Scene, source: str, name: str, lens: PinholeCamera | None, axes: LidarAxes) -> Row:
    """The row of our calibrated sensor `source`, whose token is made of `name`; a camera has the K of its images."""
    record = scene.dataset.calibrated_sensor.get(source)
    rotation, intrinsic = record["rotation"], []
    if lens is None:
        rotation = quaternions.from_matrix(quaternions.to_matrix(rotation) @ TURNS[axes].T).tolist()
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
    points[:, :3] = cloud.xyz @ TURNS[axes].T
    points[:, 3] = cloud.intensity
    return points.tobytes()
