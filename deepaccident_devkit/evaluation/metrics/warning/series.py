"""`ScoreSeries`: the scores of recordings, frame by frame, which anticipation metrics are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, FrozenArrays


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScoreSeries(FrozenArrays):
    """How sure a predictor is, at each frame of N recordings, that an accident comes; arrays are read-only.

    Attributes:
        scores: (N, T) float64, higher is surer; NaN after a recording's end, and where a frame is missing.
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
        there: BoolArray = np.isfinite(self.scores) & (np.arange(self.scores.shape[1]) < self.toa[:, None])
        return there

    def highest(self, seconds: float = 0.0) -> FloatArray:
        """(N,) the highest score of each recording, at least so many seconds before its `toa`; −inf without any."""
        early = np.arange(self.scores.shape[1]) <= self.toa[:, None] - seconds * self.fps + 1e-6
        highest: FloatArray = np.max(self.scores, axis=1, initial=-np.inf, where=self.valid & early)
        return highest

    def leads(self, thresholds: FloatArray) -> FloatArray:
        """(N, K) seconds from the first score of at least each of K thresholds to `toa`; NaN where there is none."""
        so_far = np.maximum.accumulate(np.where(self.valid, self.scores, -np.inf), axis=1)
        first = np.array([np.searchsorted(row, thresholds, side="left") for row in so_far], dtype=np.float64)
        first = first.reshape(len(so_far), len(thresholds))
        first[first >= self.scores.shape[1]] = np.nan
        leads: FloatArray = (self.toa[:, None] - first) / self.fps
        return leads
