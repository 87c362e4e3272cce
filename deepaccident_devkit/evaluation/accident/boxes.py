"""Accident metrics for users of alarms: compared with what happens, not with rasters (`boxes`).

The truth is the pair and the moment that the scenario's meta file names, at the positions of the
labels. Every alarm counts, the truth does not help to choose one, and an alarm that a recording
cannot refute is not judged.
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
    average_precision,
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
from deepaccident_devkit.evaluation.truth import (
    TIME_TOLERANCE_S,
    AccidentContext,
    BoxTruth,
    not_counted_notes,
)
from deepaccident_devkit.motion import MotionLabels

# Reasons why nothing of a sample counts, keys of its counts.
_SKIP_REASONS = ("at_impact", "unplaced")
# Keys of the numbers of alarms and samples that do not count.
_UNCOUNTED = ("unjudged", "beyond", *_SKIP_REASONS)


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxAccidentResult(AccidentResult):
    """Accident metrics, and numbers on alarms at the distance `ERRORS_AT`.

    Without any accident to foresee APA and the accuracies are NaN, and the false alarm rate shows
    how good predictions are.

    Attributes:
        precision: Share of the alarms that foresee a true accident; None without alarms.
        recall: Share of the true accidents that are foreseen; None without any.
        average_precision: Mean of the precision over the recall, alarms from the surest on; None
            likewise.
        false_alarm_rate: Share of the samples without a coming accident that raise an alarm; None
            without any.
        lateness: Seconds, mean over the true positives by which the predicted moment is later than
            the true one, negative if it is earlier; None without any.
        unjudged: Alarms that nothing can refute: no accident is known, and they are for a time
            after the recording.
        beyond: Alarms for later than the horizon, which do not count.
        at_impact: Samples at the impact itself, where nothing can be foreseen any more; they are
            left out of all other numbers.
        unplaced: Samples before an accident without a label of both actors (meta names one
            that has none, or one twice); left out likewise.
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

    A list of `Accident`s is a list of alarms: each is true or false, and the surest one that is
    near enough to the true accident (the earliest of equally sure ones) is the true positive. K
    motion predictions are one alarm, scored by the share of them that have an accident. The
    mean sample (the last) gives place and time, or if it has no accident, the first sample that has
    one. They are not cut at the recording's end, which a model cannot know. An alarm for later than
    the horizon does not count, and at the impact itself there is nothing to foresee.

    An alarm that the recording cannot refute is left out and counted separately. If nobody is near
    enough to an explicit accident without `ids`, it names the wrong actors.

    Attributes:
        reading: How an accident is read off maps. By the paper's 1 m, the default, traffic side by
            side collides, since neighbouring cells are 0.5 m apart; at 0.5 m a square contact is
            missed.
    """

    reading: AccidentReading = field(default_factory=AccidentReading)

    def counts(
        self, prediction: Prediction, label: MotionLabels | None, context: AccidentContext
    ) -> Counts:
        """Return what one sample adds.

        Args:
            prediction: Motion in maps, or explicit accidents; an empty list for no alarm.
            label: Labels that define how far apart in time maps are and where instances lie within
                their cells; None for the released convention.
            context: Context with `truth`, from `accident_context(dataset, sample, horizon)`.

        Returns:
            `positive`: whether an accident comes; `named`: the actors that the boxes bring nearer
            to each other than the danger distance (one of `NAMED`); `alarms`: the surest first;
            `unjudged` and `beyond`: numbers of alarms that were left out, and that do not count;
            `at_impact` and `unplaced`: whether the impact is now, or comes but cannot be compared
            with, so that nothing else of the sample counts.

        Raises:
            EvaluationError: the context has no truth, or the prediction is neither maps nor
                accidents.
        """
        truth = _truth_of(context)
        raised = named_alarms(checked_prediction(prediction), label, truth, self.reading)
        within = within_horizon(raised, truth)
        judged = []
        for accident, ids in within:
            # without an accident to come the recording refutes alarms up to its end only
            is_refutable = accident.time <= float(truth.time[-1]) + TIME_TOLERANCE_S
            if truth.accident is not None or is_refutable:
                judged.append(_alarm(accident, ids, truth))
        return {
            "positive": truth.accident is not None,
            "named": named(truth.nearest_pair(self.reading.danger_distance), context),
            "alarms": judged,
            "unjudged": len(within) - len(judged),
            "beyond": len(raised) - len(within),
            "at_impact": truth.accident is not None and truth.accident.time < TIME_TOLERANCE_S,
            "unplaced": truth.is_unplaced,
        }

    def compared(
        self,
        prediction: MotionOutput | list[Accident],
        label: MotionLabels | None,
        context: AccidentContext,
    ) -> ComparedAccidents:
        """Return the accidents that the protocol sees; raises EvaluationError."""
        truth = _truth_of(context)
        alarms = named_alarms(prediction, label, truth, self.reading)
        return ComparedAccidents(
            true=truth.accident,
            predicted=tuple(alarm for alarm, _ in alarms),
            unplaced=truth.unplaced if truth.is_unplaced else None,
        )

    def result(self, counts: Collection[Counts]) -> BoxAccidentResult:
        """Return the metrics of some samples' counts, in any order."""
        sums = _united(counts)
        base = tally_result(sums["tally"], ERRORS_AT)
        if not base.positives:
            within = {}
            for distance, cases in base.within.items():
                within[distance] = replace(cases, accuracy=math.nan)
            base = replace(base, apa=math.nan, within=within)
        values = {field.name: getattr(base, field.name) for field in fields(AccidentResult)}
        values["notes"] = (*base.notes, *not_counted_notes(sums["unplaced"], sums["beyond"]))
        cases = base.within[ERRORS_AT]
        area = None
        if base.positives:
            alarms = np.array(sums["alarms"], dtype=np.float64).reshape(-1, 2)
            area = average_precision(alarms[:, 0], alarms[:, 1], base.positives)
        return BoxAccidentResult(
            **values,
            precision=_share(cases.tp, cases.tp + cases.fp),
            recall=_share(cases.tp, base.positives),
            average_precision=area,
            false_alarm_rate=_share(sums["false_samples"], base.negatives),
            lateness=_share(math.fsum(sums["lateness"]), cases.tp),
            **{name: sums[name] for name in _UNCOUNTED},
        )

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        """Return the sums of all counts, which have the same result, with alarms one by one."""
        return [_united(counts)]


