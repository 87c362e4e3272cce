"""`Evaluator`: the base of all tasks; it turns samples into counts, and counts into a result.

Results do not depend on the order of samples or on the number of workers, memory grows only with
the counts, and any selection of the samples can be summed (see `breakdown`).
`counting.evaluate_samples` updates an evaluator with many samples.
"""

import math
from abc import abstractmethod
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Generic, TypeVar

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.drawing import Drawing, joined_drawing
from deepaccident_devkit.evaluation.sample_counts import Counts, SampleCounts
from deepaccident_devkit.evaluation.task import TaskResult, headlines, plain, protocol_of
from deepaccident_devkit.support.arrays import FloatArray, IntArray

__all__ = ["Counts", "Evaluator", "EvaluatorT", "ratio", "total"]

_Result = TypeVar("_Result")
EvaluatorT = TypeVar("EvaluatorT", bound="Evaluator[Any]")


class Evaluator(SampleCounts, Generic[_Result]):
    """Base class of evaluators, which count samples and compute a result from the counts.

    A new task is a subclass in its own folder, and is listed in `runs.setups.TASKS`. It defines:

    - the class attributes below;
    - `truth`, which returns what the prediction for a sample is compared with;
    - `update`, which counts a sample and passes the counts to `add`;
    - `result_of`, which computes the result from the counts of samples; the result's `rows`
      describe its numbers.

    All other methods have a default. `drawing` describes the picture of a sample. Pictures of a
    result are drawn in `render.evaluation`, from the result and from `counts`. Evaluators that are
    not tasks, but add numbers to a task's numbers, only need `settings`, `update` and `result_of`.

    Attributes:
        task: Name of the task.
        description: Description of the task in one line, for the command line.
        result_kinds: Kinds of results files from which the task can be evaluated.
        protocols: Name → rules of the metrics, which are frozen dataclasses; the first is the
            default.
        result_class: Class of the results, or the base of their classes.
        main_numbers: Paths of the headlines that breakdowns show; samples are ranked by the first.
        needs_whole_recordings: Whether the task follows whole recordings; then it cannot be broken
            down by attributes that change within a recording.
        needs_complete_recordings: Whether a recording that lacks a prediction is left out
            completely if partial results are allowed.
        needs_meta: Whether the truth is read from the scenarios' meta files.
        vehicles_only: Whether only vehicles have such predictions, but not the infrastructure.
        has_horizon: Whether predictions look ahead to the horizon of a setup.
        protocol: Rules of this evaluator.
    """

    task: ClassVar[str]
    description: ClassVar[str]
    result_kinds: ClassVar[tuple[str, ...]] = ()
    protocols: ClassVar[Mapping[str, Any]] = {}
    result_class: ClassVar[type[Any]] = TaskResult
    main_numbers: ClassVar[tuple[str, ...]] = ()
    needs_whole_recordings: ClassVar[bool] = False
    needs_complete_recordings: ClassVar[bool] = False
    needs_meta: ClassVar[bool] = False
    vehicles_only: ClassVar[bool] = False
    has_horizon: ClassVar[bool] = True

    protocol: Any

    def __init__(self, protocol: Any = "") -> None:
        """Create an evaluator without samples.

        Args:
            protocol: Name of one of `protocols`, or rules of the same class; an empty name selects
                the first protocol.

        Raises:
            ChoiceError: If no protocol has this name, or the rules have another class.
        """
        super().__init__()
        if protocol == "":
            self.protocol = next(iter(self.protocols.values()), None)
        else:
            self.protocol = protocol_of(protocol, self.protocols)

    # Methods that a task defines

    def truth(self, dataset: Dataset, token: str, form: Any, horizon: float, /) -> tuple[Any, ...]:
        """Load the arguments of `update` that follow the prediction; only tasks define this method.

        Args:
            dataset: Release with the labels.
            token: Token of the sample.
            form: How maps are stored (`Results.form`); None for results without maps.
            horizon: Seconds that the predictions look ahead.
        """
        raise NotImplementedError

    @abstractmethod
    def update(self, token: str, *arguments: Any) -> None:
        """Count one sample from its token, prediction and truth; pass the counts to `add`."""

    @abstractmethod
    def result_of(self, counts: Collection[Counts]) -> _Result:
        """Compute the metrics from the counts of samples, in any order."""

    # Methods that a task can override

    def read(self, results: Any, dataset: Dataset, token: str) -> Any:  # noqa: ARG002 - boxes need the data set
        """Read the prediction for a sample from results, in the form that `update` expects."""
        return results.prediction(token)

    def drawing(
        self,
        dataset: Dataset,  # noqa: ARG002 - tasks use them
        token: str,  # noqa: ARG002
        prediction: Any,
        /,
        *truth: Any,  # noqa: ARG002
    ) -> Drawing:
        """Describe the picture of a sample; by default, the prediction without the truth.

        Args:
            dataset: Release with the sample.
            token: Token of the sample.
            prediction: Prediction, as `update` takes it.
            truth: What `truth` returns.
        """
        if isinstance(prediction, list | tuple):
            return joined_drawing(prediction)
        return joined_drawing([prediction])

    @property
    def settings(self) -> dict[str, Any]:
        """Names and values of the protocol's fields."""
        return dict(plain(self.protocol))

    def sample_row(self, token: str) -> dict[str, Any]:
        """Return a sample's row in the table of samples; by default it contains the headlines."""
        result: Any = self.compute([token])
        return {number.name: number.value for number in headlines(result)}

    def compute(self, tokens: Iterable[str] | None = None) -> _Result:
        """Compute the metrics of all samples, or only of some.

        Args:
            tokens: Tokens of the samples; None for all.

        Raises:
            EvaluationError: If a sample was not counted, or a token is not a string.
        """
        if tokens is None:
            return self.result_of(list(self._counts.values()))
        if isinstance(tokens, str) or not isinstance(tokens, Iterable):
            raise EvaluationError(
                f"tokens: expected a list of tokens, found {tokens!r}; put a single token "
                "into a list"
            )
        selected_tokens: list[Any] = list(tokens)
        for token in selected_tokens:
            if not isinstance(token, str):
                raise EvaluationError(f"tokens: expected text, found {token!r} among them")
        missing = sorted(set(selected_tokens) - self._counts.keys())
        if missing:
            raise EvaluationError(
                f"{len(missing)} samples have no prediction, such as {missing[0]}"
            )
        return self.result_of([self._counts[token] for token in set(selected_tokens)])

    # Methods that resample the counts, for intervals and tests

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Merge counts into fewer ones with the same result, so that they are fast to resample.

        A subclass whose counts are sums adds them up; by default they are returned unchanged.
        """
        return list(counts)

    @property
    def has_intervals(self) -> bool:
        """Whether the result can be resampled, as intervals and tests require."""
        return True

    def resampled(self, parts: Sequence[Sequence[Counts]], times: IntArray) -> Iterator[_Result]:
        """Yield the result of each of D draws of groups of samples.

        Args:
            parts: Counts of P groups of samples; each group is drawn as a whole.
            times: (D, P) how often each draw contains each group.
        """
        pooled_parts = [self.pooled(part) for part in parts]
        for draw in times.tolist():
            drawn_counts: list[Counts] = []
            for part, repetitions in zip(pooled_parts, draw, strict=True):
                drawn_counts += [*part] * repetitions
            yield self.result_of(drawn_counts)

    def drawn_numbers(
        self,
        parts: Sequence[Sequence[Counts]],  # noqa: ARG002 - subclasses use them
        times: IntArray,  # noqa: ARG002
        names: Sequence[str],  # noqa: ARG002
    ) -> FloatArray | None:
        """Compute M numbers in each of D draws, shape (D, M); missing numbers are NaN.

        Return None if the numbers can only be taken from `resampled`.
        """
        return None


def ratio(part: float, whole: float) -> float:
    """Return `part / whole`; NaN if `whole` is 0."""
    if not whole:
        return math.nan
    return part / whole


def total(counts: Iterable[Counts], name: str) -> float:
    """Sum a number over samples exactly, so that the order does not matter."""
    return math.fsum(sample[name] for sample in counts)
