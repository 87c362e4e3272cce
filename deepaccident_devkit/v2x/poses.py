"""Poses of agents, transforms between them, and points of any agent in the images of any.

See docs/released_code.md, Poses. Every function works for both kinds of handedness: right-handed
poses (the devkit's) give right-handed 6-vectors, CARLA's raw poses give the 6-vectors of the
released code; `geometry.conventions.flip_six_vector` converts one into the other.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, GeometryError
from deepaccident_devkit.geometry import SE3, LidarPointCloud, PinholeCamera, conventions
from deepaccident_devkit.geometry.conventions import inverses
from deepaccident_devkit.support.arrays import (
    BoolArray,
    ByteArray,
    FloatArray,
    FrozenArrays,
    checked,
)
from deepaccident_devkit.support.nuscenes_names import with_keywords_named

Poses = Sequence[SE3] | ArrayLike
"""Poses of several agents or moments: SE3 objects, or an array (K, 4, 4)."""


def transform(
    dataset: Dataset,
    target_sample: RowArgument,
    source_sample: RowArgument,
    target: str = "ego",
    source: str = "ego",
) -> SE3:
    """Return `target_from_source` between frames of any two agents and moments of one scenario.

    Args:
        dataset: The release.
        target_sample: Token or record of the sample to which the target frame belongs.
        source_sample: Token or record of the sample to which the source frame belongs.
        target: `world`, `ego`, `lidar` or a channel (cameras: the optical frame).
        source: The same choice as for `target`.

    Raises:
        TokenError: There is no such sample.
        ChoiceError: There is no such frame, or the samples are of two scenarios, which take place
            in unrelated worlds.
    """
    target_scenario = dataset.get("sample", target_sample)["scenario_token"]
    source_scenario = dataset.get("sample", source_sample)["scenario_token"]
    if target_scenario != source_scenario:
        raise ChoiceError(
            f"transform: expected two samples of one scenario, found {target_scenario} and "
            f"{source_scenario}; scenarios take place in different worlds"
        )
    world_from_target = dataset.world_from(target_sample, target)
    return world_from_target.inverse() @ dataset.world_from(source_sample, source)


def relative_pose_to_ego(world_from_agent: Poses) -> FloatArray:
    """Return agents' poses in the ego's frame: `ego_from_agent` of each as a 6-vector.

    See docs/released_code.md, Poses.

    Args:
        world_from_agent: Poses of one moment, shape (K, 4, 4), or K SE3, the ego's first.

    Returns:
        6-vectors, shape (K, 6), metres and radians, in the ego's frame and the poses' handedness;
        row 0 is zero up to rounding.

    Raises:
        GeometryError: The poses have another shape, or there is none.
    """
    poses = _stacked("world_from_agent", world_from_agent)
    if not len(poses):
        raise GeometryError(
            "world_from_agent: expected the ego's pose and its partners', found none"
        )
    return conventions.six_vectors_of(inverses(poses[:1]) @ poses)


def future_egomotion(world_from_ego: Poses, valid: ArrayLike | None = None) -> FloatArray:
    """Return an agent's motion from each moment to the next: `next_from_this` as 6-vectors.

    See docs/released_code.md, Poses. A row maps points of a moment's ego frame into the next
    moment's ego frame. For the seven rows of the released code give eight poses: 1 s before the
    present to 2.5 s after it, in steps of 0.5 s.

    Args:
        world_from_ego: Poses of one agent in the order of time, shape (T + 1, 4, 4), or T + 1 SE3.
        valid: Truth values, shape (T + 1,): whether each moment is in the recording; the poses of
            other moments do not matter. None if all are.

    Returns:
        6-vectors, shape (T, 6), metres and radians, in the poses' handedness; a row is zero (no
        motion) if its moment or the next is not valid.

    Raises:
        GeometryError: The shapes do not fit, or there is no pose.
    """
    poses = _stacked("world_from_ego", world_from_ego)
    if not len(poses):
        raise GeometryError("world_from_ego: expected at least one pose, found none")
    if valid is None:
        valid = np.ones(len(poses))
    recorded: BoolArray = checked("valid", valid, (len(poses),), np.bool_)
    known_steps = recorded[:-1] & recorded[1:]
    world_from_this = poses[:-1][known_steps]
    world_from_next = poses[1:][known_steps]
    motion = np.zeros((len(poses) - 1, 6))
    motion[known_steps] = conventions.six_vectors_of(inverses(world_from_next) @ world_from_this)
    return motion


def _stacked(name: str, poses: Poses) -> FloatArray:
    """Return poses as an array (K, 4, 4)."""
    matrices: Any = poses
    if isinstance(poses, Iterable) and not isinstance(poses, np.ndarray):
        matrices = [pose.matrix if isinstance(pose, SE3) else pose for pose in poses]
    return checked(name, matrices, (None, 4, 4))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImagePoints(FrozenArrays):
    """N points projected into an image; arrays are read-only.

    Attributes:
        pixels: Image coordinates (u, v), shape (N, 2), float64; pixel centres are at 0.5, 1.5, …;
            NaN behind the camera.
        depth: Distances along the optical axis, shape (N,), float64, metres.
        color: RGB colours of the pixels, shape (N, 3), uint8, black outside the image; None if no
            colours were requested.
        mask: Truth values, shape (N,): whether a point is in front of the camera and in the image
            (other things may hide it).
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
    """Project points of one agent into an image of any agent at any moment of the same scenario.

    The points are assumed to stand still: points of another moment are wrong for things that moved.

    Args:
        dataset: The release.
        points: A point cloud, or an array (N, 3), metres.
        sample: Token or record of the sample to which the points' coordinate frame belongs.
        camera: Token or record of the image (sample data).
        frame: Coordinate frame of the points: `world`, `ego`, `lidar` or a channel of `sample`;
            None for the frame of a cloud, or for `world` with an array.
        colors: Whether to load the image for its colours.

    Raises:
        TokenError: There is no such sample or sensor file, such as a camera that does not exist.
        ChoiceError: The sensor is no camera, there is no such frame, or `sample` and `camera` are
            of two scenarios.
        GeometryError: The points are no array (N, 3).
        MissingFileError: `colors` is true and the image was not downloaded.
        SensorFileError: The image cannot be read.
    """
    if isinstance(points, LidarPointCloud):
        xyz = points.xyz
        source = frame or points.frame
    else:
        xyz = checked("points", points, (None, 3))
        source = frame or "world"
    record = dataset.get("sample_data", camera)
    pinhole = camera_of(dataset, record)
    optical_from_source = transform(
        dataset, record["sample_token"], sample, record["channel"], source
    )
    pixels, depth = pinhole.project(optical_from_source.apply(xyz))
    mask = pinhole.in_image(pixels)
    color = colors_at(dataset.load_image(record), pinhole, pixels, mask) if colors else None
    return ImagePoints(pixels=pixels, depth=depth, color=color, mask=mask)


