"""From accidents foreseen and true to counts, tallies and an `AccidentResult`, the same for all protocols."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, ClassVar, Final

import numpy as np

from deepaccident_devkit.evaluation.evaluator import Counts, ratio
from deepaccident_devkit.evaluation.map_accidents import TIE, even
from deepaccident_devkit.evaluation.predictions import Accident
from deepaccident_devkit.evaluation.task import Row, TaskResult
from deepaccident_devkit.evaluation.truth import AccidentContext
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabels
from deepaccident_devkit.support.arrays import BoolArray, ShortRepr

DISTANCES: Final = (5.0, 10.0, 15.0)
"""The largest position differences of a predicted accident, metres."""
# The actors that the truth of a sample names: the pair of the meta file, another pair, nobody; or the pair is
# unknown.
NAMED: Final = ("meta", "another", "none", "unknown")


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentsWithin(ShortRepr):
    """Accidents counted with one distance allowed.

    Attributes:
        distance: metres allowed.
        tp: predicted within the distance.
        fp: predicted, but elsewhere or without any.
        fn: missed.
        accuracy: tp / (tp + fp / 2 + fn / 2); NaN where nothing is counted.
        id_error: share of the true positives that name others; None if the protocol has no value.
        position_error: metres, mean over the true positives; likewise.
        time_error: seconds, mean over the true positives; likewise.
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
        within: by the distance allowed (`DISTANCES`).
        apa: accident prediction accuracy, the mean of the accuracies; in [0, 1], NaN where nothing is counted.
        id_error: share of the true positives that name others; None where the protocol has no value.
        position_error: metres; likewise.
        time_error: seconds; likewise.
        samples: how many.
        positives: samples whose truth has an accident.
        negatives: those without.
        truths: whom the samples' truths name, counts by `NAMED`.
        notes: sentences that a reader of the numbers should know.
        beside: results of other choices that are always printed too, by `name=value`.
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
    """The accidents of one sample, in the present ego frame; those read off maps have no `ids`.

    Attributes:
        true: the accident to come, by the protocol; None without one.
        predicted: the accidents foreseen, one for each alarm, or for each prediction with one.
        unplaced: seconds to an impact within the horizon that no place is known of (`BoxTruth.unplaced`); None without.
    """

    true: Accident | None
    predicted: tuple[Accident, ...]
    unplaced: float | None = None


ERRORS: Final = ("id", "position", "time")
_CASES: Final = ("tp", "fp", "fn")
# `numbers`: how many samples and positives there are, how many by `NAMED`, and for each of `DISTANCES` how many are
# true positive, false positive and missed, and how many of each of `ERRORS` are known; `errors`: for each distance and
# of `ERRORS` floats whose exact sum is theirs. Flat, since breakdowns add up thousands; as JSON can hold it.
_Tally = Mapping[str, Any]
_NOTHING: Final[_Tally] = {
    "numbers": [0] * (2 + len(NAMED) + len(DISTANCES) * (len(_CASES) + len(ERRORS))),
    "errors": [[]] * (len(DISTANCES) * len(ERRORS)),
}


def sample_tally(sample: Counts, within: Sequence[Mapping[str, Any]]) -> _Tally:
    """Of one sample.

    Args:
        sample: its counts, of which `positive` and `named` are read.
        within: for each distance how many are `tp`, `fp` and `fn`, and lists of each of `ERRORS` that is known.
    """
    names = [int(sample["named"] == name) for name in NAMED]
    numbers = [
        [*(each[case] for case in _CASES), *(len(each[error]) for error in ERRORS)]
        for each in within
    ]
    return {
        "numbers": [1, int(sample["positive"]), *names, *chain.from_iterable(numbers)],
        "errors": [each[error] for each in within for error in ERRORS],
    }


def united(tallies: Iterable[_Tally]) -> _Tally:
    """The tally of several together."""
    given = [_NOTHING, *tallies]
    return {
        "numbers": [
            sum(column) for column in zip(*(each["numbers"] for each in given), strict=True)
        ],
        "errors": [
            exact_parts(column) for column in zip(*(each["errors"] for each in given), strict=True)
        ],
    }


def exact_parts(numbers: Iterable[Iterable[float]]) -> list[float]:
    """A few floats with the exact sum of many: the rounded sum, then the remainders."""
    rest, parts = [*chain.from_iterable(numbers)], []
    while part := math.fsum(rest):
        parts.append(part)
        if not math.isfinite(part):  # nothing remains of it, and nothing makes it 0
            break
        rest.append(-part)
    return parts


