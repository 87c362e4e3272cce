"""The recordings of the agents' sensors: images with their cameras, and point clouds."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.export.mcap.config import McapConfig
from deepaccident_devkit.export.mcap.messages import cloud_message, frame_id
from deepaccident_devkit.export.mcap.moment import Moment
from deepaccident_devkit.export.mcap.recording import Recording, frame_timestamp
from deepaccident_devkit.release.images import read_jpeg
from deepaccident_devkit.release.missing_files import MissingFiles
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.taxonomy import LIDAR

LIDAR_POINT: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])


class Sensors:
    """Writes the sensor files of moments, and counts the missing ones."""

    def __init__(self, dataset: Dataset, config: McapConfig) -> None:
        """Prepare the sensor files of a release."""
        self._dataset = dataset
        self._channels = tuple(config.channels or ())
        self._step = config.point_step
        self._files = MissingFiles(dataset.dataroot, config.on_missing)

    def write(self, moment: Moment, recording: Recording) -> None:
        """Write the files of a moment, agent by agent; raises MissingFileError or SensorFileError."""
        for agent, sample in moment.samples.items():
            for channel in self._channels:
                path = self._dataset.sensor_path(f"{sample}/{channel}")
                if not self._files.has(path, channel):
                    continue
                if channel == LIDAR:
                    self._write_cloud(agent, sample, moment.index, recording)
                else:
                    self._write_image(agent, f"{sample}/{channel}", path, moment.index, recording)

    def tell_missing(self) -> None:
        """Log how many files were left out, if any."""
        self._files.tell()

    def _write_image(self, agent: str, token: str, path: ReleasePath, index: int, recording: Recording) -> None:
        (content, size), channel = read_jpeg(path), token.rsplit("/", 1)[1]
        frame = frame_id(agent, channel)
        image = CompressedImage(timestamp=frame_timestamp(index), frame_id=frame, data=content, format="jpeg")
        calibration = _calibration(self._dataset, token, size, frame, index)
        recording.write(f"/{frame}/calibration", calibration, index)
        recording.write(f"/{frame}/image", image, index)

    def _write_cloud(self, agent: str, sample: str, index: int, recording: Recording) -> None:
        cloud = self._dataset.load_point_cloud(sample, "lidar")
        rows = slice(None, None, self._step)
        points = np.zeros(len(cloud.xyz[rows]), dtype=LIDAR_POINT)
        points["x"], points["y"], points["z"] = cloud.xyz[rows].T
        points["intensity"] = cloud.intensity[rows]
        frame = frame_id(agent, "lidar")
        recording.write(f"/{frame}/points", cloud_message(points, frame, index), index)


def _calibration(dataset: Dataset, token: str, size: tuple[int, int], frame: str, index: int) -> Any:
    """A CameraCalibration for an image of `size` (width, height), which may be smaller than calib says."""
    lens = dataset.camera(token).resized(*size)
    return CameraCalibration(
        timestamp=frame_timestamp(index),
        frame_id=frame,
        width=lens.width,
        height=lens.height,
        distortion_model="plumb_bob",
        D=[0.0] * 5,
        K=lens.intrinsic.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.column_stack([lens.intrinsic, np.zeros(3)]).ravel().tolist(),
    )
