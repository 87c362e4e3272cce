"""The frame of the labels' velocities: the world's, turned once more by the box's own yaw (docs/conventions.md).

The release writes `(vx, vy) = Rz(yaw) · v_world`, with the row's own yaw in the agent's LiDAR frame. The rule is the
same in CARLA's left-handed axes and in the devkit's: mirroring negates both the angle and y. The agent's own row has
yaw 0, so it reads as the world's.
"""

import numpy as np

from deepaccident_devkit.arrays import FloatArray


def label_from_world_velocity(velocity: FloatArray, yaw: FloatArray) -> FloatArray:
    """(N, 2) m/s as a label writes them.

    Args:
        velocity: (N, 2) m/s in world.
        yaw: (N,) radians, each box's in the LiDAR frame of the label, of the same handedness.
    """
    return turned(velocity, yaw)


def world_from_label_velocity(velocity: FloatArray, yaw: FloatArray) -> FloatArray:
    """(N, 2) m/s in world: the inverse of `label_from_world_velocity`; NaN stays NaN."""
    return turned(velocity, -yaw)


def turned(vectors: FloatArray, angle: FloatArray) -> FloatArray:
    """Vectors (N, 2) turned by angles (N,), from the first axis to the second."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.column_stack([cos * x - sin * y, sin * x + cos * y])
