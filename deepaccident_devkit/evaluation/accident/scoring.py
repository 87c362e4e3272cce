"""From foreseen and true accidents to counts, tallies and results, for all protocols."""

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

DISTANCES: Final = (5.0, 10.0, 15.0)
"""The largest position differences of a predicted accident, metres."""
# The actors that the truth of a sample names: the pair of the meta file, another pair, nobody; or
# the pair is unknown.
NAMED: Final = ("meta", "another", "none", "unknown")
# Metres: in `paper` and `boxes` the errors are means over the true positives within this distance.
ERRORS_AT: Final = 10.0
ACCIDENT_ERRORS: Final = ("id", "position", "time")
_CASES: Final = ("tp", "fp", "fn")
# Length of the numbers of one distance in a tally: cases, then known errors.
_NUMBERS_PER_DISTANCE: Final = len(_CASES) + len(ACCIDENT_ERRORS)
# `numbers`: numbers of samples and of positives, numbers by `NAMED`, and for each of `DISTANCES`
# the numbers of true positives, false positives and missed accidents, and of known errors by
# `ACCIDENT_ERRORS`; `errors`: for each distance and error floats with the same exact sum as all
# errors. Flat, since breakdowns add up thousands, and as JSON can hold it.
_Tally = Mapping[str, Any]
_EMPTY_TALLY: Final[_Tally] = {
    "numbers": [0] * (2 + len(NAMED) + len(DISTANCES) * _NUMBERS_PER_DISTANCE),
    "errors": [[]] * (len(DISTANCES) * len(ACCIDENT_ERRORS)),
}
# A foreseen accident as counts hold it: differences from the truth in `position` (metres), `time`
# (seconds, positive if later) and `id` (0 the same two actors, 1 others); None where there is no
# truth or the value is not known.
Alarm = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentsWithin(ShortRepr):
    """Accidents counted with one distance allowed.

    Attributes:
        distance: Allowed distance, metres.
        tp: Predicted within the distance.
        fp: Predicted elsewhere, or without a true accident.
        fn: Missed.
        accuracy: tp / (tp + fp / 2 + fn / 2); NaN where nothing is counted.
        id_error: Share of the true positives that name other actors; None if the protocol has no
            value.
        position_error: Mean over the true positives, metres; None likewise.
        time_error: Mean over the true positives, seconds; None likewise.
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
    """Accident metrics of some samples.

    Attributes:
        within: Numbers by the distance allowed (`DISTANCES`).
        apa: Accident prediction accuracy, the mean of the accuracies; in [0, 1], NaN where nothing
            is counted.
        id_error: Share of the true positives that name other actors; None where the protocol has no
            value.
        position_error: Metres; None likewise.
        time_error: Seconds; None likewise.
        samples: Number of samples.
        positives: Number of samples with a true accident.
        negatives: Number of the other samples.
        truths: Actors that the samples' truths name, counts by `NAMED`.
        notes: Sentences that a reader of the numbers should know.
        beside: Results of other choices that are always printed too, by `name=value`.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedAccidents(ShortRepr):
    """The accidents of one sample, in the present ego frame; accidents read off maps have no `ids`.

    Attributes:
        true: The accident to come, by the protocol; None without one.
        predicted: The foreseen accidents, one for each alarm, or for each prediction with one.
        unplaced: Seconds to an impact within the horizon without a known position
            (`BoxTruth.unplaced`); None without one.
    """

    true: Accident | None
    predicted: tuple[Accident, ...]
    unplaced: float | None = None