@with_keywords_named
def map_pointcloud_to_image(
    dataset: Dataset, camera: RowArgument, sample: RowArgument | None = None, *, colors: bool = True
) -> ImagePoints:
    """Project a sample's LiDAR into an image, like the nuScenes explorer's function of this name.

    Args:
        dataset: The release.
        camera: Token or record of the image (sample data).
        sample: Token or record of the sample with the LiDAR; None for the camera's own sample.
        colors: Whether to load the image for its colours.

    Returns:
        One row for each point, in the cloud's order.

    Raises:
        TokenError: There is no such sample or sensor file.
        ChoiceError: The sensor is no camera, or `sample` and `camera` are of two scenarios.
        MissingFileError: The image or the cloud was not downloaded.
        SensorFileError: The image or the cloud cannot be read.
    """
    record = dataset.get("sample_data", camera)
    lidar_sample = record["sample_token"] if sample is None else sample
    cloud = dataset.load_point_cloud(lidar_sample, "lidar")
    return project_to_image(dataset, cloud, lidar_sample, record, colors=colors)


def camera_of(dataset: Dataset, camera: RowArgument) -> PinholeCamera:
    """Return the pinhole camera of an image, with the image size that calib gives.

    Raises:
        TokenError: There is no such sensor file.
        ChoiceError: The sensor is no camera.
    """
    return dataset.camera(camera)


def colors_at(
    image: ByteArray, camera: PinholeCamera, pixels: FloatArray, mask: BoolArray
) -> ByteArray:
    """Look up the colours of points in an image.

    Args:
        image: RGB image, shape (H, W, 3), uint8.
        camera: Camera of the image; pixels are scaled if the image was stored smaller than calib
            gives.
        pixels: Image coordinates (u, v), shape (N, 2).
        mask: Truth values, shape (N,): the points in the image.

    Returns:
        RGB colours, shape (N, 3), uint8, black for points outside the image.
    """
    height, width = image.shape[:2]
    columns = (pixels[mask, 0] * (width / camera.width)).astype(np.intp)
    rows = (pixels[mask, 1] * (height / camera.height)).astype(np.intp)
    colors = np.zeros((len(pixels), 3), dtype=np.uint8)
    colors[mask] = image[np.minimum(rows, height - 1), np.minimum(columns, width - 1)]
    return colors
