"""Accident metrics as the paper describes them; where it is silent, as the released code has them (protocol `paper`).

Each choice is a field of `PaperAccidents`, `AccidentReading` or `Scoring`; docs/protocols.md lists them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.errors import ChoiceError, ConfigError, EvaluationError
from deepaccident_devkit.evaluation.accident.actors import actor_of
from deepaccident_devkit.evaluation.accident.matching import match_tracks
from deepaccident_devkit.evaluation.accident.protocol import AccidentContext, Prediction
from deepaccident_devkit.evaluation.accident.reading import AccidentReading, InstanceAccident, accident_of
from deepaccident_devkit.evaluation.accident.result import AccidentResult
from deepaccident_devkit.evaluation.accident.scoring import (
    Alarm,
    Scoring,
    alarms_tally,
    foreseen,
    named,
    position_difference,
)
from deepaccident_devkit.evaluation.accident.tallies import tally_result, united
from deepaccident_devkit.evaluation.accident.variants import with_others, with_parts
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.frames import check_output, first_frames, frames_there, labels_at_present
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.motion import LABEL_PROTOCOLS, LabelProtocol, MotionHeads, MotionLabels
from deepaccident_devkit.taxonomy import FRAME_PERIOD

SampleChoice = Literal["best", "mean_first"]
PredictedBy = Literal["any", "mean"]
PositionTime = Literal["own", "truth"]
_CHOICES: Final[Mapping[str, tuple[str, ...]]] = {
    "labels": tuple(LABEL_PROTOCOLS),
    "predicted_by": get_args(PredictedBy),
    "sample_choice": get_args(SampleChoice),
    "position_time": get_args(PositionTime),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperAccidents:
    """The accident metrics of the paper's text.

    Attributes:
        labels: protocol of the labels that are the truth; others are refused.
        reading: how an accident is read off maps, the truth's and the prediction's alike.
        predicted_by: whose accident counts as predicted: that of `any` of the K predictions, or the `mean` sample's
            (the last of the K) alone.
        sample_choice: which of several predictions that have an accident is compared: the `best`, whose positions are
            nearest to the truth (as the released code; the first of equal ones), or `mean_first`: the mean sample's or
            else the first, without a look at the truth. Both are counted; this one is the result, the other is beside.
        position_time: the moment of the predicted positions: its `own` accident's, or that of the `truth`, where both
            predicted agents are there then.
        match_distance: metres: gate of the match of instances that decides whether a prediction names the right ones.
        scoring: when an accident counts as foreseen.
    """

    labels: str = "released"
    reading: AccidentReading = field(default_factory=AccidentReading)
    predicted_by: PredictedBy = "any"
    sample_choice: SampleChoice = "best"
    position_time: PositionTime = "own"
    match_distance: float = 4.0
    scoring: Scoring = field(default_factory=Scoring)

    def __post_init__(self) -> None:
        """Check the values; raises ChoiceError or ConfigError."""
        for name, allowed in _CHOICES.items():
            if getattr(self, name) not in allowed:
                raise ChoiceError(f"{name}: expected one of {', '.join(allowed)}, found {getattr(self, name)!r}")
        if not 0 < self.match_distance < np.inf:
            raise ConfigError(f"match_distance: expected metres above 0, found {self.match_distance!r}")

    def settings(self) -> dict[str, Any]:
        """All choices, as JSON can hold them."""
        return asdict(self)

    def variants(self) -> dict[str, PaperAccidents]:
        """These metrics with one choice made otherwise, by `name=value`; for explanations."""
        own: Mapping[str, tuple[Any, ...]] = {
            "predicted_by": get_args(PredictedBy),
            "sample_choice": get_args(SampleChoice),
            "position_time": get_args(PositionTime),
            "match_distance": (2.0, 4.0, 8.0),
        }
        return {
            **with_parts(self, "reading", self.reading.variants()),
            **with_others(self, own),
            **with_parts(self, "scoring", self.scoring.variants()),
        }

    def counts(self, prediction: Prediction, label: MotionLabels | None, context: AccidentContext) -> Counts:
        """What one sample adds.

        Where heads are predicted, the truth is the labels as heads, through the same grouping and linking; where
        instance maps are, it is the labels' warped instance map.

        Returns:
            `positive`: whether the truth has an accident; `named`: whom it names (of `NAMED`); `instance_maps`: whether
            those were given; `best` and `mean_first`: the alarm that each choice compares, or None.

        Raises:
            EvaluationError: explicit accidents, no labels or those of another protocol, another grid, too few frames.
        """
        output, label = self._checked(prediction, label)
        frames, rules = frames_there(label), label.config.rules
        check_output(output, label, frames)
        label = labels_at_present(label)
        shown = self._truth_map(output, label, frames)
        truth = accident_of(shown, label.config.grid, rules, self.reading)
        seconds = label.config.step * FRAME_PERIOD
        alarms = [
            self._alarm(found, truth, seconds) if found.contact else None
            for found in self._predicted(output, frames, rules)
        ]
        if self.predicted_by == "mean":
            alarms = alarms[-1:]
        actors = None
        if truth.contact is not None:
            frame, ids = truth.contact.frame, truth.contact.ids
            actors = [actor_of(shown[frame] == identity, frame, label, context) for identity in ids]
        return {
            "positive": truth.contact is not None,
            "named": named(actors, context),
            "instance_maps": output.instances is not None,
            "best": _nearest(alarms),
            "mean_first": next((alarm for alarm in (*alarms[-1:], *alarms[:-1]) if alarm), None),
        }

    def result(self, counts: Collection[Counts]) -> AccidentResult:
        """The metrics of some samples' counts, in any order."""
        given = self._united(counts)
        chosen, other = sorted(get_args(SampleChoice), key=lambda choice: choice != self.sample_choice)
        result, beside = (tally_result(given[choice], self.scoring.errors_at) for choice in (chosen, other))
        notes = _notes(given["instance_maps"], result.samples)
        return replace(result, notes=notes, beside={f"sample_choice={other}": beside})

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        """The sums of all counts, which have the same result."""
        return [{"tallies": self._united(counts)}]

    def _united(self, counts: Collection[Counts]) -> dict[str, Any]:
        """The tally of each choice of a sample, and how many predictions were given as instance maps."""
        given = [each["tallies"] if "tallies" in each else self._tallies(each) for each in counts]
        return {
            **{choice: united(each[choice] for each in given) for choice in get_args(SampleChoice)},
            "instance_maps": sum(each["instance_maps"] for each in given),
        }

    def _tallies(self, sample: Counts) -> dict[str, Any]:
        alarms = {choice: [sample[choice]] if sample[choice] else [] for choice in get_args(SampleChoice)}
        return {
            **{choice: alarms_tally(sample, each, self.scoring) for choice, each in alarms.items()},
            "instance_maps": int(sample["instance_maps"]),
        }

    def _checked(self, prediction: Prediction, label: MotionLabels | None) -> tuple[MotionOutput, MotionLabels]:
        if not isinstance(prediction, MotionOutput):
            raise EvaluationError(
                "prediction: the accident protocol 'paper' compares instances; give a MotionOutput, or evaluate "
                "explicit accidents with protocol='boxes'"
            )
        if label is None:
            raise EvaluationError("label: the accident protocol 'paper' needs the sample's motion labels")
        if label.config.rules != LABEL_PROTOCOLS[self.labels]:
            raise EvaluationError(
                f"label: was not made by the label protocol {self.labels!r}, which these metrics compare with; make it "
                f"with MotionLabelConfig(protocol={self.labels!r}), or choose PaperAccidents(labels=…)"
            )
        return prediction, label

    def _truth_map(self, output: MotionOutput, label: MotionLabels, frames: int) -> AnyArray:
        if output.heads is None:
            return label.instance[:frames]
        return self.reading.instances(first_frames(MotionHeads.from_labels(label), frames))

    def _predicted(self, output: MotionOutput, frames: int, rules: LabelProtocol) -> list[InstanceAccident]:
        if output.heads is not None:
            maps = [self.reading.instances(first_frames(heads, frames)) for heads in output.heads]
        else:
            maps = [] if output.instances is None else [each[:frames] for each in output.instances]
        return [accident_of(each, output.grid, rules, self.reading) for each in maps]

    def _alarm(self, found: InstanceAccident, truth: InstanceAccident, seconds: float) -> Alarm:
        """A predicted accident against the true one, if there is one; `seconds` from frame to frame."""
        if found.contact is None or truth.contact is None:
            return foreseen()
        positions = found.positions
        if self.position_time == "truth":
            then = found.tracks.at(truth.contact.frame, found.contact.ids)
            positions = then if np.isfinite(then).all() else positions
        match = match_tracks(found.tracks, truth.tracks, self.match_distance)
        same = {match.get(identity) for identity in found.contact.ids} == set(truth.contact.ids)
        return foreseen(
            position=position_difference(positions, truth.positions),
            time=(found.contact.frame - truth.contact.frame) * seconds,
            id_error=int(not same),
        )


def _nearest(alarms: Sequence[Alarm | None]) -> Alarm | None:
    """The first with the smallest difference of positions; the first at all where there is no truth to differ from."""
    there = [alarm for alarm in alarms if alarm]
    return min(there, key=lambda alarm: alarm["position"] or 0.0, default=None)


def _notes(given_as_maps: int, samples: int) -> tuple[str, ...]:
    if not given_as_maps:
        return ()
    note = (
        f"{given_as_maps} of {samples} predictions were given as instance maps: their truth is the labels' "
        "instance map, not the released grouping and linking of the labels"
    )
    return (note,)
