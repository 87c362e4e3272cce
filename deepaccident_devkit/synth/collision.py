"""How far apart oriented rectangles are, over arrays of poses."""

import numpy as np

from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.support.arrays import FloatArray


def separation(poses_a: FloatArray, size_a: FloatArray, poses_b: FloatArray, size_b: FloatArray) -> FloatArray:
    """The widest gap (…) along any side's normal, metres: 0 where rectangles just touch, negative if they overlap.

    Args:
        poses_a: (…, 3) x, y, yaw of the rectangles' centres.
        size_a: (…, 2) full length and width, metres.
        poses_b: like `poses_a`, of any shape that broadcasts.
        size_b: like `size_a`.
    """
    turn = poses_b[..., 2] - poses_a[..., 2]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    along_a = np.abs(_relative(poses_a, poses_b[..., :2]))
    along_b = np.abs(_relative(poses_b, poses_a[..., :2]))
    half_a, half_b = size_a / 2, size_b / 2
    gaps = [
        along_a[..., 0] - half_a[..., 0] - half_b[..., 0] * cos - half_b[..., 1] * sin,
        along_a[..., 1] - half_a[..., 1] - half_b[..., 0] * sin - half_b[..., 1] * cos,
        along_b[..., 0] - half_b[..., 0] - half_a[..., 0] * cos - half_a[..., 1] * sin,
        along_b[..., 1] - half_b[..., 1] - half_a[..., 0] * sin - half_a[..., 1] * cos,
    ]
    result: FloatArray = np.max(np.stack(np.broadcast_arrays(*gaps)), axis=0)
    return result


def gap(poses_a: FloatArray, size_a: FloatArray, poses_b: FloatArray, size_b: FloatArray) -> FloatArray:
    """The distance between rectangles (…), metres, 0 where they overlap; arguments as in `separation`.

    Two disjoint rectangles are nearest at a corner of one of them.
    """
    return gaps_of_pairs(_footprints(poses_a, size_a), _footprints(poses_b, size_b))


def _relative(poses: FloatArray, points: FloatArray) -> FloatArray:
    """Points (…, 2) in the frames of poses (…, 3)."""
    delta = points - poses[..., :2]
    cos, sin = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    return np.stack([cos * delta[..., 0] + sin * delta[..., 1], cos * delta[..., 1] - sin * delta[..., 0]], axis=-1)


def _footprints(poses: FloatArray, size: FloatArray) -> FloatArray:
    """Rectangles (…, 5) as `geometry.box_arrays` has them: x, y, length, width, yaw."""
    sizes = np.broadcast_to(size, (*poses.shape[:-1], 2))
    return np.concatenate([poses[..., :2], sizes, poses[..., 2:]], axis=-1)
