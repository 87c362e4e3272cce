"""`AccidentEvaluator`: how well accidents are foreseen."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any, Final

from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.accident.protocol import AccidentContext, AccidentProtocol, Prediction
from deepaccident_devkit.evaluation.accident.released import ReleasedAccidents
from deepaccident_devkit.evaluation.accident.result import AccidentResult
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator
from deepaccident_devkit.motion import MotionLabels

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

    def __init__(self, protocol: str | AccidentProtocol = "released", *, explain: bool = False) -> None:
        """Start without samples.

        Args:
            protocol: of `PROTOCOLS` by name, or your own.
            explain: count each sample also with each choice of the protocol made otherwise, for `explained`; takes
                that many times longer.

        Raises:
            ChoiceError: no protocol has that name.
        """
        super().__init__()
        self.protocol = _protocol(protocol)
        self._variants = dict(self.protocol.variants()) if explain else {}

    @property
    def settings(self) -> dict[str, Any]:
        """The protocol, its choices, and whether they are explained."""
        return {
            "protocol": type(self.protocol).__name__,
            "choices": self.protocol.settings(),
            "explain": bool(self._variants),
        }

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
                frames are warped to the present with bilinear centres, as the released evaluation does.
            context: what else is known of it; None for nothing.

        Raises:
            EvaluationError: the protocol cannot evaluate such a prediction or label, or the sample came before with
                another outcome.
        """
        known = context or AccidentContext()
        counts = dict(self.protocol.counts(prediction, label, known))
        if self._variants:
            counts["variants"] = {
                name: variant.counts(prediction, label, known) for name, variant in self._variants.items()
            }
        self.add(token, counts)

    def result_of(self, counts: Collection[Counts]) -> AccidentResult:
        """The metrics of some samples' counts, in any order."""
        return self.protocol.result(counts)

    def explained(self) -> dict[str, AccidentResult]:
        """For each choice of the protocol the result if it were made otherwise, all else equal.

        Raises:
            EvaluationError: the evaluator was not made with `explain`.
        """
        if not self._variants:
            raise EvaluationError("nothing to explain: make the evaluator with explain=True")
        return {
            name: variant.result([counts["variants"][name] for counts in self.counts.values()])
            for name, variant in self._variants.items()
        }


def _protocol(protocol: str | AccidentProtocol) -> AccidentProtocol:
    if not isinstance(protocol, str):
        return protocol
    if protocol not in PROTOCOLS:
        raise ChoiceError(f"protocol: expected one of {', '.join(PROTOCOLS)}, found {protocol!r}")
    return PROTOCOLS[protocol]
