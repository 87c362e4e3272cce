"""`compare_bundles`: two evaluations side by side, and which of their differences are real.

The tests are fixed beforehand: of the task's first headline by itself, the other headlines together by Holm's rule.
All else is for exploration.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.evaluation.metrics.headlines import Headline, headlines
from deepaccident_devkit.evaluation.metrics.intervals import Resampling
from deepaccident_devkit.evaluation.metrics.numbers import numbers_of
from deepaccident_devkit.evaluation.runs.comparable import comparable_pair
from deepaccident_devkit.evaluation.runs.comparison import ComparedNumber, Comparison, Family
from deepaccident_devkit.evaluation.runs.paired import PairedTest, holm, paired_test, undecided
from deepaccident_devkit.files import path_of


def compare_bundles(
    a: str | os.PathLike[str],
    b: str | os.PathLike[str],
    resampling: Resampling | None = None,
    *,
    common: bool = False,
) -> Comparison:
    """Compare two bundles' numbers; the release and the results are not needed.

    Args:
        a: folder of the first, as `save_run` writes it.
        b: folder of the second.
        resampling: how they are tested; None for the defaults.
        common: whether to compare only the samples that both have, if they differ.

    Raises:
        ResultsError: one of them is no bundle.
        EvaluationError: they differ in task, rules, labels or samples, or were made by another devkit.
    """
    chosen = resampling or Resampling()
    pair = comparable_pair(path_of(a), path_of(b), common=common)
    setup = pair.bundles[0].setup
    results = [evaluator.compute(pair.tokens) for evaluator in pair.evaluators]
    known = {each.path: each for result in results for each in headlines(setup.task, result)}
    first, second = (numbers_of(result) for result in results)
    names = list(dict.fromkeys([*(name for name in known if name in {**first, **second}), *first, *second]))
    values = np.array([[numbers.get(name, math.nan) for name in names] for numbers in (first, second)])
    test = paired_test(
        pair.evaluators[0], pair.clusters(), dict(zip(names, values[1] - values[0], strict=True)), chosen
    )
    partial = [bundle.summary["partial"] for bundle in pair.bundles]
    return Comparison(
        a=pair.bundles[0].folder,
        b=pair.bundles[1].folder,
        task=setup.task,
        protocol=setup.protocol,
        samples=len(pair.tokens),
        scenarios=len(pair.scenarios),
        clusters=test.clusters,
        left_out=pair.left_out,
        partial=tuple(f"{name}: {mark['mark']}" for name, mark in zip("ab", partial, strict=True) if mark),
        resampling=chosen,
        swaps=len(test.swaps.swapped),
        all_swaps=test.swaps.complete,
        numbers=_compared(names, values, test, known, len(pair.scenarios)),
    )


def _compared(
    names: list[str], values: FloatArray, test: PairedTest, known: Mapping[str, Headline], scenarios: int
) -> tuple[ComparedNumber, ...]:
    main = next(iter(known), None)
    families: list[Family] = ["main" if name == main else "headlines" if name in known else "other" for name in names]
    tested = np.array([family == "headlines" for family in families]) & np.isfinite(test.p)
    adjusted = test.p.copy()
    adjusted[tested] = holm(test.p[tested])
    together = {"main": 1, "headlines": max(int(tested.sum()), 1)}
    compared = []
    for at, (name, family) in enumerate(zip(names, families, strict=True)):
        headline = known.get(name)
        real = family != "other" and bool(adjusted[at] <= 1 - test.resampling.confidence)
        better = _better(test.differences[at], headline) if real else None
        decision = "for exploration" if family == "other" else f"{better} is better" if better else "they differ"
        compared.append(
            ComparedNumber(
                number=name,
                headline=None if headline is None else headline.name,
                unit=None if headline is None else headline.unit,
                a=_finite(values[0, at]),
                b=_finite(values[1, at]),
                difference=_finite(test.differences[at]),
                low=_finite(test.low[at]),
                high=_finite(test.high[at]),
                family=family,
                p=_finite(test.p[at]),
                adjusted_p=_finite(adjusted[at]),
                real=real,
                better=better,
                decision=decision if real or family == "other" else undecided(test, at, together[family], scenarios),
            )
        )
    return tuple(compared)


def _better(difference: float, headline: Headline | None) -> str | None:
    if headline is None or headline.higher_is_better is None:
        return None
    return "b" if (difference > 0) == headline.higher_is_better else "a"


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
