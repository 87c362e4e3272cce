"""Accident metrics for users of alarms: compared with what happens, not with rasters (protocol `boxes`).

The truth is the pair and the moment that the scenario's meta file names, at the places where the labels have them.
Every alarm counts, the truth does not help to choose one, and an alarm that a recording cannot refute is not judged.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident.scoring import (
    ERRORS_AT,
    AccidentResult,
    Alarm,
    ComparedAccidents,
    alarms_tally,
    exact_parts,
    foreseen,
    hit_of,
    named,
    tally_result,
    united,
)
from deepaccident_devkit.evaluation.alarms import (
    Pair,
    named_alarms,
    position_difference,
    within_horizon,
)
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.map_accidents import AccidentReading
from deepaccident_devkit.evaluation.predictions import (
    Accident,
    MotionOutput,
    Prediction,
    checked_prediction,
)
from deepaccident_devkit.evaluation.truth import SLACK, AccidentContext, BoxTruth, not_counted_notes
from deepaccident_devkit.motion import MotionLabels

# Why nothing else of a sample counts.
_ASIDE = ("at_impact", "unplaced")
_LEFT_OUT = ("unjudged", "beyond", *_ASIDE)


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxAccidentResult(AccidentResult):
    """Accident metrics, and numbers on alarms; these at the distance `ERRORS_AT`.

    Without any accident to foresee APA and the accuracies are NaN, and the false alarm rate says how good predictions
    are.

    Attributes:
        precision: share of the alarms that foresee a true accident; None without alarms.
        recall: share of the true accidents that are foreseen; None without any.
        average_precision: the mean of the precision over the recall, alarms taken from the surest on; None likewise.
        false_alarm_rate: share of the samples without an accident to come that raise an alarm; None without any.
        lateness: seconds, mean over the true positives by which the predicted moment is later than the true one,
            negative if it is earlier; None without any.
        unjudged: alarms that nothing can refute: no accident is known, and they are for a time after the recording.
        beyond: alarms for later than the horizon, which do not count.
        at_impact: samples at the impact itself, where nothing is foreseen any more; they are left out of all else.
        unplaced: samples before an accident of which no label shows both actors (meta names one that has none, or one
            twice); likewise.
    """

    precision: float | None
    recall: float | None
    average_precision: float | None
    false_alarm_rate: float | None
    lateness: float | None
    unjudged: int
    beyond: int
    at_impact: int
    unplaced: int


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxAccidents:
    """Accident metrics against the labels' boxes.

    A list of `Accident`s is a list of alarms: each is true or false, and the surest one that is near enough to the true
    accident (the earliest of equally sure ones) is the true positive. K motion predictions are one alarm, whose score
    is the share of them that have an accident. The mean sample (the last) says where and when, or if it has no
    accident, the first sample that has one. They are not cut at the recording's end, which a model cannot know. An
    alarm for later than the horizon does not count, and at the impact itself there is nothing to foresee.

    An alarm that the recording cannot refute is left out and counted aside. If nobody is near enough to an explicit
    accident without `ids`, it names the wrong actors.

    Attributes:
        reading: how an accident is read off maps. By the paper's 1 m, the default, traffic side by side collides, since
            neighbouring cells are 0.5 m apart; at 0.5 m a square contact is missed.
    """

    reading: AccidentReading = field(default_factory=AccidentReading)

    def counts(
        self, prediction: Prediction, label: MotionLabels | None, context: AccidentContext
    ) -> Counts:
        """What one sample adds.

        Args:
            prediction: motion in maps, or explicit accidents; an empty list for no alarm.
            label: says how far apart in time maps are and how they lie in their cells; None for the released way.
            context: with `truth`, from `accident_context(dataset, sample, horizon)`.

        Returns:
            `positive`: whether an accident comes; `named`: whom the boxes bring nearer to each other than the danger
            distance (of `NAMED`); `alarms`: the surest first; `unjudged` and `beyond`: how many were left out, and how
            many do not count; `at_impact` and `unplaced`: whether the impact is now, or comes but cannot be compared
            with, so that nothing else of the sample counts.

        Raises:
            EvaluationError: the context has no truth, or the prediction is neither maps nor accidents.
        """
        truth = _truth_of(context)
        raised = named_alarms(checked_prediction(prediction), label, truth, self.reading)
        within = within_horizon(raised, truth)
        judged = [  # the alarms that the recording can refute
            each
            for each in within
            if truth.accident is not None or each[0].time <= float(truth.time[-1]) + SLACK
        ]
        return {
            "positive": truth.accident is not None,
            "named": named(truth.nearest_pair(self.reading.danger_distance), context),
            "alarms": [_alarm(accident, ids, truth) for accident, ids in judged],
            "unjudged": len(within) - len(judged),
            "beyond": len(raised) - len(within),
            "at_impact": truth.accident is not None and truth.accident.time < SLACK,
            "unplaced": truth.is_unplaced,
        }

    def compared(
        self,
        given: MotionOutput | list[Accident],
        label: MotionLabels | None,
        context: AccidentContext,
    ) -> ComparedAccidents:
        """Which accidents it sees; raises EvaluationError."""
        truth = _truth_of(context)
        return ComparedAccidents(
            true=truth.accident,
            predicted=tuple(alarm for alarm, _ in named_alarms(given, label, truth, self.reading)),
            unplaced=truth.unplaced if truth.is_unplaced else None,
        )

    def result(self, counts: Collection[Counts]) -> BoxAccidentResult:
        """The metrics of some samples' counts, in any order."""
        given = _united(counts)
        base = tally_result(given["tally"], ERRORS_AT)
        if not base.positives:
            nothing = {
                distance: replace(each, accuracy=math.nan) for distance, each in base.within.items()
            }
            base = replace(base, apa=math.nan, within=nothing)
        at = base.within[ERRORS_AT]
        return BoxAccidentResult(
            **{
                each.name: getattr(base, each.name)
                for each in fields(AccidentResult)
                if each.name != "notes"
            },
            notes=(*base.notes, *not_counted_notes(given["unplaced"], given["beyond"])),
            precision=_share(at.tp, at.tp + at.fp),
            recall=_share(at.tp, base.positives),
            average_precision=_average_precision(given["alarms"], base.positives),
            false_alarm_rate=_share(given["false_samples"], base.negatives),
            lateness=_share(math.fsum(given["lateness"]), at.tp),
            **{name: given[name] for name in _LEFT_OUT},
        )

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        """The sums of all counts, which have the same result; alarms are kept one by one."""
        return [_united(counts)]


