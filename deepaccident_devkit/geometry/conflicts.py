"""Conflicts of two road users, seen from above: when boxes touch if they keep their velocities."""

from __future__ import annotations

import numpy as np

from deepaccident_devkit.arrays import FloatArray


def time_to_collision(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Seconds until P pairs of boxes touch, seen from above, if each keeps its velocity and does not turn.

    Two boxes touch while they overlap along each of the four directions of their sides. For each direction that is an
    interval of time. So the boxes touch from the latest begin to the earliest end of the four.

    Args:
        first: (P, 5) x, y, length, width, yaw; metres and radians, in one coordinate frame.
        second: (P, 5) the same of the second boxes.
        first_velocity: (P, 2) metres a second, over the ground, along the axes of that frame.
        second_velocity: (P, 2) the same of the second boxes.

    Returns:
        (P,) 0 for boxes that touch now, infinite for boxes that never touch.
    """
    apart, speed = second[:, :2] - first[:, :2], second_velocity - first_velocity
    yaw = np.stack([first[:, 4], first[:, 4] + np.pi / 2, second[:, 4], second[:, 4] + np.pi / 2], axis=1)
    normal = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    reach = np.zeros(yaw.shape)
    for box in (first, second):
        turned = box[:, None, 4] - yaw
        reach += np.abs(np.cos(turned)) * box[:, None, 2] / 2 + np.abs(np.sin(turned)) * box[:, None, 3] / 2
    gap, closing = np.einsum("pnk,pk->pn", normal, apart), np.einsum("pnk,pk->pn", normal, speed)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(-reach - gap) / closing, (reach - gap) / closing])
    begin, end = ends.min(axis=0), ends.max(axis=0)
    still = closing == 0
    parted = still & (np.abs(gap) > reach)
    begin, end = np.where(still, -np.inf, begin), np.where(still, np.inf, end)
    start = np.maximum(begin.max(axis=1), 0.0)
    meets = (start <= end.min(axis=1)) & ~parted.any(axis=1)
    times: FloatArray = np.where(meets, start, np.inf)
    return times
