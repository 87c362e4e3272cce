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
from deepaccident_devkit.evaluation.accident.matching import match_tracks
from deepaccident_devkit.evaluation.accident.protocol import AccidentContext, Prediction
from deepaccident_devkit.evaluation.accident.reading import AccidentReading, Contact, InstanceAccident, accident_of
from deepaccident_devkit.evaluation.accident.result import AccidentResult
from deepaccident_devkit.evaluation.accident.scoring import (
    Alarm,
    Scoring,
    accident_result,
    foreseen,
    named,
    position_difference,
)
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.frames import check_output, first_frames, frames_there, labels_at_present
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.motion import LABEL_PROTOCOLS, OWN_BOX_ID, LabelProtocol, MotionHeads, MotionLabels
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
            **{name: replace(self, reading=reading) for name, reading in self.reading.variants().items()},
            **{
                f"{name}={value}": replace(self, **{name: value})
                for name, values in own.items()
                for value in values
                if value != getattr(self, name)
            },
            **{name: replace(self, scoring=scoring) for name, scoring in self.scoring.variants().items()},
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
        actors = None if truth.contact is None else _actors(truth.contact, shown, label, context)
        return {
            "positive": truth.contact is not None,
            "named": named(actors, context),
            "instance_maps": output.instances is not None,
            "best": _nearest(alarms),
            "mean_first": next((alarm for alarm in (*alarms[-1:], *alarms[:-1]) if alarm), None),
        }

    def result(self, counts: Collection[Counts]) -> AccidentResult:
        """The metrics of some samples' counts, in any order."""
        samples = list(counts)
        chosen, other = sorted(get_args(SampleChoice), key=lambda choice: choice != self.sample_choice)
        beside = self._result(samples, other)
        return replace(self._result(samples, chosen, _notes(samples)), beside={f"sample_choice={other}": beside})

    def _result(self, samples: Sequence[Counts], choice: str, notes: Sequence[str] = ()) -> AccidentResult:
        alarms = [[sample[choice]] if sample[choice] else [] for sample in samples]
        return accident_result(samples, alarms, self.scoring, notes)

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


def _actors(
    contact: Contact, shown: AnyArray, label: MotionLabels, context: AccidentContext
) -> tuple[int | None, int | None]:
    """The actors that two instances of the truth are, by whose label most of their cells have; None where unknown."""
    actor_of: dict[int | None, int] = {identity: actor for actor, identity in label.id_map.items()}
    first, second = (
        actor_of.get(_most_frequent(label.instance[contact.frame][shown[contact.frame] == identity]))
        for identity in contact.ids
    )
    own = context.own_actor_id
    return own if first == OWN_BOX_ID else first, own if second == OWN_BOX_ID else second


def _most_frequent(ids: AnyArray) -> int | None:
    """The most frequent id but 0, the lowest of equally frequent ones; None if there is none."""
    values, counts = np.unique(ids[ids != 0], return_counts=True)
    return int(values[np.argmax(counts)]) if len(values) else None


def _notes(samples: Sequence[Counts]) -> list[str]:
    given_as_maps = sum(bool(sample["instance_maps"]) for sample in samples)
    if not given_as_maps:
        return []
    note = (
        f"{given_as_maps} of {len(samples)} predictions were given as instance maps: their truth is the labels' "
        "instance map, not the released grouping and linking of the labels"
    )
    return [note]
