"""`compare_bundles`: two evaluations side by side, and which of their differences are real.

The tests are fixed beforehand: the task's first headline is tested by itself, the other headlines
together by Holm's rule. If both evaluations are equally good, it is chance which of them has which
counts of a cluster (an accident and its twin). A paired permutation test swaps the counts of some
clusters and asks how often the two then differ as much. So clusters that are hard for both do not
hide a difference.
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
from deepaccident_devkit.evaluation.runs.verification import find_differences
from deepaccident_devkit.evaluation.task import Headline, headlines, plain
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, ShortRepr, known
from deepaccident_devkit.support.reports import Report, Row, record_rows
from deepaccident_devkit.support.text import columns_text, counted, path_of

# How a number is tested: by itself, with all other headlines, or not at all.
Family = Literal["main", "headlines", "other"]
# Keys of a summary that both evaluations must have in common.
_SETUP_KEYS: Final = ("task", "protocol", "switches", "horizon", "settings")
# Number of differing rules, and of names, that an error lists.
_MAX_LISTED: Final = 3
# Differences that differ by at most this share of them count as equal.
_RELATIVE_TOLERANCE: Final = 1e-9
_IMPOSSIBLE: Final = "no decision is possible with"
# Stands for that text in a table, which explains it below.
_TOO_FEW: Final = "too few"
# Chance that the stated number of scenarios decides a difference.
_POWER: Final = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedNumber(ShortRepr):
    """A number of both results.

    Attributes:
        number: Path in the result, such as `ranges/30x30/iou`.
        headline: Short name, if it is one of the task's headlines; otherwise None.
        unit: Unit of a headline; otherwise None.
        a: Value of the first; None where it has nothing to count.
        b: Value of the second; likewise.
        difference: b − a; None if either is None.
        low: Lower end of the interval of the true difference; None for no interval.
        high: Upper end.
        family: `main` for the task's first headline, which is tested by itself; `headlines` for the
            others, which are tested together; `other` for numbers for exploration, which are not
            tested.
        p: p of the paired permutation test of this number by itself; None without difference or
            resamples.
        adjusted_p: The same by Holm's rule over the headlines; equal to p for other numbers.
        real: Whether the adjusted p is at most 1 − confidence; False for numbers that are not
            tested.
        better: `a` or `b`, if a difference is real and it is known whether more is better;
            otherwise None.
        decision: Text for readers: `b is better`, or why nothing is decided, and how many scenarios
            would decide it.
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
        a: Folder of the first.
        b: Folder of the second.
        task: Task of both.
        protocol: Protocol of both.
        samples: Number of samples compared.
        scenarios: Number of their scenarios.
        clusters: Number of their clusters, where an accident and its twin are one.
        left_out: Number of samples that only one of them has.
        partial: Marks of the evaluations that are partial themselves.
        resampling: How differences were tested.
        swaps: Number of swaps of the two runs' counts, cluster by cluster, that p is a share of.
        all_swaps: Whether these are all possible swaps (apart from the sign); otherwise they are
            random.
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

    def to_text(self) -> str:
        """Return a table of the headlines, how many other numbers differ, and how to read it."""
        samples, scenarios = counted(self.samples, "sample"), counted(self.scenarios, "scenario")
        head = [
            f"{self.task}, protocol {self.protocol}: {samples} of {scenarios}",
            f"clusters: {self.clusters} (an accident and its twin are one)",
            f"a: {self.a}",
            f"b: {self.b}",
            *self.partial,
        ]
        if self.left_out:
            head.append(f"a, b: only the samples that both have; {self.left_out} left out")
        interval_title = f"{self.resampling.confidence:.0%} interval"
        rows: list[Sequence[str]] = [("number", "a", "b", "b − a", interval_title, "p", "decision")]
        explanations: list[str] = []
        for number in self.numbers:
            if not number.headline:
                continue
            rows.append(text_row(number))
            if number.decision.startswith(_IMPOSSIBLE):
                explanations = [f"{_TOO_FEW}: {number.decision}"]
        # the first headline is tested by itself and needs fewer clusters, so the last explanation
        # stays
        return "\n".join([*head, "", columns_text(rows), "", *explanations, *self.notes()])

    def notes(self) -> list[str]:
        """Return notes for readers of the table."""
        if not self.resampling.resamples:
            return ["no intervals and no tests: no resamples were asked for"]
        level = 1 - self.resampling.confidence
        main = next((number.headline for number in self.numbers if number.family == "main"), None)
        drawn = f"all {self.swaps:,}" if self.all_swaps else f"{self.swaps:,} random"
        notes = [
            (
                f"p: share of {drawn} swaps of clusters between a and b after which they differ at "
                "least as much"
            ),
            (
                f"tested at {level:.0%}: {main}; and the other headlines together, whose p is "
                "adjusted by Holm's rule"
            ),
            (
                "scenarios that would decide: with a chance of 80 %, if the true difference is the "
                "observed one"
            ),
        ]
        p_values = [number.p for number in self.numbers if number.family == "other"]
        tested = [p for p in p_values if p is not None]
        if tested:
            low = sum(p <= level for p in tested)
            notes.append(
                f"for exploration: {low} of {len(tested)} other numbers have a p of at most "
                f"{level:.0%}; between equally good runs about {level * len(tested):.1f} would, by "
                "chance"
            )
        return notes

    def to_dict(self) -> dict[str, Any]:
        """Return all values in JSON form."""
        values = asdict(self) | {"a": os.fspath(self.a), "b": os.fspath(self.b)}
        payload: dict[str, Any] = plain(values)
        return payload | {"notes": self.notes()}

    def named_tables(self) -> dict[str, list[Row]]:
        """Return a table with a row for each number."""
        return {"numbers": record_rows(ComparedNumber, self.numbers)}


