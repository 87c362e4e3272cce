"""Accident metrics for users of alarms: the protocol `boxes` compares with boxes, not with rasters.

The meta file of the scenario names the true pair and time; the labels provide the positions. Every
alarm counts: none is selected with the help of the truth. An alarm that the recording cannot refute
is not judged.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident.scoring import (
    ERRORS_AT,
    AccidentResult,
    Alarm,
    ComparedAccidents,
    add_tallies,
    alarms_tally,
    average_precision,
    classify_pair,
    exact_parts,
    hit_of,
    make_alarm,
    tally_result,
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
from deepaccident_devkit.support.values import NamedValues

# Keys of a sample's counts that say why the sample does not count at all.
_SKIP_REASONS = ("at_impact", "unplaced")
# Keys of the numbers of alarms, and of samples, that do not count.
_UNCOUNTED = ("unjudged", "beyond", *_SKIP_REASONS)


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxAccidentResult(AccidentResult):
    """Accident metrics, including alarm metrics, at the allowed distance `ERRORS_AT`.

    If there is no accident to foresee, APA and the accuracies are NaN; then the false alarm rate
    shows how good the predictions are.

    Attributes:
        precision: Share of the alarms that foresee a true accident; None if there are no alarms.
        recall: Share of the true accidents that are foreseen; None if there are none.
        average_precision: Area under precision over recall, with alarms in descending order of
            score; None if there are no true accidents.
        false_alarm_rate: Share of the samples without a coming accident that raise an alarm; None
            if there are no such samples.
        lateness: Predicted minus true accident time, averaged over the true positives, seconds;
            negative if predictions are too early, None if there are no true positives.
        unjudged: Number of alarms that nothing can refute, because no accident is known and they
            predict one after the recording's end.
        beyond: Number of alarms that predict an accident beyond the horizon; these are ignored.
        at_impact: Number of samples at the impact itself, where there is nothing left to foresee;
            they are left out of all other numbers.
        unplaced: Number of samples before an accident whose two actors are not both labelled (the
            meta file names an actor without a label, or the same actor twice); they are left out of
            all other numbers, too.
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
    """Rules of accident metrics that compare with the boxes of the labels.

    Each `Accident` is an alarm. The highest-scoring alarm close enough to the true accident is the
    true positive (ties: the earliest); all others are false positives.

    K motion predictions are a single alarm. Its score is the share of the predictions that contain
    an accident. The mean prediction (the last) sets the positions and the time; if it contains no
    accident, the first prediction that contains one does.

    Predictions are not cut at the recording's end, which a model cannot know. Alarms that predict
    an accident beyond the horizon do not count. Samples at the impact are skipped. An alarm that
    the recording cannot refute is left out and counted separately. An explicit accident without
    `ids` names the wrong actors if no actors are close enough to its positions.

    Attributes:
        reading: How an accident is read off maps. At the paper's 1 m, the default, vehicles driving
            side by side count as colliding, since neighbouring cells are 0.5 m apart; at 0.5 m, a
            head-on contact of two straight edges is missed.
    """

    reading: AccidentReading = field(default_factory=AccidentReading)

    def counts(
        self, prediction: Prediction, label: MotionLabels | None, context: AccidentContext
    ) -> Counts:
        """Count one sample.

        Args:
            prediction: Motion in maps, or explicit accidents; an empty list means no alarm.
            label: Labels that define the time between maps, and where instances lie within their
                cells; None for the released convention.
            context: Context with `truth`, from `accident_context(dataset, sample, horizon)`.

        Returns:
            `positive`: whether an accident comes; `named`: kind of the nearest pair of boxes within
            the danger distance (one of `NAMED`); `alarms`: the judged alarms, in descending order
            of score; `unjudged`: number of alarms that the recording cannot refute; `beyond`:
            number of alarms that predict an accident beyond the horizon; `at_impact`: whether the
            sample is at the impact; `unplaced`: whether the coming accident has no known positions.
            If one of the last two is True, nothing else of the sample counts.

        Raises:
            EvaluationError: If the context has no truth, or the prediction is neither maps nor
                accidents.
        """
        truth = _checked_truth(context)
        all_alarms = named_alarms(checked_prediction(prediction), label, truth, self.reading)
        alarms_within_horizon = within_horizon(all_alarms, truth)
        recording_end = float(truth.time[-1]) + TIME_TOLERANCE_S
        judged_alarms = []
        for accident, ids in alarms_within_horizon:
            # if no accident comes, the recording only refutes alarms up to its end
            if truth.accident is not None or accident.time <= recording_end:
                judged_alarms.append(_alarm(accident, ids, truth))
        return {
            "positive": truth.accident is not None,
            "named": classify_pair(truth.nearest_pair(self.reading.danger_distance), context),
            "alarms": judged_alarms,
            "unjudged": len(alarms_within_horizon) - len(judged_alarms),
            "beyond": len(all_alarms) - len(alarms_within_horizon),
            "at_impact": truth.accident is not None and truth.accident.time < TIME_TOLERANCE_S,
            "unplaced": truth.is_unplaced,
        }

    def compared(
        self,
        prediction: MotionOutput | list[Accident],
        label: MotionLabels | None,
        context: AccidentContext,
    ) -> ComparedAccidents:
        """Find the accidents in a prediction and in the truth.

        Raises:
            EvaluationError: If the context has no truth.
        """
        truth = _checked_truth(context)
        alarms = named_alarms(prediction, label, truth, self.reading)
        return ComparedAccidents(
            true=truth.accident,
            predicted=tuple(alarm for alarm, _ in alarms),
            unplaced=truth.unplaced if truth.is_unplaced else None,
        )

    def result(self, counts: Collection[Counts]) -> BoxAccidentResult:
        """Compute the metrics from the counts of samples, in any order."""
        sums = _sum_counts(counts)
        result = tally_result(sums["tally"], ERRORS_AT)
        area = None
        if result.positives:
            alarms = np.array(sums["alarms"], dtype=np.float64).reshape(-1, 2)
            area = average_precision(alarms[:, 0], alarms[:, 1], result.positives)
        else:
            within = {}
            for distance, accidents in result.within.items():
                within[distance] = replace(accidents, accuracy=math.nan)
            result = replace(result, apa=math.nan, within=within)
        values = {field.name: getattr(result, field.name) for field in fields(AccidentResult)}
        values["notes"] = (*result.notes, *not_counted_notes(sums["unplaced"], sums["beyond"]))
        values |= {name: sums[name] for name in _UNCOUNTED}
        tp = result.within[ERRORS_AT].tp
        fp = result.within[ERRORS_AT].fp
        return BoxAccidentResult(
            **values,
            precision=_share(tp, tp + fp),
            recall=_share(tp, result.positives),
            average_precision=area,
            false_alarm_rate=_share(sums["false_samples"], result.negatives),
            lateness=_share(math.fsum(sums["lateness"]), tp),
        )

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        """Sum all counts, which leads to the same result; alarms stay separate."""
        return [_sum_counts(counts)]


