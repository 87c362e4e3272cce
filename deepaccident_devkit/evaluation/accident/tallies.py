"""Tallies: what samples add to the accident metrics at each distance, so that no order and no parts change a bit."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import Any, Final

from deepaccident_devkit.evaluation.accident.result import DISTANCES, NAMED, AccidentResult, AccidentsWithin
from deepaccident_devkit.evaluation.evaluator import Counts, ratio

ERRORS: Final = ("id", "position", "time")
_CASES: Final = ("tp", "fp", "fn")
Tally = Mapping[str, Any]
"""`numbers`: how many samples and positives there are, how many by `NAMED`, and for each of `DISTANCES` how many are
true positive, false positive and missed, and how many of each of `ERRORS` are known; `errors`: for each distance and of
`ERRORS` floats whose exact sum is theirs. Flat, since breakdowns add up thousands; as JSON can hold it.
"""
_NOTHING: Final[Tally] = {
    "numbers": [0] * (2 + len(NAMED) + len(DISTANCES) * (len(_CASES) + len(ERRORS))),
    "errors": [[]] * (len(DISTANCES) * len(ERRORS)),
}


def sample_tally(sample: Counts, within: Sequence[Mapping[str, Any]]) -> Tally:
    """Of one sample.

    Args:
        sample: its counts, of which `positive` and `named` are read.
        within: for each distance how many are `tp`, `fp` and `fn`, and lists of each of `ERRORS` that is known.
    """
    names = [int(sample["named"] == name) for name in NAMED]
    numbers = [[*(each[case] for case in _CASES), *(len(each[error]) for error in ERRORS)] for each in within]
    return {
        "numbers": [1, int(sample["positive"]), *names, *chain.from_iterable(numbers)],
        "errors": [each[error] for each in within for error in ERRORS],
    }


def united(tallies: Iterable[Tally]) -> Tally:
    """The tally of several together."""
    given = [_NOTHING, *tallies]
    return {
        "numbers": [sum(column) for column in zip(*(each["numbers"] for each in given), strict=True)],
        "errors": [exact_parts(column) for column in zip(*(each["errors"] for each in given), strict=True)],
    }


def exact_parts(numbers: Iterable[Iterable[float]]) -> list[float]:
    """A few floats with the exact sum of many: it as a float, then what that lacks."""
    rest, parts = [*chain.from_iterable(numbers)], []
    while part := math.fsum(rest):
        parts.append(part)
        rest.append(-part)
    return parts


def tally_result(tally: Tally, errors_at: float) -> AccidentResult:
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


def _within(distance: float, numbers: Sequence[int], errors: Sequence[Sequence[float]]) -> AccidentsWithin:
    """Of one distance: what `numbers` and `errors` begin with."""
    tp, fp, fn, *known = numbers[: len(_CASES) + len(ERRORS)]
    means = [math.fsum(parts) / count if count else None for parts, count in zip(errors, known, strict=False)]
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
