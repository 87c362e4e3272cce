"""Count points in boxes, without the devkit."""

import numpy as np


def count_points_in_box(box: np.ndarray, points: np.ndarray, margin_m: float) -> int:
    """Count the points (N, 3) in a box of centre, full lengths and yaw, grown on every side.

    The yaw turns from x to y, as in a right-handed frame.
    """
    x, y, z = (points - box[:3]).T
    cos, sin = np.cos(box[6]), np.sin(box[6])
    offsets = np.column_stack([x * cos + y * sin, y * cos - x * sin, z])
    is_inside = np.abs(offsets) <= box[3:6] / 2 + margin_m
    return int(is_inside.all(axis=1).sum())
