"""Accident metrics as the paper describes them (protocol `paper`).

Where the paper is silent, the rules in docs/protocols.md apply.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, get_args

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident.scoring import (
    ERRORS_AT,
    AccidentResult,
    Alarm,
    ComparedAccidents,
    actor_of,
    add_tallies,
    alarms_tally,
    classify_pair,
    make_alarm,
    tally_result,
)
from deepaccident_devkit.evaluation.alarms import (
    MATCH_DISTANCE,
    alarm_sort_key,
    nearest_two,
    position_difference,
)
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.map_accidents import (
    AccidentReading,
    InstanceAccident,
    instances_of_heads,
    map_accident,
    match_tracks,
    predicted_accidents,
)
from deepaccident_devkit.evaluation.predictions import (
    Accident,
    MotionOutput,
    Prediction,
    checked_prediction,
    compared_frames,
    first_frames,
    labels_at_present,
    num_recorded_frames,
)
from deepaccident_devkit.evaluation.truth import AccidentContext
from deepaccident_devkit.motion import MotionHeads, MotionLabels
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.text import counted, settle_choices
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import FRAME_PERIOD

SampleChoice = Literal["best", "mean_first"]
_NO_LABEL = "label: the accident protocol 'paper' needs the sample's motion labels"
# Kinds of predictions other than heads: key in the counts → words in the notes.
_FORMS = {
    "instance_maps": "instance maps",
    "explicit": "explicit accidents",
}
_SAMPLE_CHOICES: tuple[SampleChoice, ...] = get_args(SampleChoice)


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperAccidents:
    """Rules of accident metrics that follow the paper's text.

    An accident in any of the K predictions counts as predicted. Its positions are taken at the
    predicted time of the accident.

    Attributes:
        reading: How an accident is read off maps, both in the truth and in the prediction.
        sample_choice: Which prediction is compared if several contain an accident. `best`, like the
            released code, takes the one whose positions are nearest to the truth (ties: the first).
            `mean_first` does not use the truth: it takes the mean prediction or, if it contains
            no accident, the first prediction that does. Both choices are counted: the chosen one is
            the result, and the other is in its `beside`.
    """

    labels: ClassVar[str] = "released"
    """Name of the protocol that the labels must follow; others are rejected."""
    reading: AccidentReading = field(default_factory=AccidentReading)
    sample_choice: SampleChoice = "best"

    def __post_init__(self) -> None:
        """Check the fields; raise ChoiceError if `sample_choice` is not a known name."""
        settle_choices(self, {"sample_choice": _SAMPLE_CHOICES})

    def counts(
        self, prediction: Prediction, label: MotionLabels | None, context: AccidentContext
    ) -> Counts:
        """Count one sample.

        For heads, the truth is the labels converted to heads, after the same grouping and linking.
        For instance maps or explicit accidents, it is the warped instance map of the labels.

        Returns:
            `positive`: whether the truth contains an accident; `named`: the kind of pair that
            collides in the truth (one of `NAMED`); `instance_maps` and `explicit`: whether the
            prediction is of this kind; `best` and `mean_first`: the alarm that each choice
            compares, None if no prediction contains an accident.

        Raises:
            EvaluationError: If the prediction is neither motion nor accidents, or if the labels are
                missing, follow another protocol, or have another grid or too few frames.
        """
        if label is None:
            raise EvaluationError(_NO_LABEL)
        checked = checked_prediction(prediction)
        frames = compared_frames(checked, label, self.labels)
        rules = label.config.rules
        label = labels_at_present(label)
        maps = self.truth_map(checked, label, frames)
        truth = map_accident(maps, label.config.grid, rules, self.reading)
        step = label.config.step * FRAME_PERIOD
        contact = truth.contact
        actors = None
        if contact is not None:
            masks = [maps[contact.frame] == identity for identity in contact.ids]
            actors = [actor_of(mask, contact.frame, label, context) for mask in masks]
        alarms: list[Alarm] = []
        mean_alarm = None
        has_instance_maps = False
        is_explicit = not isinstance(checked, MotionOutput)
        if isinstance(checked, MotionOutput):
            has_instance_maps = checked.instances is not None
            # the mean prediction is the last one
            for accident in predicted_accidents(checked, rules, self.reading, frames):
                mean_alarm = None
                if accident.contact is not None:
                    mean_alarm = _alarm(accident, truth, step)
                    alarms.append(mean_alarm)
        else:
            for explicit_accident in surest_within(checked, (frames - 0.5) * step):
                alarms.append(explicit_alarm(explicit_accident, truth, actors, seconds=step))
        first_alarm = alarms[0] if alarms else None
        return {
            "positive": contact is not None,
            "named": classify_pair(actors, context),
            "instance_maps": has_instance_maps,
            "explicit": is_explicit,
            # smallest position error (ties: the first); without a true accident, the first alarm
            "best": min(alarms, key=_position_or_zero, default=None),
            "mean_first": mean_alarm or first_alarm,
        }

    def compared(
        self,
        prediction: MotionOutput | list[Accident],
        label: MotionLabels | None,
        _context: AccidentContext,
    ) -> ComparedAccidents:
        """Find the accidents in a prediction and in the truth.

        Raises:
            EvaluationError: If there are no labels.
        """
        if label is None:
            raise EvaluationError(_NO_LABEL)
        config = label.config
        frames = num_recorded_frames(label)
        step = config.step * FRAME_PERIOD
        maps = self.truth_map(prediction, labels_at_present(label), frames)
        truth = map_accident(maps, config.grid, config.rules, self.reading)
        true_accident = truth.explicit(step)
        alarms = []
        if isinstance(prediction, MotionOutput):
            for accident in predicted_accidents(prediction, config.rules, self.reading, frames):
                explicit_accident = accident.explicit(step)
                if explicit_accident is not None:
                    alarms.append(explicit_accident)
        else:
            alarms = surest_within(prediction, (frames - 0.5) * step)
        return ComparedAccidents(true=true_accident, predicted=tuple(alarms))

    def result(self, counts: Collection[Counts]) -> AccidentResult:
        """Compute the metrics from the counts of samples, in any order."""
        sums = _sum_counts(counts)
        result = tally_result(sums[self.sample_choice], ERRORS_AT)
        other_results = {}
        for sample_choice in _SAMPLE_CHOICES:
            if sample_choice != self.sample_choice:
                other_result = tally_result(sums[sample_choice], ERRORS_AT)
                other_results[f"sample_choice={sample_choice}"] = other_result
        predictions = counted(result.samples, "prediction")
        notes = []
        for form, words in _FORMS.items():
            if sums[form]:
                notes.append(
                    f"given as {words}: {sums[form]} of {predictions}. Their truth is the labels' "
                    "instance map, not the released grouping and linking of the labels"
                )
        return replace(result, notes=tuple(notes), beside=other_results)

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        """Sum all counts, which leads to the same result."""
        return [{"tallies": _sum_counts(counts)}]

    def truth_map(
        self, prediction: MotionOutput | list[Accident], label: MotionLabels, frames: int
    ) -> AnyArray:
        """Return the true instances that a prediction is compared with, shape (T, H, W).

        They have the orientation of the labels, which must be in the current ego frame.
        """
        if not isinstance(prediction, MotionOutput) or prediction.heads is None:
            return label.instance[:frames]
        label_heads = first_frames(MotionHeads.from_labels(label), frames)
        return instances_of_heads(label_heads)


def _sum_counts(counts: Collection[Counts]) -> NamedValues:
    """Sum the tallies of each sample choice, and count the predictions of each kind."""
    terms = []
    for sample in counts:
        terms.append(sample["tallies"] if "tallies" in sample else _sample_terms(sample))
    sums: NamedValues = {}
    for sample_choice in _SAMPLE_CHOICES:
        sums[sample_choice] = add_tallies(term[sample_choice] for term in terms)
    for form in _FORMS:
        sums[form] = sum(term[form] for term in terms)
    return sums


def _sample_terms(sample: Counts) -> NamedValues:
    """Return what one sample adds to the sums of `_sum_counts`."""
    terms: NamedValues = {}
    for sample_choice in _SAMPLE_CHOICES:
        alarm = sample[sample_choice]
        terms[sample_choice] = alarms_tally(sample, [alarm] if alarm else [])
    for form in _FORMS:
        terms[form] = int(sample[form])
    return terms


def _position_or_zero(alarm: Alarm) -> float:
    """Return an alarm's position error, metres; 0 if there is no true accident."""
    return alarm["position"] or 0.0


