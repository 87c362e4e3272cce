"""`WarningEvaluator`: how early an accident is warned of, and how often an alarm is false."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation.metrics.alarms.truth import AccidentContext
from deepaccident_devkit.evaluation.metrics.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.metrics.predictions import Prediction
from deepaccident_devkit.evaluation.metrics.warning.protocol import WarningProtocol
from deepaccident_devkit.evaluation.metrics.warning.recordings import sample_counts, tally_of
from deepaccident_devkit.evaluation.metrics.warning.result import WarningResult, warning_result
from deepaccident_devkit.motion import MotionLabels

WARNING_PROTOCOLS: Final[Mapping[str, WarningProtocol]] = MappingProxyType({"boxes": WarningProtocol()})
"""`boxes` compares with the labels' boxes, as the accident protocol of that name; the paper has no such metrics."""


class WarningEvaluator(Evaluator[WarningResult]):
    """What those ask who would rely on the alarm: seconds of warning, detection in time, false alarms a minute.

    Give it whole recordings, normal scenarios among them: samples of a recording that are not given are as if nobody
    had driven then.

    >>> evaluator = WarningEvaluator()
    >>> evaluator.compute().samples
    0
    """

    def __init__(self, protocol: str | WarningProtocol = "boxes") -> None:
        """Start without samples.

        Args:
            protocol: of `WARNING_PROTOCOLS` by name, or your own.

        Raises:
            ChoiceError: no protocol has that name, or it is none.
        """
        super().__init__()
        self.protocol = _protocol(protocol)

    @property
    def settings(self) -> dict[str, Any]:
        """The protocol's choices."""
        return self.protocol.settings()

    def update(
        self,
        token: str,
        prediction: Prediction,
        label: MotionLabels | None = None,
        context: AccidentContext | None = None,
    ) -> None:
        """Count one sample.

        Args:
            token: of the sample; it says of which scenario and agent, and when.
            prediction: what a model says: motion in maps, which is at most one alarm, or a list of alarms.
            label: says how far apart in time the maps of a prediction are, and how they lie in their cells; None for
                the released way. Alarms need none.
            context: what happens, from `accident_context(dataset, sample, horizon)`; the horizon says up to when actors
                can be named.

        Raises:
            EvaluationError: the token is no sample's, the context or something in it is missing, the prediction is
                neither, or the sample came before with another outcome.
        """
        if label is not None and not isinstance(label, MotionLabels):
            raise EvaluationError(
                f"label: expected MotionLabels or None, found {type(label).__name__}; give what happens as context"
            )
        if not isinstance(context, AccidentContext):
            raise EvaluationError(
                f"context: expected an AccidentContext, found {type(context).__name__}; make it with "
                "accident_context(dataset, sample, horizon=2.0)"
            )
        self.add(token, sample_counts(token, prediction, label, context, self.protocol))

    def result_of(self, counts: Collection[Counts]) -> WarningResult:
        """The metrics of some samples' counts, in any order; of what `pooled` gives, too."""
        return warning_result(tally_of(counts, self.protocol), self.protocol)

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """The tally of whole recordings, which has the same result.

        Its recordings stay apart from those of others, so that a scenario that a bootstrap draws twice counts twice.
        """
        return [tally_of(counts, self.protocol)]


def _protocol(protocol: object) -> WarningProtocol:
    if isinstance(protocol, WarningProtocol):
        return protocol
    if not isinstance(protocol, str) or protocol not in WARNING_PROTOCOLS:
        raise ChoiceError(f"protocol: expected one of {', '.join(WARNING_PROTOCOLS)}, or your own, found {protocol!r}")
    return WARNING_PROTOCOLS[protocol]
