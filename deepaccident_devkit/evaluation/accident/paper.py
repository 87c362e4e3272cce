"""Accident metrics as the paper describes them, or where it is silent, as in the released code.

The protocol `paper`; docs/protocols.md lists which rule comes from which source.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Final, Literal, get_args

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident.scoring import (
    ERRORS_AT,
    AccidentResult,
    Alarm,
    ComparedAccidents,
    actor_of,
    alarms_tally,
    foreseen,
    named,
    tally_result,
    united,
)
from deepaccident_devkit.evaluation.alarms import (
    MATCH_DISTANCE,
    by_sureness,
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
    frames_there,
    labels_at_present,
)
from deepaccident_devkit.evaluation.truth import AccidentContext
from deepaccident_devkit.motion import MotionHeads, MotionLabels
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import FRAME_PERIOD

SampleChoice = Literal["best", "mean_first"]
_NO_LABEL: Final = "label: the accident protocol 'paper' needs the sample's motion labels"
# Forms of a prediction that are not heads: key in the counts → words in the notes.
_FORMS: Final[Mapping[str, str]] = {
    "instance_maps": "instance maps",
    "explicit": "explicit accidents",
}
_SAMPLE_CHOICES: Final[tuple[SampleChoice, ...]] = get_args(SampleChoice)


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperAccidents:
    """The accident metrics of the paper's text.

    An accident of any of the K predictions counts as predicted. Its positions are at its own
    moment.

    Attributes:
        reading: How an accident is read off maps, in the truth and in the prediction alike.
        sample_choice: Which of several predictions with an accident is compared: the `best`,
            with positions nearest to the truth (as the released code; the first of equal ones), or
            `mean_first`: that of the mean sample, otherwise the first, which does not use the
            truth. Both are counted; this one is the result, the other is in `beside`.
    """

    labels: ClassVar[str] = "released"
    """Label protocol of the truth; labels of others are refused."""
    reading: AccidentReading = field(default_factory=AccidentReading)
    sample_choice: SampleChoice = "best"

    def __post_init__(self) -> None:
        """Check the values; raises ChoiceError."""
        settle_choices(self, {"sample_choice": _SAMPLE_CHOICES})

    def counts(
        self, prediction: Prediction, label: MotionLabels | None, context: AccidentContext
    ) -> Counts:
        """Return what one sample adds.

        For heads the truth is the labels as heads, through the same grouping and linking; for
        instance maps or explicit accidents it is the labels' warped instance map.

        Returns:
            `positive`: whether the truth has an accident; `named`: the actors that it names (one of
            `NAMED`); `instance_maps` and `explicit`: whether the prediction is of that form; `best`
            and `mean_first`: the alarm that each choice compares, or None.

        Raises:
            EvaluationError: the prediction is neither motion nor accidents, there are no labels or
                labels of another protocol, another grid, or too few frames.
        """
        if label is None:
            raise EvaluationError(_NO_LABEL)
        checked = checked_prediction(prediction)
        frames = compared_frames(checked, label, self.labels)
        rules = label.config.rules
        label = labels_at_present(label)
        maps = self.truth_map(checked, label, frames)
        truth = map_accident(maps, label.config.grid, rules, self.reading)
        seconds = label.config.step * FRAME_PERIOD
        contact = truth.contact
        actors = None
        if contact is not None:
            true_maps = [maps[contact.frame] == identity for identity in contact.ids]
            actors = [actor_of(cells, contact.frame, label, context) for cells in true_maps]
        alarms: list[Alarm | None] = []
        if isinstance(checked, MotionOutput):
            for accident in predicted_accidents(checked, rules, self.reading, frames):
                alarms.append(_alarm(accident, truth, seconds) if accident.contact else None)
        else:
            for explicit in surest_within(checked, (frames - 0.5) * seconds):
                alarms.append(explicit_alarm(explicit, truth, actors, seconds=seconds))
        mean_first = (alarm for alarm in (*alarms[-1:], *alarms[:-1]) if alarm)
        return {
            "positive": contact is not None,
            "named": named(actors, context),
            "instance_maps": isinstance(checked, MotionOutput) and checked.instances is not None,
            "explicit": not isinstance(checked, MotionOutput),
            # the first with the least difference of positions; without a truth the first of all
            "best": min(filter(None, alarms), key=_position_or_zero, default=None),
            "mean_first": next(mean_first, None),
        }

    def compared(
        self,
        prediction: MotionOutput | list[Accident],
        label: MotionLabels | None,
        _context: AccidentContext,
    ) -> ComparedAccidents:
        """Return the accidents that the protocol sees; raises EvaluationError."""
        if label is None:
            raise EvaluationError(_NO_LABEL)
        config = label.config
        frames = frames_there(label)
        seconds = config.step * FRAME_PERIOD
        maps = self.truth_map(prediction, labels_at_present(label), frames)
        truth = map_accident(maps, config.grid, config.rules, self.reading)
        true = truth.explicit(seconds)
        if not isinstance(prediction, MotionOutput):
            predicted = surest_within(prediction, (frames - 0.5) * seconds)
            return ComparedAccidents(true=true, predicted=tuple(predicted))
        alarms = []
        for accident in predicted_accidents(prediction, config.rules, self.reading, frames):
            explicit = accident.explicit(seconds)
            if explicit is not None:
                alarms.append(explicit)
        return ComparedAccidents(true=true, predicted=tuple(alarms))

    def result(self, counts: Collection[Counts]) -> AccidentResult:
        """Return the metrics of some samples' counts, in any order."""
        tallies = _united(counts)
        result = tally_result(tallies[self.sample_choice], ERRORS_AT)
        beside = {}
        for sample_choice in _SAMPLE_CHOICES:
            if sample_choice != self.sample_choice:
                other = tally_result(tallies[sample_choice], ERRORS_AT)
                beside[f"sample_choice={sample_choice}"] = other
        notes = []
        for form, words in _FORMS.items():
            if tallies[form]:
                notes.append(
                    f"{tallies[form]} of {result.samples} predictions were given as {words}: their "
                    "truth is the labels' instance map, not the released grouping and linking of "
                    "the labels"
                )
        return replace(result, notes=tuple(notes), beside=beside)

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        """Return the sums of all counts, which have the same result."""
        return [{"tallies": _united(counts)}]

    def truth_map(
        self, prediction: MotionOutput | list[Accident], label: MotionLabels, frames: int
    ) -> AnyArray:
        """Return the true instances that a prediction is compared with, shape (T, H, W).

        They are in the orientation of the labels, which must be at the present.
        """
        if not isinstance(prediction, MotionOutput) or prediction.heads is None:
            return label.instance[:frames]
        return instances_of_heads(first_frames(MotionHeads.from_labels(label), frames))