def _alarm(predicted: InstanceAccident, truth: InstanceAccident, seconds: float) -> Alarm:
    """Compare the accident in a prediction's maps with the one in the labels' maps.

    If either is missing, the differences in the alarm are None.

    Args:
        predicted: Accident read off the maps of a prediction.
        truth: Accident read off the maps of the labels.
        seconds: Seconds from one frame to the next.
    """
    if predicted.contact is None or truth.contact is None:
        return make_alarm()
    true_ids = match_tracks(predicted.tracks, truth.tracks, MATCH_DISTANCE)
    matched_ids = {true_ids.get(identity) for identity in predicted.contact.ids}
    return make_alarm(
        position=position_difference(predicted.positions, truth.positions),
        time=(predicted.contact.frame - truth.contact.frame) * seconds,
        id_error=int(matched_ids != set(truth.contact.ids)),
    )


def surest_within(accidents: Sequence[Accident], latest: float) -> list[Accident]:
    """Return a list with the highest-scoring accident up to a time, or an empty list.

    Only one is kept, as maps show at most one (ties: the earliest).

    Args:
        accidents: Explicit accidents.
        latest: Time of the last labelled frame of the recording plus half a step, seconds; later
            accidents are left out, like later frames of maps.
    """
    early_accidents = [accident for accident in accidents if accident.time <= latest]
    return sorted(early_accidents, key=alarm_sort_key)[:1]


