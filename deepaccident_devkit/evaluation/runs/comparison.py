"""`compare_bundles`: two evaluations side by side, and which of their differences are real.

The tests are fixed beforehand: the task's first headline is tested by itself, the other headlines
together by Holm's rule. If both evaluations are equally good, only chance decides which of them has
the better counts of a cluster (an accident and its twin). So a paired permutation test swaps the
counts of random clusters, and asks how often the evaluations then differ at least as much. Clusters
that are hard for both evaluations do not hide a difference.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal

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
from deepaccident_devkit.evaluation.runs.verification import find_differences
from deepaccident_devkit.evaluation.task import Headline, headlines, plain
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, ShortRepr, json_numbers
from deepaccident_devkit.support.human_names import metric_name, rules_name, with_unit
from deepaccident_devkit.support.reports import Report, Row, record_rows
from deepaccident_devkit.support.text import (
    PathType,
    columns_text,
    counted,
    interval_text,
    number_text,
    path_of,
)
from deepaccident_devkit.support.values import NamedValues

# How a number is tested: by itself, together with the other headlines, or not at all.
Family = Literal["main", "headlines", "other"]
# Keys of a summary that must have the same values in both evaluations.
_SETUP_KEYS = ("task", "protocol", "switches", "horizon", "settings")
# An error lists at most this many differing rules, or names.
_MAX_LISTED = 3
# Differences count as equal if they deviate by at most this fraction.
_RELATIVE_TOLERANCE = 1e-9
_IMPOSSIBLE = "no decision is possible with"
# Replaces such a decision in a table; the explanation is printed below the table.
_TOO_FEW = "too few"
# Probability that the stated number of scenarios decides a difference.
_POWER = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedNumber(ShortRepr):
    """One number in two evaluations, a and b.

    Attributes:
        number: Path of the number in the result, such as `ranges/30x30/iou`.
        headline: Short name of a headline; None for other numbers.
        unit: Unit of a headline; None for other numbers.
        a: Value in the first evaluation; None if there is nothing to count.
        b: Value in the second evaluation; None if there is nothing to count.
        difference: b − a; None if either is None.
        low: Lower end of the interval of the true difference; None if there is no interval.
        high: Upper end of the interval; None if there is no interval.
        family: `main` for the task's first headline, which is tested by itself; `headlines` for the
            other headlines, which are tested together; `other` for all other numbers, which are
            only meant for exploration and are not tested.
        p: p of the paired permutation test of this number by itself; None if there is no difference
            or there are no resamples.
        adjusted_p: p adjusted by Holm's rule over the headlines; equal to `p` for other numbers.
        real: Whether the adjusted p is at most 1 − confidence; False for numbers that are not
            tested.
        better: `a` or `b` if the difference is real and it is known whether higher or lower numbers
            are better; otherwise None.
        decision: Text such as `b is better`; if nothing is decided, it explains why, and how many
            scenarios would decide it.
        higher_is_better: Whether higher values of a headline are better; None if neither higher
            nor lower are, and for other numbers.
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
    higher_is_better: bool | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison(Report):
    """Comparison of two evaluations under the same rules.

    Attributes:
        a: Folder of the first evaluation.
        b: Folder of the second evaluation.
        task: Task of both evaluations.
        protocol: Protocol of both evaluations.
        samples: Number of compared samples.
        scenarios: Number of scenarios that the samples belong to.
        clusters: Number of clusters that the samples belong to; an accident and its twin are one.
        left_out: Number of samples that only one evaluation has.
        partial: Marks of the partial evaluations among the two.
        resampling: Settings of the intervals and tests.
        swaps: Number of swaps that the p values are based on; a swap exchanges the counts of
            clusters between the two runs.
        all_swaps: Whether these are all possible swaps (up to the sign); otherwise they are random.
        numbers: Compared numbers, headlines first.
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

    @property
    def title(self) -> str:
        """The task, its protocol and the number of common samples, in words."""
        samples = counted(self.samples, "sample")
        scenarios = counted(self.scenarios, "scenario")
        return f"{rules_name(self.task, self.protocol)}; {samples} of {scenarios}"

    def to_text(self) -> str:
        """Format a table of the headlines, with notes on how to read it and on other numbers."""
        head = [
            self.title,
            f"clusters: {self.clusters} (an accident and its twin form one cluster)",
            f"a: {self.a}",
            f"b: {self.b}",
            *self.partial,
        ]
        if self.left_out:
            left_out = counted(self.left_out, "sample")
            head.append(f"excluded: {left_out} that only one of the two evaluations has")
        interval_title = f"{100 * self.resampling.confidence:.0f} % interval"
        rows: list[Sequence[str]] = [("number", "a", "b", "b − a", interval_title, "p", "decision")]
        explanations: list[str] = []
        for number in self.numbers:
            if not number.headline:
                continue
            rows.append(text_row(number))
            if number.decision.startswith(_IMPOSSIBLE):
                explanations = [f"{_TOO_FEW}: {number.decision}"]
        # show only the last explanation: the first headline, which is tested by itself, needs fewer
        # clusters than the others
        return "\n".join([*head, "", columns_text(rows), "", *explanations, *self.notes()])

    def notes(self) -> list[str]:
        """Return notes that explain the table."""
        if not self.resampling.resamples:
            return ["no confidence intervals and no tests, since the resamples were set to 0"]
        level = 1 - self.resampling.confidence
        main_headline = None
        other_p = []
        for number in self.numbers:
            if number.family == "main":
                main_headline = metric_name(str(number.headline))
            elif number.family == "other" and number.p is not None:
                other_p.append(number.p)
        swaps = "all swaps" if self.all_swaps else "random swaps"
        notes = [
            (
                f"p is the share of {swaps} of clusters between a and b after which the two differ "
                f"at least as much; number of swaps: {self.swaps:,}"
            ),
            (
                f"{main_headline} is tested at {100 * level:.0f} %; the other headlines are tested "
                "together, with p adjusted by Holm's rule"
            ),
            (
                "the number of scenarios needed is the number at which a test would find the "
                "difference with a probability of 80 %, if the observed difference is the true "
                "one"
            ),
        ]
        if other_p:
            low_count = sum(p <= level for p in other_p)
            notes.append(
                f"exploratory: p is at most {100 * level:.0f} % for {low_count} of {len(other_p)} "
                f"other numbers; about {level * len(other_p):.1f} are expected by chance if both "
                "runs are equally good"
            )
        return notes

    def to_dict(self) -> dict[str, Any]:
        """Convert all fields to JSON-compatible values."""
        values = asdict(self)
        values["a"] = os.fspath(self.a)
        values["b"] = os.fspath(self.b)
        values["notes"] = self.notes()
        payload: NamedValues = plain(values)
        return payload

    def named_tables(self) -> dict[str, list[Row]]:
        """Return a single table with one row per number."""
        return {"numbers": record_rows(ComparedNumber, self.numbers)}


def text_row(number: ComparedNumber) -> tuple[str, ...]:
    """Format the cells of a number's row in the text of a comparison."""
    decision = number.decision
    if decision.startswith(_IMPOSSIBLE):
        decision = _TOO_FEW
    return (
        with_unit(metric_name(str(number.headline)), number.unit),
        number_text(number.a, 3),
        number_text(number.b, 3),
        number_text(number.difference, 3, "+"),
        interval_text(number.low, number.high, sign="+"),
        number_text(number.adjusted_p, 3),
        decision,
    )


