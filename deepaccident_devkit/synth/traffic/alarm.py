"""Those who meet notice each other at the last moment, or never."""

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.synth.collision import separation

_STEP = 0.05
"""Seconds between the moments ahead at which it is looked whether they touch."""
_FIELD_OF_VIEW = np.deg2rad(80.0)
"""To each side of straight ahead, within which a driver looks."""


class Alarm:
    """Who of a pair that minds nobody has seen the contact coming; who has once, brakes until the end.

    Args:
        rows: (2,) of the pair.
        size: (2, 2) length and width of theirs, metres.
        alert: (2,) seconds before the contact at which each notices it; 0 for never.
    """

    def __init__(self, rows: IntArray, size: FloatArray, alert: FloatArray) -> None:
        self._rows, self._size, self._alert = rows, size, alert
        self._ahead = np.arange(0.0, alert.max() + _STEP / 2, _STEP)
        self._noticed = np.zeros(2, dtype=bool)

    def rows(self, poses: FloatArray, velocities: FloatArray) -> IntArray:
        """Rows of those who brake, 0 to 2 of them; to be asked at one moment after the other.

        Args:
            poses: (A, 3) x, y (metres), yaw (radians) of all boxes' centres.
            velocities: (A, 2) m/s, with which they are expected to go on.
        """
        two, moving = poses[self._rows], velocities[self._rows]
        expected = np.repeat(two[:, None], len(self._ahead), axis=1)
        expected[..., :2] += self._ahead[:, None] * moving[:, None]
        touching = separation(expected[0], self._size[0], expected[1], self._size[1]) <= 0
        if touching.any():
            self._noticed |= (self._ahead[touching.argmax()] < self._alert) & _looks_at(two)
        return self._rows[self._noticed]


def _looks_at(poses: FloatArray) -> BoolArray:
    """(2,) bool, whether each of two (2, 3) has the other before it."""
    delta = poses[::-1, :2] - poses[:, :2]
    bearing = np.arctan2(delta[:, 1], delta[:, 0]) - poses[:, 2]
    return np.asarray(np.cos(bearing) > np.cos(_FIELD_OF_VIEW))
