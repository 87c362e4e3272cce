"""Accident metrics as the paper describes them, or where it is silent, as in the released code (protocol `paper`).

docs/protocols.md says what is which.
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
    accident_of,
    instances_of_heads,
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
# Forms of a prediction that are not heads, as counts and as notes have them.
_FORMS: Final[Mapping[str, str]] = {
    "instance_maps": "instance maps",
    "explicit": "explicit accidents",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperAccidents:
    """The accident metrics of the paper's text.

    An accident of any of the K predictions counts as predicted. Its positions are those of its own moment.

    Attributes:
        reading: how an accident is read off maps, the truth's and the prediction's alike.
        sample_choice: which of several predictions that have an accident is compared: the `best`, whose positions are
            nearest to the truth (as the released code; the first of equal ones), or `mean_first`: the mean sample's, or
            else the first, which does not use the truth. Both are counted; this one is the result, the other is in
            `beside`.
    """

    labels: ClassVar[str] = "released"
    """Label protocol of the truth; labels of others are refused."""
    reading: AccidentReading = field(default_factory=AccidentReading)
    sample_choice: SampleChoice = "best"

    def __post_init__(self) -> None:
        """Check the values; raises ChoiceError."""
        settle_choices(self, {"sample_choice": get_args(SampleChoice)})

    def counts(
        self, prediction: Prediction, label: MotionLabels | None, context: AccidentContext
    ) -> Counts:
        """What one sample adds.

        Where heads are predicted, the truth is the labels as heads, through the same grouping and linking; where
        instance maps or explicit accidents are, it is the labels' warped instance map.

        Returns:
            `positive`: whether the truth has an accident; `named`: whom it names (of `NAMED`); `instance_maps` and
            `explicit`: whether the prediction is those; `best` and `mean_first`: the alarm that each choice compares,
            or None.

        Raises:
            EvaluationError: the prediction is neither motion nor accidents, no labels or those of another protocol,
                another grid, too few frames.
        """
        if label is None:
            raise EvaluationError(_NO_LABEL)
        given = checked_prediction(prediction)
        frames, rules = compared_frames(given, label, self.labels), label.config.rules
        label = labels_at_present(label)
        shown = self.truth_map(given, label, frames)
        truth = accident_of(shown, label.config.grid, rules, self.reading)
        seconds = label.config.step * FRAME_PERIOD
        actors = None
        if truth.contact is not None:
            frame, ids = truth.contact.frame, truth.contact.ids
            actors = [actor_of(shown[frame] == identity, frame, label, context) for identity in ids]
        alarms: list[Alarm | None]
        if isinstance(given, MotionOutput):
            read = predicted_accidents(given, rules, self.reading, frames)
            alarms = [_alarm(found, truth, seconds) if found.contact else None for found in read]
        else:
            alarms = [
                explicit_alarm(each, truth, actors, seconds=seconds)
                for each in surest_within(given, (frames - 0.5) * seconds)
            ]
        return {
            "positive": truth.contact is not None,
            "named": named(actors, context),
            "instance_maps": isinstance(given, MotionOutput) and given.instances is not None,
            "explicit": not isinstance(given, MotionOutput),
            # the first with the least difference of positions; the first at all where there is no truth to differ from
            "best": min(
                filter(None, alarms), key=lambda alarm: alarm["position"] or 0.0, default=None
            ),
            "mean_first": next((alarm for alarm in (*alarms[-1:], *alarms[:-1]) if alarm), None),
        }

    def compared(
        self,
        given: MotionOutput | list[Accident],
        label: MotionLabels | None,
        _context: AccidentContext,
    ) -> ComparedAccidents:
        """Which accidents it sees; raises EvaluationError."""
        if label is None:
            raise EvaluationError(_NO_LABEL)
        frames, labels, step = (
            frames_there(label),
            label.config.rules,
            label.config.step * FRAME_PERIOD,
        )
        shown = self.truth_map(given, labels_at_present(label), frames)
        true = accident_of(shown, label.config.grid, labels, self.reading).explicit(step)
        if isinstance(given, MotionOutput):
            read = [
                each.explicit(step)
                for each in predicted_accidents(given, labels, self.reading, frames)
            ]
            return ComparedAccidents(
                true=true, predicted=tuple(each for each in read if each is not None)
            )
        return ComparedAccidents(
            true=true, predicted=tuple(surest_within(given, (frames - 0.5) * step))
        )

    def result(self, counts: Collection[Counts]) -> AccidentResult:
        """The metrics of some samples' counts, in any order."""
        given = _united(counts)
        chosen, other = sorted(
            get_args(SampleChoice), key=lambda choice: choice != self.sample_choice
        )
        result, beside = (tally_result(given[choice], ERRORS_AT) for choice in (chosen, other))
        notes = tuple(
            f"{given[form]} of {result.samples} predictions were given as {words}: their truth is the labels' instance "
            "map, not the released grouping and linking of the labels"
            for form, words in _FORMS.items()
            if given[form]
        )
        return replace(result, notes=notes, beside={f"sample_choice={other}": beside})

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        """The sums of all counts, which have the same result."""
        return [{"tallies": _united(counts)}]

    def truth_map(
        self, given: MotionOutput | list[Accident], label: MotionLabels, frames: int
    ) -> AnyArray:
        """(T, H, W) the instances that a prediction is compared with, of labels at the present; as the labels lie."""
        if not isinstance(given, MotionOutput) or given.heads is None:
            return label.instance[:frames]
        return instances_of_heads(first_frames(MotionHeads.from_labels(label), frames))


