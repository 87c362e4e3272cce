"""Accuracy of predicted accidents, by three protocols: the task `accident`."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from types import MappingProxyType
from typing import Any, ClassVar, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.accident.released import ReleasedAccidents
from deepaccident_devkit.evaluation.accident.scoring import (
    DISTANCES,
    AccidentResult,
    AccidentsWithin,
    ComparedAccidents,
    average_precision,
)
from deepaccident_devkit.evaluation.alarms import foreseen_accident
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.instances import prediction_accuracy
from deepaccident_devkit.evaluation.map_accidents import AccidentReading
from deepaccident_devkit.evaluation.predictions import Prediction, checked_prediction
from deepaccident_devkit.evaluation.truth import (
    AccidentContext,
    BoxTruth,
    accident_context,
    box_truth,
    checked_facts,
    compared_facts,
)
from deepaccident_devkit.motion import MotionLabels

__all__ = [
    "DISTANCES",
    "PROTOCOLS",
    "AccidentContext",
    "AccidentEvaluator",
    "AccidentProtocol",
    "AccidentReading",
    "AccidentResult",
    "AccidentsWithin",
    "BoxAccidents",
    "BoxTruth",
    "ComparedAccidents",
    "PaperAccidents",
    "Prediction",
    "ReleasedAccidents",
    "accident_context",
    "average_precision",
    "box_truth",
    "compared_accidents",
    "foreseen_accident",
    "prediction_accuracy",
]


AccidentProtocol = ReleasedAccidents | PaperAccidents | BoxAccidents
PROTOCOLS: Final[Mapping[str, AccidentProtocol]] = MappingProxyType(
    {"released": ReleasedAccidents(), "paper": PaperAccidents(), "boxes": BoxAccidents()}
)
"""`released` is what the released code computes, `paper` what the paper's text describes, and
`boxes` compares with the labels themselves and not with rasters."""


class AccidentEvaluator(Evaluator[AccidentResult]):
    """Accident prediction accuracy and the errors of the accidents that are foreseen.

    >>> evaluator = AccidentEvaluator(protocol="released")
    >>> len(evaluator)
    0
    """

    task = "accident"
    description = "Evaluate predicted accidents: APA, and the errors in who, where and when."
    result_kinds: ClassVar[tuple[str, ...]] = ("motion", "accident")
    protocols = PROTOCOLS
    result_class = AccidentResult
    main_numbers: ClassVar[tuple[str, ...]] = ("apa", "position_error")
    needs_meta = True

    protocol: AccidentProtocol

    @property
    def settings(self) -> dict[str, Any]:
        """The protocol and its choices."""
        return {"protocol": type(self.protocol).__name__, "choices": asdict(self.protocol)}

    def truth(
        self, dataset: Dataset, token: str, form: Any, horizon: float, /
    ) -> tuple[MotionLabels | None, AccidentContext]:
        """Return the labels that the protocol compares with, None for none, and the context."""
        return compared_facts(dataset, token, self.protocol, form, horizon)

    def update(
        self,
        token: str,
        prediction: Prediction,
        label: MotionLabels | None = None,
        context: AccidentContext | None = None,
    ) -> None:
        """Count one sample.

        Args:
            token: Token of the sample.
            prediction: Prediction of a model.
            label: Motion labels of the sample, each frame in its own frame or all at the present.
                Labels in their own frames are warped to the present with bilinear centres, as the
                released evaluation does. The protocol `boxes` needs none.
            context: Other facts on the sample, from `accident_context`, with the truth of `boxes`;
                None for nothing.

        Raises:
            EvaluationError: the protocol cannot evaluate such a prediction or label, or the sample
                came before with other counts.
        """
        checked_facts(label, context)
        counts = self.protocol.counts(
            checked_prediction(prediction), label, context or AccidentContext()
        )
        self.add(token, dict(counts))

    def result_of(self, counts: Collection[Counts]) -> AccidentResult:
        """Return the metrics of some samples' counts, in any order."""
        return self.protocol.result(counts)

    def sample_row(self, token: str) -> dict[str, Any]:
        """Return whether an accident comes, cases by distance, and errors at the largest one."""
        result = self.compute([token])
        truth = next((name for name, count in result.truths.items() if count), None)
        row: dict[str, Any] = {"positive": bool(result.positives), "truth": truth}
        for distance, within in result.within.items():
            for case in ("tp", "fp", "fn"):
                row[f"{case}_{distance:g}m"] = getattr(within, case)
        widest = result.within[max(result.within)]
        for name in ("position_error", "time_error", "id_error"):
            error = getattr(widest, name)
            row[name] = None if error is None else float(error)
        return row

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Return fewer counts with the same result."""
        return self.protocol.pooled(counts)


def compared_accidents(
    prediction: Prediction,
    label: MotionLabels | None,
    context: AccidentContext,
    protocol: AccidentProtocol,
) -> ComparedAccidents:
    """Return the accidents that a protocol sees in a prediction and in the truth.

    Args:
        prediction: Prediction of a model, of a kind that `protocol.counts` accepts.
        label: Motion labels of the sample, where the protocol compares with labels.
        context: Other facts on the sample.
        protocol: Rules by which accidents are seen.

    Raises:
        EvaluationError: the prediction is neither motion nor accidents, or the protocol lacks its
            truth.
    """
    return protocol.compared(checked_prediction(prediction), label, context)
