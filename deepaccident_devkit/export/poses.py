"""Poses and boxes in the conventions of other codes; the devkit's are right-handed, these say what each one has."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.geometry.handedness import flip_pose


def carla_six(pose: ArrayLike) -> FloatArray:
    """Right-handed rigid matrices (…, 4, 4) → CARLA's (…, 6): x, y, z in metres, roll, yaw, pitch in degrees.

    Left-handed, as CARLA's `Transform` and OpenCOOD's `x_to_world` have them: yaw clockwise from above, pitch upwards.
    """
    m = flip_pose(pose)
    roll = np.arctan2(-m[..., 2, 1], m[..., 2, 2])
    yaw = np.arctan2(m[..., 1, 0], m[..., 0, 0])
    pitch = np.arcsin(np.clip(m[..., 2, 0], -1.0, 1.0))
    angles = np.degrees(np.stack([roll, yaw, pitch], axis=-1))
    return np.concatenate([m[..., :3, 3], angles], axis=-1)