def _sum_counts(counts: Collection[Counts]) -> NamedValues:
    """Sum the counts of samples, or sums that `pooled` returned.

    Returns:
        `tally`; `alarms`: [score, whether it is correct] of each alarm; `lateness`: floats whose
        exact sum is the summed lateness of the correct alarms; `false_samples`: number of samples
        that raise an alarm although no accident comes; and the numbers in `_UNCOUNTED`.
    """
    terms = []
    for sample in counts:
        # earlier versions rejected unplaced samples, so their runs lack this number
        complete = {"unplaced": 0, **sample}
        terms.append(complete if "tally" in complete else _sample_terms(complete))
    sums: NamedValues = {
        "tally": add_tallies(term["tally"] for term in terms),
        "alarms": [alarm for term in terms for alarm in term["alarms"]],
        "lateness": exact_parts(term["lateness"] for term in terms),
    }
    for name in ("false_samples", *_UNCOUNTED):
        sums[name] = sum(term[name] for term in terms)
    return sums


def is_skipped(sample: Counts) -> bool:
    """Return whether a sample does not count at all."""
    return any(sample.get(name) for name in _SKIP_REASONS)


def _sample_terms(sample: Counts) -> NamedValues:
    """Return what one sample adds to the sums of `_sum_counts`."""
    terms: NamedValues = dict.fromkeys(("false_samples", *_UNCOUNTED), 0)
    if is_skipped(sample):
        for name in _SKIP_REASONS:
            terms[name] = int(sample[name])
        return terms | {"tally": add_tallies([]), "alarms": [], "lateness": []}
    alarms: Sequence[Alarm] = sample["alarms"]
    hit = hit_of(alarms, ERRORS_AT) if sample["positive"] else None
    return terms | {
        "tally": alarms_tally(sample, alarms),
        "alarms": [[alarm["score"], alarm is hit] for alarm in alarms],
        "lateness": [] if hit is None else [hit["time"]],
        "false_samples": int(bool(alarms) and not sample["positive"]),
        "unjudged": sample["unjudged"],
        "beyond": sample["beyond"],
    }


def _checked_truth(context: AccidentContext) -> BoxTruth:
    """Return the context's truth; raise EvaluationError if it has none."""
    if not isinstance(context.truth, BoxTruth):
        raise EvaluationError(
            "context: the accident protocol 'boxes' needs its truth, the labels' boxes; give "
            "accident_context(dataset, sample, horizon=2.0)"
        )
    return context.truth


def _alarm(accident: Accident, ids: Pair, truth: BoxTruth) -> NamedValues:
    """Build an alarm, with its differences from the true accident if there is one."""
    true_accident = truth.accident
    if true_accident is None:
        return make_alarm(score=accident.score)
    id_error = None
    if true_accident.ids is not None:
        id_error = int(set(ids) != set(true_accident.ids))
    return make_alarm(
        position=position_difference(accident.positions, true_accident.positions),
        time=accident.time - true_accident.time,
        id_error=id_error,
        score=accident.score,
    )


def _share(part: float, total: float) -> float | None:
    """Return `part / total`; None if the total is 0."""
    return part / total if total else None
