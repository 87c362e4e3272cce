"""`comparable_pair`: two bundles that can be compared: of the same task, rules, truth and samples."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.attributes import cluster_of
from deepaccident_devkit.evaluation.metrics.evaluator import Evaluator
from deepaccident_devkit.evaluation.metrics.intervals import Clusters
from deepaccident_devkit.evaluation.runs.bundles import Bundle, read_bundle
from deepaccident_devkit.evaluation.runs.differences import differing
from deepaccident_devkit.evaluation.runs.selection import scenario_of
from deepaccident_devkit.reading import shortened

_SETUP: Final = ("task", "protocol", "switches", "horizon", "settings")
_SHOWN: Final = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ComparablePair:
    """Two evaluations of the same samples by the same rules.

    Attributes:
        bundles: the two.
        evaluators: of each, with the counts of all its samples.
        scenarios: scenario → tokens of its samples that both have; in order.
        left_out: samples that only one of them has.
    """

    bundles: tuple[Bundle, Bundle]
    evaluators: tuple[Evaluator[Any], Evaluator[Any]]
    scenarios: Mapping[str, tuple[str, ...]]
    left_out: int

    @property
    def tokens(self) -> list[str]:
        """All samples that both have, in order."""
        return [token for tokens in self.scenarios.values() for token in tokens]

    def clusters(self) -> tuple[Clusters, Clusters]:
        """Of both, the counts of each cluster's samples (an accident and its twin are one), in the same order."""
        tokens: dict[str, list[str]] = {}
        for name, those in self.scenarios.items():
            tokens.setdefault(cluster_of(name), []).extend(those)
        first, second = (
            [[evaluator.counts[token] for token in those] for those in tokens.values()] for evaluator in self.evaluators
        )
        return first, second


def comparable_pair(first: Path, second: Path, *, common: bool = False) -> ComparablePair:
    """Open two bundles and check that their numbers can be compared.

    Args:
        first: folder of one.
        second: of the other.
        common: whether to compare only the samples that both have, if they differ.

    Raises:
        ResultsError: one of them is no bundle.
        EvaluationError: they differ in task, rules, truth, or, without `common`, in samples; or counts cannot be read.
    """
    one, other = read_bundle(first), read_bundle(second)
    _check_rules(one, other)
    evaluators = one.evaluator(), other.evaluator()
    tokens = _shared_tokens((one, other), evaluators, common=common)
    scenarios: dict[str, list[str]] = {}
    for token in tokens:
        scenarios.setdefault(scenario_of(token), []).append(token)
    _check_truth(one, other, scenarios)
    return ComparablePair(
        bundles=(one, other),
        evaluators=evaluators,
        scenarios={name: tuple(those) for name, those in scenarios.items()},
        left_out=len(evaluators[0].tokens ^ evaluators[1].tokens),
    )


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


def _check_truth(one: Bundle, other: Bundle, scenarios: Mapping[str, object]) -> None:
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
