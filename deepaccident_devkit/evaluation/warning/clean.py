"""Anticipation metrics without the quirks of published ones: by recording, with misses (`clean`).

Every figure that grows with more alarms stands beside their cost: recall and lead beside precision
and time in alarm. Recordings have weights, so that a resample does not read the scores again.
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
# R80 and P80: recall and precision at which operating points are compared.
SAME_RECALL: Final = 0.8
# Seconds before the impact from which on an alarm counts as one of this accident; an earlier alarm
# is neither right nor wrong.
EARLY: Final = 5.0
_ROUNDING_TOLERANCE: Final = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatingPoint(ShortRepr):
    """Gain and cost if every score of at least a threshold is an alarm. NaN: nothing to count.

    Attributes:
        threshold: Lowest score that is an alarm; NaN where no threshold meets the condition.
        recall: Share of the accident recordings with an alarm before the impact.
        precision: Share of the recordings with an alarm that end in an accident and have a right
            alarm; depends on the numbers of accident and other recordings.
        tta_hit: Seconds from the first alarm to the impact, mean over the warned recordings only.
        tta0: The same over all accident recordings, where a missed one counts as 0 s.
        time_in_alarm: Share of the frames without a coming accident that are in alarm.
        alarm_seconds_per_minute: The same in seconds per minute.
        episodes_per_minute: Runs of alarmed frames among them; a run that never ends counts once.
        false_recordings: Recordings without an accident in which there is any alarm.
        early_share: Share of the frames more than 5 s before an impact that are in alarm; such
            alarms are neither right nor wrong.
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
    """Scores of N recordings, counted once, for figures with any weights.

    Attributes:
        series: Scores of the recordings.
        highest: (N,) highest score of each recording.
    """

    def __init__(self, series: ScoreSeries, any_alarm: FloatArray | None = None) -> None:
        """Count what figures at any threshold need.

        Args:
            series: Scores of the recordings.
            any_alarm: (N,) highest scores of all alarms, where the series has only right ones; None
                where it has all.
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
        columns_to_impact = series.toa[:, None] - np.arange(series.scores.shape[1])
        is_early = columns_to_impact > EARLY * series.fps + _ROUNDING_TOLERANCE
        self._early = valid & series.positive[:, None] & is_early
        # the only thresholds of use are the recordings' highest scores
        self._levels = np.unique(self.highest[np.isfinite(self.highest)])[::-1]
        self._leads = series.leads(self._levels)
        self._level_index = np.searchsorted(-self._levels, -self.highest, side="left")
        sorted_scores = np.sort(self._scores, axis=1)
        lower = [np.searchsorted(row, self._levels) for row in sorted_scores]
        lower_counts = np.array(lower).reshape(len(lower), len(self._levels))
        self._alarmed = self._scores.shape[1] - lower_counts

    def __repr__(self) -> str:
        return f"CleanScores({self.series!r})"

    def average_precision(self, weight: FloatArray) -> float:
        """Return Σ (R_k − R_{k−1}) P_k over the recordings' highest scores, from the highest on.

        Recall that no threshold reaches adds nothing; NaN without an accident.
        """
        accidents = self._accidents(weight)
        if not accidents:
            return math.nan
        true, false = self._raised(weight)
        recall_steps = np.diff(true, prepend=0.0) / accidents
        return math.fsum((recall_steps * shares(true, true + false)).tolist())

    def area_under_curve(self, weight: FloatArray) -> float:
        """Return the probability that an accident's highest score exceeds another recording's.

        Ties count half; NaN without both kinds of recordings.
        """
        return roc_area(self._ranks, self.series.positive, weight)

    def area_at_moments(self, weight: FloatArray) -> float:
        """Return the probability that an accident's score exceeds another's at one moment.

        Both scores are taken at the same time before the end; ties count half. The mean is over the
        moments of the last seconds at which there are both kinds; NaN without any.
        """
        areas = [roc_area(ranks, self.series.positive, weight) for ranks in self._moments]
        known_areas = [area for area in areas if not math.isnan(area)]
        if not known_areas:
            return math.nan
        return math.fsum(known_areas) / len(known_areas)

    def mean_time(self, weight: FloatArray) -> float:
        """Return the mTTA over the curve, seconds: Σ (R_k − R_{k−1}) · T_k.

        T_k is the mean lead of the warned recordings at the highest threshold that reaches R_k.
        """
        accidents = self._accidents(weight)
        if not accidents:
            return math.nan
        true, _ = self._raised(weight)
        recall_steps = np.diff(true, prepend=0.0) / accidents
        positive = self.series.positive
        leads = np.where(np.isfinite(self._leads), self._leads, 0.0)
        seconds = leads[positive] * weight[positive, None]
        return math.fsum((recall_steps * shares(seconds.sum(axis=0), true)).tolist())

    def threshold_of_highest_recall(self, weight: FloatArray) -> float:
        """Return the highest threshold with the highest recall; infinite without a right alarm."""
        recalls = self._recalls(weight)
        return float(self._levels[np.argmax(recalls)]) if recalls.any() else math.inf

    def threshold_of_recall(self, weight: FloatArray, recall: float = SAME_RECALL) -> float:
        """Return the highest threshold with at least a recall; NaN if none has it."""
        lowest_recall = recall - _ROUNDING_TOLERANCE
        reached = np.flatnonzero(self._recalls(weight) >= lowest_recall)
        return float(self._levels[reached[0]]) if len(reached) else math.nan

    def threshold_of_precision(self, weight: FloatArray, precision: float = SAME_RECALL) -> float:
        """Return the threshold of the highest recall with at least a precision.

        The highest of several; NaN if no threshold has the precision.
        """
        true, false = self._raised(weight)
        alarms = true + false
        is_precise = shares(true, alarms) >= precision - _ROUNDING_TOLERANCE
        precise = np.flatnonzero(is_precise & (alarms > 0))
        if not len(precise):
            return math.nan
        return float(self._levels[precise[np.argmax(true[precise])]])

    def threshold_of_best_f1(self, weight: FloatArray) -> float:
        """Return the highest threshold of the best F1 over recordings; NaN without an accident."""
        true, false = self._raised(weight)
        if not true.any():
            return math.nan
        total = true + false + self._accidents(weight)
        return float(self._levels[np.argmax(2 * true / total)])

    def threshold_of_alarm_time(self, weight: FloatArray, seconds_per_minute: float = 1.0) -> float:
        """Return the lowest threshold with at most a time in alarm without a coming accident.

        NaN if no threshold is that quiet.
        """
        is_other = ~self.series.positive
        frames = float((self._frames[is_other] * weight[is_other]).sum())
        if not frames:
            return math.nan
        alarmed = (self._alarmed[is_other] * weight[is_other, None]).sum(axis=0)
        # levels of recordings that count
        is_level = np.diff(sum(self._raised(weight)), prepend=0.0) > 0
        is_quiet = alarmed * MINUTE <= seconds_per_minute * frames + _ROUNDING_TOLERANCE
        quiet = np.flatnonzero(is_quiet & is_level)
        return float(self._levels[quiet[-1]]) if len(quiet) else math.nan

    def at(self, threshold: float, weight: FloatArray) -> OperatingPoint:
        """Return the figures at a threshold; all NaN at NaN."""
        if math.isnan(threshold):
            return OperatingPoint(**dict.fromkeys(OperatingPoint.__slots__, math.nan))
        series = self.series
        positive = self.series.positive
        leads = series.leads(np.array([threshold]))[:, 0]
        warned = np.isfinite(leads)
        hits = float(weight[positive & warned].sum())
        accidents = self._accidents(weight)
        lead_times = np.where(warned, leads, 0.0) * weight
        seconds = math.fsum(lead_times[positive].tolist())
        false = float(weight[~positive & warned].sum())
        misled = float(weight[positive & ~warned & (self._any_alarm >= threshold)].sum())
        in_alarm = (self._scores >= threshold)[~positive]
        begun = in_alarm & ~(self._lasting >= threshold)[~positive]
        other_weight = weight[~positive]
        frames = float((self._frames[~positive] * other_weight).sum())
        alarmed_frames = float((in_alarm.sum(axis=1) * other_weight).sum())
        time_in_alarm = ratio(alarmed_frames, frames)
        episodes = float((begun.sum(axis=1) * other_weight).sum())
        early = self._early & (self._scores >= threshold)
        early_frames = float((self._early.sum(axis=1) * weight).sum())
        return OperatingPoint(
            threshold=threshold,
            recall=ratio(hits, accidents),
            precision=ratio(hits, hits + false + misled),
            tta_hit=ratio(seconds, hits),
            tta0=ratio(seconds, accidents),
            time_in_alarm=time_in_alarm,
            alarm_seconds_per_minute=time_in_alarm * MINUTE,
            episodes_per_minute=ratio(episodes, frames / series.fps / MINUTE),
            false_recordings=false,
            early_share=ratio(float((early.sum(axis=1) * weight).sum()), early_frames),
        )

    def tta0_after(self, threshold: float, weight: FloatArray, latency: float) -> float:
        """Return `OperatingPoint.tta0` with a latency taken off each lead, seconds; NaN at NaN.

        No lead falls below 0.
        """
        if math.isnan(threshold):
            return math.nan
        leads = self.series.leads(np.array([threshold]))[:, 0] - latency
        seconds = np.where(np.isfinite(leads), np.maximum(leads, 0.0), 0.0) * weight
        accident_seconds = seconds[self.series.positive]
        return ratio(math.fsum(accident_seconds.tolist()), self._accidents(weight))

    def _accidents(self, weight: FloatArray) -> float:
        """Return the summed weight of the accident recordings."""
        return float(weight[self.series.positive].sum())

    def _raised(self, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the weights of accidents and of others that reach each level, (K,) each."""
        has_score = np.isfinite(self.highest)
        positive = self.series.positive
        return (
            self._reaching(has_score & positive, weight),
            self._reaching(has_score & ~positive, weight),
        )

    def _reaching(self, recordings: BoolArray, weight: FloatArray) -> FloatArray:
        """Return the weight of recordings with a score that reaches each level, shape (K,).

        Args:
            recordings: (N,) mask of the recordings.
            weight: (N,) weights.
        """
        index = self._level_index[recordings]
        by_level = np.bincount(index, weight[recordings], len(self._levels))
        return np.cumsum(by_level.astype(np.float64))

    def _recalls(self, weight: FloatArray) -> FloatArray:
        """Return the recall at each level, shape (K,); 0 without accidents."""
        true, _ = self._raised(weight)
        accidents = self._accidents(weight)
        return true / accidents if accidents else np.zeros(len(true))