def text_row(number: ComparedNumber) -> tuple[str, ...]:
    """Return the cells of a number's row."""
    unit = ""
    if number.unit and number.unit != "share":
        unit = f" ({number.unit})"
    interval = "–"
    if number.low is not None and number.high is not None:
        interval = f"[{number.low:+.3f}, {number.high:+.3f}]"
    is_impossible = number.decision.startswith(_IMPOSSIBLE)
    return (
        f"{number.headline}{unit}",
        _number_text(number.a),
        _number_text(number.b),
        "–" if number.difference is None else f"{number.difference:+.3f}",
        interval,
        _number_text(number.adjusted_p),
        _TOO_FEW if is_impossible else number.decision,
    )


def _number_text(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.3f}"


def compare_bundles(
    a: str | os.PathLike[str],
    b: str | os.PathLike[str],
    resampling: Resampling | None = None,
    *,
    common: bool = False,
) -> Comparison:
    """Compare two bundles' numbers; the release and the results are not needed.

    Args:
        a: Folder of the first, as written by `save_run`.
        b: Folder of the second.
        resampling: How differences are tested; None for the defaults.
        common: Whether to compare only the samples that both have, if they differ.

    Raises:
        ResultsError: one of them is no bundle.
        EvaluationError: they differ in task, rules, labels or samples, or were made by another
            devkit.
    """
    resampling = resampling or Resampling()
    bundles = read_bundle(path_of(a)), read_bundle(path_of(b))
    evaluators, tokens = comparable(bundles, common=common)
    scenarios = list(dict.fromkeys(map(scenario_of, tokens)))
    setup = bundles[0].setup
    results = [evaluator.compute(tokens) for evaluator in evaluators]
    headlines_by_path = {line.path: line for result in results for line in headlines(result)}
    numbers_a, numbers_b = map(numbers_of, results)
    all_paths = {**numbers_a, **numbers_b}
    headline_paths = [path for path in headlines_by_path if path in all_paths]
    paths = list(dict.fromkeys([*headline_paths, *all_paths]))
    values_a = [numbers_a.get(path, math.nan) for path in paths]
    values_b = [numbers_b.get(path, math.nan) for path in paths]
    values = np.array([values_a, values_b])
    cluster_names = {token: cluster_of(scenario_of(token)) for token in tokens}
    clusters = evaluators[0].clustered(cluster_names), evaluators[1].clustered(cluster_names)
    differences = dict(zip(paths, values[1] - values[0], strict=True))
    test = paired_test(evaluators[0], clusters, differences, resampling)
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
        left_out=len(evaluators[0].tokens ^ evaluators[1].tokens),
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
    """Return the M numbers with their tests; values (2, M) of the first and the second."""
    main = next(iter(headlines_by_path), None)
    families = [_family(path, main, headlines_by_path) for path in paths]
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
        better = _better(test.differences[index], headline) if is_real else None
        if family == "other":
            decision = "for exploration"
        elif is_real:
            decision = f"{better} is better" if better else "they differ"
        else:
            decision = undecided_text(test, index, test_counts[family], scenarios)
        numbers.append(
            ComparedNumber(
                number=path,
                headline=None if headline is None else headline.name,
                unit=None if headline is None else headline.unit,
                a=known(values[0, index]),
                b=known(values[1, index]),
                difference=known(test.differences[index]),
                low=known(test.low[index]),
                high=known(test.high[index]),
                family=family,
                p=known(test.p[index]),
                adjusted_p=known(adjusted[index]),
                real=is_real,
                better=better,
                decision=decision,
            )
        )
    return tuple(numbers)


