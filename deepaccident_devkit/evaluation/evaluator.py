"""`Evaluator`: one task, from a sample's prediction and truth to counts, then to a result.

Results do not depend on the order of samples or on how many workers counted them, memory grows with
the counts only, and any selection of the samples can be summed (see `breakdown`).
`counting.evaluate_samples` updates an evaluator with many samples.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Generic, TypeVar

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.sample_counts import Counts, SampleCounts
from deepaccident_devkit.evaluation.task import TaskResult, headlines, plain, protocol_of
from deepaccident_devkit.support.arrays import FloatArray, IntArray

__all__ = ["Counts", "Evaluator", "EvaluatorT", "ratio", "total"]

_Result = TypeVar("_Result")
EvaluatorT = TypeVar("EvaluatorT", bound="Evaluator[Any]")


class Evaluator(SampleCounts, Generic[_Result]):
    """One task: the truth of its predictions, what a sample adds, and the result of many samples.

    A new task is a subclass in a folder of its own, and its name in the tuple of
    `runs.setups.TASKS`. It defines:

    - its facts, the class attributes below;
    - `truth`: what the prediction of a sample is compared with;
    - `update`: what the sample adds, as `add` keeps it;
    - `result_of`: the result of the counts of some samples, with `rows` that describe its numbers.

    All other methods have a default. Pictures of a result are drawn in `render.evaluation`, from
    the result and from `counts`. Evaluators that are not tasks, for numbers beside the ones of a
    task, need only `settings`, `update` and `result_of`.

    Attributes:
        task: Name of the task.
        description: One line on the task for the command line.
        result_kinds: Kinds of results files that the task is evaluated from.
        protocols: Rules of the metrics by name, frozen dataclasses; the first is the default.
        result_class: Class of the results, or the base of their classes.
        main_numbers: Paths of the headlines that are shown by attribute; samples are ranked by the
            first.
        needs_whole_recordings: Whether whole recordings are followed, so that attributes within
            them are of no use.
        needs_meta: Whether the truth is in the scenarios' meta files.
        vehicles_only: Whether the roadside has no such predictions.
        has_horizon: Whether predictions look ahead to the horizon of a setup.
        protocol: The rules of this evaluator.
    """

    task: ClassVar[str]
    description: ClassVar[str]
    result_kinds: ClassVar[tuple[str, ...]] = ()
    protocols: ClassVar[Mapping[str, Any]] = {}
    result_class: ClassVar[type[Any]] = TaskResult
    main_numbers: ClassVar[tuple[str, ...]] = ()
    needs_whole_recordings: ClassVar[bool] = False
    needs_meta: ClassVar[bool] = False
    vehicles_only: ClassVar[bool] = False
    has_horizon: ClassVar[bool] = True

    protocol: Any

    def __init__(self, protocol: Any = "") -> None:
        """Start without samples.

        Args:
            protocol: Name of one of `protocols`, or rules of the same class; empty for the first
                protocol.

        Raises:
            ChoiceError: no protocol has that name, or the rules are of another class.
        """
        super().__init__()
        if protocol == "":
            self.protocol = next(iter(self.protocols.values()), None)
        else:
            self.protocol = protocol_of(protocol, self.protocols)

    # What a task defines

    def truth(self, dataset: Dataset, token: str, form: Any, horizon: float, /) -> tuple[Any, ...]:
        """Return the arguments of `update` after the prediction; only tasks have them.

        Args:
            dataset: Release with the labels.
            token: Token of the sample.
            form: How motion is stored (`Results.form`); None for other results.
            horizon: Seconds that the predictions look ahead.
        """
        raise NotImplementedError

    @abstractmethod
    def update(self, token: str, *arguments: Any) -> None:
        """Count one sample: its token, prediction and truth; passes the counts to `add`."""

    @abstractmethod
    def result_of(self, counts: Collection[Counts]) -> _Result:
        """Return the metrics of some samples' counts, in any order."""

    # What a task can change

    def read(self, results: Any, dataset: Dataset, token: str) -> Any:  # noqa: ARG002 - boxes need the data set
        """Return the prediction of a sample in a results file, as `update` takes it."""
        return results.prediction(token)

    @property
    def settings(self) -> dict[str, Any]:
        """The protocol's choices."""
        return dict(plain(self.protocol))

    def sample_row(self, token: str) -> dict[str, Any]:
        """Return the columns of one sample in the table of samples: its own headlines."""
        result: Any = self.compute([token])
        return {number.name: number.value for number in headlines(result)}

    def compute(self, tokens: Iterable[str] | None = None) -> _Result:
        """Return the metrics of all samples, or of some.

        Args:
            tokens: Tokens of the samples; None for all.

        Raises:
            EvaluationError: a sample was not counted, or a token is no text.
        """
        if tokens is None:
            return self.result_of(list(self._counts.values()))
        if isinstance(tokens, str) or not isinstance(tokens, Iterable):
            raise EvaluationError(
                f"tokens: expected several of them, found {tokens!r}; give [token] for one"
            )
        selected: list[Any] = list(tokens)
        for token in selected:
            if not isinstance(token, str):
                raise EvaluationError(f"tokens: expected texts, found {token!r} among them")
        missing = sorted(set(selected) - self._counts.keys())
        if missing:
            raise EvaluationError(
                f"{len(missing)} samples have no prediction, such as {missing[0]}"
            )
        return self.result_of([self._counts[token] for token in set(selected)])

    # How intervals and tests draw samples again and again

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Return fewer counts with the same result, for many results of these samples.

        A subclass with sums as counts adds them up; by default they stay apart.
        """
        return list(counts)

    @property
    def has_intervals(self) -> bool:
        """Whether numbers can be computed many times; otherwise they have no intervals or tests."""
        return True

    def resampled(self, parts: Sequence[Sequence[Counts]], times: IntArray) -> Iterator[_Result]:
        """Yield the result of each of D draws of groups of samples.

        Args:
            parts: Counts of P groups of samples; each group is drawn as a whole.
            times: How often each group is drawn, shape (D, P).
        """
        pooled = [self.pooled(part) for part in parts]
        for draw in times.tolist():
            repeated = [
                part for part, count in zip(pooled, draw, strict=True) for _ in range(count)
            ]
            yield self.result_of([counts for part in repeated for counts in part])

    def drawn_numbers(
        self,
        parts: Sequence[Sequence[Counts]],  # noqa: ARG002 - subclasses use them
        times: IntArray,  # noqa: ARG002
        names: Sequence[str],  # noqa: ARG002
    ) -> FloatArray | None:
        """Return M numbers in each of D draws, shape (D, M), NaN for none.

        None to use `resampled`.
        """
        return None


def ratio(part: float, whole: float) -> float:
    """Return `part / whole`; NaN if there is nothing to count."""
    return part / whole if whole else math.nan


def total(counts: Iterable[Counts], name: str) -> float:
    """Return the exact sum of a number over samples, the same in any order."""
    return math.fsum(sample[name] for sample in counts)