def _united(counts: Collection[Counts]) -> dict[str, Any]:
    """The tally of each choice of a sample, and how many predictions were given in which form."""
    given = [each["tallies"] if "tallies" in each else _tallies(each) for each in counts]
    return {
        **{choice: united(each[choice] for each in given) for choice in get_args(SampleChoice)},
        **{form: sum(each[form] for each in given) for form in _FORMS},
    }


def _tallies(sample: Counts) -> dict[str, Any]:
    alarms = {
        choice: [sample[choice]] if sample[choice] else [] for choice in get_args(SampleChoice)
    }
    return {
        **{choice: alarms_tally(sample, each) for choice, each in alarms.items()},
        **{form: int(sample[form]) for form in _FORMS},
    }


def _alarm(found: InstanceAccident, truth: InstanceAccident, seconds: float) -> Alarm:
    """A predicted accident against the true one, if there is one; `seconds` from frame to frame."""
    if found.contact is None or truth.contact is None:
        return foreseen()
    match = match_tracks(found.tracks, truth.tracks, MATCH_DISTANCE)
    same = {match.get(identity) for identity in found.contact.ids} == set(truth.contact.ids)
    return foreseen(
        position=position_difference(found.positions, truth.positions),
        time=(found.contact.frame - truth.contact.frame) * seconds,
        id_error=int(not same),
    )


def surest_within(accidents: Sequence[Accident], last: float) -> list[Accident]:
    """The surest explicit accident (the earliest of equally sure ones), as maps show one at most.

    Those for later than `last`, the labels' last frame in the recording and half a step, are left out, as the frames of
    maps are.
    """
    return sorted((each for each in accidents if each.time <= last), key=by_sureness)[:1]


def explicit_alarm(
    predicted: Accident,
    truth: InstanceAccident,
    actors: Sequence[int | None] | None,
    *,
    seconds: float,
) -> Alarm:
    """A predicted accident against the true one, if there is one.

    Args:
        predicted: in the present ego frame, as the truth.
        truth: read off the labels' maps.
        actors: actor ids of the two true instances, None for one that is not known; None without a true accident.
        seconds: from frame to frame of the maps.
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
    """1 if other actors than the two true ones are named; None if their ids are not known.

    Without `ids` it names the instances nearest to its positions, up to `MATCH_DISTANCE` off.
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
