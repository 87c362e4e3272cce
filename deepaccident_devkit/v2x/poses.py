"""Poses of agents, transforms between them, and one agent's points in another one's images.

See docs/released_code.md, Poses. Every function works with either handedness: the devkit's
right-handed poses yield right-handed 6-vectors, and CARLA's raw poses yield the released code's
6-vectors. `geometry.conventions.flip_six_vector` converts between them.
"""

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
"""Poses of several agents or times: SE3 objects, or an array (K, 4, 4)."""


def transform(
    dataset: Dataset,
    target_sample: RowArgument,
    source_sample: RowArgument,
    target: str = "ego",
    source: str = "ego",
) -> SE3:
    """Return `target_from_source` between the frames of two samples of one scenario.

    Args:
        dataset: The release.
        target_sample: Token or record of the sample that the target frame belongs to.
        source_sample: Token or record of the sample that the source frame belongs to.
        target: `world`, `ego`, `lidar` or a channel (cameras: the optical frame).
        source: The source frame, with the same choices as `target`.

    Raises:
        TokenError: The sample is unknown.
        ChoiceError: A frame is unknown, or the samples are from two scenarios, which take place in
            unrelated worlds.
    """
    target_scenario = dataset.get("sample", target_sample)["scenario_token"]
    source_scenario = dataset.get("sample", source_sample)["scenario_token"]
    if target_scenario != source_scenario:
        raise ChoiceError(
            f"transform: expected two samples of one scenario, found {target_scenario} and "
            f"{source_scenario}; scenarios take place in different worlds"
        )
    target_from_world = dataset.world_from(target_sample, target).inverse()
    return target_from_world @ dataset.world_from(source_sample, source)


def relative_pose_to_ego(world_from_agent: Poses) -> FloatArray:
    """Return each agent's pose in the ego's frame, `ego_from_agent`, as a 6-vector.

    See docs/released_code.md, Poses.

    Args:
        world_from_agent: Poses at one time, the ego's first: shape (K, 4, 4), or K SE3 objects.

    Returns:
        6-vectors, shape (K, 6), metres and radians, in the ego's frame and the poses' handedness;
        row 0 is zero, up to rounding errors.

    Raises:
        GeometryError: The poses have the wrong shape, or there is none.
    """
    poses = _stack_matrices("world_from_agent", world_from_agent)
    if not len(poses):
        raise GeometryError(
            "world_from_agent: expected the ego's pose and its partners', found none"
        )
    ego_from_world = inverses(poses[:1])
    return conventions.six_vectors_of(ego_from_world @ poses)


def future_egomotion(world_from_ego: Poses, valid: ArrayLike | None = None) -> FloatArray:
    """Return an agent's motion from each time to the next, `next_from_this`, as 6-vectors.

    See docs/released_code.md, Poses. Each row transforms points from the ego frame at one time to
    the ego frame at the next time. To get the released code's seven rows, pass eight poses, from
    1 s before the current frame to 2.5 s after it, in steps of 0.5 s.

    Args:
        world_from_ego: Poses of one agent, earliest first, shape (T + 1, 4, 4), or T + 1 SE3
            objects.
        valid: Truth values, shape (T + 1,): whether each time is in the recording; the other poses
            do not matter. None if all are.

    Returns:
        6-vectors, shape (T, 6), metres and radians, in the poses' handedness; a row is zero (no
            motion) if its time or the next is not valid.

    Raises:
        GeometryError: The shapes do not match, or there is no pose.
    """
    poses = _stack_matrices("world_from_ego", world_from_ego)
    if not len(poses):
        raise GeometryError("world_from_ego: expected at least one pose, found none")
    if valid is None:
        valid = np.ones(len(poses))
    is_recorded: BoolArray = checked("valid", valid, (len(poses),), np.bool_)
    is_known = is_recorded[:-1] & is_recorded[1:]
    world_from_this = poses[:-1][is_known]
    next_from_world = inverses(poses[1:][is_known])
    motion = np.zeros((len(poses) - 1, 6))
    motion[is_known] = conventions.six_vectors_of(next_from_world @ world_from_this)
    return motion


