"""Counts, tallies and results of accident metrics, shared by all protocols."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.instances import prediction_accuracy
from deepaccident_devkit.evaluation.map_accidents import TIE, even
from deepaccident_devkit.evaluation.predictions import Accident
from deepaccident_devkit.evaluation.task import Row, TaskResult
from deepaccident_devkit.evaluation.truth import AccidentContext
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabels
from deepaccident_devkit.support.arrays import BoolArray, ShortRepr
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues

DISTANCES: Final = (5.0, 10.0, 15.0)
"""Allowed position errors of a predicted accident, metres."""
# Which pair collides in the truth of a sample: the pair of the meta file, another pair, none, or a
# pair with an unknown id.
NAMED: Final = ("meta", "another", "none", "unknown")
# In `paper` and `boxes`, errors are averaged over the true positives within this distance, metres.
ERRORS_AT: Final = 10.0
ACCIDENT_ERRORS: Final = ("id", "position", "time")
_CASES = ("tp", "fp", "fn")
# Number of entries of a tally for one distance: cases, then known errors.
_NUMBERS_PER_DISTANCE = len(_CASES) + len(ACCIDENT_ERRORS)
# `numbers`: number of samples, number of positives, numbers by `NAMED`; then for each of
# `DISTANCES` the numbers of true positives, false positives and missed accidents, and of known
# errors by `ACCIDENT_ERRORS`. `errors`: for each distance and error, floats with the same exact sum
# as all errors. A tally is flat and JSON-compatible, since breakdowns add up thousands of them.
_Tally = Mapping[str, Any]
_EMPTY_TALLY: _Tally = {
    "numbers": [0] * (2 + len(NAMED) + len(DISTANCES) * _NUMBERS_PER_DISTANCE),
    "errors": [[]] * (len(DISTANCES) * len(ACCIDENT_ERRORS)),
}
# A foreseen accident in counts: its differences from the truth in `position` (metres), `time`
# (seconds, positive if later) and `id` (0 for the same two actors, 1 for others). A difference is
# None if there is no true accident or the value is unknown.
Alarm = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentsWithin(ShortRepr):
    """Numbers of accidents, and their errors, at one allowed distance.

    Attributes:
        distance: Allowed position error, metres.
        tp: Number of true accidents that are predicted within the distance.
        fp: Number of predicted accidents that are too far from a true one, or have no true one.
        fn: Number of true accidents that are missed.
        accuracy: tp / (tp + fp / 2 + fn / 2); NaN if all three are 0.
        id_error: Share of the true positives that name other actors; None if no value is known.
        position_error: Mean over the true positives, metres; None if no value is known.
        time_error: Mean over the true positives, seconds; None if no value is known.
    """

    distance: float
    tp: int
    fp: int
    fn: int
    accuracy: float
    id_error: float | None
    position_error: float | None
    time_error: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentResult(TaskResult):
    """Accident metrics of a set of samples.

    Attributes:
        within: Allowed distance in metres (`DISTANCES`) → numbers at this distance.
        apa: Accident prediction accuracy: the mean of the accuracies at all distances, in [0, 1];
            NaN if there is nothing to count.
        id_error: Share of the true positives that name other actors; None if no value is known.
        position_error: Mean over the true positives, metres; None if no value is known.
        time_error: Mean over the true positives, seconds; None if no value is known.
        samples: Number of samples.
        positives: Number of samples with a true accident.
        negatives: Number of samples without a true accident.
        truths: Which pair collides in the truth (`NAMED`) → number of samples.
        notes: Caveats that belong next to the numbers, one sentence each.
        beside: Results with other settings, which are always printed too; keys are `name=value`.
    """

    rows: ClassVar[tuple[Row, ...]] = (
        Row("apa", "share", "higher"),
        Row("precision", "share", "higher"),
        Row("recall", "share", "higher"),
        Row("false_alarm_rate", "share"),
        Row("average_precision", "share", "higher"),
        Row("within/*/accuracy", "share", "higher", name="accuracy@*"),
        Row("id_error", "share"),
        Row("position_error", "m"),
        Row("time_error", "s"),
        Row("lateness", "s", "neither", is_signed=True),
    )
    within: Mapping[float, AccidentsWithin]
    apa: float
    id_error: float | None
    position_error: float | None
    time_error: float | None
    samples: int
    positives: int
    negatives: int
    truths: Mapping[str, int]
    notes: tuple[str, ...] = ()
    beside: Mapping[str, AccidentResult] = field(default_factory=dict)


def outcome_words(result: AccidentResult) -> str:
    """Name a sample's outcomes with their allowed distances: `FP + FN within 5 m, TP within 10 m`.

    Equal outcomes are joined. The outcome is `TN` if nothing is counted.
    """
    distances: dict[str, list[str]] = {}
    for distance, within in result.within.items():
        distances.setdefault(count_words(within), []).append(f"{distance:g}")
    return ", ".join(f"{counts} within {'/'.join(at)} m" for counts, at in distances.items())


def count_words(within: AccidentsWithin) -> str:
    """Name a sample's outcome at one allowed distance: `FP + FN`; `TN` if nothing is counted."""
    words = []
    for name, count in (("TP", within.tp), ("FP", within.fp), ("FN", within.fn)):
        if count > 1:
            words.append(f"{count} {name}")
        elif count:
            words.append(name)
    return " + ".join(words) or "TN"


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedAccidents(ShortRepr):
    """The accidents of one sample, in the current ego frame; accidents read off maps have no `ids`.

    Attributes:
        true: The true accident to come, as the protocol defines it; None if there is none.
        predicted: The predicted accidents: one per alarm, or one per prediction that contains one.
        unplaced: Seconds to an impact within the horizon whose position is unknown
            (`BoxTruth.unplaced`); None if there is none.
    """

    true: Accident | None
    predicted: tuple[Accident, ...]
    unplaced: float | None = None


