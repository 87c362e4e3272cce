"""`WarningEvaluator`: how early an accident is warned of, and how often an alarm is false."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.predictions import Prediction
from deepaccident_devkit.evaluation.truth import AccidentContext, checked_facts, compared_facts
from deepaccident_devkit.evaluation.warning.anticipation import AnticipationResult, CleanWarnings
from deepaccident_devkit.evaluation.warning.field import FieldResult, FieldWarnings
from deepaccident_devkit.evaluation.warning.recordings import PART, parts_of, sample_counts
from deepaccident_devkit.evaluation.warning.result import WarningResult
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.support.arrays import IntArray

_Protocol = CleanWarnings | FieldWarnings
_Result = AnticipationResult | FieldResult
WARNING_PROTOCOLS: Final[Mapping[str, _Protocol]] = MappingProxyType(
    {"clean": CleanWarnings(), "field": FieldWarnings()}
)
"""`clean` ranks predictors, recording by recording; `field` is what published codes print. Both
compare with labels as the accident protocol `boxes` does; the paper has no such metrics."""


class WarningEvaluator(Evaluator[Any]):
    """Whether an alarm foresees accidents, how early it comes, and how long it is false.

    Give it whole recordings, normal scenarios among them: the metrics ignore moments without a
    sample.

    `compute` returns an `AnticipationResult` or a `FieldResult`, by the protocol.

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
        """Return the labels that maps are compared with, None for alarms, and the context."""
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
            label: Labels that define how far apart in time the maps of a prediction are, and where
                instances lie within their cells; None for the released convention. Alarms need
                none.
            context: Truth from `accident_context(dataset, sample, horizon, references=True)`; up to
                its horizon actors can be named, and later alarms do not count.

        Raises:
            EvaluationError: the token is no sample's, the context or something in it is missing,
                the prediction is neither motion nor alarms, or the sample came before with other
                counts.
        """
        checked_facts(label, context)
        self.add(token, sample_counts(token, prediction, label, context or AccidentContext()))

    def result_of(self, counts: Collection[Counts]) -> _Result:
        """Return the metrics of some samples' counts, in any order, also of `pooled` counts."""
        return self.protocol.result(counts)

    def compute(self, tokens: Iterable[str] | None = None) -> _Result:
        """Return the metrics of all samples with reference predictors, or of some without."""
        if tokens is None:
            return self.protocol.result(list(self._counts.values()), references=True)
        result: _Result = super().compute(tokens)
        return result

    def sample_row(self, token: str) -> dict[str, Any]:
        """Return the plain values of the sample's counts, and the lengths of its lists."""
        row: dict[str, Any] = {}
        for name, value in self._counts[token].items():
            if isinstance(value, list | tuple | Mapping):
                row[f"{name}_count"] = len(value)
            else:
                row[name] = value
        return row

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Return counts with the same result; their recordings are never joined with others.

        So a scenario that is drawn twice counts twice.
        """
        samples = [sample for part in parts_of(counts) for sample in part]
        return [{PART: samples}]

    def resampled(self, parts: Sequence[Sequence[Counts]], times: IntArray) -> Iterator[Any]:
        """Yield the result of each draw, without references."""
        if isinstance(self.protocol, CleanWarnings):
            return self.protocol.resampled(parts, times)
        return super().resampled(parts, times)

    @property
    def has_intervals(self) -> bool:
        """Whether the protocol has intervals; `field` has none, since its numbers take long."""
        return not isinstance(self.protocol, FieldWarnings)
