"""Accuracy of predicted accidents under three protocols: the task `accident`."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, replace
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
    outcome_words,
)
from deepaccident_devkit.evaluation.alarms import MIN_SCORE, drawing_of_alarms, foreseen_accident
from deepaccident_devkit.evaluation.drawing import Drawing
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
from deepaccident_devkit.support.values import NamedValues

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
"""`released` computes what the released code computes, `paper` computes what the paper's text
describes, and `boxes` compares with the boxes of the labels instead of rasters."""


class AccidentEvaluator(Evaluator[AccidentResult]):
    """Evaluator of accidents: prediction accuracy (APA), and the errors of foreseen accidents.

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
        """Names and values of the settings: the protocol and its fields."""
        protocol_name = type(self.protocol).__name__
        return {"protocol": protocol_name, "choices": asdict(self.protocol)}

    def truth(
        self, dataset: Dataset, token: str, form: Any, horizon: float, /
    ) -> tuple[MotionLabels | None, AccidentContext]:
        """Return the labels that the protocol compares with (None for `boxes`), and the context."""
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
            label: Motion labels of the sample. Each frame is in its own ego frame, or all are in
                the current one. In the former case they are warped to the current ego frame with
                bilinear centres, as the released evaluation does. `boxes` does not need labels.
            context: Other facts about the sample, from `accident_context`; it contains the truth
                that `boxes` compares with. None if nothing else is known.

        Raises:
            EvaluationError: If the protocol cannot evaluate this kind of prediction or label, or
                the sample was counted before with other counts.
        """
        checked_facts(label, context)
        prediction = checked_prediction(prediction)
        counts = self.protocol.counts(prediction, label, context or AccidentContext())
        self.add(token, dict(counts))

    def drawing(self, dataset: Dataset, token: str, prediction: Any, /, *truth: Any) -> Drawing:
        """Describe the accidents that the protocol compares, and the outcome of the sample."""
        label, context = truth
        compared = compared_accidents(prediction, label, context, self.protocol)
        drawing = drawing_of_alarms(
            dataset, token, compared.true, compared.predicted, context.truth, MIN_SCORE
        )
        outcome = self.result_of([self.protocol.counts(prediction, label, context)])
        return replace(drawing, words=f"{outcome_words(outcome)}; {drawing.words}")

    def result_of(self, counts: Collection[Counts]) -> AccidentResult:
        """Compute the metrics from the counts of samples, in any order."""
        return self.protocol.result(counts)

    def sample_row(self, token: str) -> dict[str, Any]:
        """Return a sample's row: positive or not, cases by distance, errors at the largest one.

        `truth` is the kind of pair that the truth names, one of `NAMED`.
        """
        result = self.compute([token])
        row: NamedValues = {"positive": bool(result.positives), "truth": None}
        for pair_kind, count in result.truths.items():
            if count:
                row["truth"] = pair_kind
                break
        for distance, accidents_within in result.within.items():
            for case in ("tp", "fp", "fn"):
                row[f"{case}_{distance:g}m"] = getattr(accidents_within, case)
        largest_distance = max(result.within)
        for name in ("position_error", "time_error", "id_error"):
            error = getattr(result.within[largest_distance], name)
            row[name] = None if error is None else float(error)
        return row

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Merge the counts into fewer ones that lead to the same result."""
        return self.protocol.pooled(counts)


def compared_accidents(
    prediction: Prediction,
    label: MotionLabels | None,
    context: AccidentContext,
    protocol: AccidentProtocol,
) -> ComparedAccidents:
    """Find the accidents in a prediction and in the truth, by the rules of a protocol.

    Args:
        prediction: Prediction of a model, of a kind that `protocol.counts` accepts.
        label: Motion labels of the sample; None if the protocol does not need them.
        context: Other facts about the sample.
        protocol: Rules for finding accidents.

    Raises:
        EvaluationError: If the prediction is neither motion nor accidents, or the truth that the
            protocol needs is missing.
    """
    prediction = checked_prediction(prediction)
    return protocol.compared(prediction, label, context)
