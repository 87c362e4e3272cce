"""`explain`: what each choice of the rules does to the numbers of some results, counted in one pass."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.evaluator import Evaluator
from deepaccident_devkit.evaluation.metrics.frozen_mappings import FrozenMappings
from deepaccident_devkit.evaluation.metrics.headlines import Headline, Unit, headline_numbers, headlines, value_text
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs.explanation.variants import (
    CHOSEN,
    Refusal,
    SideBySide,
    Variants,
    VariantsLoader,
    variants_of,
)
from deepaccident_devkit.evaluation.runs.many_samples import evaluate_samples
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, SampleLoader
from deepaccident_devkit.text import columns_text

if TYPE_CHECKING:
    from concurrent.futures import Executor

_SHOWN: Final = 8
"""Headlines that a table of the terminal has room for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExplainedNumber:
    """A headline number if one choice is changed.

    Attributes:
        choice: `name=value`.
        headline: name of the number.
        value: then; None where there is nothing to count.
        change: against the chosen rules; None where one of both is not known.
        changed: whether it is another number then.
    """

    choice: str
    headline: str
    value: float | None
    change: float | None
    changed: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Explanation(FrozenMappings):
    """The headline numbers of some results by other rules.

    Attributes:
        task: whose.
        protocol: the chosen one, with its switches.
        samples: how many.
        chosen: headline → value by the chosen rules.
        units: headline → unit.
        protocols: name → headline → value, of the task's protocols that take such predictions. A headline is missing
            where the protocol has none of that name.
        numbers: of each choice, changed one at a time, each headline; the largest changes first.
        refused: protocol or choice → why the results cannot be evaluated so.
    """

    task: str
    protocol: str
    samples: int
    chosen: Mapping[str, float | None]
    units: Mapping[str, Unit]
    protocols: Mapping[str, Mapping[str, float | None]]
    numbers: tuple[ExplainedNumber, ...]
    refused: Mapping[str, str]

    def to_text(self) -> str:
        """The protocols' numbers, what each choice changes, what changes nothing, and what cannot be counted."""
        shown = [*self.chosen][:_SHOWN]
        numbers = {"chosen rules": self.chosen, **{f"protocol {name}": each for name, each in self.protocols.items()}}
        lines = [
            f"Explanation of {self.task} by {self.protocol}, {self.samples} samples. The numbers by each protocol:",
            columns_text([["", *shown], *([name, *self._texts(each, shown)] for name, each in numbers.items())]),
        ]
        changed = _by_choice(self.numbers)
        moving = {name: each for name, each in changed.items() if any(number.changed for number in each)}
        still = [name for name in changed if name not in moving]
        if moving:
            rows = [[name, *self._changes(each, shown)] for name, each in moving.items()]
            lines += [
                "What a change of one choice changes (percents in percentage points):",
                columns_text([["", *shown], *rows]),
            ]
        if still:
            lines.append(f"No difference: {', '.join(still)}")
        return "\n".join([*lines, *(f"Cannot be counted: {name}: {reason}" for name, reason in self.refused.items())])

    def _texts(self, values: Mapping[str, float | None], shown: Sequence[str]) -> list[str]:
        return [value_text(values.get(name), self.units[name]) for name in shown]

    def _changes(self, numbers: Sequence[ExplainedNumber], shown: Sequence[str]) -> list[str]:
        by_name = {each.headline: each for each in numbers}
        return [_change_text(by_name.get(name), self.units[name]) for name in shown]


def explained(choice: str, before: Sequence[Headline], after: Sequence[Headline]) -> list[ExplainedNumber]:
    """The numbers with one choice changed, in the order of those before."""
    then = {each.name: each.value for each in after}
    numbers = []
    for each in before:
        value = then.get(each.name)
        known = value is not None and each.value is not None
        numbers.append(
            ExplainedNumber(
                choice=choice,
                headline=each.name,
                value=value,
                change=value - each.value if known and value is not None and each.value is not None else None,
                changed=value != each.value,
            )
        )
    return numbers