def _stack_matrices(name: str, poses: Poses) -> FloatArray:
    """Return poses as an array (K, 4, 4)."""
    matrices: Any = poses
    if isinstance(poses, Iterable) and not isinstance(poses, np.ndarray):
        matrices = []
        for pose in poses:
            matrix = pose.matrix if isinstance(pose, SE3) else pose
            matrices.append(matrix)
    return checked(name, matrices, (None, 4, 4))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImagePoints(FrozenArrays):
    """N points projected into an image, with read-only arrays.

    Attributes:
        pixels: Image coordinates (u, v), shape (N, 2), float64; pixel centres are at 0.5, 1.5, …;
            NaN for points behind the camera.
        depth: Distances along the optical axis, shape (N,), float64, metres.
        color: RGB colours of the pixels, shape (N, 3), uint8, black outside the image; None if no
            colours were requested.
        mask: Truth values, shape (N,): whether a point is in front of the camera and in the image
            (other objects may hide it).
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
    """Project an agent's points into an image of any agent and frame of the same scenario.

    The points are assumed to be stationary: if the image is from another time, the points of moving
    objects are projected to the wrong pixels.

    Args:
        dataset: The release.
        points: A point cloud, or an array (N, 3), metres.
        sample: Token or record of the sample that the points' coordinate frame belongs to.
        camera: Token or record of the image (sample data).
        frame: Coordinate frame of the points: `world`, `ego`, `lidar` or a channel of `sample`;
            None for the cloud's own frame; for an array, `world`.
        colors: Whether to load the image, for the points' colours.

    Raises:
        TokenError: The sample or the sensor file is unknown.
        ChoiceError: The sensor is not a camera, the frame is unknown, or `sample` and `camera` are
            from two scenarios.
        GeometryError: The points are not an array (N, 3).
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
    color = None
    if colors:
        image = dataset.load_image(record)
        color = colors_at(image, pinhole, pixels, mask)
    return ImagePoints(pixels=pixels, depth=depth, color=color, mask=mask)


@with_keywords_named
def map_pointcloud_to_image(
    dataset: Dataset, camera: RowArgument, sample: RowArgument | None = None, *, colors: bool = True
) -> ImagePoints:
    """Project a sample's LiDAR points into an image, like the nuScenes function of this name.

    Args:
        dataset: The release.
        camera: Token or record of the image (sample data).
        sample: Token or record of the sample with the point cloud; None for the image's sample.
        colors: Whether to load the image, for the points' colours.

    Returns:
        One row for each point, in the cloud's order.

    Raises:
        TokenError: The sample or the sensor file is unknown.
        ChoiceError: The sensor is not a camera, or `sample` and `camera` are from two scenarios.
        MissingFileError: The image or the cloud was not downloaded.
        SensorFileError: The image or the cloud cannot be read.
    """
    record = dataset.get("sample_data", camera)
    lidar_sample = record["sample_token"] if sample is None else sample
    cloud = dataset.load_point_cloud(lidar_sample, "lidar")
    return project_to_image(dataset, cloud, lidar_sample, record, colors=colors)


def camera_of(dataset: Dataset, camera: RowArgument) -> PinholeCamera:
    """Return the pinhole camera of an image, with the image size from the calib file.

    Raises:
        TokenError: The sensor file is unknown.
        ChoiceError: The sensor is not a camera.
    """
    return dataset.camera(camera)


def colors_at(
    image: ByteArray, camera: PinholeCamera, pixels: FloatArray, mask: BoolArray
) -> ByteArray:
    """Look up the colours of points in an image.

    Args:
        image: RGB image, shape (H, W, 3), uint8.
        camera: Camera of the image; pixels are scaled if the stored image is smaller than the size
            in the calib file.
        pixels: Image coordinates (u, v), shape (N, 2).
        mask: Truth values, shape (N,): the points in the image.

    Returns:
        RGB colours, shape (N, 3), uint8, black for points outside the image.
    """
    height, width = image.shape[:2]
    x, y = pixels[mask].T
    columns = (x * (width / camera.width)).astype(np.intp)
    rows = (y * (height / camera.height)).astype(np.intp)
    columns = np.minimum(columns, width - 1)
    rows = np.minimum(rows, height - 1)
    colors = np.zeros((len(pixels), 3), dtype=np.uint8)
    colors[mask] = image[rows, columns]
    return colors
