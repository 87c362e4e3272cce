"""Anticipation metrics without the quirks of the published ones: over recordings, misses included (`clean`).

Every figure that grows with more alarms stands beside their cost: recall and lead beside precision and time in
alarm. Recordings have weights, so that a resample does not read the scores again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.evaluation.evaluator import ratio
from deepaccident_devkit.evaluation.warning.recordings import MINUTE, ScoreSeries, shares
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray, ShortRepr

# Seconds before the impact in which the headline compares scores.
WINDOW: Final = 3.0
# R80 and P80: recall and precision that operating points are asked for.
SAME_RECALL: Final = 0.8
# Seconds before the impact from which on an alarm counts as one of this accident; before, it is neither right nor
# wrong.
EARLY: Final = 5.0
_SLACK: Final = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatingPoint(ShortRepr):
    """The gain and the cost if every score of at least a threshold is an alarm. NaN: nothing to count.

    Attributes:
        threshold: the lowest score that is an alarm; NaN where no threshold has what is asked for.
        recall: share of the accident recordings with an alarm before the impact.
        precision: share of the recordings with an alarm that end in an accident and have a right one; depends on how
            many of each there are.
        tta_hit: seconds from the first alarm to the impact, mean over the warned recordings alone.
        tta0: likewise over all accident recordings, a missed one as 0 s.
        time_in_alarm: share of the frames without an accident to come that are in alarm.
        alarm_seconds_per_minute: likewise, in seconds of each minute.
        episodes_per_minute: runs of alarmed frames there; one that never ends is one only.
        false_recordings: recordings without an accident in which there is any alarm.
        early_share: share of the frames more than 5 s before an impact that are in alarm; neither right nor wrong.
    """

    threshold: float
    recall: float
    precision: float
    tta_hit: float
    tta0: float
    time_in_alarm: float
    alarm_seconds_per_minute: float
    episodes_per_minute: float
    false_recordings: float
    early_share: float


class CleanScores:
    """N recordings' scores, counted once, asked for figures with any weights.

    Attributes:
        series: the scores.
        highest: (N,) the highest score of each.
    """

    def __init__(self, series: ScoreSeries, any_alarm: FloatArray | None = None) -> None:
        """Count what figures at any threshold need.

        Args:
            series: the scores.
            any_alarm: (N,) highest scores of all alarms, where those of the series are of right ones alone; None where
                they are of all.
        """
        self.series = series
        self.highest = series.highest()
        self._any_alarm = self.highest if any_alarm is None else any_alarm
        self._ranks = _ranks(self.highest)
        self._moments = [_ranks(scores) for scores in series.before(WINDOW).T]
        valid = series.valid
        self._frames = valid.sum(axis=1).astype(np.float64)
        self._scores = np.where(valid, series.scores, -np.inf)
        lasting = np.minimum(self._scores[:, 1:], self._scores[:, :-1])
        self._lasting = np.concatenate([np.full((len(lasting), 1), -np.inf), lasting], axis=1)
        is_early = (
            series.toa[:, None] - np.arange(series.scores.shape[1]) > EARLY * series.fps + _SLACK
        )
        self._early = valid & series.positive[:, None] & is_early
        # beyond all thresholds of use: those that a recording's highest score is
        self._levels = np.unique(self.highest[np.isfinite(self.highest)])[::-1]
        self._leads = series.leads(self._levels)
        self._place = np.searchsorted(-self._levels, -self.highest, side="left")
        below = [np.searchsorted(row, self._levels) for row in np.sort(self._scores, axis=1)]
        self._alarmed = self._scores.shape[1] - np.array(below).reshape(
            len(below), len(self._levels)
        )

    def __repr__(self) -> str:
        return f"CleanScores({self.series!r})"

    def average_precision(self, weight: FloatArray) -> float:
        """Σ (R_k − R_{k−1}) P_k over the recordings' highest scores, falling; NaN without an accident.

        Recall that no threshold reaches adds nothing.
        """
        if not self._accidents(weight):
            return math.nan
        true, false = self._raised(weight)
        gained = np.diff(true, prepend=0.0) / self._accidents(weight)
        return math.fsum((gained * shares(true, true + false)).tolist())

    def area_under_curve(self, weight: FloatArray) -> float:
        """The chance that an accident's highest score is above another recording's, ties half; NaN without both."""
        return roc_area(self._ranks, self.series.positive, weight)

    def area_at_moments(self, weight: FloatArray) -> float:
        """The chance that an accident's score is above another recording's as long before the end, ties half.

        Mean over the moments of the last seconds at which there are both kinds; NaN without any.
        """
        areas = [roc_area(ranks, self.series.positive, weight) for ranks in self._moments]
        known = [area for area in areas if not math.isnan(area)]
        return math.fsum(known) / len(known) if known else math.nan

    def mean_time(self, weight: FloatArray) -> float:
        """MTTA over the curve: Σ (R_k − R_{k−1}) · seconds of the warned at the highest threshold that reaches R_k."""
        if not self._accidents(weight):
            return math.nan
        true, _ = self._raised(weight)
        gained = np.diff(true, prepend=0.0) / self._accidents(weight)
        positive = self.series.positive
        seconds = (
            np.where(np.isfinite(self._leads), self._leads, 0.0)[positive] * weight[positive, None]
        )
        return math.fsum((gained * shares(seconds.sum(axis=0), true)).tolist())

    def threshold_of_highest_recall(self, weight: FloatArray) -> float:
        """The highest threshold with the highest recall of all; infinite without any alarm that is right."""
        recalls = self._recalls(weight)
        return float(self._levels[np.argmax(recalls)]) if recalls.any() else math.inf

    def threshold_of_recall(self, weight: FloatArray, recall: float = SAME_RECALL) -> float:
        """The highest threshold with at least a recall; NaN if none has."""
        reached = np.flatnonzero(self._recalls(weight) >= recall - _SLACK)
        return float(self._levels[reached[0]]) if len(reached) else math.nan

    def threshold_of_precision(self, weight: FloatArray, precision: float = SAME_RECALL) -> float:
        """Of the thresholds with at least a precision that of the highest recall, then the highest; NaN if none has."""
        true, false = self._raised(weight)
        good = np.flatnonzero(
            (shares(true, true + false) >= precision - _SLACK) & (true + false > 0)
        )
        return float(self._levels[good[np.argmax(true[good])]]) if len(good) else math.nan

    def threshold_of_best_f1(self, weight: FloatArray) -> float:
        """The highest threshold of the best F1 over recordings; NaN without an accident."""
        true, false = self._raised(weight)
        whole = true + false + self._accidents(weight)
        return float(self._levels[np.argmax(2 * true / whole)]) if true.any() else math.nan

    def threshold_of_alarm_time(self, weight: FloatArray, seconds_per_minute: float = 1.0) -> float:
        """The lowest threshold with at most so much time in alarm without an accident to come; NaN if none has."""
        others = ~self.series.positive
        frames = float((self._frames[others] * weight[others]).sum())
        if not frames:
            return math.nan
        alarmed = (self._alarmed[others] * weight[others, None]).sum(axis=0)
        raised = (
            np.diff(sum(self._raised(weight)), prepend=0.0) > 0
        )  # levels of recordings that count
        good = np.flatnonzero((alarmed * MINUTE <= seconds_per_minute * frames + _SLACK) & raised)
        return float(self._levels[good[-1]]) if len(good) else math.nan

    def at(self, threshold: float, weight: FloatArray) -> OperatingPoint:
        """The figures at a threshold; all NaN at NaN."""
        if math.isnan(threshold):
            return OperatingPoint(**dict.fromkeys(OperatingPoint.__slots__, math.nan))
        series, positive = self.series, self.series.positive
        leads = series.leads(np.array([threshold]))[:, 0]
        warned = np.isfinite(leads)
        hits, accidents = float(weight[positive & warned].sum()), self._accidents(weight)
        seconds = math.fsum((np.where(warned, leads, 0.0) * weight)[positive].tolist())
        false = float(weight[~positive & warned].sum())
        misled = float(weight[positive & ~warned & (self._any_alarm >= threshold)].sum())
        in_alarm = (self._scores >= threshold)[~positive]
        begun = in_alarm & ~(self._lasting >= threshold)[~positive]
        others = weight[~positive]
        frames = float((self._frames[~positive] * others).sum())
        share = ratio(float((in_alarm.sum(axis=1) * others).sum()), frames)
        early = self._early & (self._scores >= threshold)
        return OperatingPoint(
            threshold=threshold,
            recall=ratio(hits, accidents),
            precision=ratio(hits, hits + false + misled),
            tta_hit=ratio(seconds, hits),
            tta0=ratio(seconds, accidents),
            time_in_alarm=share,
            alarm_seconds_per_minute=share * MINUTE,
            episodes_per_minute=ratio(
                float((begun.sum(axis=1) * others).sum()), frames / series.fps / MINUTE
            ),
            false_recordings=false,
            early_share=ratio(
                float((early.sum(axis=1) * weight).sum()),
                float((self._early.sum(axis=1) * weight).sum()),
            ),
        )

    def tta0_after(self, threshold: float, weight: FloatArray, latency: float) -> float:
        """Seconds as `OperatingPoint.tta0`, each less a latency, but not below 0; NaN at NaN."""
        if math.isnan(threshold):
            return math.nan
        leads = self.series.leads(np.array([threshold]))[:, 0] - latency
        told = np.where(np.isfinite(leads), np.maximum(leads, 0.0), 0.0) * weight
        return ratio(math.fsum(told[self.series.positive].tolist()), self._accidents(weight))

    def _accidents(self, weight: FloatArray) -> float:
        return float(weight[self.series.positive].sum())

    def _raised(self, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(K,) accident recordings, and others, whose highest score is at least each level."""
        there = np.isfinite(self.highest)
        true, false = (
            np.cumsum(
                np.bincount(self._place[chosen], weight[chosen], len(self._levels)).astype(
                    np.float64
                )
            )
            for chosen in (there & self.series.positive, there & ~self.series.positive)
        )
        return true, false

    def _recalls(self, weight: FloatArray) -> FloatArray:
        true, _ = self._raised(weight)
        accidents = self._accidents(weight)
        return true / accidents if accidents else np.zeros(len(true))


def _ranks(scores: FloatArray) -> IntArray:
    """(N,) places of scores in their order, equal ones the same; −1 for NaN."""
    known = ~np.isnan(scores)
    ranks = np.full(len(scores), -1, dtype=np.int64)
    ranks[known] = np.unique(scores[known], return_inverse=True)[1].reshape(-1)
    return ranks


def roc_area(ranks: IntArray, positive: BoolArray, weight: FloatArray) -> float:
    """The area under the ROC curve of weighted scores, by their ranks, −1 for no score; NaN without both kinds."""
    known = ranks >= 0
    here, below = (
        np.bincount(ranks[chosen], weight[chosen], int(ranks.max(initial=0)) + 1)
        for chosen in (known & positive, known & ~positive)
    )
    pairs = here.sum() * below.sum()
    return float((here * (np.cumsum(below) - below / 2)).sum() / pairs) if pairs else math.nan
