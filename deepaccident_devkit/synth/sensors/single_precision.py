"""Calib files as the release has them."""

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.geometry.se3 import trusted_se3
from deepaccident_devkit.release import Calib


def with_single_precision(calib: Calib) -> Calib:
    """The calib of one frame as the release has it: made of world poses of single precision.

    The simulator knows every sensor's pose in the world as numbers of single precision, which at some hundred metres
    have steps of 0.03 mm, and the release's makers multiplied the inverse of one with another. So a transform between
    two sensors that never move against each other differs from frame to frame by up to 0.1 mm, and its rotation is
    rigid to some 1e-7 alone. Here the same is done: nothing is drawn. Intrinsics stay as they are.
    """
    world_from_lidar = calib.world_from_ego.matrix @ calib.ego_from_lidar.matrix
    lidar_from_camera = np.linalg.inv(np.stack([pose.matrix for pose in calib.camera_from_lidar.values()]))
    world_from_ego, lidar = _single(calib.world_from_ego.matrix), _single(_by_quaternion(world_from_lidar))
    camera_from_world = np.linalg.inv(_single(world_from_lidar @ lidar_from_camera))
    return Calib(
        ego_from_lidar=trusted_se3(np.linalg.inv(world_from_ego) @ lidar),
        world_from_ego=trusted_se3(world_from_ego),
        camera_from_lidar={
            channel: trusted_se3(pose)
            for channel, pose in zip(calib.camera_from_lidar, camera_from_world @ lidar, strict=True)
        },
        intrinsic=calib.intrinsic,
    )


def _single(matrices: FloatArray) -> FloatArray:
    return matrices.astype(np.float32).astype(np.float64)


def _by_quaternion(matrix: FloatArray) -> FloatArray:
    """A pose (4, 4) whose rotation went through a quaternion of single precision: it is not the ego's to the bit."""
    turned = matrix.copy()
    turned[:3, :3] = quaternions.to_matrix(_single(quaternions.from_matrix(matrix[:3, :3])))
    return turned