def sample_tally(sample: Counts, within: Sequence[ReadOnlyValues]) -> _Tally:
    """Build the tally of one sample.

    Args:
        sample: Counts of the sample; only `positive` and `named` are read.
        within: For each of `DISTANCES`, the numbers `tp`, `fp` and `fn`, and for each of
            `ACCIDENT_ERRORS` a list of the known values.
    """
    numbers = [1, int(sample["positive"])]
    numbers += [int(sample["named"] == name) for name in NAMED]
    errors = []
    for cases in within:
        numbers += [cases[case] for case in _CASES]
        for name in ACCIDENT_ERRORS:
            numbers.append(len(cases[name]))
            errors.append(cases[name])
    return {"numbers": numbers, "errors": errors}


def add_tallies(tallies: Iterable[_Tally]) -> _Tally:
    """Add up tallies; the sum of none has only zeros."""
    tallies = [_EMPTY_TALLY, *tallies]
    number_columns = zip(*(tally["numbers"] for tally in tallies), strict=True)
    error_columns = zip(*(tally["errors"] for tally in tallies), strict=True)
    return {
        "numbers": [sum(column) for column in number_columns],
        "errors": [exact_parts(column) for column in error_columns],
    }


def exact_parts(numbers: Iterable[Iterable[float]]) -> list[float]:
    """Return a few floats with the exact sum of many: first the rounded sum, then remainders."""
    remaining_terms = [*chain.from_iterable(numbers)]
    parts = []
    while part := math.fsum(remaining_terms):
        parts.append(part)
        if not math.isfinite(part):  # no remainder of inf or NaN is 0
            break
        remaining_terms.append(-part)
    return parts


def tally_result(tally: _Tally, errors_at: float) -> AccidentResult:
    """Compute the metrics from a tally.

    Args:
        tally: Summed tally of all samples.
        errors_at: One of `DISTANCES`, metres; errors are averaged over the true positives within
            this distance.
    """
    samples, positives, *numbers = tally["numbers"]
    within = {}
    for index, distance in enumerate(DISTANCES):
        first_number = len(NAMED) + index * _NUMBERS_PER_DISTANCE
        distance_numbers = numbers[first_number : first_number + _NUMBERS_PER_DISTANCE]
        first_error = index * len(ACCIDENT_ERRORS)
        distance_errors = tally["errors"][first_error : first_error + len(ACCIDENT_ERRORS)]
        within[distance] = _accidents_within(distance, distance_numbers, distance_errors)
    errors = within[errors_at]
    accuracies = [accidents.accuracy for accidents in within.values()]
    return AccidentResult(
        within=within,
        apa=math.fsum(accuracies) / len(within),
        id_error=errors.id_error,
        position_error=errors.position_error,
        time_error=errors.time_error,
        samples=samples,
        positives=positives,
        negatives=samples - positives,
        truths=dict(zip(NAMED, numbers, strict=False)),
    )


def _accidents_within(
    distance: float, numbers: Sequence[int], errors: Sequence[Sequence[float]]
) -> AccidentsWithin:
    """Compute the numbers at one distance from its part of a tally's `numbers` and `errors`."""
    tp, fp, fn, *error_counts = numbers
    means = []
    for terms, count in zip(errors, error_counts, strict=True):
        means.append(math.fsum(terms) / count if count else None)
    id_error, position_error, time_error = means
    return AccidentsWithin(
        distance=distance,
        tp=tp,
        fp=fp,
        fn=fn,
        accuracy=prediction_accuracy(tp, fp, fn),
        id_error=id_error,
        position_error=position_error,
        time_error=time_error,
    )


