"""Who notices whom: the nearest road user ahead on the path and, at the last moment, the other one of the pair."""

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.synth.collision import separation
from deepaccident_devkit.synth.traffic.kinematics import Tracks

_SPACING = 2.0
_POINTS = np.arange(0.0, 44.0, _SPACING)
"""Metres ahead along a road user's own path."""
_MARGIN = 0.25
"""The free space at each side that drivers want, metres."""
_BEHIND = 2.0
"""Metres: a road user that is farther back than this does not count as ahead."""


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """Where all road users are at one moment.

    Attributes:
        poses: (A, 3) x, y (metres), yaw (radians) of the boxes' centres.
        speed: (A,) m/s.
        length: (A,) metres.
        width: (A,) metres.
    """

    poses: FloatArray
    speed: FloatArray
    length: FloatArray
    width: FloatArray


def leaders(bodies: Bodies, tracks: Tracks, centers: FloatArray, sees: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Gap (A,) in metres to the nearest one ahead on each path, infinite if there is none, and that one's speed (A,).

    Args:
        bodies: where they are.
        tracks: their paths.
        centers: (A,) how far along its path the centre of each is, metres.
        sees: (A, A) bool, whether the road user of the row reacts to that of the column.
    """
    rows, others = _candidates(bodies, sees)
    gaps, speeds = np.full(len(centers), np.inf), np.zeros(len(centers))
    if not len(rows):
        return gaps, speeds
    ahead, lateral, turn = _in_path_frame(bodies, tracks, centers, rows, others)
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    half_along = (cos * bodies.length[others] + sin * bodies.width[others]) / 2
    half_across = (sin * bodies.length[others] + cos * bodies.width[others]) / 2
    blocking = (np.abs(lateral) < bodies.width[rows] / 2 + half_across + _MARGIN) & (ahead > 0)
    rows, others = rows[blocking], others[blocking]
    gap = (ahead - half_along)[blocking] - bodies.length[rows] / 2
    order = np.argsort(-gap, kind="stable")  # the nearest is written last
    gaps[rows[order]] = gap[order]
    along_path = np.maximum(bodies.speed[others] * np.cos(turn[blocking]), 0.0)
    speeds[rows[order]] = along_path[order]
    return gaps, speeds


def _candidates(bodies: Bodies, sees: BoolArray) -> tuple[IntArray, IntArray]:
    """Pairs of rows: one that looks, and another that is near and not behind it."""
    delta = bodies.poses[None, :, :2] - bodies.poses[:, None, :2]
    heading = bodies.poses[:, 2]
    forward = np.cos(heading)[:, None] * delta[..., 0] + np.sin(heading)[:, None] * delta[..., 1]
    reach = (_POINTS[-1] + bodies.length)[:, None] / 2 + 2.0 * bodies.speed[:, None]
    near = (delta[..., 0] ** 2 + delta[..., 1] ** 2 < reach**2) & (forward > -_BEHIND) & sees
    rows, others = np.nonzero(near)
    return rows, others


def _in_path_frame(
    bodies: Bodies, tracks: Tracks, centers: FloatArray, rows: IntArray, others: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How far ahead, how far to the left (metres) and how much turned (radians) others are, along the rows' paths."""
    points, along = tracks.near(rows, centers[rows, None] + _POINTS)
    delta = bodies.poses[others, None, :2] - points[..., :2]
    nearest = (delta**2).sum(axis=-1).argmin(axis=1)
    pick = np.arange(len(rows))
    offset, yaw = delta[pick, nearest], points[pick, nearest, 2]
    cos, sin = np.cos(yaw), np.sin(yaw)
    ahead = along[pick, nearest] - centers[rows] + cos * offset[:, 0] + sin * offset[:, 1]
    return ahead, cos * offset[:, 1] - sin * offset[:, 0], bodies.poses[others, 2] - yaw


_STEP = 0.05
"""Seconds between the future moments that are checked for a contact."""
_FIELD_OF_VIEW = np.deg2rad(80.0)
"""How far to each side of straight ahead a driver looks, radians."""


class Alarm:
    """Which of a pair has noticed its coming contact; from then on it brakes until the end.

    Args:
        rows: (2,) rows of the pair.
        size: (2, 2) length and width of the two, metres.
        alert: (2,) seconds before the contact at which each notices it; 0 for never.
    """

    def __init__(self, rows: IntArray, size: FloatArray, alert: FloatArray) -> None:
        self._rows, self._size, self._alert = rows, size, alert
        self._ahead = np.arange(0.0, alert.max() + _STEP / 2, _STEP)
        self._noticed = np.zeros(2, dtype=bool)

    def rows(self, poses: FloatArray, velocities: FloatArray) -> IntArray:
        """Rows of those who brake, 0 to 2 of them; call it with one moment after the other.

        Args:
            poses: (A, 3) x, y (metres), yaw (radians) of all boxes' centres.
            velocities: (A, 2) m/s; they are assumed to stay the same.
        """
        two, moving = poses[self._rows], velocities[self._rows]
        expected = np.repeat(two[:, None], len(self._ahead), axis=1)
        expected[..., :2] += self._ahead[:, None] * moving[:, None]
        touching = separation(expected[0], self._size[0], expected[1], self._size[1]) <= 0
        if touching.any():
            self._noticed |= (self._ahead[touching.argmax()] < self._alert) & _looks_at(two)
        return self._rows[self._noticed]


def _looks_at(poses: FloatArray) -> BoolArray:
    """(2,) bool, whether each of two (2, 3) has the other in its field of view."""
    delta = poses[::-1, :2] - poses[:, :2]
    bearing = np.arctan2(delta[:, 1], delta[:, 0]) - poses[:, 2]
    return np.asarray(np.cos(bearing) > np.cos(_FIELD_OF_VIEW))