def _ranks(scores: FloatArray) -> IntArray:
    """Return the ranks of scores, shape (N,), equal for equal scores; −1 for NaN."""
    known = ~np.isnan(scores)
    ranks = np.full(len(scores), -1, dtype=np.int64)
    ranks[known] = np.unique(scores[known], return_inverse=True)[1].reshape(-1)
    return ranks


def roc_area(ranks: IntArray, positive: BoolArray, weight: FloatArray) -> float:
    """Return the area under the ROC curve of weighted scores (AUC), ties half.

    Equals the probability that a positive score exceeds a negative one.

    >>> import numpy as np
    >>> roc_area(np.array([0, 1, 1]), np.array([False, True, False]), np.ones(3))
    0.75

    Args:
        ranks: (N,) ranks of the scores, −1 for no score.
        positive: (N,) whether each is of the positive kind.
        weight: (N,) weights.

    Returns:
        A share in [0, 1]; NaN without both kinds.
    """
    has_score = ranks >= 0
    rank_count = int(ranks.max(initial=0)) + 1
    positives = has_score & positive
    negatives = has_score & ~positive
    true = np.bincount(ranks[positives], weight[positives], rank_count)
    false = np.bincount(ranks[negatives], weight[negatives], rank_count)
    pairs = true.sum() * false.sum()
    if not pairs:
        return math.nan
    return float((true * (np.cumsum(false) - false / 2)).sum() / pairs)
