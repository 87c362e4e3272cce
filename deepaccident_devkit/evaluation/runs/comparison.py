"""`compare_bundles`: two evaluations side by side, and which of their differences are real.

The tests are fixed beforehand: of the task's first headline by itself, the other headlines together by Holm's rule.
If both are equally good, it is chance which counts of a cluster (an accident and its twin) are whose: a paired
permutation test swaps those of some clusters and asks how often the two then differ as much. So clusters that are hard
for both do not hide a difference.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from deepaccident_devkit.errors import EvaluationError, shortened
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.intervals import (
    Clusters,
    Resampling,
    difference_intervals,
    has_interval,
    numbers_of,
    numbers_of_draws,
)
from deepaccident_devkit.evaluation.runs.bundles import Bundle, read_bundle
from deepaccident_devkit.evaluation.runs.setups import scenario_of
from deepaccident_devkit.evaluation.runs.verification import differing
from deepaccident_devkit.evaluation.task import Headline, headlines, plain
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, ShortRepr, known
from deepaccident_devkit.support.reports import Report, Row, record_rows
from deepaccident_devkit.support.text import columns_text, counted, path_of

# What a number is tested with: by itself, with all other headlines, or not at all.
Family = Literal["main", "headlines", "other"]
_SETUP: Final = ("task", "protocol", "switches", "horizon", "settings")
_SHOWN: Final = 3
# Differences that differ by at most this share of them count as equal.
_ROUNDING: Final = 1e-9
_IMPOSSIBLE: Final = "no decision is possible with"
# What a table says instead of that, and explains below.
_TOO_FEW: Final = "too few"
# The chance that the stated number of scenarios decides a difference.
_POWER: Final = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedNumber(ShortRepr):
    """A number of both results.

    Attributes:
        number: its path in the result: `ranges/30x30/iou`.
        headline: its short name, if it is one of the task's headlines; else None.
        unit: of a headline; else None.
        a: of the first; None where it has nothing to count.
        b: of the second; likewise.
        difference: b − a; None if one of them is.
        low: where the interval of the true difference begins; None for no interval.
        high: where it ends.
        family: `main` for the task's first headline, which is tested by itself; `headlines` for the others, which are
            tested together; `other` for numbers that are for exploration and are not tested.
        p: of the paired permutation test of this number for itself; None without difference or resamples.
        adjusted_p: the same by Holm's rule over the headlines; of others like p.
        real: whether the adjusted p is at most 1 − confidence; False for numbers that are not tested.
        better: `a` or `b`, if a difference is real and it is known whether more is better; else None.
        decision: for people: `b is better`, or why nothing is decided, and how many scenarios would.
    """

    number: str
    headline: str | None
    unit: str | None
    a: float | None
    b: float | None
    difference: float | None
    low: float | None
    high: float | None
    family: Family
    p: float | None
    adjusted_p: float | None
    real: bool
    better: str | None
    decision: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison(Report):
    """Two evaluations by the same rules.

    Attributes:
        a: folder of the first.
        b: folder of the second.
        task: of both.
        protocol: of both.
        samples: compared.
        scenarios: that they are of.
        clusters: that these are, where an accident and its twin are one.
        left_out: samples that only one of them has.
        partial: marks of those that are partial themselves.
        resampling: how differences were tested.
        swaps: how many swaps of the two runs' counts, cluster by cluster, p is of.
        all_swaps: whether these are all there are (apart from the sign); else they are random.
        numbers: headlines first.
    """

    a: Path
    b: Path
    task: str
    protocol: str
    samples: int
    scenarios: int
    clusters: int
    left_out: int
    partial: tuple[str, ...]
    resampling: Resampling
    swaps: int
    all_swaps: bool
    numbers: tuple[ComparedNumber, ...]

    def to_text(self) -> str:
        """A table of the headlines, how many other numbers differ, and what to make of that."""
        marks = (
            [f"a, b: only the samples that both have; {self.left_out} left out"]
            if self.left_out
            else []
        )
        samples, scenarios = counted(self.samples, "sample"), counted(self.scenarios, "scenario")
        head = [
            f"{self.task}, protocol {self.protocol}: {samples} of {scenarios}",
            f"clusters: {self.clusters} (an accident and its twin are one)",
            f"a: {self.a}",
            f"b: {self.b}",
            *self.partial,
            *marks,
        ]
        shown = [each for each in self.numbers if each.headline]
        percent = f"{self.resampling.confidence:.0%}"
        rows: list[Sequence[str]] = [
            ("number", "a", "b", "b − a", f"{percent} interval", "p", "decision")
        ]
        rows += [text_row(each) for each in shown]
        few = [each.decision for each in shown if each.decision.startswith(_IMPOSSIBLE)]
        told = (
            [f"{_TOO_FEW}: {few[-1]}"] if few else []
        )  # the first headline, tested alone, needs fewer
        return "\n".join([*head, "", columns_text(rows), "", *told, *self.notes()])

    def notes(self) -> list[str]:
        """Notes for readers of the table."""
        if not self.resampling.resamples:
            return ["no intervals and no tests: no resamples were asked for"]
        level = 1 - self.resampling.confidence
        main = next((each.headline for each in self.numbers if each.family == "main"), None)
        others = [each for each in self.numbers if each.family == "other" and each.p is not None]
        low = sum(each.p is not None and each.p <= level for each in others)
        drawn = f"all {self.swaps:,}" if self.all_swaps else f"{self.swaps:,} random"
        by_chance = f"between equally good runs about {level * len(others):.1f} would, by chance"
        explored = f"for exploration: {low} of {len(others)} other numbers have a p of at most {level:.0%}; {by_chance}"
        return [
            f"p: share of {drawn} swaps of clusters between a and b after which they differ at least as much",
            f"tested at {level:.0%}: {main}; and the other headlines together, whose p is adjusted by Holm's rule",
            "scenarios that would decide: with a chance of 80 %, if the true difference is the observed one",
            *([explored] if others else []),
        ]

    def to_dict(self) -> dict[str, Any]:
        """All of it, as JSON holds it."""
        made: dict[str, Any] = plain(
            asdict(self) | {"a": os.fspath(self.a), "b": os.fspath(self.b)}
        )
        return made | {"notes": self.notes()}

    def named_tables(self) -> dict[str, list[Row]]:
        """A line a number."""
        return {"numbers": record_rows(ComparedNumber, self.numbers)}


def text_row(each: ComparedNumber) -> tuple[str, ...]:
    """The cells of a number's row."""
    unit = f" ({each.unit})" if each.unit and each.unit != "share" else ""
    interval = (
        "–" if each.low is None or each.high is None else f"[{each.low:+.3f}, {each.high:+.3f}]"
    )
    return (
        f"{each.headline}{unit}",
        *("–" if value is None else f"{value:.3f}" for value in (each.a, each.b)),
        "–" if each.difference is None else f"{each.difference:+.3f}",
        interval,
        "–" if each.adjusted_p is None else f"{each.adjusted_p:.3f}",
        _TOO_FEW if each.decision.startswith(_IMPOSSIBLE) else each.decision,
    )


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
    evaluators, tokens = comparable(bundles, common=common)
    scenarios = list(dict.fromkeys(map(scenario_of, tokens)))
    setup = bundles[0].setup
    results = [evaluator.compute(tokens) for evaluator in evaluators]
    shown = {each.path: each for result in results for each in headlines(result)}
    first, second = (numbers_of(result) for result in results)
    names = list(
        dict.fromkeys([*(name for name in shown if name in {**first, **second}), *first, *second])
    )
    values = np.array(
        [[numbers.get(name, math.nan) for name in names] for numbers in (first, second)]
    )
    cluster_names = {token: cluster_of(scenario_of(token)) for token in tokens}
    clusters = evaluators[0].clustered(cluster_names), evaluators[1].clustered(cluster_names)
    test = paired_test(
        evaluators[0], clusters, dict(zip(names, values[1] - values[0], strict=True)), chosen
    )
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
        partial=tuple(
            f"{name}: {mark['mark']}" for name, mark in zip("ab", partial, strict=True) if mark
        ),
        resampling=chosen,
        swaps=len(test.swaps.swapped),
        all_swaps=test.swaps.complete,
        numbers=_compared(names, values, test, shown, len(scenarios)),
    )


