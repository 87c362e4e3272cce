"""Bodies set on the terrain: pitch and roll from the ground below their wheels."""

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray
from deepaccident_devkit.synth.roads import Terrain

_AXLES, _WHEELS = 0.3, 0.4
"""Where bodies touch the ground: shares of the length ahead of and behind the middle, of the width at its sides."""


def placed_on(terrain: Terrain, poses: FloatArray, size: FloatArray, upright: BoolArray) -> FloatArray:
    """The frames of bodies on the ground, (A, 4, 4): origin on the ground below the box's centre, x forward, z up.

    Args:
        terrain: the ground.
        poses: (A, 3) x, y (metres), yaw (radians) of the boxes' centres.
        size: (A, 3) length, width, height, metres.
        upright: (A,) who keeps upright on a slope.
    """
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    zero = np.zeros(len(poses))
    forward, left = np.stack([cos, sin, zero], axis=1), np.stack([-sin, cos, zero], axis=1)
    height = zero
    if not terrain.is_flat:
        ahead, aside = _AXLES * size[:, :1], _WHEELS * size[:, 1:2]
        xy = poses[:, :2]
        at = [xy + ahead * forward[:, :2], xy - ahead * forward[:, :2]]
        at += [xy + aside * left[:, :2], xy - aside * left[:, :2]]
        front, rear, port, starboard = terrain.height(np.concatenate(at)).reshape(4, -1)
        tilted = ~upright
        forward[tilted, 2] = ((front - rear) / (2 * ahead[:, 0]))[tilted]
        left[tilted, 2] = ((port - starboard) / (2 * aside[:, 0]))[tilted]
        height = (front + rear + port + starboard) / 4
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    up = np.cross(forward, left)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    frames = np.zeros((len(poses), 4, 4))
    frames[:, :3, 0], frames[:, :3, 1], frames[:, :3, 2] = forward, np.cross(up, forward), up
    frames[:, :2, 3], frames[:, 2, 3] = poses[:, :2], height
    frames[:, 3, 3] = 1.0
    return frames


def moved(corners: FloatArray, frames: FloatArray) -> FloatArray:
    """Points (P, K, 3) of P bodies' own frames, set at frames (P, 4, 4)."""
    turned: FloatArray = corners @ np.swapaxes(frames[:, :3, :3], 1, 2)
    return turned + frames[:, None, :3, 3]