def _family(path: str, main: str | None, headlines_by_path: Mapping[str, Headline]) -> Family:
    if path == main:
        return "main"
    if path in headlines_by_path:
        return "headlines"
    return "other"


def _better(difference: float, headline: Headline | None) -> str | None:
    if headline is None or headline.higher_is_better is None:
        return None
    if (difference > 0) == headline.higher_is_better:
        return "b"
    return "a"


def comparable(
    bundles: Sequence[Bundle], *, common: bool
) -> tuple[list[Evaluator[Any]], list[str]]:
    """Return the counts of bundles, and the samples that all of them have.

    Arguments and errors are the same as for `compare_bundles`.
    """
    reference = bundles[0]
    for bundle in bundles[1:]:
        _check_rules(reference, bundle)
    evaluators = [bundle.evaluator() for bundle in bundles]
    tokens = set(evaluators[0].tokens)
    for bundle, evaluator in zip(bundles[1:], evaluators[1:], strict=True):
        tokens &= set(
            _shared_tokens((reference, bundle), (evaluators[0], evaluator), common=common)
        )
        scenarios = dict.fromkeys(map(scenario_of, sorted(tokens)))
        _check_truth(reference, bundle, list(scenarios))
    return evaluators, sorted(tokens)


def _check_rules(bundle: Bundle, other: Bundle) -> None:
    """Raise EvaluationError if two bundles were evaluated by different rules."""
    task, other_task = bundle.setup.task, other.setup.task
    if task != other_task:
        raise EvaluationError(
            f"{bundle.folder} is an evaluation of the task {task}, {other.folder} one of "
            f"{other_task}; compare two of the same task"
        )
    rules, other_rules = _rules(bundle), _rules(other)
    cells, other_cells = _cells(bundle), _cells(other)
    if cells and other_cells:
        rules["cells"], other_rules["cells"] = cells, other_cells
    differences = list(find_differences(rules, other_rules))
    if not differences:
        return
    texts = []
    for path, value, other_value in differences[:_MAX_LISTED]:
        values = f"{shortened(repr(value))} and {shortened(repr(other_value))}"
        texts.append(f"{shortened(path)} {values}")
    hidden = len(differences) - _MAX_LISTED
    more = ""
    if hidden > 0:
        more = f", and {hidden} more"
    raise EvaluationError(
        f"{bundle.folder} and {other.folder}: were not evaluated by the same rules: "
        f"{'; '.join(texts)}{more}; evaluate both in the same way"
    )


def _rules(bundle: Bundle) -> dict[str, Any]:
    return {name: bundle.summary.get(name) for name in _SETUP_KEYS}


