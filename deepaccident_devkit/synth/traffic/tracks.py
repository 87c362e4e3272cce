"""The paths of all road users as one table, so that all are looked up at once."""

from collections.abc import Sequence

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.synth.roads.paths import Path

SPACING = 0.25
"""Metres between the table's points."""
_BEYOND = 80.0
"""Metres for which a path goes straight on past its end."""
_BEND_BRAKING = 1.8
"""m/s² at which drivers slow down before a bend."""


class Tracks:
    """Points along each path, and how fast its bends allow to drive; one row a road user.

    Args:
        paths: of the road users.
        lateral: (A,) m/s² that each takes across itself in a bend.
        stops: (A,) bool, whether it stops at its path's end; else it goes straight on.
    """

    def __init__(self, paths: Sequence[Path], lateral: FloatArray, stops: BoolArray) -> None:
        reach = max(path.length for path in paths) + _BEYOND
        along = np.arange(0.0, reach, SPACING)
        distinct = {id(path): path for path in paths}
        order = {key: row for row, key in enumerate(distinct)}
        points = np.stack([np.stack(path.at(along), axis=-1) for path in distinct.values()])
        rows = np.array([order[id(path)] for path in paths])
        self._points, self._distinct = points, rows  # (P, K, 4), (A,)
        ends = np.where(stops, [path.length for path in paths], np.inf)
        self._allowed = _allowed_speed(along, points[rows, :, 3], lateral, ends)
        self._flat = np.ascontiguousarray(points.reshape(-1, 4).T)
        self._first = rows * len(along)
        self._row = np.arange(len(paths))
        self._last = len(along) - 2

    def at(self, along: FloatArray) -> FloatArray:
        """(4, A) x, y, yaw, curvature where each is, `along` (A,) metres from its path's start."""
        low, share = self._cell(along)
        flat = self._first + low
        before = self._flat[:, flat]
        return np.asarray(before + share * (self._flat[:, flat + 1] - before))

    def near(self, rows: IntArray, along: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The table's points nearest to `along` (P, K) metres on the paths of `rows` (P,).

        Returns:
            x, y, yaw, curvature (P, K, 4), and how far along they are (P, K), metres.
        """
        cells = np.rint(along / SPACING).astype(np.int64).clip(0, self._last)
        return np.asarray(self._points[self._distinct[rows, None], cells]), cells * SPACING

    def allowed_speed(self, along: FloatArray) -> FloatArray:
        """(A,) m/s from which the bends ahead can be reached comfortably."""
        low, _ = self._cell(along)
        return np.asarray(self._allowed[self._row, low])

    def _cell(self, along: FloatArray) -> tuple[IntArray, FloatArray]:
        place = along / SPACING
        low = np.minimum(np.maximum(place, 0.0), self._last).astype(np.int64)
        return low, place - low


def _allowed_speed(along: FloatArray, curvature: FloatArray, lateral: FloatArray, ends: FloatArray) -> FloatArray:
    """(A, K) m/s, so slow that each bend ahead is entered as slowly as it asks, and nobody passes its end."""
    bend = lateral[:, None] / np.maximum(np.abs(curvature), 1e-4)
    bend[along >= ends[:, None]] = 0.0
    lead = bend + 2 * _BEND_BRAKING * along
    least = np.minimum.accumulate(lead[:, ::-1], axis=1)[:, ::-1]
    return np.sqrt(np.maximum(least - 2 * _BEND_BRAKING * along, 0.0))
