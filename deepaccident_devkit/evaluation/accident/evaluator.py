"""`AccidentEvaluator`: how well accidents are foreseen, by one of three protocols, and what it compares."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents, surest_within
from deepaccident_devkit.evaluation.accident.released import DrawnPaths, ReleasedAccidents, collision, padded_paths
from deepaccident_devkit.evaluation.accident.scoring import AccidentResult
from deepaccident_devkit.evaluation.accident_truth import AccidentContext, checked_facts, named_alarms
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.instances import longest
from deepaccident_devkit.evaluation.map_accidents import InstanceAccident, accident_of
from deepaccident_devkit.evaluation.predictions import (
    Accident,
    MotionOutput,
    Prediction,
    checked_prediction,
    frames_there,
    labels_at_present,
)
from deepaccident_devkit.evaluation.task import protocol_of
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.taxonomy import FRAME_PERIOD

AccidentProtocol = ReleasedAccidents | PaperAccidents | BoxAccidents
PROTOCOLS: Final[Mapping[str, AccidentProtocol]] = MappingProxyType(
    {"released": ReleasedAccidents(), "paper": PaperAccidents(), "boxes": BoxAccidents()}
)
"""`released` is what the released code computes, `paper` what the paper's text says, `boxes` compares with the labels
themselves and not with rasters."""


class AccidentEvaluator(Evaluator[AccidentResult]):
    """Accident prediction accuracy and the errors of the accidents that are foreseen.

    >>> evaluator = AccidentEvaluator(protocol="released")
    >>> len(evaluator)
    0
    """

    def __init__(self, protocol: str | AccidentProtocol = "released") -> None:
        """Start without samples.

        Args:
            protocol: of `PROTOCOLS` by name, or one of them with other fields.

        Raises:
            ChoiceError: no protocol has that name, or it is of another type.
        """
        super().__init__()
        self.protocol = protocol_of(protocol, AccidentProtocol, PROTOCOLS)  # type: ignore[arg-type]  # a union is a kind too

    @property
    def settings(self) -> dict[str, Any]:
        """The protocol and its choices."""
        return {"protocol": type(self.protocol).__name__, "choices": asdict(self.protocol)}

    def update(
        self,
        token: str,
        prediction: Prediction,
        label: MotionLabels | None = None,
        context: AccidentContext | None = None,
    ) -> None:
        """Count one sample.

        Args:
            token: of the sample.
            prediction: what a model says.
            label: the sample's motion labels, each frame in its own frame or all at the present. Those in their own
                frames are warped to the present with bilinear centres, as the released evaluation does. The protocol
                `boxes` needs none.
            context: other facts on the sample, from `accident_context`, with the truth of `boxes`; None for nothing.

        Raises:
            EvaluationError: the protocol cannot evaluate such a prediction or label, or the sample came before with
                another outcome.
        """
        checked_facts(label, context)
        self.add(token, dict(self.protocol.counts(checked_prediction(prediction), label, context or AccidentContext())))

    def result_of(self, counts: Collection[Counts]) -> AccidentResult:
        """The metrics of some samples' counts, in any order."""
        return self.protocol.result(counts)

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Fewer counts with the same result."""
        return self.protocol.pooled(counts)


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


def compared_accidents(
    prediction: Prediction, label: MotionLabels | None, context: AccidentContext, protocol: AccidentProtocol
) -> ComparedAccidents:
    """Which accidents a protocol sees in a prediction and in the truth.

    Args:
        prediction: what a model says; of one that `protocol.counts` takes.
        label: the sample's motion labels, where the protocol compares with those.
        context: other facts on the sample.
        protocol: by which accidents are seen.

    Raises:
        EvaluationError: the prediction is neither motion nor accidents, or the protocol lacks its truth.
    """
    given = checked_prediction(prediction)
    if isinstance(protocol, ReleasedAccidents):
        return _released(given, label, protocol)
    if isinstance(protocol, PaperAccidents):
        return _paper(given, label, protocol)
    if context.truth is None:
        raise EvaluationError(
            "context: the protocol 'boxes' needs its truth; make it with accident_context(…, horizon)"
        )
    alarms = named_alarms(given, label, context.truth, protocol.reading)
    unplaced = context.truth.unplaced if context.truth.is_unplaced else None
    return ComparedAccidents(
        true=context.truth.accident, predicted=tuple(alarm for alarm, _ in alarms), unplaced=unplaced
    )


def _released(
    given: MotionOutput | list[Accident], label: MotionLabels | None, rules: ReleasedAccidents
) -> ComparedAccidents:
    if label is None or not isinstance(given, MotionOutput):
        raise EvaluationError("the released protocol compares motion: give a MotionOutput and the motion labels")
    frames = frames_there(label)
    truth, _ = rules.truth_paths(labels_at_present(label), frames)
    points = longest(truth.paths) or len(truth.drawn)
    last = points - 1
    time = last * (label.config.step * FRAME_PERIOD)

    def found(paths: DrawnPaths, gap: float) -> Accident | None:
        padded = padded_paths(paths, points)
        pair = collision(padded, last, gap)
        if pair is None:
            return None
        return Accident(positions=np.array([padded.paths[name][last] for name in pair]), time=time)

    predictions = rules.prediction_paths(given, frames)
    if not predictions[0].paths:
        predictions = []
    return ComparedAccidents(
        true=found(truth, rules.truth_gap), predicted=_there(found(each, rules.prediction_gap) for each in predictions)
    )


def _paper(
    given: MotionOutput | list[Accident], label: MotionLabels | None, rules: PaperAccidents
) -> ComparedAccidents:
    if label is None:
        raise EvaluationError("label: the accident protocol 'paper' needs the sample's motion labels")
    frames, labels, step = frames_there(label), label.config.rules, label.config.step * FRAME_PERIOD
    shown = rules.truth_map(given, labels_at_present(label), frames)
    true = _accident(accident_of(shown, label.config.grid, labels, rules.reading), step)
    if isinstance(given, MotionOutput):
        read = rules.read_predictions(given, frames, labels)
        return ComparedAccidents(true=true, predicted=_there(_accident(each, step) for each in read))
    return ComparedAccidents(true=true, predicted=tuple(surest_within(given, (frames - 0.5) * step)))


def _accident(found: InstanceAccident, step: float) -> Accident | None:
    return None if found.contact is None else Accident(positions=found.positions, time=found.contact.frame * step)


def _there(accidents: Iterable[Accident | None]) -> tuple[Accident, ...]:
    return tuple(each for each in accidents if each is not None)
