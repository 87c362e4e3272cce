"""`AccidentEvaluator`: how well accidents are foreseen, and the interface of a protocol for it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Final, Protocol, runtime_checkable

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.metrics.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.metrics.accident.released import ReleasedAccidents
from deepaccident_devkit.evaluation.metrics.accident.scoring import AccidentResult
from deepaccident_devkit.evaluation.metrics.alarms.truth import AccidentContext, BoxTruth
from deepaccident_devkit.evaluation.metrics.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.metrics.predictions import Prediction, checked_prediction
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.text import choice

Truth = MotionLabels | BoxTruth | AccidentContext
"""What an evaluator takes as label: motion labels, or for a protocol without rasters its own truth."""


@runtime_checkable
class AccidentProtocol(Protocol):
    """A frozen dataclass with one field for each choice; `PROTOCOLS` has those with names."""

    def settings(self) -> dict[str, Any]:
        """All choices that affect the numbers, as JSON can hold them."""

    def counts(self, prediction: Prediction, label: MotionLabels | None, context: AccidentContext) -> Counts:
        """What one sample adds; raises EvaluationError if it cannot be evaluated by this protocol."""

    def result(self, counts: Collection[Counts]) -> AccidentResult:
        """The metrics of some samples' counts, in any order; of those that `pooled` gives, too."""

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Fewer counts with the same result, to the last bit."""


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
            protocol: of `PROTOCOLS` by name, or your own.

        Raises:
            ChoiceError: no protocol has that name, or it is of another type.
        """
        super().__init__()
        self.protocol = _protocol(protocol)

    @property
    def settings(self) -> dict[str, Any]:
        """The protocol and its choices."""
        return {
            "protocol": type(self.protocol).__name__,
            "choices": self.protocol.settings(),
        }

    def update(
        self,
        token: str,
        prediction: Prediction,
        label: Truth | None = None,
        context: AccidentContext | None = None,
    ) -> None:
        """Count one sample.

        Args:
            token: of the sample.
            prediction: what a model says.
            label: the sample's motion labels, each frame in its own frame or all at the present. Those in their own
                frames are warped to the present with bilinear centres, as the released evaluation does. A protocol that
                compares with boxes needs none; it takes their truth here (`box_truth` or `accident_context`), or in the
                context.
            context: other facts on the sample; None for nothing.

        Raises:
            EvaluationError: the protocol cannot evaluate such a prediction or label, or the sample came before with
                another outcome.
        """
        labels, known = _known(label, context)
        given = checked_prediction(prediction)
        counts = dict(self.protocol.counts(given, labels, known))
        self.add(token, counts)

    def result_of(self, counts: Collection[Counts]) -> AccidentResult:
        """The metrics of some samples' counts, in any order."""
        return self.protocol.result(counts)

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Fewer counts with the same result."""
        return self.protocol.pooled(counts)


def _known(label: Truth | None, context: AccidentContext | None) -> tuple[MotionLabels | None, AccidentContext]:
    """Motion labels, and the other facts; raises EvaluationError."""
    if context is not None and not isinstance(context, AccidentContext):
        raise EvaluationError(
            f"context: expected an AccidentContext, found {type(context).__name__}; make it with "
            "accident_context(dataset, sample, horizon)"
        )
    known = context or AccidentContext()
    if label is None or isinstance(label, MotionLabels):
        return label, known
    if isinstance(label, AccidentContext) and context is None:
        return None, label
    if isinstance(label, BoxTruth) and known.truth is None:
        return None, replace(known, truth=label)
    if isinstance(label, AccidentContext | BoxTruth):
        raise EvaluationError("label, context: both say what is true; give the truth in one of them")
    raise EvaluationError(
        f"label: expected MotionLabels, or for protocol='boxes' a BoxTruth or an AccidentContext, found "
        f"{type(label).__name__}; give what dataset.motion_labels(token) has of the sample"
    )


def _protocol(protocol: object) -> AccidentProtocol:
    if isinstance(protocol, AccidentProtocol):
        return protocol
    return PROTOCOLS[choice("protocol", protocol, PROTOCOLS)]
