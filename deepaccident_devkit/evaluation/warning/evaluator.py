"""`WarningEvaluator`: how early alarms precede an accident, and how often they are false."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.alarms import drawing_of_alarms, named_alarms, within_horizon
from deepaccident_devkit.evaluation.drawing import Drawing
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.map_accidents import AccidentReading
from deepaccident_devkit.evaluation.predictions import Prediction, checked_prediction
from deepaccident_devkit.evaluation.truth import AccidentContext, checked_facts, compared_facts
from deepaccident_devkit.evaluation.warning.anticipation import AnticipationResult, CleanWarnings
from deepaccident_devkit.evaluation.warning.field import FieldResult, FieldWarnings
from deepaccident_devkit.evaluation.warning.recordings import PART, sample_counts, split_counts
from deepaccident_devkit.evaluation.warning.result import WarningResult
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.support.arrays import IntArray
from deepaccident_devkit.support.values import NamedValues

# Pictures show an alarm from this score on, if the protocol has no threshold.
_DRAWN_THRESHOLD = 0.5
_Protocol = CleanWarnings | FieldWarnings
_Result = AnticipationResult | FieldResult
WARNING_PROTOCOLS: Final[Mapping[str, _Protocol]] = MappingProxyType(
    {"clean": CleanWarnings(), "field": FieldWarnings()}
)
"""`clean` ranks predictors by recording; `field` reproduces what public implementations print. Both
compare alarms with the labels, as the accident protocol `boxes` does; the paper does not define
metrics of warnings."""


class WarningEvaluator(Evaluator[Any]):
    """Evaluator of alarms: do they foresee accidents, how early, and how long are they false?

    Pass whole recordings, including ones of normal scenarios: the metrics ignore times without a
    sample.

    `compute` returns an `AnticipationResult` or a `FieldResult`, depending on the protocol.

    >>> evaluator = WarningEvaluator()
    >>> evaluator.compute().samples
    0
    """

    task = "warning"
    description = (
        "Evaluate warnings: how early they come before accidents, and how often an alarm is false."
    )
    result_kinds: ClassVar[tuple[str, ...]] = ("motion", "accident")
    protocols = WARNING_PROTOCOLS
    result_class = WarningResult
    main_numbers: ClassVar[tuple[str, ...]] = ("groups/ego_involved/auc_ahead",)
    needs_whole_recordings = True
    needs_meta = True

    protocol: _Protocol

    def truth(
        self, dataset: Dataset, token: str, form: Any, horizon: float, /
    ) -> tuple[MotionLabels | None, AccidentContext]:
        """Return the labels that maps are compared with (None for alarms) and the context."""
        return compared_facts(dataset, token, self.protocol, form, horizon, references=True)

    def update(
        self,
        token: str,
        prediction: Prediction,
        label: MotionLabels | None = None,
        context: AccidentContext | None = None,
    ) -> None:
        """Count one sample.

        Args:
            token: Token of the sample, which names scenario, agent and frame.
            prediction: Prediction of a model: motion in maps, which is at most one alarm, or a list
                of alarms.
            label: Labels that define the time between the maps of a prediction, and where
                instances lie within their cells; None for the released convention. Lists of alarms
                do not need it.
            context: Truth from `accident_context(dataset, sample, horizon, references=True)`.
                Actors can be named up to its horizon; alarms beyond it do not count.

        Raises:
            EvaluationError: If the token is not a sample token, the context or something in it is
                missing, the prediction is neither motion nor alarms, or the sample was counted
                before with other counts.
        """
        checked_facts(label, context)
        self.add(token, sample_counts(token, prediction, label, context or AccidentContext()))

    def drawing(self, dataset: Dataset, token: str, prediction: Any, /, *truth: Any) -> Drawing:
        """Describe the alarms up to the horizon, and the collision that follows at any time."""
        label, context = truth
        checked = checked_prediction(prediction)
        alarms = named_alarms(checked, label, context.truth, AccidentReading())
        shown_alarms = [alarm for alarm, _ in within_horizon(alarms, context.truth)]
        threshold = getattr(self.protocol, "threshold", None)
        if threshold is None:
            threshold = _DRAWN_THRESHOLD
        true = context.truth.impact
        return drawing_of_alarms(dataset, token, true, shown_alarms, context.truth, threshold)

    def result_of(self, counts: Collection[Counts]) -> _Result:
        """Compute the metrics from the counts of samples, in any order; they can be `pooled`."""
        return self.protocol.result(counts)

    def compute(self, tokens: Iterable[str] | None = None) -> _Result:
        """Compute the metrics of some samples, or of all samples and the reference predictors.

        If `tokens` is None, all samples and the reference predictors are evaluated.
        """
        if tokens is None:
            return self.protocol.result(self._counts.values(), references=True)
        result: _Result = super().compute(tokens)
        return result

    def sample_row(self, token: str) -> dict[str, Any]:
        """Return the sample's counts; lists are replaced by their lengths."""
        row: NamedValues = {}
        for name, value in self._counts[token].items():
            if isinstance(value, list | tuple | Mapping):
                row[f"{name}_count"] = len(value)
            else:
                row[name] = value
        return row

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Return the counts as a single group that leads to the same result.

        Recordings of different groups are never joined, so a scenario that is drawn twice counts
        twice.
        """
        samples = [sample for part in split_counts(counts) for sample in part]
        return [{PART: samples}]

    def resampled(self, parts: Sequence[Sequence[Counts]], times: IntArray) -> Iterator[Any]:
        """Yield the result of each draw, without references."""
        if isinstance(self.protocol, CleanWarnings):
            return self.protocol.resampled(parts, times)
        return super().resampled(parts, times)

    @property
    def has_intervals(self) -> bool:
        """Whether the protocol has intervals; `field` has none, since its numbers are slow."""
        return not isinstance(self.protocol, FieldWarnings)
