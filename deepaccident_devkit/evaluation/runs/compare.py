"""`compare_bundles`: two evaluations side by side, and which of their differences are real.

The tests are fixed beforehand: of the task's first headline by itself, the other headlines together by Holm's rule.
All else is for exploration.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.attributes import cluster_of
from deepaccident_devkit.evaluation.metrics.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.metrics.headlines import Headline, headlines
from deepaccident_devkit.evaluation.metrics.intervals import Clusters, Resampling
from deepaccident_devkit.evaluation.metrics.numbers import numbers_of
from deepaccident_devkit.evaluation.runs.bundles import Bundle, read_bundle
from deepaccident_devkit.evaluation.runs.comparison import ComparedNumber, Comparison, Family
from deepaccident_devkit.evaluation.runs.differences import differing
from deepaccident_devkit.evaluation.runs.paired import PairedTest, holm, paired_test, undecided
from deepaccident_devkit.evaluation.runs.selection import scenario_of
from deepaccident_devkit.files import path_of
from deepaccident_devkit.reading import shortened

_SETUP: Final = ("task", "protocol", "switches", "horizon", "settings")
_SHOWN: Final = 3


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
    bundles = read_bundle(path_of(a)), read_bundle(path_of(b))
    _check_rules(*bundles)
    evaluators = bundles[0].evaluator(), bundles[1].evaluator()
    tokens = _shared_tokens(bundles, evaluators, common=common)
    scenarios = list(dict.fromkeys(map(scenario_of, tokens)))
    _check_truth(*bundles, scenarios)
    setup = bundles[0].setup
    results = [evaluator.compute(tokens) for evaluator in evaluators]
    known = {each.path: each for result in results for each in headlines(setup.task, result)}
    first, second = (numbers_of(result) for result in results)
    names = list(dict.fromkeys([*(name for name in known if name in {**first, **second}), *first, *second]))
    values = np.array([[numbers.get(name, math.nan) for name in names] for numbers in (first, second)])
    clusters = _clusters(evaluators[0], tokens), _clusters(evaluators[1], tokens)
    test = paired_test(evaluators[0], clusters, dict(zip(names, values[1] - values[0], strict=True)), chosen)
    partial = [bundle.summary["partial"] for bundle in bundles]
    return Comparison(
        a=bundles[0].folder,
        b=bundles[1].folder,
        task=setup.task,
        protocol=setup.protocol,
        samples=len(tokens),
        scenarios=len(scenarios),
        clusters=test.clusters,
        left_out=len(evaluators[0].tokens ^ evaluators[1].tokens),
        partial=tuple(f"{name}: {mark['mark']}" for name, mark in zip("ab", partial, strict=True) if mark),
        resampling=chosen,
        swaps=len(test.swaps.swapped),
        all_swaps=test.swaps.complete,
        numbers=_compared(names, values, test, known, len(scenarios)),
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


def _clusters(evaluator: Evaluator[Any], tokens: list[str]) -> Clusters:
    """The counts of each cluster's samples (an accident and its twin are one)."""
    clusters: dict[str, list[Counts]] = {}
    for token in tokens:
        clusters.setdefault(cluster_of(scenario_of(token)), []).append(evaluator.counts[token])
    return list(clusters.values())


def _check_rules(one: Bundle, other: Bundle) -> None:
    stated = [{name: bundle.summary.get(name) for name in _SETUP} for bundle in (one, other)]
    cells = [_cells(bundle) for bundle in (one, other)]
    if all(cells):
        stated = [{**rules, "cells": those} for rules, those in zip(stated, cells, strict=True)]
    unlike = list(differing(*stated))
    if unlike:
        told = "; ".join(
            f"{shortened(where)} {shortened(repr(first))} and {shortened(repr(second))}"
            for where, first, second in unlike[:_SHOWN]
        )
        more = f", and {len(unlike) - _SHOWN} more" if len(unlike) > _SHOWN else ""
        raise EvaluationError(
            f"{one.folder} and {other.folder}: were not evaluated by the same rules: {told}{more}; evaluate both in "
            "the same way"
        )


def _cells(bundle: Bundle) -> dict[str, Any]:
    """The cells of motion results, on which their labels are made, too; empty for other results.

    How maps lie is not among them, since it changes no number.
    """
    form = bundle.summary["results"]["form"] or {}
    return {name: str(form[name]) for name in ("x", "y", "step") if name in form}


def _check_truth(one: Bundle, other: Bundle, scenarios: list[str]) -> None:
    hashes = [bundle.scenarios() for bundle in (one, other)]
    changed = [name for name in scenarios if hashes[0].get(name) != hashes[1].get(name)]
    if changed:
        raise EvaluationError(
            f"{one.folder} and {other.folder}: the label, meta or calib files of {len(changed)} scenarios are not the "
            f"same ({', '.join(_first(changed))}); evaluate both results with the same release"
        )


def _shared_tokens(
    bundles: tuple[Bundle, Bundle], evaluators: tuple[Evaluator[Any], Evaluator[Any]], *, common: bool
) -> list[str]:
    mine, theirs = (each.tokens for each in evaluators)
    if mine != theirs and not common:
        counted = "; ".join(
            f"{len(alone)} samples only in {bundle.folder} ({', '.join(_first(sorted(alone)))})"
            for bundle, alone in zip(bundles, (mine - theirs, theirs - mine), strict=True)
            if alone
        )
        raise EvaluationError(
            f"{counted}; evaluate both at the same samples, or compare those that both have with common=True (--common)"
        )
    shared = sorted(mine & theirs)
    if not shared:
        raise EvaluationError(f"{bundles[0].folder} and {bundles[1].folder}: have no sample in common")
    return shared


def _first(names: list[str]) -> Iterator[str]:
    yield from map(shortened, names[:_SHOWN])
    if len(names) > _SHOWN:
        yield "…"