def _cells(bundle: Bundle) -> dict[str, Any]:
    """Return the cells of motion results; empty for other results.

    The orientation of maps is left out, since it changes no number.
    """
    form = bundle.summary["results"]["form"] or {}
    return {name: str(form[name]) for name in ("x", "y", "step") if name in form}


def _check_truth(bundle: Bundle, other: Bundle, scenarios: list[str]) -> None:
    """Raise EvaluationError if files of scenarios differ between two bundles' releases."""
    hashes, other_hashes = bundle.scenarios(), other.scenarios()
    changed = []
    for name in scenarios:
        if name not in hashes or not hashes[name].is_like(other_hashes.get(name)):
            changed.append(name)
    if changed:
        raise EvaluationError(
            f"{bundle.folder} and {other.folder}: the label, meta or calib files of {len(changed)} "
            f"scenarios are not the same ({', '.join(_shorten(changed))}); evaluate both results "
            "with the same release"
        )


def _shared_tokens(
    bundles: tuple[Bundle, Bundle],
    evaluators: tuple[Evaluator[Any], Evaluator[Any]],
    *,
    common: bool,
) -> list[str]:
    """Return the samples of both; raises EvaluationError without any, or if samples differ."""
    tokens, other_tokens = evaluators[0].tokens, evaluators[1].tokens
    if tokens != other_tokens and not common:
        unmatched = (tokens - other_tokens, other_tokens - tokens)
        texts = []
        for bundle, extra in zip(bundles, unmatched, strict=True):
            if extra:
                texts.append(
                    f"{counted(len(extra), 'sample')} only in {bundle.folder} "
                    f"({', '.join(_shorten(sorted(extra)))})"
                )
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
    """Yield the first names, and dots for the others."""
    yield from map(shortened, names[:_MAX_LISTED])
    if len(names) > _MAX_LISTED:
        yield "…"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Swaps:
    """Swaps of clusters between two runs.

    Attributes:
        swapped: Whether a swap exchanges a cluster, shape (S, C) for S swaps of C clusters. It has
            the half of all swaps that leave the first cluster unchanged: the other half swaps the
            complement, and gives the same differences with the opposite sign.
        complete: Whether these are all such swaps; otherwise they are drawn at random.
    """

    swapped: BoolArray
    complete: bool

    @property
    def least_p(self) -> float:
        """The smallest possible p."""
        return 1 / (len(self.swapped) + (not self.complete))