def compare_bundles(
    a: PathType,
    b: PathType,
    resampling: Resampling | None = None,
    *,
    common: bool = False,
) -> Comparison:
    """Compare the numbers of two bundles; neither the release nor the results are needed.

    Args:
        a: Folder of the first bundle, as written by `save_run`.
        b: Folder of the second bundle.
        resampling: Settings of the intervals and tests; None for the defaults.
        common: Whether to compare only the common samples if the samples differ.

    Raises:
        ResultsError: If one of the folders does not contain a bundle.
        EvaluationError: If the two differ in task, rules, labels or samples, or were written by
            another version of the devkit.
    """
    resampling = resampling or Resampling()
    bundles = (read_bundle(path_of(a)), read_bundle(path_of(b)))
    evaluators, tokens = comparable(bundles, common=common)
    evaluator_a, evaluator_b = evaluators
    scenarios = set(map(scenario_of, tokens))
    setup = bundles[0].setup
    results = [evaluator.compute(tokens) for evaluator in evaluators]
    headlines_by_path = {}
    for headline in chain(*map(headlines, results)):
        headlines_by_path[headline.path] = headline
    numbers_a, numbers_b = map(numbers_of, results)
    all_paths = {**numbers_a, **numbers_b}
    headline_paths = [path for path in headlines_by_path if path in all_paths]
    paths = list(dict.fromkeys([*headline_paths, *all_paths]))
    values_a = [numbers_a.get(path, math.nan) for path in paths]
    values_b = [numbers_b.get(path, math.nan) for path in paths]
    values = np.array([values_a, values_b])
    cluster_names = {token: cluster_of(scenario_of(token)) for token in tokens}
    clusters = (evaluator_a.clustered(cluster_names), evaluator_b.clustered(cluster_names))
    differences = dict(zip(paths, values[1] - values[0], strict=True))
    test = paired_test(evaluator_a, clusters, differences, resampling)
    marks = []
    for name, bundle in zip("ab", bundles, strict=True):
        partial = bundle.summary["partial"]
        if partial:
            marks.append(f"{name}: {partial['mark']}")
    return Comparison(
        a=bundles[0].folder,
        b=bundles[1].folder,
        task=setup.task,
        protocol=setup.protocol,
        samples=len(tokens),
        scenarios=len(scenarios),
        clusters=test.clusters,
        left_out=len(evaluator_a.tokens ^ evaluator_b.tokens),
        partial=tuple(marks),
        resampling=resampling,
        swaps=len(test.swaps.swapped),
        all_swaps=test.swaps.complete,
        numbers=_compare_numbers(paths, values, test, headlines_by_path, len(scenarios)),
    )