def sample_tally(sample: Counts, within: Sequence[Mapping[str, Any]]) -> _Tally:
    """Return the tally of one sample.

    Args:
        sample: Counts of the sample; only `positive` and `named` are read.
        within: For each distance the numbers `tp`, `fp` and `fn`, and lists of the known values of
            each of `ACCIDENT_ERRORS`.
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


def united(tallies: Iterable[_Tally]) -> _Tally:
    """Return the joint tally of several."""
    parts = [_EMPTY_TALLY, *tallies]
    number_columns = zip(*(tally["numbers"] for tally in parts), strict=True)
    error_columns = zip(*(tally["errors"] for tally in parts), strict=True)
    return {
        "numbers": [sum(column) for column in number_columns],
        "errors": [exact_parts(column) for column in error_columns],
    }


def exact_parts(numbers: Iterable[Iterable[float]]) -> list[float]:
    """Return a few floats with the exact sum of many: the rounded sum, then the remainders."""
    remainder = [*chain.from_iterable(numbers)]
    parts = []
    while part := math.fsum(remainder):
        parts.append(part)
        if not math.isfinite(part):  # nothing remains of it, and nothing makes it 0
            break
        remainder.append(-part)
    return parts


def tally_result(tally: _Tally, errors_at: float) -> AccidentResult:
    """Return the metrics of a tally.

    Args:
        tally: Joint tally of all samples.
        errors_at: One of `DISTANCES`, metres; the errors are computed from the true positives at
            this distance.
    """
    samples, positives, *numbers = tally["numbers"]
    within = {}
    for index, distance in enumerate(DISTANCES):
        first_number = len(NAMED) + index * _NUMBERS_PER_DISTANCE
        first_error = index * len(ACCIDENT_ERRORS)
        within[distance] = _within(distance, numbers[first_number:], tally["errors"][first_error:])
    errors = within[errors_at]
    accuracies = [cases.accuracy for cases in within.values()]
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


def _within(
    distance: float, numbers: Sequence[int], errors: Sequence[Sequence[float]]
) -> AccidentsWithin:
    """Return the numbers of one distance from the head of `numbers` and `errors`."""
    tp, fp, fn, *error_counts = numbers[:_NUMBERS_PER_DISTANCE]
    means = []
    for parts, count in zip(errors, error_counts, strict=False):
        means.append(math.fsum(parts) / count if count else None)
    return AccidentsWithin(
        distance=distance,
        tp=tp,
        fp=fp,
        fn=fn,
        accuracy=prediction_accuracy(tp, fp, fn),
        id_error=means[0],
        position_error=means[1],
        time_error=means[2],
    )


def average_precision(scores: ArrayLike, is_right: ArrayLike, positives: int) -> float:
    """Return the area under the steps of precision over recall; alarms of equal score are one step.

    Recall that no alarm reaches adds nothing, as in `sklearn.metrics.average_precision_score`.

    >>> average_precision([0.9, 0.8, 0.7], [True, False, True], positives=2)
    0.8333333333333333

    Args:
        scores: (N,) scores of the alarms, higher is surer.
        is_right: (N,) whether each alarm is right.
        positives: Number of true accidents, at least 1.

    Returns:
        A share in [0, 1]; 0 without alarms.
    """
    score = np.asarray(scores, dtype=np.float64)
    true = np.asarray(is_right, dtype=np.float64)
    if not len(score):
        return 0.0
    steps = np.unique(-score)
    step_index = np.searchsorted(steps, -score)
    raised = np.bincount(step_index, minlength=len(steps))
    right = np.bincount(step_index, true, len(steps))
    precision = np.cumsum(right) / np.cumsum(raised)
    return math.fsum((right / positives * precision).tolist())


def hit_of(alarms: Sequence[Alarm], distance: float) -> Alarm | None:
    """Return the first alarm that foresees the true accident nearer than a distance; or None."""
    for alarm in alarms:
        if alarm["position"] is not None and alarm["position"] < distance - TIE:
            return alarm
    return None


def foreseen(
    position: float | None = None,
    time: float | None = None,
    id_error: int | None = None,
    **extra: float,
) -> dict[str, Any]:
    """Return an `Alarm` with its position rounded so that values within `TIE` compare equal.

    Args:
        position: Difference of positions, metres.
        time: Difference of times, seconds.
        id_error: 0 if it names the same actors, otherwise 1.
        **extra: Values that are stored with it.
    """
    position = None if position is None else float(even(np.asarray(position)))
    return {"position": position, "time": time, "id": id_error, **extra}


def named(pair: Iterable[int | None] | None, context: AccidentContext) -> str:
    """Return the actors that a truth names, one of `NAMED`.

    Args:
        pair: Actor ids, None for one that is not known; None for no accident.
        context: Context of the sample.
    """
    if pair is None:
        return "none"
    actors = set(pair)
    if not context.known or None in actors:
        return "unknown"
    return "meta" if context.pair is not None and actors == set(context.pair) else "another"


def alarms_tally(sample: Counts, alarms: Sequence[Alarm]) -> _Tally:
    """Return what one sample adds.

    An accident foreseen elsewhere is a false positive and leaves the true one missed.

    Args:
        sample: Counts of the sample; only `positive` and `named` are read.
        alarms: Its alarms, the most important one first.
    """
    within = [_cases_within(sample, alarms, distance) for distance in DISTANCES]
    return sample_tally(sample, within)


def _cases_within(sample: Counts, alarms: Sequence[Alarm], distance: float) -> dict[str, Any]:
    """Return the cases of one sample with a distance allowed, and the known errors."""
    hit = hit_of(alarms, distance) if sample["positive"] else None
    cases: dict[str, Any] = {
        "tp": int(hit is not None),
        "fp": len(alarms) - int(hit is not None),
        "fn": int(sample["positive"] and hit is None),
    }
    for name in ACCIDENT_ERRORS:
        cases[name] = [] if hit is None or hit[name] is None else [abs(hit[name])]
    return cases


def actor_of(
    cells: BoolArray, frame: int, label: MotionLabels, context: AccidentContext
) -> int | None:
    """Return the actor to which most of an instance's labelled cells belong.

    Of equal ones it is the actor that was rasterised first.

    Args:
        cells: (H, W) cells of the instance, in the label's orientation.
        frame: Frame of the label.
        label: Label of the sample.
        context: Context, which has the actor id of the label's own box.

    Returns:
        Actor id; None if no cell is labelled, or if the agent of the label is not known.
    """
    drawn = label.instance[frame][cells]
    instances, counts = np.unique(drawn[drawn > 0], return_counts=True)
    if not len(instances):
        return None
    largest = int(instances[np.argmax(counts)])
    actors = (actor for actor, instance in label.id_map.items() if instance == largest)
    actor = next(actors, None)
    return context.own_actor_id if actor == OWN_BOX_ID else actor
