"""What a way to evaluate accidents has to offer, and what it is told of a sample beside its labels."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from deepaccident_devkit.evaluation.accident.result import AccidentResult
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.motion import MotionLabels

Prediction = MotionOutput | Sequence[Accident]


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentContext:
    """What is known of a sample beside its motion labels; a protocol may need some of it.

    Attributes:
        pair: actor ids of the two that collide, from the scenario's meta file; None if nobody does, or if it is not
            `known`.
        known: whether `pair` says anything.
        own_actor_id: the actor id of the agent whose sample it is; None for the roadside, or if not known.
        truth: what a protocol without rasters compares with (see `boxes`); None for the others.
    """

    pair: tuple[int, int] | None = None
    known: bool = False
    own_actor_id: int | None = None
    truth: Any = None


class AccidentProtocol(Protocol):
    """A frozen dataclass with one field a choice; `evaluator.PROTOCOLS` has those with names."""

    def settings(self) -> dict[str, Any]:
        """All that decides the numbers, as JSON can hold it."""

    def counts(self, prediction: Prediction, label: MotionLabels | None, context: AccidentContext) -> Counts:
        """What one sample adds; raises EvaluationError if it cannot be evaluated so."""

    def result(self, counts: Collection[Counts]) -> AccidentResult:
        """The metrics of some samples' counts, in any order."""

    def variants(self) -> Mapping[str, AccidentProtocol]:
        """The same protocol with one choice made otherwise, by the choice's name: what `explain` compares with."""
