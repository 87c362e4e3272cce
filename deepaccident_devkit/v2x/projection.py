"""Points of any agent in the images of any agent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import LidarPointCloud, PinholeCamera
from deepaccident_devkit.support.arrays import BoolArray, ByteArray, FloatArray, FrozenArrays, checked
from deepaccident_devkit.v2x.poses import transform


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImagePoints(FrozenArrays):
    """Where N points fall in an image; arrays are read-only.

    Attributes:
        pixels: (N, 2) float64 as (u, v); pixel centres are at 0.5, 1.5, …; NaN behind the camera.
        depth: (N,) float64, metres along the optical axis.
        color: (N, 3) uint8 RGB of the pixel, black outside the image; None if no colours are wanted.
        mask: (N,) bool, whether a point is in front of the camera and in the image (other things may hide it).
    """

    pixels: FloatArray
    depth: FloatArray
    color: ByteArray | None
    mask: BoolArray


def project_to_image(
    dataset: Dataset,
    points: LidarPointCloud | ArrayLike,
    sample: RowArgument,
    camera: RowArgument,
    *,
    frame: str | None = None,
    colors: bool = True,
) -> ImagePoints:
    """Points of one agent in an image of any agent at any moment of the same scenario.

    The points are assumed to stand still: points of another moment are wrong for things that moved.

    Args:
        dataset: the release.
        points: a point cloud, or an array (N, 3), metres.
        sample: token or record of the sample to which the points' coordinate frame belongs.
        camera: token or record of the image (sample data).
        frame: the points' coordinate frame: `world`, `ego`, `lidar` or a channel of `sample`; None for that of a
            cloud, or for `world` with an array.
        colors: whether to load the image for its colours.

    Raises:
        TokenError: no such sample or sensor file, such as a camera that does not exist.
        ChoiceError: the sensor is no camera, there is no such frame, or `sample` and `camera` are of two scenarios.
        GeometryError: the points are no array (N, 3).
        MissingFileError: colours are wanted and the image was not downloaded.
        SensorFileError: the image cannot be read.
    """
    if isinstance(points, LidarPointCloud):
        xyz, source = points.xyz, frame or points.frame
    else:
        xyz, source = checked("points", points, (None, 3)), frame or "world"
    record = dataset.get("sample_data", camera)
    lens = camera_of(dataset, record)
    optical_from_source = transform(dataset, record["sample_token"], sample, record["channel"], source)
    pixels, depth = lens.project(optical_from_source.apply(xyz))
    mask = lens.in_image(pixels)
    color = _colors_at(dataset.load_image(record), lens, pixels, mask) if colors else None
    return ImagePoints(pixels=pixels, depth=depth, color=color, mask=mask)


def map_pointcloud_to_image(
    dataset: Dataset, camera: RowArgument, sample: RowArgument | None = None, *, colors: bool = True
) -> ImagePoints:
    """The points of a sample's LiDAR in an image, like the nuScenes explorer's function of this name.

    Args:
        dataset: the release.
        camera: token or record of the image (sample data).
        sample: token or record: whose LiDAR; None for the camera's own sample.
        colors: whether to load the image for its colours.

    Returns:
        One row for each point, in the cloud's order.

    Raises:
        TokenError: no such sample or sensor file.
        ChoiceError: the sensor is no camera, or `sample` and `camera` are of two scenarios.
        MissingFileError: the image or the cloud was not downloaded.
        SensorFileError: the image or the cloud cannot be read.
    """
    record = dataset.get("sample_data", camera)
    source = record["sample_token"] if sample is None else sample
    return project_to_image(dataset, dataset.load_point_cloud(source, "lidar"), source, record, colors=colors)


def camera_of(dataset: Dataset, camera: RowArgument) -> PinholeCamera:
    """The pinhole camera of an image, with the image size that calib gives.

    Raises:
        TokenError: no such sensor file.
        ChoiceError: the sensor is no camera.
    """
    return dataset.camera(camera)


def _colors_at(image: ByteArray, lens: PinholeCamera, pixels: FloatArray, mask: BoolArray) -> ByteArray:
    """Colours (N, 3) uint8; pixels are scaled if the image was stored smaller than its calib says."""
    height, width = image.shape[:2]
    columns = (pixels[mask, 0] * (width / lens.width)).astype(np.intp)
    rows = (pixels[mask, 1] * (height / lens.height)).astype(np.intp)
    result = np.zeros((len(pixels), 3), dtype=np.uint8)
    result[mask] = image[np.minimum(rows, height - 1), np.minimum(columns, width - 1)]
    return result