def _compared(
    names: list[str],
    values: FloatArray,
    test: PairedTest,
    shown: Mapping[str, Headline],
    scenarios: int,
) -> tuple[ComparedNumber, ...]:
    main = next(iter(shown), None)
    families: list[Family] = [
        "main" if name == main else "headlines" if name in shown else "other" for name in names
    ]
    tested = np.array([family == "headlines" for family in families]) & np.isfinite(test.p)
    adjusted = test.p.copy()
    adjusted[tested] = holm(test.p[tested])
    together = {"main": 1, "headlines": max(int(tested.sum()), 1)}
    compared = []
    for at, (name, family) in enumerate(zip(names, families, strict=True)):
        headline = shown.get(name)
        real = family != "other" and bool(adjusted[at] <= 1 - test.resampling.confidence)
        better = _better(test.differences[at], headline) if real else None
        decision = (
            "for exploration"
            if family == "other"
            else f"{better} is better"
            if better
            else "they differ"
        )
        compared.append(
            ComparedNumber(
                number=name,
                headline=None if headline is None else headline.name,
                unit=None if headline is None else headline.unit,
                a=known(values[0, at]),
                b=known(values[1, at]),
                difference=known(test.differences[at]),
                low=known(test.low[at]),
                high=known(test.high[at]),
                family=family,
                p=known(test.p[at]),
                adjusted_p=known(adjusted[at]),
                real=real,
                better=better,
                decision=decision
                if real or family == "other"
                else undecided(test, at, together[family], scenarios),
            )
        )
    return tuple(compared)


