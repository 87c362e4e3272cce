"""Who touches whom in a simulation."""

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.synth.collision import gap, separation

_LOOK_STEP = 5
"""Steps between the moments at which it is looked who is near whom."""
_NEAR = 2.0
"""Metres that two may come nearer between these moments."""


def touching_pairs(poses: FloatArray, size: FloatArray, margin: float) -> list[tuple[int, int]]:
    """Pairs of rows, the first one lower, that come nearer to each other than `margin`, along any side's normal.

    Args:
        poses: (S, A, 3) x, y (metres), yaw (radians) of the boxes' centres.
        size: (A, 2) length and width, metres.
        margin: metres.
    """
    found = []
    for i, j in _near_pairs(poses, size, margin):
        if (separation(poses[:, i], size[i], poses[:, j], size[j]) < margin).any():
            found.append((i, j))
    return found


def least_gap(poses: FloatArray, size: FloatArray, rows: list[int], enough: float) -> float:
    """The least distance in metres between any two of some rows; arguments as in `touching_pairs`.

    Pairs that never come nearer than `enough` are not looked at; it is returned if there is no other.
    """
    pairs = _near_pairs(poses[:, rows], size[rows], enough)
    gaps = [float(gap(poses[:, rows[i]], size[rows[i]], poses[:, rows[j]], size[rows[j]]).min()) for i, j in pairs]
    return min([*gaps, enough])


def _near_pairs(poses: FloatArray, size: FloatArray, margin: float) -> list[tuple[int, int]]:
    """Pairs of rows that may come nearer than `margin`."""
    moments = np.concatenate([poses[::_LOOK_STEP], poses[-1:]])
    x, y = moments[..., 0], moments[..., 1]
    square = (x[:, :, None] - x[:, None, :]) ** 2 + (y[:, :, None] - y[:, None, :]) ** 2
    radius = np.hypot(size[:, 0], size[:, 1]) / 2
    near = (square < (radius[:, None] + radius + margin + _NEAR) ** 2).any(axis=0)
    rows, columns = np.nonzero(np.triu(near, 1))
    return list(zip(rows.tolist(), columns.tolist(), strict=True))