def _compare_numbers(
    paths: list[str],
    values: FloatArray,
    test: PairedTest,
    headlines_by_path: Mapping[str, Headline],
    scenarios: int,
) -> tuple[ComparedNumber, ...]:
    """Combine M numbers with the results of their tests.

    Args:
        paths: Paths of the numbers.
        values: (2, M) values in the first and in the second evaluation.
        test: Test of the differences.
        headlines_by_path: Path → headline, the most important first.
        scenarios: Number of scenarios in both evaluations.
    """
    main_path = next(iter(headlines_by_path), None)
    families = [_find_family(path, main_path, headlines_by_path) for path in paths]
    is_headline = np.array([family == "headlines" for family in families])
    is_tested = is_headline & np.isfinite(test.p)
    adjusted = test.p.copy()
    adjusted[is_tested] = holm(test.p[is_tested])
    test_counts = {"main": 1, "headlines": max(int(is_tested.sum()), 1)}
    numbers = []
    for index, (path, family) in enumerate(zip(paths, families, strict=True)):
        headline = headlines_by_path.get(path)
        is_low = bool(adjusted[index] <= 1 - test.resampling.confidence)
        is_real = family != "other" and is_low
        better = None
        if family == "other":
            decision = "for exploration"
        elif not is_real:
            decision = undecided_text(test, index, test_counts[family], scenarios)
        else:
            better = _better_side(test.differences[index], headline)
            decision = f"{better} is better" if better else "they differ"
        compared = ComparedNumber(
            number=path,
            headline=None if headline is None else headline.name,
            unit=None if headline is None else headline.unit,
            a=json_numbers(values[0, index]),
            b=json_numbers(values[1, index]),
            difference=json_numbers(test.differences[index]),
            low=json_numbers(test.low[index]),
            high=json_numbers(test.high[index]),
            family=family,
            p=json_numbers(test.p[index]),
            adjusted_p=json_numbers(adjusted[index]),
            real=is_real,
            better=better,
            decision=decision,
            higher_is_better=None if headline is None else headline.higher_is_better,
        )
        numbers.append(compared)
    return tuple(numbers)


def _find_family(
    path: str, main_path: str | None, headlines_by_path: Mapping[str, Headline]
) -> Family:
    """Return in which family the number at a path is tested."""
    if path == main_path:
        return "main"
    if path in headlines_by_path:
        return "headlines"
    return "other"


def _better_side(difference: float, headline: Headline | None) -> str | None:
    """Return which evaluation has the better value, `a` or `b`; None if unknown."""
    if headline is None or headline.higher_is_better is None:
        return None
    if (difference > 0) == headline.higher_is_better:
        return "b"
    return "a"


