"""Conflicts of two road users, seen from above: when boxes touch if they keep their velocities."""

from __future__ import annotations

import numpy as np

from deepaccident_devkit.support.arrays import FloatArray


def time_to_collision(
    first: FloatArray, second: FloatArray, first_velocity: FloatArray, second_velocity: FloatArray
) -> FloatArray:
    """Seconds until pairs of boxes touch, seen from above, if each keeps its velocity and does not turn.

    Two boxes touch while they overlap along each of the four directions of their sides. For each direction that is an
    interval of time. So the boxes touch from the latest begin to the earliest end of the four.

    Args:
        first: (…, 5) x, y, length, width, yaw; metres and radians, in one coordinate frame.
        second: (…, 5) the same of the second boxes.
        first_velocity: (…, 2) metres a second, over the ground, along the axes of that frame.
        second_velocity: (…, 2) the same of the second boxes.

    Returns:
        (…,) 0 for boxes that touch now, infinite for boxes that never touch; NaN where a velocity is.
    """
    normal, gap, reach = side_gaps(first, second)
    closing = along(normal, second_velocity - first_velocity)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ends = np.stack([(-reach - gap) / closing, (reach - gap) / closing])
    begin, end = ends.min(axis=0), ends.max(axis=0)
    still = closing == 0
    parted = still & (np.abs(gap) > reach)
    begin, end = np.where(still, -np.inf, begin), np.where(still, np.inf, end)
    start = np.maximum(begin.max(axis=-1), 0.0)
    meets = (start <= end.min(axis=-1)) & ~parted.any(axis=-1)
    times: FloatArray = np.where(meets | np.isnan(start), start, np.inf)
    return times


def side_gaps(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How pairs of boxes (…, 5) lie along the four directions of their sides; they touch while |gap| ≤ reach in all.

    Returns:
        (…, 4, 2) unit directions, the first's two and then the second's; (…, 4) gaps, from the first's centre to the
        second's along them; and (…, 4) reaches, half of both boxes' extents along them. Metres.
    """
    normal = normals(np.concatenate([side_yaws(first), side_yaws(second)], axis=-1))
    gap = along(normal, second[..., :2] - first[..., :2])
    return normal, gap, half_extents(first, normal) + half_extents(second, normal)


def side_yaws(boxes: FloatArray) -> FloatArray:
    """The directions (…, 2) of the normals of boxes' (…, 5) front and left sides, radians."""
    yaw: FloatArray = boxes[..., 4, None] + np.array([0.0, np.pi / 2])
    return yaw


def normals(yaw: FloatArray) -> FloatArray:
    """Unit vectors (…, 2) in directions (…), radians."""
    return np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)


def along(directions: FloatArray, vectors: FloatArray) -> FloatArray:
    """How far vectors (…, 2) go along each of their N directions (…, N, 2): (…, N)."""
    result: FloatArray = directions[..., 0] * vectors[..., 0, None] + directions[..., 1] * vectors[..., 1, None]
    return result


def half_extents(boxes: FloatArray, directions: FloatArray) -> FloatArray:
    """Half of the extents of boxes (…, 5) along each of their N unit directions (…, N, 2): (…, N) metres."""
    lengthwise, across = (np.abs(along(directions, normals(yaw))) for yaw in np.moveaxis(side_yaws(boxes), -1, 0))
    result: FloatArray = lengthwise * boxes[..., 2, None] / 2 + across * boxes[..., 3, None] / 2
    return result