def _united(counts: Collection[Counts]) -> dict[str, Any]:
    """Return the tally of each choice of a sample, and the number of predictions of each form."""
    tallies = []
    for sample in counts:
        tallies.append(sample["tallies"] if "tallies" in sample else _tallies(sample))
    sums: dict[str, Any] = {}
    for sample_choice in _SAMPLE_CHOICES:
        sums[sample_choice] = united(tally[sample_choice] for tally in tallies)
    for form in _FORMS:
        sums[form] = sum(tally[form] for tally in tallies)
    return sums


def _tallies(sample: Counts) -> dict[str, Any]:
    """Return the tally of one sample for each choice, and its form."""
    tallies: dict[str, Any] = {}
    for sample_choice in _SAMPLE_CHOICES:
        alarms = [sample[sample_choice]] if sample[sample_choice] else []
        tallies[sample_choice] = alarms_tally(sample, alarms)
    for form in _FORMS:
        tallies[form] = int(sample[form])
    return tallies


def _position_or_zero(alarm: Alarm) -> float:
    """Return an alarm's difference of positions; 0 without a truth."""
    return alarm["position"] or 0.0


def _alarm(predicted: InstanceAccident, truth: InstanceAccident, seconds: float) -> Alarm:
    """Return a predicted accident compared with the true one, if there is one.

    Args:
        predicted: Accident read off the maps of a prediction.
        truth: Accident read off the maps of the labels.
        seconds: Seconds from frame to frame.
    """
    if predicted.contact is None or truth.contact is None:
        return foreseen()
    match = match_tracks(predicted.tracks, truth.tracks, MATCH_DISTANCE)
    matched_ids = {match.get(identity) for identity in predicted.contact.ids}
    return foreseen(
        position=position_difference(predicted.positions, truth.positions),
        time=(predicted.contact.frame - truth.contact.frame) * seconds,
        id_error=int(matched_ids != set(truth.contact.ids)),
    )


def surest_within(accidents: Sequence[Accident], latest: float) -> list[Accident]:
    """Return the surest explicit accident, since maps show one at most; empty without any.

    The earliest of equally sure ones counts. Accidents later than `latest` seconds, the labels'
    last frame in the recording and half a step, are left out, like the frames of maps.
    """
    within = [accident for accident in accidents if accident.time <= latest]
    return sorted(within, key=by_sureness)[:1]


def explicit_alarm(
    predicted: Accident,
    truth: InstanceAccident,
    actors: Sequence[int | None] | None,
    *,
    seconds: float,
) -> Alarm:
    """Return a predicted accident compared with the true one, if there is one.

    Args:
        predicted: Accident in the present ego frame, like the truth.
        truth: Accident read off the labels' maps.
        actors: Actor ids of the two true instances, None for one that is not known; None without a
            true accident.
        seconds: Seconds from frame to frame of the maps.
    """
    if truth.contact is None:
        return foreseen()
    return foreseen(
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
    """Return 1 if other actors than the two true ones are named; None if their ids are not known.

    Without `ids` an accident names the instances nearest to its positions, up to `MATCH_DISTANCE`.
    """
    if truth.contact is None or actors is None:
        return None
    if predicted.ids is not None:
        return None if None in actors else int(set(predicted.ids) != set(actors))
    frame = min(round(predicted.time / seconds), len(truth.tracks.center) - 1)
    nearest = nearest_two(
        predicted.positions, truth.tracks.identity, truth.tracks.center[frame], MATCH_DISTANCE
    )
    return int(set(nearest) != set(truth.contact.ids))