def tally_result(tally: _Tally, errors_at: float) -> AccidentResult:
    """The metrics of what `united` gives.

    Args:
        tally: the sum of all samples.
        errors_at: metres: of `DISTANCES`, whose true positives the errors are means over.
    """
    samples, positives, *numbers = tally["numbers"]
    within = {
        distance: _within(
            distance,
            numbers[len(NAMED) + index * (len(_CASES) + len(ERRORS)) :],
            tally["errors"][index * len(ERRORS) :],
        )
        for index, distance in enumerate(DISTANCES)
    }
    at = within[errors_at]
    return AccidentResult(
        within=within,
        apa=math.fsum(each.accuracy for each in within.values()) / len(within),
        id_error=at.id_error,
        position_error=at.position_error,
        time_error=at.time_error,
        samples=samples,
        positives=positives,
        negatives=samples - positives,
        truths=dict(zip(NAMED, numbers, strict=False)),
    )


def _within(
    distance: float, numbers: Sequence[int], errors: Sequence[Sequence[float]]
) -> AccidentsWithin:
    """Of one distance: what `numbers` and `errors` begin with."""
    tp, fp, fn, *known = numbers[: len(_CASES) + len(ERRORS)]
    means = [
        math.fsum(parts) / count if count else None
        for parts, count in zip(errors, known, strict=False)
    ]
    return AccidentsWithin(
        distance=distance,
        tp=tp,
        fp=fp,
        fn=fn,
        accuracy=ratio(tp, tp + fp / 2 + fn / 2),
        id_error=means[0],
        position_error=means[1],
        time_error=means[2],
    )


# An accident that is foreseen, as counts hold it: `position` (metres), `time` (seconds, later than the truth is
# positive) and `id` (0 the same two, 1 others) differences from the truth; None where there is none or it is not known.
Alarm = Mapping[str, Any]


# Metres: of `paper` and `boxes` the errors are means over the true positives within this distance.
ERRORS_AT: Final = 10.0


def hit_of(alarms: Sequence[Alarm], distance: float) -> Alarm | None:
    """The first alarm that foresees the true accident nearer than a distance."""
    return next(
        (
            each
            for each in alarms
            if each["position"] is not None and each["position"] < distance - TIE
        ),
        None,
    )


def foreseen(
    position: float | None = None,
    time: float | None = None,
    id_error: int | None = None,
    **more: float,
) -> dict[str, Any]:
    """An `Alarm`, of whose positions those that differ by less than `TIE` are equal; `more` is kept with it."""
    position = None if position is None else float(even(np.asarray(position)))
    return {"position": position, "time": time, "id": id_error, **more}


def named(pair: Iterable[int | None] | None, context: AccidentContext) -> str:
    """Whom a truth names, of `NAMED`.

    Args:
        pair: actor ids, None for one that is not known; None for no accident.
        context: of the sample.
    """
    if pair is None:
        return "none"
    actors = set(pair)
    if not context.known or None in actors:
        return "unknown"
    return "meta" if context.pair is not None and actors == set(context.pair) else "another"


def alarms_tally(sample: Counts, alarms: Sequence[Alarm]) -> _Tally:
    """What one sample adds; an accident foreseen elsewhere is a false positive and leaves the true one missed.

    Args:
        sample: its counts, of which `positive` and `named` are read.
        alarms: its, the most important one first.
    """
    return sample_tally(sample, [_cases_within(sample, alarms, each) for each in DISTANCES])


def _cases_within(sample: Counts, alarms: Sequence[Alarm], distance: float) -> dict[str, Any]:
    hit = hit_of(alarms, distance) if sample["positive"] else None
    return {
        "tp": int(hit is not None),
        "fp": len(alarms) - int(hit is not None),
        "fn": int(sample["positive"] and hit is None),
        **{name: [] if hit is None or hit[name] is None else [abs(hit[name])] for name in ERRORS},
    }


def actor_of(
    cells: BoolArray, frame: int, label: MotionLabels, context: AccidentContext
) -> int | None:
    """The actor to which most of an instance's labelled cells belong; of equal ones the one rasterised first.

    Args:
        cells: (H, W) where the instance is, as the label lies.
        frame: at which of the label's frames.
        label: the sample's.
        context: who the label's own box is.

    Returns:
        Its id; None if no cell is labelled, or if the agent of the label is not known.
    """
    drawn = label.instance[frame][cells]
    names, counts = np.unique(drawn[drawn > 0], return_counts=True)
    if not len(names):
        return None
    most = int(names[np.argmax(counts)])
    actor = next((actor for actor, name in label.id_map.items() if name == most), None)
    return context.own_actor_id if actor == OWN_BOX_ID else actor