def swaps_of(clusters: int, resampling: Resampling) -> Swaps:
    """Return all 2ⁿ⁻¹ swaps of n clusters, or `resamples` random ones if there are more."""
    swap_count = 2 ** max(clusters - 1, 0)
    if swap_count <= resampling.resamples:
        numbers = np.arange(swap_count)[:, None]
        return Swaps(swapped=(numbers << 1) >> np.arange(clusters) & 1 == 1, complete=True)
    source = np.random.default_rng(resampling.seed)
    bits = source.integers(2, size=(resampling.resamples, clusters))
    return Swaps(swapped=bits == 1, complete=False)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairedTest:
    """Differences of M numbers of two runs, and their uncertainty.

    Attributes:
        differences: Second − first, shape (M,); NaN where one of them has nothing to count.
        low: Lower end of the interval of the true difference, shape (M,); NaN for no interval (see
            `intervals.interval_ends`).
        high: Upper end, shape (M,).
        errors: Standard errors, shape (M,); NaN where unknown.
        p: Two-sided p of each number by itself, shape (M,); NaN without a difference, or without
            resamples.
        swaps: Swaps that p is a share of.
        clusters: Number of clusters.
        resampling: How the differences were tested.
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
    """Test the differences of two runs' counts of the same clusters.

    Args:
        evaluator: Evaluator of the counts.
        runs: Clusters of the first and the second run.
        differences: Path of a number → second − first.
        resampling: How differences are tested.
    """
    resampling = resampling if evaluator.has_intervals else replace(resampling, resamples=0)
    names, observed = list(differences), np.array(list(differences.values()))
    low, high, errors, p = (np.full(len(names), math.nan) for _ in range(4))
    is_changed = [cluster != other for cluster, other in zip(*runs, strict=True)]
    swaps = swaps_of(sum(is_changed), resampling)
    if resampling.resamples:
        changed_first = np.argsort(np.logical_not(is_changed), kind="stable")
        ordered = [[run[index] for index in changed_first] for run in runs]
        p = p_values(observed, swapped_differences(evaluator, ordered, swaps, names), swaps)
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
    """Return the differences second − first of M numbers after each of S swaps, shape (S, M).

    The swaps are of the first clusters of the pairs. Differences are NaN where there is none.
    """
    first, second = pairs
    fixed = np.zeros((len(swaps.swapped), len(first) - swaps.swapped.shape[1]), dtype=bool)
    swapped = np.hstack([swaps.swapped, fixed])
    parts = [*first, *second]
    draws_a = np.hstack((~swapped, swapped)).astype(np.int64)
    numbers_a = numbers_of_draws(evaluator, parts, draws_a, names)
    draws_b = np.hstack((swapped, ~swapped)).astype(np.int64)
    numbers_b = numbers_of_draws(evaluator, parts, draws_b, names)
    return numbers_b - numbers_a


def p_values(differences: FloatArray, swapped: FloatArray, swaps: Swaps) -> FloatArray:
    """Return the two-sided p of each difference.

    It is the share of swaps, the observed one included, that differ as much or more. Of random
    swaps only half of the equal ones count, unless none differ more: such ties are many
    where a number changes in few clusters, and counting all would make the test far too strict.

    Args:
        differences: Observed differences, shape (M,); the p of NaN is NaN.
        swapped: Differences after the swaps, shape (S, M); NaN counts as more.
        swaps: The swaps.
    """
    observed, resampled = np.abs(differences), np.abs(swapped)
    with np.errstate(invalid="ignore"):
        more = (~(resampled <= observed * (1 + _RELATIVE_TOLERANCE))).sum(axis=0)
        less = (resampled < observed * (1 - _RELATIVE_TOLERANCE)).sum(axis=0)
    if swaps.complete:
        hits = len(swapped) - less
    else:
        ties = len(swapped) - more - less
        hits = 1 + more + np.where((more == 0) | (observed == 0), ties, ties / 2)
    return np.where(np.isnan(differences), math.nan, hits * swaps.least_p)


def holm(p: FloatArray) -> FloatArray:
    """Return p (M,) adjusted by Holm's rule.

    If differences with an adjusted p below a level are called real, the chance that any of them is
    false is at most that level.
    """
    order = np.argsort(p)
    scaled = p[order] * np.arange(len(p), 0, -1)
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(scaled), 1)
    return adjusted


def undecided_text(test: PairedTest, index: int, test_count: int, scenarios: int) -> str:
    """Return why a difference is not real, and how many scenarios would decide it.

    Args:
        test: The test.
        index: Index of the number.
        test_count: Number of differences that are tested together.
        scenarios: Number of scenarios tested.
    """
    difference = abs(float(test.differences[index]))
    level = (1 - test.resampling.confidence) / test_count
    if math.isnan(difference):
        return "nothing to compare"
    if difference == 0:
        return "the difference is 0"
    if not test.resampling.resamples:
        return "not tested: no resamples were asked for, or the protocol has none"
    if test.swaps.least_p > level:
        return f"{_IMPOSSIBLE} {_too_few_text(test, level)} are needed"
    from scipy.special import ndtri

    quantiles = ndtri(1 - level / 2) + ndtri(_POWER)
    deviations = float(test.errors[index]) / difference * quantiles
    if not deviations > 0:
        return "not decided"
    scenario_count = _rounded_up(max(deviations**2, 1) * scenarios)
    return f"not decided: about {scenario_count} scenarios would decide it"


def _too_few_text(test: PairedTest, level: float) -> str:
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
    """Return a count rounded up to two digits: `130`, `1,300`."""
    unit = 10 ** max(math.floor(math.log10(count)) - 1, 0)
    return f"{math.ceil(count / unit) * unit:,}"