def _united(counts: Collection[Counts]) -> dict[str, Any]:
    """What samples add, those of `pooled` among them.

    Returns:
        `tally`; `alarms`: [score, whether it is the right one] of each; `lateness`: in sum, of the right ones;
        `false_samples`: how many raise an alarm without an accident to come; and of `_LEFT_OUT` each.
    """
    complete = [
        {"unplaced": 0, **each} for each in counts
    ]  # runs kept by earlier versions refused such samples
    given = [each if "tally" in each else _tallied(each) for each in complete]
    return {
        "tally": united(each["tally"] for each in given),
        "alarms": [alarm for each in given for alarm in each["alarms"]],
        "lateness": exact_parts(each["lateness"] for each in given),
        **{name: sum(each[name] for each in given) for name in ("false_samples", *_LEFT_OUT)},
    }


def _tallied(sample: Counts) -> dict[str, Any]:
    if any(sample[name] for name in _ASIDE):
        return (
            {"tally": united([]), "alarms": [], "lateness": []}
            | dict.fromkeys(("false_samples", *_LEFT_OUT), 0)
            | {name: int(sample[name]) for name in _ASIDE}
        )
    alarms: Sequence[Alarm] = sample["alarms"]
    hit = hit_of(alarms, ERRORS_AT) if sample["positive"] else None
    return {
        "tally": alarms_tally(sample, alarms),
        "alarms": [[alarm["score"], alarm is hit] for alarm in alarms],
        "lateness": [] if hit is None else [hit["time"]],
        "false_samples": int(bool(alarms) and not sample["positive"]),
        **{name: sample[name] for name in ("unjudged", "beyond")},
        **dict.fromkeys(_ASIDE, 0),
    }


def _truth_of(context: AccidentContext) -> BoxTruth:
    """Return the truth of the boxes; raises EvaluationError if there is none."""
    if not isinstance(context.truth, BoxTruth):
        raise EvaluationError(
            "context: the accident protocol 'boxes' needs its truth, the labels' boxes; give "
            "accident_context(dataset, sample, horizon=2.0)"
        )
    return context.truth


def _alarm(accident: Accident, ids: Pair, truth: BoxTruth) -> dict[str, Any]:
    true = truth.accident
    if true is None:
        return foreseen(score=accident.score)
    return foreseen(
        position=position_difference(accident.positions, true.positions),
        time=accident.time - true.time,
        id_error=None if true.ids is None else int(set(ids) != set(true.ids)),
        score=accident.score,
    )


def _average_precision(alarms: Sequence[Sequence[float]], positives: int) -> float | None:
    """The area under the steps of precision over recall; alarms of equal score are one step."""
    if not positives:
        return None
    if not alarms:
        return 0.0
    score, true = np.array(alarms, dtype=np.float64).T
    steps = np.unique(-score)
    place = np.searchsorted(steps, -score)
    raised = np.bincount(place, minlength=len(steps))
    right = np.bincount(place, true, len(steps))
    return math.fsum((right / positives * (np.cumsum(right) / np.cumsum(raised))).tolist())


def _share(part: float, whole: float) -> float | None:
    return part / whole if whole else None