def explicit_alarm(
    predicted: Accident,
    truth: InstanceAccident,
    actors: Sequence[int | None] | None,
    *,
    seconds: float,
) -> Alarm:
    """Compare an explicit predicted accident with the accident in the labels' maps.

    If there is no true accident, the differences in the alarm are None.

    Args:
        predicted: Accident in the current ego frame, like the truth.
        truth: Accident read off the labels' maps.
        actors: Actor ids of the two true instances, None for an unknown id; None if there is no
            true accident.
        seconds: Seconds from one map to the next.
    """
    if truth.contact is None:
        return make_alarm()
    return make_alarm(
        position=position_difference(predicted.positions, truth.positions),
        time=predicted.time - truth.contact.frame * seconds,
        id_error=_id_error(predicted, truth, actors, seconds),
    )


def _id_error(
    predicted: Accident,
    truth: InstanceAccident,
    actors: Sequence[int | None] | None,
    seconds: float,
) -> int | None:
    """Return 0 if the prediction names the two true actors, otherwise 1; None if unknown.

    An accident without `ids` names the instances nearest to its positions, up to `MATCH_DISTANCE`.
    It is unknown if there is no true accident, or an actor id is needed but unknown.
    """
    if truth.contact is None or actors is None:
        return None
    if predicted.ids is None:
        last_frame = len(truth.tracks.center) - 1
        frame = min(round(predicted.time / seconds), last_frame)
        centers = truth.tracks.center[frame]
        nearest_ids = nearest_two(
            predicted.positions, truth.tracks.identity, centers, MATCH_DISTANCE
        )
        return int(set(nearest_ids) != set(truth.contact.ids))
    if None in actors:
        return None
    return int(set(predicted.ids) != set(actors))
