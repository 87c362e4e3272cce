"""Anticipation metrics without the quirks of published ones (protocol `clean`).

They count by recording and include misses. Every figure that grows with the number of alarms is
reported with the cost of the alarms: recall and lead time with precision and time in alarm.
Recordings have weights, so that resamples do not read the scores again.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.evaluation.evaluator import ratio
from deepaccident_devkit.evaluation.warning.recordings import MINUTE, ScoreSeries, shares
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray, ShortRepr

# The main metric compares scores within this many seconds before the impact.
WINDOW: Final = 3.0
# Operating points are compared at this recall (R80) and at this precision (P80).
SAME_RECALL: Final = 0.8
# An alarm more than this many seconds before the impact is neither correct nor false.
EARLY: Final = 5.0
_ROUNDING_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatingPoint(ShortRepr):
    """Benefit and cost when every score at or above a threshold raises an alarm.

    A figure is NaN if there is nothing to count.

    Attributes:
        threshold: Lowest score that raises an alarm; NaN if no threshold meets the condition.
        recall: Share of the accident recordings with an alarm before the impact.
        precision: Share of the recordings with an alarm that end in an accident and have a correct
            alarm; it depends on how many recordings end in an accident and how many do not.
        tta_hit: Time from the first alarm to the impact, seconds, averaged over the accident
            recordings with an alarm.
        tta0: Time from the first alarm to the impact, seconds, averaged over all accident
            recordings; a missed one counts as 0 s.
        time_in_alarm: Share of the frames without a coming accident that are in alarm.
        alarm_seconds_per_minute: `time_in_alarm` in seconds per minute.
        episodes_per_minute: Runs of frames in alarm per minute of frames without a coming accident;
            a run that never ends counts once.
        false_recordings: Recordings without an accident that have any alarm.
        early_share: Share of the frames more than 5 s before an impact that are in alarm; such
            alarms are neither correct nor false.
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
    """Scores of N recordings, prepared once so that the recordings can be weighted in any way.

    Attributes:
        series: Scores of the recordings, frame by frame.
        highest: (N,) highest score of each recording.
    """

    def __init__(self, series: ScoreSeries, any_alarm: FloatArray | None = None) -> None:
        """Compute in advance what the figures need at any threshold.

        Args:
            series: Scores of the recordings, frame by frame.
            any_alarm: (N,) highest score of any alarm of each recording, if the series contains
                correct alarms only; None if it contains all alarms.
        """
        self.series = series
        self.highest = series.highest()
        self._highest_of_all_alarms = self.highest if any_alarm is None else any_alarm
        self._ranks = _ranks(self.highest)
        self._ranks_by_moment = [_ranks(scores) for scores in series.before(WINDOW).T]
        valid = series.valid
        self._frame_counts = valid.sum(axis=1).astype(np.float64)
        self._scores = np.where(valid, series.scores, -np.inf)
        # a frame continues an alarm at the thresholds that both its score and the previous reach
        recording_count, column_count = series.scores.shape
        self._continued_scores = np.full((recording_count, column_count), -np.inf)
        self._continued_scores[:, 1:] = np.minimum(self._scores[:, 1:], self._scores[:, :-1])
        columns_to_impact = series.toa[:, None] - np.arange(column_count)
        is_early = columns_to_impact > EARLY * series.fps + _ROUNDING_TOLERANCE
        self._is_early = valid & series.positive[:, None] & is_early
        # only the recordings' highest scores matter as thresholds
        is_finite = np.isfinite(self.highest)
        self._thresholds = np.unique(self.highest[is_finite])[::-1]
        self._leads = series.leads(self._thresholds)
        self._threshold_index = np.searchsorted(-self._thresholds, -self.highest, side="left")
        self._alarmed_frames = np.empty((recording_count, len(self._thresholds)), dtype=np.int64)
        for row, scores in enumerate(np.sort(self._scores, axis=1)):
            lower_counts = np.searchsorted(scores, self._thresholds)
            self._alarmed_frames[row] = column_count - lower_counts

    def __repr__(self) -> str:
        return f"CleanScores({self.series!r})"

    def average_precision(self, weights: FloatArray) -> float:
        """Return the AP: the sum of (R_k − R_{k−1}) P_k over the descending highest scores.

        Recall that no threshold reaches adds nothing. The AP is NaN if there is no accident.

        Args:
            weights: (N,), one per recording.
        """
        accidents = self._accidents(weights)
        if not accidents:
            return math.nan
        true, false = self._true_and_false(weights)
        recall_steps = np.diff(true, prepend=0.0) / accidents
        precision = shares(true, true + false)
        return math.fsum((recall_steps * precision).tolist())

    def area_under_curve(self, weights: FloatArray) -> float:
        """Return the probability that an accident's highest score exceeds another recording's.

        Ties count half. The result is NaN unless there are recordings with and without an accident.

        Args:
            weights: (N,), one per recording.
        """
        return roc_area(self._ranks, self.series.positive, weights)

    def area_at_moments(self, weights: FloatArray) -> float:
        """Return the probability that an accident's score exceeds another recording's score.

        Both scores are taken at the same time before the end; ties count half. The probability is
        averaged over the time steps of the last 3 s that have recordings of both kinds. It is NaN
        if there are none.

        Args:
            weights: (N,), one per recording.
        """
        positive = self.series.positive
        areas = [roc_area(ranks, positive, weights) for ranks in self._ranks_by_moment]
        known_areas = [area for area in areas if not math.isnan(area)]
        if not known_areas:
            return math.nan
        return math.fsum(known_areas) / len(known_areas)

    def mean_time(self, weights: FloatArray) -> float:
        """Return the mTTA over the recall curve, seconds: the sum of (R_k − R_{k−1}) · T_k.

        T_k is the mean lead time of the recordings with an alarm at the highest threshold that
        reaches R_k.

        Args:
            weights: (N,), one per recording.
        """
        accidents = self._accidents(weights)
        if not accidents:
            return math.nan
        true, _ = self._true_and_false(weights)
        recall_steps = np.diff(true, prepend=0.0) / accidents
        positive = self.series.positive
        leads = np.where(np.isfinite(self._leads), self._leads, 0.0)
        seconds = leads[positive] * weights[positive, None]
        mean_leads = shares(seconds.sum(axis=0), true)
        return math.fsum((recall_steps * mean_leads).tolist())

    def threshold_of_highest_recall(self, weights: FloatArray) -> float:
        """Return the highest threshold with the highest recall; inf if no alarm is correct."""
        recalls = self._recalls(weights)
        if not recalls.any():
            return math.inf
        return float(self._thresholds[np.argmax(recalls)])

    def threshold_of_recall(self, weights: FloatArray, recall: float = SAME_RECALL) -> float:
        """Return the highest threshold that reaches `recall`; NaN if none does."""
        lowest_recall = recall - _ROUNDING_TOLERANCE
        is_reached = self._recalls(weights) >= lowest_recall
        reached = np.flatnonzero(is_reached)
        if not len(reached):
            return math.nan
        return float(self._thresholds[reached[0]])

    def threshold_of_precision(self, weights: FloatArray, precision: float = SAME_RECALL) -> float:
        """Return the threshold with the highest recall among the ones that reach a precision.

        If several have the same recall, return the highest; if none reaches the precision, NaN.
        """
        true, false = self._true_and_false(weights)
        alarms = true + false
        is_precise = shares(true, alarms) >= precision - _ROUNDING_TOLERANCE
        precise = np.flatnonzero(is_precise & (alarms > 0))
        if not len(precise):
            return math.nan
        best_row = precise[np.argmax(true[precise])]
        return float(self._thresholds[best_row])

    def threshold_of_best_f1(self, weights: FloatArray) -> float:
        """Return the highest threshold with the best F1; NaN if no recording has an accident."""
        true, false = self._true_and_false(weights)
        if not true.any():
            return math.nan
        f1 = 2 * true / (true + false + self._accidents(weights))
        return float(self._thresholds[np.argmax(f1)])

    def threshold_of_alarm_time(
        self, weights: FloatArray, seconds_per_minute: float = 1.0
    ) -> float:
        """Return the lowest threshold at which frames without a coming accident are quiet.

        Return NaN if no threshold is quiet.

        Args:
            weights: (N,), one per recording.
            seconds_per_minute: Longest time in alarm per minute that still counts as quiet.
        """
        is_other = ~self.series.positive
        other_weights = weights[is_other]
        frames = float((self._frame_counts[is_other] * other_weights).sum())
        if not frames:
            return math.nan
        alarmed_frames = (self._alarmed_frames[is_other] * other_weights[:, None]).sum(axis=0)
        is_quiet = alarmed_frames * MINUTE <= seconds_per_minute * frames + _ROUNDING_TOLERANCE
        true, false = self._true_and_false(weights)
        has_weight = np.diff(true + false, prepend=0.0) > 0
        quiet = np.flatnonzero(is_quiet & has_weight)
        if not len(quiet):
            return math.nan
        return float(self._thresholds[quiet[-1]])

    def at(self, threshold: float, weights: FloatArray) -> OperatingPoint:
        """Compute the figures at a threshold; all are NaN if the threshold is NaN."""
        if math.isnan(threshold):
            return OperatingPoint(**dict.fromkeys(OperatingPoint.__slots__, math.nan))
        series = self.series
        positive = series.positive
        leads = series.leads(np.array([threshold]))[:, 0]
        warned = np.isfinite(leads)
        hits = float(weights[positive & warned].sum())
        accidents = self._accidents(weights)
        lead_times = np.where(warned, leads, 0.0) * weights
        seconds = math.fsum(lead_times[positive].tolist())
        false = float(weights[~positive & warned].sum())
        has_alarm = self._highest_of_all_alarms >= threshold
        misled = float(weights[positive & ~warned & has_alarm].sum())
        is_alarmed = self._scores >= threshold
        other_alarms = is_alarmed[~positive]
        begins_alarm = other_alarms & ~(self._continued_scores[~positive] >= threshold)
        other_weights = weights[~positive]
        other_frames = float((self._frame_counts[~positive] * other_weights).sum())
        alarmed_frames = float((other_alarms.sum(axis=1) * other_weights).sum())
        time_in_alarm = ratio(alarmed_frames, other_frames)
        episodes = float((begins_alarm.sum(axis=1) * other_weights).sum())
        early_alarms = (self._is_early & is_alarmed).sum(axis=1)
        early_frames = self._is_early.sum(axis=1)
        return OperatingPoint(
            threshold=threshold,
            recall=ratio(hits, accidents),
            precision=ratio(hits, hits + false + misled),
            tta_hit=ratio(seconds, hits),
            tta0=ratio(seconds, accidents),
            time_in_alarm=time_in_alarm,
            alarm_seconds_per_minute=time_in_alarm * MINUTE,
            episodes_per_minute=ratio(episodes, other_frames / series.fps / MINUTE),
            false_recordings=false,
            early_share=ratio(
                float((early_alarms * weights).sum()), float((early_frames * weights).sum())
            ),
        )

    def tta0_after(self, threshold: float, weights: FloatArray, latency: float) -> float:
        """Return `OperatingPoint.tta0` after a latency is subtracted from each lead time, seconds.

        Lead times do not fall below 0. The result is NaN if the threshold is NaN.

        Args:
            threshold: Lowest score that raises an alarm.
            weights: (N,), one per recording.
            latency: Seconds between the alarm and its receipt.
        """
        if math.isnan(threshold):
            return math.nan
        leads = self.series.leads(np.array([threshold]))[:, 0] - latency
        remaining_leads = np.where(np.isfinite(leads), np.maximum(leads, 0.0), 0.0)
        seconds = (remaining_leads * weights)[self.series.positive]
        return ratio(math.fsum(seconds.tolist()), self._accidents(weights))

    def _accidents(self, weights: FloatArray) -> float:
        """Sum the weights of the accident recordings."""
        accident_weights = weights[self.series.positive]
        return float(accident_weights.sum())

    def _true_and_false(self, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Sum the weights of accidents, and of others, that reach each threshold: (K,) each."""
        has_score = np.isfinite(self.highest)
        positive = self.series.positive
        true = self._reaching_weight(has_score & positive, weights)
        false = self._reaching_weight(has_score & ~positive, weights)
        return true, false

    def _reaching_weight(self, mask: BoolArray, weights: FloatArray) -> FloatArray:
        """Sum the weights of the masked recordings that reach each threshold, shape (K,).

        Args:
            mask: (N,), True for recordings to include.
            weights: (N,), one per recording.
        """
        index = self._threshold_index[mask]
        weight_by_threshold = np.bincount(index, weights[mask], len(self._thresholds))
        return np.cumsum(weight_by_threshold.astype(np.float64))

    def _recalls(self, weights: FloatArray) -> FloatArray:
        """Return the recall at each threshold, shape (K,); 0 if there are no accidents."""
        true, _ = self._true_and_false(weights)
        accidents = self._accidents(weights)
        if not accidents:
            return np.zeros(len(true))
        return true / accidents


def _ranks(scores: FloatArray) -> IntArray:
    """Rank scores, shape (N,), in ascending order; equal scores share a rank, and NaN gets −1."""
    is_known = ~np.isnan(scores)
    ranks = np.full(len(scores), -1, dtype=np.int64)
    _, known_ranks = np.unique(scores[is_known], return_inverse=True)
    ranks[is_known] = known_ranks.reshape(-1)
    return ranks


def roc_area(ranks: IntArray, positive: BoolArray, weights: FloatArray) -> float:
    """Return the area under the ROC curve (AUC) of weighted scores; ties count half.

    It is the probability that a positive score exceeds a negative one.

    >>> import numpy as np
    >>> roc_area(np.array([0, 1, 1]), np.array([False, True, False]), np.ones(3))
    0.75

    Args:
        ranks: (N,) ranks of the scores; −1 for a missing score.
        positive: (N,) bool, True for scores of the positive class.
        weights: (N,) weights of the scores.

    Returns:
        The AUC in [0, 1]; NaN unless both classes have scores.
    """
    has_score = ranks >= 0
    rank_count = int(ranks.max(initial=0)) + 1
    positives = has_score & positive
    negatives = has_score & ~positive
    true = np.bincount(ranks[positives], weights[positives], rank_count)
    false = np.bincount(ranks[negatives], weights[negatives], rank_count)
    pairs = true.sum() * false.sum()
    if not pairs:
        return math.nan
    exceeded_negatives = np.cumsum(false) - false / 2
    return float((true * exceeded_negatives).sum() / pairs)
