"""`ScoreSeries`: the scores of recordings, frame by frame, for anticipation metrics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, FrozenArrays, IntArray

_SLACK: Final = 1e-6
"""Columns: times are decimal numbers, which binary numbers only approximate."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScoreSeries(FrozenArrays):
    """How sure a predictor is, at each frame of N recordings, that an accident comes; arrays are read-only.

    Attributes:
        scores: (N, T) float64, higher is surer; −inf where no threshold makes an alarm of it; NaN after a recording's
            end, and where a frame is missing.
        positive: (N,) bool, whether the recording ends in an accident.
        toa: (N,) float64, time of the accident: the column of the impact, which is no frame of the recording any more.
            Of recordings without an accident the column after the last one that counts.
        fps: columns a second.
    """

    scores: FloatArray
    positive: BoolArray
    toa: FloatArray
    fps: float

    @property
    def valid(self) -> BoolArray:
        """(N, T) whether there is a score that counts: all from the impact on do not exist."""
        there: BoolArray = ~np.isnan(self.scores) & (np.arange(self.scores.shape[1]) < self.toa[:, None])
        return there

    def highest(self) -> FloatArray:
        """(N,) the highest score of each recording; −inf without any."""
        highest: FloatArray = np.max(self.scores, axis=1, initial=-np.inf, where=self.valid)
        return highest

    def before(self, seconds: float) -> FloatArray:
        """(N, M) scores at the M moments of the last seconds before `toa`, the latest first; NaN without a score."""
        moments = np.arange(1, round(seconds * self.fps) + 1)
        column = np.ceil(self.toa[:, None] - moments - _SLACK).astype(np.int64)
        there = (column >= 0) & (column < self.scores.shape[1])
        rows = np.arange(len(self.toa))[:, None]
        scores: FloatArray = np.where(there, np.where(self.valid, self.scores, np.nan)[rows, column * there], np.nan)
        return scores

    def first(self, thresholds: FloatArray) -> IntArray:
        """(N, K) the first column with a score of at least each of K thresholds; T where there is none."""
        so_far = np.maximum.accumulate(np.where(self.valid, self.scores, -np.inf), axis=1)
        first = np.array([np.searchsorted(row, thresholds, side="left") for row in so_far], dtype=np.int64)
        return first.reshape(len(so_far), len(thresholds))

    def leads(self, thresholds: FloatArray) -> FloatArray:
        """(N, K) seconds from the first score of at least each of K thresholds to `toa`; NaN where there is none."""
        first = self.first(thresholds).astype(np.float64)
        first[first >= self.scores.shape[1]] = np.nan
        leads: FloatArray = (self.toa[:, None] - first) / self.fps
        return leads