def _better(difference: float, headline: Headline | None) -> str | None:
    if headline is None or headline.higher_is_better is None:
        return None
    return "b" if (difference > 0) == headline.higher_is_better else "a"


def comparable(
    bundles: Sequence[Bundle], *, common: bool
) -> tuple[list[Evaluator[Any]], list[str]]:
    """The counts of bundles, and the samples that all of them have; arguments and errors as of `compare_bundles`."""
    for bundle in bundles[1:]:
        _check_rules(bundles[0], bundle)
    evaluators = [bundle.evaluator() for bundle in bundles]
    tokens = set(evaluators[0].tokens)
    for bundle, evaluator in zip(bundles[1:], evaluators[1:], strict=True):
        tokens &= {*_shared_tokens((bundles[0], bundle), (evaluators[0], evaluator), common=common)}
        _check_truth(bundles[0], bundle, list(dict.fromkeys(map(scenario_of, sorted(tokens)))))
    return evaluators, sorted(tokens)


def _check_rules(one: Bundle, other: Bundle) -> None:
    task, other_task = one.setup.task, other.setup.task
    if task != other_task:
        raise EvaluationError(
            f"{one.folder} is an evaluation of the task {task}, {other.folder} one of {other_task}; compare two of the "
            "same task"
        )
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
    """The cells of motion results, but not how maps lie, which changes no number; empty for other results."""
    form = bundle.summary["results"]["form"] or {}
    return {name: str(form[name]) for name in ("x", "y", "step") if name in form}


def _check_truth(one: Bundle, other: Bundle, scenarios: list[str]) -> None:
    mine, theirs = one.scenarios(), other.scenarios()
    changed = [
        name for name in scenarios if name not in mine or not mine[name].is_like(theirs.get(name))
    ]
    if changed:
        raise EvaluationError(
            f"{one.folder} and {other.folder}: the label, meta or calib files of {len(changed)} scenarios are not the "
            f"same ({', '.join(_first(changed))}); evaluate both results with the same release"
        )


