"""How actors go on from what is known of them: at a constant velocity, or at a constant turn rate besides."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np

from deepaccident_devkit.arrays import FloatArray

MotionModel = Literal["constant_velocity", "constant_turn_rate"]
_STRAIGHT: Final = 1e-6
"""Radians of turn below which a path is straight to all digits."""


def constant_velocity(pose: FloatArray, velocity: FloatArray, times: FloatArray) -> FloatArray:
    """Straight on.

    Args:
        pose: (N, 3) x, y (metres), yaw (radians) at time 0, in any right-handed frame.
        velocity: (N, 2) m/s over the ground, in the same frame; NaN counts as standing.
        times: (T,) seconds.

    Returns:
        (T, N, 3) x, y, yaw.
    """
    return constant_turn_rate(pose, velocity, np.zeros(len(pose)), times)


def constant_turn_rate(pose: FloatArray, velocity: FloatArray, turn_rate: FloatArray, times: FloatArray) -> FloatArray:
    """At a constant speed, while velocity and heading turn alike.

    Args:
        pose: as of `constant_velocity`.
        velocity: as of `constant_velocity`.
        turn_rate: (N,) radians a second, counter-clockwise; 0 goes straight on.
        times: (T,) seconds.

    Returns:
        (T, N, 3) x, y, yaw.
    """
    moving = np.where(np.isfinite(velocity), velocity, 0.0)
    turn = times[:, None] * turn_rate
    straight = np.abs(turn) < _STRAIGHT
    divisor = np.where(straight, 1.0, turn)
    # ∫ (cos, sin)(rate · s) ds from 0 to t, over t
    ahead = np.where(straight, 1.0, np.sin(turn) / divisor)
    aside = np.where(straight, turn / 2, (1 - np.cos(turn)) / divisor)
    x = ahead * moving[:, 0] - aside * moving[:, 1]
    y = aside * moving[:, 0] + ahead * moving[:, 1]
    way = times[:, None, None] * np.stack([x, y], axis=-1)
    return np.concatenate([pose[:, :2] + way, (pose[:, 2] + turn)[..., None]], axis=-1)