def comparable(
    bundles: Sequence[Bundle], *, common: bool
) -> tuple[list[Evaluator[Any]], list[str]]:
    """Return evaluators with the counts of bundles, and the tokens that all bundles have.

    Raise the errors of `compare_bundles` if the bundles cannot be compared.

    Args:
        bundles: Bundles to compare; the first is compared with each of the others.
        common: Whether to compare only the common samples if the samples differ.
    """
    reference, *other_bundles = bundles
    for bundle in other_bundles:
        _check_rules(reference, bundle)
    evaluators = [bundle.evaluator() for bundle in bundles]
    reference_evaluator, *other_evaluators = evaluators
    tokens = reference_evaluator.tokens
    for bundle, evaluator in zip(other_bundles, other_evaluators, strict=True):
        evaluator_pair = (reference_evaluator, evaluator)
        tokens.intersection_update(
            _shared_tokens((reference, bundle), evaluator_pair, common=common)
        )
        scenarios = dict.fromkeys(map(scenario_of, sorted(tokens)))
        _check_truth(reference, bundle, list(scenarios))
    return evaluators, sorted(tokens)


def _check_rules(bundle: Bundle, other: Bundle) -> None:
    """Raise EvaluationError if two bundles were evaluated under different rules."""
    task = bundle.setup.task
    other_task = other.setup.task
    if task != other_task:
        raise EvaluationError(
            f"{bundle.folder} is an evaluation of the task {task}, and {other.folder} is an "
            f"evaluation of the task {other_task}; compare two evaluations of the same task"
        )
    rules = _read_rules(bundle)
    other_rules = _read_rules(other)
    cells = _read_cells(bundle)
    other_cells = _read_cells(other)
    if cells and other_cells:
        rules["cells"] = cells
        other_rules["cells"] = other_cells
    differences = list(find_differences(rules, other_rules))
    if not differences:
        return
    texts = []
    for path, value, other_value in differences[:_MAX_LISTED]:
        values = f"{shortened(repr(value))} and {shortened(repr(other_value))}"
        texts.append(f"{shortened(path)} {values}")
    hidden_count = len(differences) - _MAX_LISTED
    more = ""
    if hidden_count > 0:
        more = f", and {hidden_count} more"
    raise EvaluationError(
        f"{bundle.folder} and {other.folder}: were not evaluated by the same rules: "
        f"{'; '.join(texts)}{more}; evaluate both in the same way"
    )


def _read_rules(bundle: Bundle) -> NamedValues:
    """Return the rules of an evaluation, under the keys that they have in the summary."""
    return {name: bundle.summary.get(name) for name in _SETUP_KEYS}


def _read_cells(bundle: Bundle) -> NamedValues:
    """Return a description of the cells of motion results; empty for other results.

    The orientation of the maps is left out, since it does not affect the numbers.
    """
    form = bundle.summary["results"]["form"] or {}
    cells = {}
    for name in ("x", "y", "step"):
        if name in form:
            cells[name] = str(form[name])
    return cells


def _check_truth(bundle: Bundle, other: Bundle, scenarios: list[str]) -> None:
    """Raise EvaluationError if files of the scenarios differ between two bundles' releases."""
    hashes = bundle.scenarios()
    other_hashes = other.scenarios()
    changed = []
    for name in scenarios:
        if name not in hashes or not hashes[name].is_like(other_hashes.get(name)):
            changed.append(name)
    if changed:
        raise EvaluationError(
            f"{bundle.folder} and {other.folder}: the label, meta or calib files differ in "
            f"{counted(len(changed), 'scenario')} ({', '.join(_shorten(changed))}); evaluate "
            "both results with the same release"
        )


def _shared_tokens(
    bundles: tuple[Bundle, Bundle],
    evaluators: tuple[Evaluator[Any], Evaluator[Any]],
    *,
    common: bool,
) -> list[str]:
    """Return the tokens that two bundles have in common.

    Raise EvaluationError if there are none, or if the samples differ and `common` is False.
    """
    tokens = evaluators[0].tokens
    other_tokens = evaluators[1].tokens
    if tokens != other_tokens and not common:
        extra_tokens = (tokens - other_tokens, other_tokens - tokens)
        texts = []
        for bundle, extra in zip(bundles, extra_tokens, strict=True):
            if extra:
                names = ", ".join(_shorten(sorted(extra)))
                samples = counted(len(extra), "sample")
                texts.append(f"{samples} only in {bundle.folder} ({names})")
        raise EvaluationError(
            f"{'; '.join(texts)}; evaluate both at the same samples, or compare those that both "
            "have with common=True (--common)"
        )
    shared = sorted(tokens & other_tokens)
    if not shared:
        raise EvaluationError(
            f"{bundles[0].folder} and {bundles[1].folder}: have no sample in common"
        )
    return shared


