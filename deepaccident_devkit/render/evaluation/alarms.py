"""From the counts of accident evaluators to curves and errors, alarm by alarm: what their panels draw."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.evaluation.accident import AccidentEvaluator, BoxAccidents, PaperAccidents
from deepaccident_devkit.evaluation.accident.scoring import Alarm
from deepaccident_devkit.evaluation.evaluator import Counts, ratio


def accuracy_by_distance(evaluator: AccidentEvaluator, distances: FloatArray) -> FloatArray | None:
    """The accident accuracy with each of some distances allowed; at the official ones it is the result's.

    Args:
        evaluator: with samples counted.
        distances: (D,) metres.

    Returns:
        (D,) tp / (tp + fp / 2 + fn / 2), NaN where nothing is counted; None if the protocol's counts do not hold how
        far off each alarm is.
    """
    protocol = evaluator.protocol
    if not isinstance(protocol, BoxAccidents | PaperAccidents):
        return None
    samples, scoring = _samples(evaluator), protocol.scoring
    accuracy = []
    for distance in distances.tolist():
        tp = fp = fn = 0
        for positive, alarms in samples:
            hit = positive and scoring.hit(alarms, distance) is not None
            tp += hit
            fp += len(alarms) - hit
            fn += positive and not hit and (scoring.far_is_missed or not alarms)
        accuracy.append(ratio(tp, tp + fp / 2 + fn / 2))
    return np.array(accuracy)


def has_alarms(evaluator: AccidentEvaluator) -> bool:
    """Whether the counts hold how far off each alarm is; the released protocol's hold outcomes alone."""
    return isinstance(evaluator.protocol, BoxAccidents | PaperAccidents)


def errors_of_first(evaluator: AccidentEvaluator, error: Literal["position", "time"]) -> FloatArray:
    """How far off the most important alarm is of each sample with an accident to come, however far that is.

    Args:
        evaluator: with samples counted.
        error: of `position`, metres, or of `time`, seconds, positive if the alarm is for later.

    Returns:
        (N,) in the order of the samples' tokens; samples without an alarm are left out.
    """
    firsts = [alarms[0][error] for positive, alarms in _samples(evaluator) if positive and alarms]
    return np.array([value for value in firsts if value is not None], dtype=np.float64)


def alarm_precision_recall(evaluator: AccidentEvaluator) -> tuple[FloatArray, FloatArray]:
    """Recall and precision (N,) each of all alarms of at least each score, from the surest on.

    Equally sure alarms come in together. Both are empty without any alarm, or any accident, and where alarms have no
    scores.
    """
    if not isinstance(evaluator.protocol, BoxAccidents):
        return np.zeros(0), np.zeros(0)
    scoring, scored, positives = evaluator.protocol.scoring, [], 0
    for positive, alarms in _samples(evaluator):
        hit = scoring.hit(alarms, scoring.errors_at) if positive else None
        scored += [(alarm["score"], alarm is hit) for alarm in alarms]
        positives += positive
    if not scored or not positives:
        return np.zeros(0), np.zeros(0)
    score, right = np.array(scored, dtype=np.float64).T
    order = np.argsort(-score, kind="stable")
    last = np.flatnonzero(np.diff(score[order], append=-np.inf))
    found = np.cumsum(right[order])[last]
    return found / positives, found / (last + 1)


def _samples(evaluator: AccidentEvaluator) -> list[tuple[bool, Sequence[Alarm]]]:
    """Of each sample whether an accident comes, and its alarms, the most important first; in the order of tokens."""
    counts = sorted(evaluator.counts.items())
    return [(bool(sample["positive"]), _alarms(evaluator.protocol, sample)) for _, sample in counts]


def _alarms(protocol: Any, sample: Counts) -> Sequence[Alarm]:
    if isinstance(protocol, PaperAccidents):
        compared = sample[protocol.sample_choice]
        return [compared] if compared else []
    alarms: Sequence[Alarm] = sample["alarms"]
    return alarms