def _united(counts: Collection[Counts]) -> dict[str, Any]:
    """Return what samples add, `pooled` ones among them.

    Returns:
        `tally`; `alarms`: [score, whether it is right] of each; `lateness`: terms of the summed
        lateness of the right alarms; `false_samples`: samples that raise an alarm without a coming
        accident; and the numbers of `_UNCOUNTED`.
    """
    parts = []
    for sample in counts:
        # runs of earlier versions refused unplaced samples, and so have no such number
        complete = {"unplaced": 0, **sample}
        parts.append(complete if "tally" in complete else _tallied(complete))
    sums: dict[str, Any] = {
        "tally": united(part["tally"] for part in parts),
        "alarms": [alarm for part in parts for alarm in part["alarms"]],
        "lateness": exact_parts(part["lateness"] for part in parts),
    }
    for name in ("false_samples", *_UNCOUNTED):
        sums[name] = sum(part[name] for part in parts)
    return sums


def _tallied(sample: Counts) -> dict[str, Any]:
    """Return what one sample adds, in the form of `_united`."""
    if any(sample[name] for name in _SKIP_REASONS):
        skipped: dict[str, Any] = {"tally": united([]), "alarms": [], "lateness": []}
        skipped |= dict.fromkeys(("false_samples", *_UNCOUNTED), 0)
        return skipped | {name: int(sample[name]) for name in _SKIP_REASONS}
    alarms: Sequence[Alarm] = sample["alarms"]
    hit = hit_of(alarms, ERRORS_AT) if sample["positive"] else None
    return {
        "tally": alarms_tally(sample, alarms),
        "alarms": [[alarm["score"], alarm is hit] for alarm in alarms],
        "lateness": [] if hit is None else [hit["time"]],
        "false_samples": int(bool(alarms) and not sample["positive"]),
        "unjudged": sample["unjudged"],
        "beyond": sample["beyond"],
        **dict.fromkeys(_SKIP_REASONS, 0),
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
    """Return an alarm compared with the true accident, if there is one."""
    true = truth.accident
    if true is None:
        return foreseen(score=accident.score)
    return foreseen(
        position=position_difference(accident.positions, true.positions),
        time=accident.time - true.time,
        id_error=None if true.ids is None else int(set(ids) != set(true.ids)),
        score=accident.score,
    )


def _share(part: float, total: float) -> float | None:
    """Return `part / total`; None if there is nothing to count."""
    return part / total if total else None