def _shorten(names: list[str]) -> Iterator[str]:
    """Yield the first names, followed by an ellipsis if there are more."""
    yield from map(shortened, names[:_MAX_LISTED])
    if len(names) > _MAX_LISTED:
        yield "…"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Swaps:
    """S swaps of C clusters between two runs.

    Attributes:
        swapped: (S, C) bool, True if the swap exchanges the counts of the cluster. The first
            cluster is never exchanged, since exchanging the complementary clusters leads to the
            same differences with the opposite sign.
        complete: Whether these are all possible swaps; otherwise they are drawn at random.
    """

    swapped: BoolArray
    complete: bool

    @property
    def least_p(self) -> float:
        """The smallest possible p."""
        swap_count = len(self.swapped)
        if not self.complete:
            swap_count += 1  # the observed assignment
        return 1 / swap_count


def swaps_of(clusters: int, resampling: Resampling) -> Swaps:
    """Generate all 2ⁿ⁻¹ swaps of n clusters, or only `resamples` random swaps if fewer."""
    swap_count = 2 ** max(clusters - 1, 0)
    is_complete = swap_count <= resampling.resamples
    if is_complete:
        numbers = np.arange(swap_count)[:, None] << 1  # bit 0, the first cluster, is never set
        bits = numbers >> np.arange(clusters) & 1
    else:
        generator = np.random.default_rng(resampling.seed)
        bits = generator.integers(2, size=(resampling.resamples, clusters))
    return Swaps(swapped=bits == 1, complete=is_complete)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairedTest:
    """Differences between two runs in M numbers, and their uncertainty.

    Attributes:
        differences: (M,) second − first; NaN if one run has nothing to count.
        low: (M,) lower ends of the intervals of the true differences; NaN if there is no interval
            (see `intervals.interval_ends`).
        high: (M,) upper ends of the intervals; NaN if there is no interval.
        errors: (M,) standard errors; NaN if unknown.
        p: (M,) two-sided p of each number by itself; NaN if there is no difference or there are no
            resamples.
        swaps: Swaps on which p is based.
        clusters: Number of clusters.
        resampling: Settings of the intervals and tests.
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
    """Test the differences between two runs that count the same clusters.

    Args:
        evaluator: Evaluator of the counts.
        runs: Clusters of the first and of the second run, in the same order.
        differences: Path of a number → second − first.
        resampling: Settings of the intervals and tests.
    """
    if not evaluator.has_intervals:
        resampling = replace(resampling, resamples=0)
    names = list(differences)
    observed = np.array([*differences.values()])
    low, high, errors, p = np.full((4, len(names)), math.nan)
    is_changed = [cluster != other for cluster, other in zip(*runs, strict=True)]
    swaps = swaps_of(sum(is_changed), resampling)
    if resampling.resamples:
        changed_first = np.argsort(np.logical_not(is_changed), kind="stable")
        ordered_runs = []
        for run in runs:
            ordered_runs.append([run[index] for index in changed_first])
        swapped = swapped_differences(evaluator, ordered_runs, swaps, names)
        p = p_values(observed, swapped, swaps)
    if resampling.resamples and len(is_changed) > 1:
        low, high, errors = difference_intervals(evaluator, runs, differences, resampling)
    without_interval = [not has_interval(name) for name in names]
    for column in (low, high, errors):
        column[without_interval] = math.nan
    return PairedTest(
        differences=observed,
        low=low,
        high=high,
        errors=errors,
        p=p,
        swaps=swaps,
        clusters=len(is_changed),
        resampling=resampling,
    )


def swapped_differences(
    evaluator: Evaluator[Any], pairs: Sequence[Clusters], swaps: Swaps, names: Sequence[str]
) -> FloatArray:
    """Compute the differences second − first of M numbers after each of S swaps, shape (S, M).

    A difference is NaN if one of the runs has nothing to count.

    Args:
        evaluator: Evaluator of the counts.
        pairs: Clusters of the first and of the second run. The C clusters that can be swapped come
            first.
        swaps: S swaps of these C clusters.
        names: Paths of the M numbers.
    """
    first, second = pairs
    swap_count, cluster_count = swaps.swapped.shape
    unswapped = np.zeros((swap_count, len(first) - cluster_count), dtype=bool)
    swapped = np.hstack([swaps.swapped, unswapped])
    parts = [*first, *second]
    draws_a = np.hstack((~swapped, swapped)).astype(np.int64)
    numbers_a = numbers_of_draws(evaluator, parts, draws_a, names)
    draws_b = np.hstack((swapped, ~swapped)).astype(np.int64)
    numbers_b = numbers_of_draws(evaluator, parts, draws_b, names)
    return numbers_b - numbers_a


def p_values(differences: FloatArray, swapped: FloatArray, swaps: Swaps) -> FloatArray:
    """Compute the two-sided p of each difference.

    It is the share of swaps, including the observed assignment, with at least the observed
    difference. If swaps are random, only half of those with exactly the observed difference count,
    unless no swap has a larger one. Such ties are frequent if a number changes in few clusters, and
    counting all of them would make the test far too strict.

    Args:
        differences: (M,) observed differences; p is NaN where they are NaN.
        swapped: (S, M) differences after the swaps; NaN counts as a larger difference.
        swaps: Swaps that lead to `swapped`.
    """
    observed = np.abs(differences)
    resampled = np.abs(swapped)
    with np.errstate(invalid="ignore"):
        is_more = ~(resampled <= observed * (1 + _RELATIVE_TOLERANCE))
        is_less = resampled < observed * (1 - _RELATIVE_TOLERANCE)
    more = is_more.sum(axis=0)
    less = is_less.sum(axis=0)
    if swaps.complete:
        hits = len(swapped) - less
    else:
        ties = len(swapped) - more - less
        counts_all_ties = (more == 0) | (observed == 0)
        hits = 1 + more + np.where(counts_all_ties, ties, ties / 2)
    return np.where(np.isnan(differences), math.nan, hits * swaps.least_p)


def holm(p: FloatArray) -> FloatArray:
    """Adjust p values (M,) by Holm's rule.

    If differences with an adjusted p below a level are called real, the probability that any of
    them is not real is at most that level.
    """
    order = np.argsort(p)
    scaled = p[order] * np.arange(len(p), 0, -1)
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(scaled), 1)
    return adjusted


def undecided_text(test: PairedTest, index: int, test_count: int, scenarios: int) -> str:
    """Explain why a difference is not decided, and how many scenarios would decide it.

    Args:
        test: Test of the differences.
        index: Index of the number.
        test_count: Number of differences that are tested together.
        scenarios: Number of scenarios in both evaluations.
    """
    difference = abs(float(test.differences[index]))
    level = (1 - test.resampling.confidence) / test_count
    if math.isnan(difference):
        return "nothing to compare"
    if difference == 0:
        return "equal"
    if not test.resampling.resamples:
        return "not tested: there are no resamples"
    if test.swaps.least_p > level:
        return f"{_IMPOSSIBLE} {_too_few_text(test, level)} are needed"
    from scipy.special import ndtri

    quantiles = ndtri(1 - level / 2) + ndtri(_POWER)
    deviations = float(test.errors[index]) / difference * quantiles
    if not deviations > 0:
        return "inconclusive"
    scenario_count = _rounded_up(max(deviations**2, 1) * scenarios)
    return f"inconclusive (would need about {scenario_count} scenarios)"


def _too_few_text(test: PairedTest, level: float) -> str:
    """Say how many resamples or clusters there are, and how many a decision at a level needs."""
    if not test.swaps.complete:
        return f"{len(test.swaps.swapped)} resamples; at least {math.ceil(1 / level) - 1}"
    changed_count = test.swaps.swapped.shape[1]
    min_count = 1 + math.ceil(-math.log2(level))
    if changed_count == test.clusters:
        return f"{changed_count} cluster{'s' * (changed_count != 1)}; at least {min_count}"
    return (
        f"{changed_count} of {test.clusters} clusters in which the two differ; at least {min_count}"
    )


def _rounded_up(count: float) -> str:
    """Format a count, rounded up to two digits: `130`, `1,300`."""
    digits = math.floor(math.log10(count))
    unit = 10 ** max(digits - 1, 0)
    rounded = math.ceil(count / unit) * unit
    return f"{rounded:,}"
