"""`explain`: what each choice of the rules does to the numbers of some results, counted in one pass."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection
from typing import Any

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.explanation.result import Explanation, explained, largest_first
from deepaccident_devkit.evaluation.explanation.side_by_side import Refusal, SideBySide
from deepaccident_devkit.evaluation.explanation.variants import CHOSEN, Variants, VariantsLoader, variants_of
from deepaccident_devkit.evaluation.headlines import headline_numbers, headlines
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.run import evaluate_samples
from deepaccident_devkit.evaluation.setups import EvaluationSetup, SampleLoader


def explain(
    dataset: Dataset,
    results: Results,
    setup: EvaluationSetup,
    tokens: Collection[str],
    *,
    workers: int | None = 1,
    progress: bool = False,
    checkpoint: str | os.PathLike[str] | None = None,
) -> Explanation:
    """The headline numbers by every protocol of the task, and with each choice of the chosen one made otherwise.

    Labels are a choice too (`labels.half_cell_shift=False`) where the rules can be compared with others than their own.
    All is counted in one pass; of motion results that takes some thirty times as long as the evaluation alone.

    Args:
        dataset: the release.
        results: the predictions.
        setup: the rules that are explained.
        tokens: the samples that are evaluated, each with a prediction.
        workers: processes; None for as many as the work is worth.
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
    evaluate_samples(evaluator, samples, load, workers=workers, checkpoint=checkpoint, progress=progress)
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