def largest_first(choices: Sequence[Sequence[ExplainedNumber]]) -> tuple[ExplainedNumber, ...]:
    """The numbers of all choices: the one that changes the first headline most comes first, ties by the next ones."""
    ordered = sorted(choices, key=lambda numbers: tuple(-_size(each) for each in numbers))
    return tuple(number for numbers in ordered for number in numbers)


def _size(number: ExplainedNumber) -> float:
    """How much a number changes; one that comes or goes, more than any."""
    if not number.changed:
        return 0.0
    return float("inf") if number.change is None else abs(number.change)


def _by_choice(numbers: Sequence[ExplainedNumber]) -> dict[str, list[ExplainedNumber]]:
    result: dict[str, list[ExplainedNumber]] = {}
    for each in numbers:
        result.setdefault(each.choice, []).append(each)
    return result


def _change_text(number: ExplainedNumber | None, unit: Unit) -> str:
    if number is None or not number.changed:
        return "="
    if number.change is None:
        return f"now {value_text(number.value, unit)}"
    return value_text(number.change, unit, signed=True)


def explain(
    dataset: Dataset,
    results: Results,
    setup: EvaluationSetup,
    tokens: Collection[str],
    *,
    workers: int | None = 1,
    executor: Executor | None = None,
    progress: bool = False,
    checkpoint: str | os.PathLike[str] | None = None,
) -> Explanation:
    """The headline numbers by every protocol of the task, and with each choice of the chosen one changed.

    Labels are a choice too (`labels.half_cell_shift=False`) where the rules can be compared with others than their own.
    All is counted in one pass; of motion results that takes some thirty times as long as the evaluation alone.

    Args:
        dataset: the release.
        results: the predictions.
        setup: the rules that are explained.
        tokens: the samples that are evaluated, each with a prediction.
        workers: processes; None for as many as the work is worth.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a bar.
        checkpoint: as of `evaluate_samples`.

    Raises:
        EvaluationError: the results are not of a kind that the task takes, there is no sample, or one cannot be
            evaluated by the chosen rules.
    """
    if not tokens:
        raise EvaluationError("tokens: there is no sample to explain the numbers of")
    loader = SampleLoader(dataset, results, setup)
    variants = variants_of(loader)
    by_name = variants.by_name()
    kind: Callable[[Any], Evaluator[Any]] = type(setup.evaluator())
    evaluator = SideBySide({name: kind(each.rules) for name, each in by_name.items()})
    samples = {token: token for token in sorted(tokens)}
    load = VariantsLoader(loader, by_name)
    evaluate_samples(
        evaluator,
        samples,
        load,
        workers=workers,
        executor=executor,
        checkpoint=checkpoint,
        progress=progress,
        places=loader.places,
    )
    return _explanation(setup, variants, evaluator.compute(), len(samples))


def _explanation(setup: EvaluationSetup, variants: Variants, found: dict[str, Any], samples: int) -> Explanation:
    base = headlines(setup.task, found[CHOSEN])
    protocols = {name: found[f"protocol {name}"] for name in variants.protocols}
    choices = {name: found[name] for name in variants.choices}
    return Explanation(
        task=setup.task,
        protocol=", ".join([setup.protocol, *(f"{name}={value}" for name, value in setup.switches.items())]),
        samples=samples,
        chosen={each.name: each.value for each in base},
        units={each.name: each.unit for each in base},
        protocols={
            name: headline_numbers(setup.task, result)
            for name, result in protocols.items()
            if not isinstance(result, Refusal)
        },
        numbers=largest_first(
            [
                explained(name, base, headlines(setup.task, result))
                for name, result in choices.items()
                if not isinstance(result, Refusal)
            ]
        ),
        refused={
            **variants.refused,
            **{name: result.reason for name, result in (protocols | choices).items() if isinstance(result, Refusal)},
        },
    )
