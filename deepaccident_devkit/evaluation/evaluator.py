"""`Evaluator`: what all evaluators share. They keep small counts by sample and sum them when asked.

So results do not depend on the order of samples or on how many workers counted them, memory grows with the counts
alone, and any selection of the samples can be summed (see `breakdown`).
"""

from __future__ import annotations

import json
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, TypeVar

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.files import write_bytes

Counts = Mapping[str, Any]
"""What one sample adds: names → whole numbers, floats, None, or nested lists of them; as JSON holds it."""
Result = TypeVar("Result")
EvaluatorT = TypeVar("EvaluatorT", bound="Evaluator[Any]")


class Evaluator(ABC, Generic[Result]):
    """Counts by sample token; see the subclasses for what is counted.

    Attributes:
        repeated: tokens that came more than once with equal counts (samplers of distributed training do that); each
            counts once.
    """

    def __init__(self) -> None:
        """Start without samples."""
        self._counts: dict[str, Counts] = {}
        self.repeated: set[str] = set()

    @property
    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """All that decides the numbers, as JSON can hold it: evaluators of other settings cannot be merged."""

    @abstractmethod
    def result_of(self, counts: Collection[Counts]) -> Result:
        """The metrics of some samples' counts, in any order."""

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Fewer counts with the same result, for results of these samples that are asked for again and again.

        A subclass whose counts are sums adds them up; others keep them apart, as here.
        """
        return list(counts)

    def add(self, token: str, counts: Counts) -> None:
        """Take a sample's counts.

        Raises:
            EvaluationError: the sample came before, with other counts.
        """
        if token not in self._counts:
            self._counts[token] = counts
        elif self._counts[token] == counts:
            self.repeated.add(token)
        else:
            raise EvaluationError(f"{token}: evaluated twice, with different results; give each sample one prediction")

    def merge(self: EvaluatorT, other: EvaluatorT) -> EvaluatorT:
        """Take all samples of another evaluator; returns this one.

        Raises:
            EvaluationError: it has other settings, or other counts of the same sample.
        """
        if type(other) is not type(self) or other.settings != self.settings:
            raise EvaluationError(
                f"cannot merge: {type(self).__name__} of {self.settings} with {type(other).__name__} of "
                f"{getattr(other, 'settings', None)}; evaluate both with the same settings"
            )
        for token, counts in other.counts.items():
            self.add(token, counts)
        self.repeated |= other.repeated
        return self

    @property
    def counts(self) -> Mapping[str, Counts]:
        """Each sample's counts by token; a view."""
        return MappingProxyType(self._counts)

    @property
    def tokens(self) -> set[str]:
        """The samples counted."""
        return set(self._counts)

    def __len__(self) -> int:
        """Number of samples counted."""
        return len(self._counts)

    def compute(self, tokens: Iterable[str] | None = None) -> Result:
        """The metrics of all samples, or of some.

        Args:
            tokens: which samples; None for all.

        Raises:
            EvaluationError: one of them was not counted.
        """
        if tokens is None:
            return self.result_of(list(self._counts.values()))
        chosen = set(tokens)
        missing = sorted(chosen - self._counts.keys())
        if missing:
            raise EvaluationError(f"{len(missing)} samples have no prediction, such as {missing[0]}")
        return self.result_of([self._counts[token] for token in chosen])

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write all counts to a JSON file, from which a broken-off run goes on; returns its path."""
        target = Path(path).expanduser()
        state = {"settings": self.settings, "repeated": sorted(self.repeated), "counts": self._counts}
        write_bytes(target, json.dumps(state).encode())
        return target

    def resume(self: EvaluatorT, path: str | os.PathLike[str]) -> EvaluatorT:
        """Take the counts that `save` wrote; returns this one.

        Raises:
            EvaluationError: there is no such file, it cannot be read, or it is of other settings.
        """
        source = Path(path).expanduser()
        try:
            state = json.loads(source.read_text(encoding="utf-8"))
            settings, counts, repeated = state["settings"], dict(state["counts"]), set(state["repeated"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise EvaluationError(f"{source}: no saved evaluation ({error}); begin anew") from error
        if settings != self.settings:
            raise EvaluationError(f"{source}: was saved with other settings ({settings}); begin anew, or use those")
        for token, each in counts.items():
            self.add(token, each)
        self.repeated |= repeated
        return self


def ratio(part: float, whole: float) -> float:
    """`part / whole`; NaN if there is nothing to count."""
    return part / whole if whole else math.nan


def total(counts: Iterable[Counts], name: str) -> float:
    """The exact sum of a number over samples, whatever their order."""
    return math.fsum(each[name] for each in counts)
