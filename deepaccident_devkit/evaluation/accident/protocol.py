"""What a way to evaluate accidents has to offer, and what it is told of a sample beside its labels."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident.impact import BoxTruth
from deepaccident_devkit.evaluation.accident.result import AccidentResult
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.motion import MotionLabels

Prediction = MotionOutput | Iterable[Accident]


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentContext:
    """What is known of a sample beside its motion labels; a protocol may need some of it.

    Attributes:
        pair: actor ids of the two that collide, from the scenario's meta file; None if nobody does, or if it is not
            `known`.
        known: whether `pair` says anything.
        own_actor_id: the actor id of the agent whose sample it is; None for the roadside, or if not known.
        truth: what a protocol without rasters compares with (see `boxes`); None for the others.
        time_to_impact: seconds to the recorded impact, however far ahead; None if nobody collides, or not known.
        time_to_end: seconds to the recording's last frame; None if not known.
        twin: whether nobody collides here, but somebody does in the scenario's twin; None if that is not known, such
            as where the release has no twin of it.
    """

    pair: tuple[int, int] | None = None
    known: bool = False
    own_actor_id: int | None = None
    truth: BoxTruth | None = None
    time_to_impact: float | None = None
    time_to_end: float | None = None
    twin: bool | None = None


Truth = MotionLabels | BoxTruth | AccidentContext
"""What an evaluator takes as label: motion labels, or for a protocol without rasters what it compares with."""


@runtime_checkable
class AccidentProtocol(Protocol):
    """A frozen dataclass with one field a choice; `evaluator.PROTOCOLS` has those with names."""

    def settings(self) -> dict[str, Any]:
        """All that decides the numbers, as JSON can hold it."""

    def counts(self, prediction: Prediction, label: MotionLabels | None, context: AccidentContext) -> Counts:
        """What one sample adds; raises EvaluationError if it cannot be evaluated so."""

    def result(self, counts: Collection[Counts]) -> AccidentResult:
        """The metrics of some samples' counts, in any order; of those that `pooled` gives, too."""

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Fewer counts with the same result, to the last bit."""

    def variants(self) -> Mapping[str, AccidentProtocol]:
        """The same protocol with one choice made otherwise, by the choice's name: what `explain` compares with."""


def checked_prediction(prediction: object) -> MotionOutput | list[Accident]:
    """A prediction, explicit accidents as a list; raises EvaluationError if it is neither motion nor accidents."""
    if isinstance(prediction, MotionOutput):
        return prediction
    alarms: list[Accident] = []
    for each in prediction if isinstance(prediction, Iterable) else [prediction]:
        if each is prediction or not isinstance(each, Accident):
            raise EvaluationError(
                f"prediction: expected a MotionOutput or a list of Accidents, found {type(prediction).__name__} with "
                f"{type(each).__name__}; wrap a single Accident in a list, give [] for no alarm, and make an output of "
                "instance maps with instances_of"
            )
        alarms.append(each)
    return alarms