def _shared_tokens(
    bundles: tuple[Bundle, Bundle],
    evaluators: tuple[Evaluator[Any], Evaluator[Any]],
    *,
    common: bool,
) -> list[str]:
    mine, theirs = (each.tokens for each in evaluators)
    if mine != theirs and not common:
        alone_text = "; ".join(
            f"{counted(len(alone), 'sample')} only in {bundle.folder} ({', '.join(_first(sorted(alone)))})"
            for bundle, alone in zip(bundles, (mine - theirs, theirs - mine), strict=True)
            if alone
        )
        raise EvaluationError(
            f"{alone_text}; evaluate both at the same samples, or compare those that both have with common=True "
            "(--common)"
        )
    shared = sorted(mine & theirs)
    if not shared:
        raise EvaluationError(
            f"{bundles[0].folder} and {bundles[1].folder}: have no sample in common"
        )
    return shared


def _first(names: list[str]) -> Iterator[str]:
    yield from map(shortened, names[:_SHOWN])
    if len(names) > _SHOWN:
        yield "…"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Swaps:
    """Which clusters are swapped.

    Attributes:
        swapped: (S, C) of C clusters; of all swaps the half that leave the first cluster as it is: the others swap all
            that these do not, and give the same differences with the other sign.
        complete: whether all are taken; else they are drawn at random.
    """

    swapped: BoolArray
    complete: bool

    @property
    def least_p(self) -> float:
        """The least p that is possible."""
        return 1 / (len(self.swapped) + (not self.complete))


