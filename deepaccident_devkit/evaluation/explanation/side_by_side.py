"""`SideBySide`: several evaluators of the same samples, each prediction read once."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from deepaccident_devkit.errors import DeepAccidentError
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why an evaluator cannot take a sample; stands in place of a result, or of what `update` takes."""

    reason: str


class SideBySide(Evaluator[dict[str, Any]]):
    """The results of several evaluators by their names, or the `Refusal` of one that cannot take some sample.

    Whether a sample can be taken at all is up to the first one: its errors are raised, those of the others kept.
    """

    def __init__(self, evaluators: Mapping[str, Evaluator[Any]]) -> None:
        """Of evaluators without samples; the first one decides what is an error."""
        super().__init__()
        self._evaluators = dict(evaluators)

    @property
    def settings(self) -> dict[str, Any]:
        """Those of each."""
        return {name: each.settings for name, each in self._evaluators.items()}

    def update(self, token: str, arguments: Mapping[str, tuple[Any, ...] | Refusal]) -> None:
        """Count one sample: by each evaluator's name what its `update` takes after the token."""
        main = next(iter(self._evaluators))
        counts: dict[str, Counts] = {}
        for name, evaluator in self._evaluators.items():
            given, one = arguments[name], evaluator.fresh()
            if isinstance(given, Refusal):
                counts[name] = {"refused": given.reason}
                continue
            try:
                one.update(token, *given)
            except DeepAccidentError as error:
                if name == main:
                    raise
                counts[name] = {"refused": str(error)}
            else:
                counts[name] = {"counts": one.counts[token]}
        self.add(token, counts)

    def result_of(self, counts: Collection[Counts]) -> dict[str, Any]:
        """The results of some samples' counts, in any order."""
        return {name: _result(name, evaluator, counts) for name, evaluator in self._evaluators.items()}


def _result(name: str, evaluator: Evaluator[Any], counts: Collection[Counts]) -> Any:
    refused = sorted(each[name]["refused"] for each in counts if "refused" in each[name])
    if refused:
        return Refusal(refused[0])
    return evaluator.result_of([each[name]["counts"] for each in counts])
