"""Poses of agents, transforms between them, and points of any agent in the images of any.

See docs/released_code.md, Poses. Every function works for both kinds of handedness: right-handed poses (the devkit's)
give right-handed 6-vectors, CARLA's raw poses give those of the released code; `geometry.conventions.flip_six_vector`
converts one into the other.
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
    """The transform `target_from_source` between frames of any two agents and moments of one scenario.

    Args:
        dataset: the release.
        target_sample: token or record of the sample to which the target frame belongs.
        source_sample: token or record of the sample to which the source frame belongs.
        target: `world`, `ego`, `lidar` or a channel (cameras: the optical frame).
        source: the same choice as for `target`.

    Raises:
        TokenError: no such sample.
        ChoiceError: no such frame, or the samples are of two scenarios, whose worlds have nothing in common.
    """
    scenarios = [
        dataset.get("sample", sample)["scenario_token"] for sample in (target_sample, source_sample)
    ]
    if scenarios[0] != scenarios[1]:
        raise ChoiceError(
            f"transform: expected two samples of one scenario, found {scenarios[0]} and {scenarios[1]}; "
            "scenarios take place in different worlds"
        )
    world_from_target = dataset.world_from(target_sample, target)
    return world_from_target.inverse() @ dataset.world_from(source_sample, source)


def relative_pose_to_ego(world_from_agent: Poses) -> FloatArray:
    """Agents' poses in the ego's frame: `ego_from_agent` of each as a 6-vector (docs/released_code.md, Poses).

    Args:
        world_from_agent: (K, 4, 4), or K SE3: poses of one moment, the ego's first.

    Returns:
        (K, 6) metres and radians, in the ego's frame and the poses' handedness; row 0 is zero up to rounding.

    Raises:
        GeometryError: the poses have another shape, or there is none.
    """
    poses = _stacked("world_from_agent", world_from_agent)
    if not len(poses):
        raise GeometryError(
            "world_from_agent: expected the ego's pose and its partners', found none"
        )
    return conventions.six_vectors_of(inverses(poses[:1]) @ poses)


def future_egomotion(world_from_ego: Poses, valid: ArrayLike | None = None) -> FloatArray:
    """An agent's motion from each of its moments to the next: `next_from_this` as 6-vectors.

    See docs/released_code.md, Poses. A row maps points of a moment's ego frame into the next moment's ego frame. For
    the seven rows of the released code give eight poses: 1 s before the present to 2.5 s after it, in steps of 0.5 s.

    Args:
        world_from_ego: (T + 1, 4, 4), or T + 1 SE3: poses of one agent in the order of time.
        valid: (T + 1,) whether each moment is in the recording; the poses of other moments do not matter. None if all
            are.

    Returns:
        (T, 6) metres and radians, in the poses' handedness; a row is zero (no motion) if its moment or the next is
        not valid.

    Raises:
        GeometryError: the shapes do not fit, or there is no pose.
    """
    poses = _stacked("world_from_ego", world_from_ego)
    if not len(poses):
        raise GeometryError("world_from_ego: expected at least one pose, found none")
    known: BoolArray = checked(
        "valid", np.ones(len(poses)) if valid is None else valid, (len(poses),), np.bool_
    )
    both = known[:-1] & known[1:]
    motion = np.zeros((len(poses) - 1, 6))
    motion[both] = conventions.six_vectors_of(inverses(poses[1:][both]) @ poses[:-1][both])
    return motion


def _stacked(name: str, poses: Poses) -> FloatArray:
    """The poses as an array (K, 4, 4)."""
    matrices: Any = poses
    if isinstance(poses, Iterable) and not isinstance(poses, np.ndarray):
        matrices = [pose.matrix if isinstance(pose, SE3) else pose for pose in poses]
    return checked(name, matrices, (None, 4, 4))


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
    optical_from_source = transform(
        dataset, record["sample_token"], sample, record["channel"], source
    )
    pixels, depth = lens.project(optical_from_source.apply(xyz))
    mask = lens.in_image(pixels)
    color = colors_at(dataset.load_image(record), lens, pixels, mask) if colors else None
    return ImagePoints(pixels=pixels, depth=depth, color=color, mask=mask)


@with_keywords_named
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
    return project_to_image(
        dataset, dataset.load_point_cloud(source, "lidar"), source, record, colors=colors
    )


def camera_of(dataset: Dataset, camera: RowArgument) -> PinholeCamera:
    """The pinhole camera of an image, with the image size that calib gives; raises TokenError or ChoiceError."""
    return dataset.camera(camera)


def colors_at(
    image: ByteArray, lens: PinholeCamera, pixels: FloatArray, mask: BoolArray
) -> ByteArray:
    """Colours (N, 3) uint8; pixels are scaled if the image was stored smaller than its calib says."""
    height, width = image.shape[:2]
    columns = (pixels[mask, 0] * (width / lens.width)).astype(np.intp)
    rows = (pixels[mask, 1] * (height / lens.height)).astype(np.intp)
    result = np.zeros((len(pixels), 3), dtype=np.uint8)
    result[mask] = image[np.minimum(rows, height - 1), np.minimum(columns, width - 1)]
    return result