def swaps_of(clusters: int, resampling: Resampling) -> Swaps:
    """All swaps of so many clusters if they are at most `resamples`, else as many random ones."""
    number = 2 ** max(clusters - 1, 0)
    if number <= resampling.resamples:
        numbers = np.arange(number)[:, None]
        return Swaps(swapped=(numbers << 1) >> np.arange(clusters) & 1 == 1, complete=True)
    source = np.random.default_rng(resampling.seed)
    return Swaps(
        swapped=source.integers(2, size=(resampling.resamples, clusters)) == 1, complete=False
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairedTest:
    """What two runs' numbers, M of them, differ by, and how sure that is.

    Attributes:
        differences: (M,) second − first; NaN where one of them has nothing to count.
        low: (M,) where the interval of the true difference begins; NaN for none (see `intervals.interval_ends`).
        high: (M,) where it ends.
        errors: (M,) standard errors; NaN where unknown.
        p: (M,) two-sided, of each number for itself; NaN without a difference, or without resamples.
        swaps: the swaps of which p is a share.
        clusters: how many there are.
        resampling: how it was tested.
    """

    differences: FloatArray
    low: FloatArray
    high: FloatArray
    errors: FloatArray
    p: FloatArray
    swaps: Swaps
    clusters: int
    resampling: Resampling


def paired_test(
    evaluator: Evaluator[Any],
    runs: tuple[Clusters, Clusters],
    differences: Mapping[str, float],
    resampling: Resampling,
) -> PairedTest:
    """Test the differences (number, by its path → second − first) of two runs' counts of the same clusters."""
    resampling = resampling if evaluator.has_intervals else replace(resampling, resamples=0)
    names, observed = list(differences), np.array(list(differences.values()))
    low, high, errors, p = (np.full(len(names), math.nan) for _ in range(4))
    unlike = [one != other for one, other in zip(*runs, strict=True)]
    swaps = swaps_of(sum(unlike), resampling)
    if resampling.resamples:
        ordered = [
            [run[at] for at in np.argsort(np.logical_not(unlike), kind="stable")] for run in runs
        ]
        p = p_values(observed, swapped_differences(evaluator, ordered, swaps, names), swaps)
    if resampling.resamples and len(unlike) > 1:
        low, high, errors = difference_intervals(evaluator, runs, differences, resampling)
    without = [not has_interval(name) for name in names]
    for column in (low, high, errors):
        column[without] = math.nan
    return PairedTest(
        differences=observed,
        low=low,
        high=high,
        errors=errors,
        p=p,
        swaps=swaps,
        clusters=len(unlike),
        resampling=resampling,
    )


def swapped_differences(
    evaluator: Evaluator[Any], pairs: Sequence[Clusters], swaps: Swaps, names: Sequence[str]
) -> FloatArray:
    """(S, M) second − first of M numbers, after each of S swaps of the first clusters of the pairs; NaN for none."""
    first, second = pairs
    stay = np.zeros((len(swaps.swapped), len(first) - swaps.swapped.shape[1]), dtype=bool)
    others = np.hstack([swaps.swapped, stay])
    parts = [*first, *second]
    a, b = (
        numbers_of_draws(evaluator, parts, np.hstack(taken).astype(np.int64), names)
        for taken in ((~others, others), (others, ~others))
    )
    return b - a


def p_values(differences: FloatArray, swapped: FloatArray, swaps: Swaps) -> FloatArray:
    """The two-sided p of each difference: the share of swaps, the observed one included, that differ as much or more.

    Of random swaps only half of those that differ equally count, unless none differ more: such ties are many where a
    number changes in few clusters, and all of them would make the test by far too strict. Of differences (M,), of which
    NaN has the p NaN, and those after the swaps (S, M), where NaN counts as more.
    """
    found, after = np.abs(differences), np.abs(swapped)
    with np.errstate(invalid="ignore"):
        more = (~(after <= found * (1 + _ROUNDING))).sum(axis=0)
        less = (after < found * (1 - _ROUNDING)).sum(axis=0)
    if swaps.complete:
        hits = len(swapped) - less
    else:
        ties = len(swapped) - more - less
        hits = 1 + more + np.where((more == 0) | (found == 0), ties, ties / 2)
    return np.where(np.isnan(differences), math.nan, hits * swaps.least_p)


def holm(p: FloatArray) -> FloatArray:
    """(M,) p adjusted by Holm's rule: if those below a level are called real, any is falsely so with that chance."""
    order = np.argsort(p)
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1)
    return adjusted


def undecided(test: PairedTest, at: int, together: int, scenarios: int) -> str:
    """Why a difference is not real, and how many more scenarios than these would decide it."""
    difference, level = (
        abs(float(test.differences[at])),
        (1 - test.resampling.confidence) / together,
    )
    if math.isnan(difference):
        return "nothing to compare"
    if difference == 0:
        return "the difference is 0"
    if not test.resampling.resamples:
        return "not tested: no resamples were asked for, or the protocol has none"
    if test.swaps.least_p > level:
        return f"{_IMPOSSIBLE} {_too_few(test, level)} are needed"
    from scipy.special import ndtri

    deviations = float(test.errors[at]) / difference * (ndtri(1 - level / 2) + ndtri(_POWER))
    if not deviations > 0:
        return "not decided"
    return f"not decided: about {_rounded_up(max(deviations**2, 1) * scenarios)} scenarios would decide it"


def _too_few(test: PairedTest, level: float) -> str:
    if not test.swaps.complete:
        return f"{len(test.swaps.swapped)} resamples; at least {math.ceil(1 / level) - 1}"
    found, needed = test.swaps.swapped.shape[1], 1 + math.ceil(-math.log2(level))
    if found == test.clusters:
        return f"{found} cluster{'s' * (found != 1)}; at least {needed}"
    return f"{found} of {test.clusters} clusters in which the two differ; at least {needed}"


def _rounded_up(count: float) -> str:
    """With two digits: `130`, `1,300`."""
    unit = 10 ** max(math.floor(math.log10(count)) - 1, 0)
    return f"{math.ceil(count / unit) * unit:,}"