def average_precision(scores: ArrayLike, is_right: ArrayLike, positives: int) -> float:
    """Return the area under the steps of precision over recall; alarms with one score share a step.

    Recall that no alarm reaches adds nothing, as in `sklearn.metrics.average_precision_score`.

    >>> average_precision([0.9, 0.8, 0.7], [True, False, True], positives=2)
    0.8333333333333333

    Args:
        scores: (N,) scores of the alarms; higher means more certain.
        is_right: (N,) bool, True for correct alarms.
        positives: Number of true accidents, at least 1.

    Returns:
        The average precision in [0, 1]; 0 if there are no alarms.
    """
    score = np.asarray(scores, dtype=np.float64)
    right_weight = np.asarray(is_right, dtype=np.float64)
    if not len(score):
        return 0.0
    steps = np.unique(-score)
    step_index = np.searchsorted(steps, -score)
    alarm_counts = np.bincount(step_index, minlength=len(steps))
    right_counts = np.bincount(step_index, right_weight, len(steps))
    precision = np.cumsum(right_counts) / np.cumsum(alarm_counts)
    recall_steps = right_counts / positives
    return math.fsum((recall_steps * precision).tolist())


def hit_of(alarms: Sequence[Alarm], distance: float) -> Alarm | None:
    """Return the first alarm nearer to the true accident than `distance`; None if there is none."""
    for alarm in alarms:
        if alarm["position"] is not None and alarm["position"] < distance - TIE:
            return alarm
    return None


def make_alarm(
    position: float | None = None,
    time: float | None = None,
    id_error: int | None = None,
    **extra: float,
) -> NamedValues:
    """Build an `Alarm`; its position error is rounded so that values within `TIE` compare equal.

    Args:
        position: Position error, metres; None if there is no true accident.
        time: Time error, seconds, positive if the prediction is later; None if there is none.
        id_error: 0 if the alarm names the true actors, otherwise 1; None if unknown.
        **extra: Further values to store in the alarm.
    """
    if position is not None:
        position = float(even(np.asarray(position)))
    return {"position": position, "time": time, "id": id_error, **extra}


def classify_pair(pair: Iterable[int | None] | None, context: AccidentContext) -> str:
    """Return which pair collides in the truth, one of `NAMED`.

    Args:
        pair: Actor ids of the pair, None for an unknown id; None if there is no accident.
        context: Context of the sample, which has the pair of the meta file.
    """
    if pair is None:
        return "none"
    actors = set(pair)
    if not context.known or None in actors:
        return "unknown"
    if context.pair is not None and actors == set(context.pair):
        return "meta"
    return "another"


def alarms_tally(sample: Counts, alarms: Sequence[Alarm]) -> _Tally:
    """Build the tally of one sample from its alarms.

    If an accident is foreseen in the wrong place, it is a false positive, and the true accident is
    missed.

    Args:
        sample: Counts of the sample; only `positive` and `named` are read.
        alarms: Alarms of the sample, the most important one first.
    """
    within = [_cases_within(sample, alarms, distance) for distance in DISTANCES]
    return sample_tally(sample, within)


def _cases_within(sample: Counts, alarms: Sequence[Alarm], distance: float) -> NamedValues:
    """Return the cases and the known errors of one sample at one allowed distance."""
    hit = hit_of(alarms, distance) if sample["positive"] else None
    cases: NamedValues = {name: [] for name in ACCIDENT_ERRORS}
    if hit is None:
        return cases | {"tp": 0, "fp": len(alarms), "fn": int(sample["positive"])}
    for name in ACCIDENT_ERRORS:
        if hit[name] is not None:
            cases[name].append(abs(hit[name]))
    return cases | {"tp": 1, "fp": len(alarms) - 1, "fn": 0}


def actor_of(
    cells: BoolArray, frame: int, label: MotionLabels, context: AccidentContext
) -> int | None:
    """Return the actor that most of an instance's labelled cells belong to.

    If actors have the same number of cells, the one that was rasterised first is returned.

    Args:
        cells: (H, W) mask of the instance, in the label's orientation.
        frame: Index of the frame of the label.
        label: Label of the sample.
        context: Context, which has the actor id of the agent that recorded the label.

    Returns:
        Actor id; None if no cell is labelled, or if most cells belong to the recording agent and
        its actor id is unknown.
    """
    labelled_instances = label.instance[frame][cells]
    instances, counts = np.unique(labelled_instances, return_counts=True)
    counts = counts[instances > 0]
    instances = instances[instances > 0]
    if not len(instances):
        return None
    largest_instance = instances[np.argmax(counts)]
    for actor, instance in label.id_map.items():
        if instance == largest_instance:
            return context.own_actor_id if actor == OWN_BOX_ID else actor
    return None
