"""Intervals of any evaluator's numbers, from their changes when a cluster is left out (jackknife).

A cluster is an accident with its twin (`breakdowns.cluster_of`): its samples show the same junction
and traffic, so the certainty of a number depends on the number of clusters, not of samples.
docs/numbers.md, Intervals, has the formulas; `python -m benchmarks coverage` measures their
coverage.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from fnmatch import fnmatchcase
from typing import Any, Final

import numpy as np

from deepaccident_devkit.errors import ConfigError, shortened
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.task import LIMITS, Row
from deepaccident_devkit.support.arrays import FloatArray, IntArray, as_floats

# The default, to evaluate and to compare, in the library and on the command line.
RESAMPLES: Final = 1000
MOST_RESAMPLES: Final = 100_000
# Fewer have no interval, since its coverage would be too low; and no test at 5 % can decide with
# fewer.
LEAST_CLUSTERS: Final = 6
# Largest number of parts, to which more clusters are joined: it costs less, and t hardly changes
# from 99 degrees of freedom on.
_MAX_PARTS: Final = 100
# Changes below this share of a number (or of its range) come from rounding.
_ROUNDING_SHARE: Final = 1e-9
# Number of numbers that a note lists by name.
_MAX_LISTED_NAMES: Final = 3
# Totals, settings, and medians, which jump when a cluster is left out: the jackknife does not hold
# for them.
_PATHS_WITHOUT_INTERVAL: Final = (
    "false_recordings",
    *("within/*/distance", "threshold", "best_f1", "quiet", "quiet_braking"),
    "median_*",
)
# The counts of each cluster's samples.
Clusters = Sequence[Sequence[Counts]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Resampling:
    """The settings of intervals, and of the test of two runs' difference.

    Attributes:
        resamples: Largest number of resamples for intervals and tests; 0 for no intervals and no
            tests. Numbers are computed again with a cluster left out for intervals (at most 100
            times), with clusters swapped between two runs for a test.
        confidence: Share of such intervals that should hold the true number; tests are at 1 −
            confidence.
        seed: Seed of the random choice of clusters or swaps, if there are more than are used.
    """

    resamples: int = RESAMPLES
    confidence: float = 0.95
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the values; raises ConfigError."""
        if type(self.resamples) is not int or not 0 <= self.resamples <= MOST_RESAMPLES:
            expected = f"a whole number from 0 to {MOST_RESAMPLES:,}"
            raise ConfigError(
                f"resamples: expected {expected}, found {shortened(repr(self.resamples))}"
            )
        if type(self.seed) is not int or self.seed < 0:
            raise ConfigError(
                f"seed: expected a whole number from 0, found {shortened(repr(self.seed))}"
            )
        if not 0 < self.confidence < 1:
            raise ConfigError(
                "confidence: expected a share between 0 and 1, such as 0.95, found "
                f"{self.confidence!r}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Intervals:
    """Intervals of a result's numbers.

    Attributes:
        ends: Path of a number → (low, high); numbers without an interval are missing.
        notes: Sentences on the numbers without an interval, and why.
    """

    ends: Mapping[str, tuple[float, float]]
    notes: tuple[str, ...]


def intervals_of(
    evaluator: Evaluator[Any],
    clusters: Clusters,
    result: object,
    resampling: Resampling | None = None,
) -> Intervals:
    """Return the intervals of the numbers of a result.

    Args:
        evaluator: Evaluator of the result.
        clusters: Counts of each cluster, always in the same order.
        result: Result of all of them together.
        resampling: Settings; None for the defaults.
    """
    settings = resampling or Resampling()
    if not settings.resamples:
        return Intervals(ends={}, notes=())
    if not evaluator.has_intervals:
        return Intervals(ends={}, notes=("no intervals: this protocol has none",))
    if len(clusters) < LEAST_CLUSTERS:
        return Intervals(ends={}, notes=(f"no intervals: {few_clusters(len(clusters))}",))
    numbers = {}
    for name, number in numbers_of(result).items():
        if math.isfinite(number) and has_interval(name):
            numbers[name] = number
    names = list(numbers)
    values = np.array(list(numbers.values()))
    drawn = draws_of_parts(evaluator, clusters, names, settings)
    rows = evaluator.result_class.rows
    low, high, having = ends_of_draws(names, values, drawn, settings.confidence, rows)
    ends: dict[str, tuple[float, float]] = {}
    without: dict[str, int] = {}
    for index, name in enumerate(names):
        if np.isfinite(low[index]):
            ends[name] = float(low[index]), float(high[index])
        else:
            without[name] = int(having[index])
    return Intervals(ends=ends, notes=tuple(_notes(without)))


def difference_intervals(
    evaluator: Evaluator[Any],
    pair: tuple[Clusters, Clusters],
    differences: Mapping[str, float],
    resampling: Resampling,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return intervals of the differences between two sets of counts of the same clusters.

    The same clusters are left out of both sets.

    Args:
        evaluator: Evaluator of these counts.
        pair: For each set the counts of the same clusters, in the same order.
        differences: Path of a number → second − first, from all clusters together.
        resampling: Settings.

    Returns:
        Low and high ends, (M,) each, NaN for none (`interval_ends`), and standard errors, (M,).
    """
    values = np.array(list(differences.values()))
    first, second = (
        draws_of_parts(evaluator, clusters, differences, resampling) for clusters in pair
    )
    drawn = second - first
    low, high, _ = ends_of_draws(differences, values, drawn, resampling.confidence)
    left_out = np.split(drawn, 2)[1]
    return low, high, standard_errors(values, left_out)[0]


def draws_of_parts(
    evaluator: Evaluator[Any], clusters: Clusters, names: Iterable[str], resampling: Resampling
) -> FloatArray:
    """Return M numbers for each of the P parts of the clusters on its own, then for all but each.

    Returns:
        Numbers, shape (2P, M).
    """
    parts = parts_of(clusters, resampling)
    leave_one_out = leaving_out(len(parts))
    return numbers_of_draws(evaluator, parts, np.vstack([1 - leave_one_out, leave_one_out]), names)


def ends_of_draws(
    names: Iterable[str],
    values: FloatArray,
    drawn: FloatArray,
    confidence: float,
    rows: Sequence[Row] | None = None,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return intervals of numbers from draws.

    Args:
        names: Paths of M numbers.
        values: (M,) numbers of all parts together.
        drawn: (2P, M) draws from `draws_of_parts`.
        confidence: As for `interval_ends`.
        rows: Rows of the result that the numbers are of (`range_of`); None for differences, which
            have no limits.

    Returns:
        Low and high ends, (M,) each (`interval_ends`), and the number of parts that have the number
        at all, (M,).
    """
    single_parts, left_out = np.split(drawn, 2)
    if rows is None:
        ranges = [(-math.inf, math.inf)] * len(values)
    else:
        ranges = [range_of(name, draws, rows) for name, draws in zip(names, drawn.T, strict=True)]
    having = np.isfinite(single_parts).sum(axis=0)
    limits = np.reshape(ranges, (-1, 2))
    low, high = interval_ends(values, left_out, limits, confidence, having)
    return low, high, having


def few_clusters(count: int) -> str:
    """Return half a sentence on fewer clusters than intervals need."""
    return (
        f"of {count} cluster{'s' * (count != 1)} (an accident and its twin are one); at least "
        f"{LEAST_CLUSTERS} are "
        "needed"
    )


def parts_of(clusters: Clusters, resampling: Resampling) -> Clusters:
    """Return the clusters, or many clusters joined at random to as many parts as fit."""
    part_count = min(_MAX_PARTS, max(resampling.resamples, LEAST_CLUSTERS))
    if len(clusters) <= part_count:
        return clusters
    order = np.random.default_rng(resampling.seed).permutation(len(clusters)).tolist()
    parts = []
    for start in range(part_count):
        members = [clusters[index] for index in order[start::part_count]]
        parts.append([counts for cluster in members for counts in cluster])
    return parts


def leaving_out(count: int) -> IntArray:
    """Return draws of P parts, each without one of them, shape (P, P)."""
    return 1 - np.eye(count, dtype=np.int64)


def numbers_of_draws(
    evaluator: Evaluator[Any], parts: Clusters, times: IntArray, names: Iterable[str]
) -> FloatArray:
    """Return M numbers in each of D draws, shape (D, M), NaN for none.

    The draws are made by `Evaluator.resampled`.

    Args:
        evaluator: Evaluator of the counts.
        parts: Counts of P groups of samples.
        times: How often each draw takes each group, shape (D, P).
        names: Paths of the numbers.
    """
    paths = list(names)
    drawn_numbers = evaluator.drawn_numbers(parts, times, paths)
    if drawn_numbers is not None:
        return drawn_numbers
    rows = []
    for result in evaluator.resampled(parts, times):
        numbers = numbers_of(result)
        rows.append([numbers.get(path, math.nan) for path in paths])
    return np.array(rows).reshape(len(rows), len(paths))  # also without names


def standard_errors(values: FloatArray, left_out: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how much numbers vary from one set of clusters to another: the delete-one jackknife.

    Args:
        values: (M,) numbers of all P parts.
        left_out: (P, M) the same numbers without each part.

    Returns:
        (M,) standard errors, NaN where a number depends on a single part; and (M,) degrees of
        freedom of t: one less than the parts that change a number, and fewer where some change it
        much more than others, since such an error is itself uncertain: P / (kurtosis − 1). At
        least 1.
    """
    count = len(left_out)
    changes = left_out - values
    squares = changes**2
    variation = squares.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        excess = count * (squares**2).sum(axis=0) / variation**2 - 1  # kurtosis − 1
        changed = np.count_nonzero(changes, axis=0)
        freedom = np.fmin(changed - 1, count / np.maximum(excess, 0))
    return np.sqrt((count - 1) / count * variation), np.fmax(freedom, 1.0)


def interval_ends(
    values: FloatArray,
    left_out: FloatArray,
    ranges: FloatArray,
    confidence: float,
    having: IntArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return intervals by Student's t.

    Shares have Wilson's intervals, numbers from 0 on intervals of their logarithms, and other
    numbers intervals of the numbers themselves.

    Args:
        values: (M,) numbers of all P parts.
        left_out: (P, M) the same without each part.
        ranges: (M, 2) lowest and highest possible value; infinite for no limit.
        confidence: Share of such intervals that should hold the true number.
        having: (M,) number of parts that have the number at all; None for all.

    Returns:
        (M,) low and (M,) high ends; NaN for numbers that fewer than `LEAST_CLUSTERS` parts have or
        change: shares that are the same in all parts have an interval, other such numbers none.
    """
    from scipy.special import stdtrit

    lowest, highest = ranges.T
    if having is None:
        having = np.full(len(values), len(left_out))
    is_share = np.isfinite(highest)
    width = np.where(np.isfinite(highest - lowest), highest - lowest, np.abs(values))
    errors, freedom = standard_errors(values, left_out)
    is_constant = errors <= _ROUNDING_SHARE * width
    changing_parts = np.count_nonzero(left_out - values, axis=0)
    is_known = np.where(
        is_constant,
        is_share & (having >= LEAST_CLUSTERS),
        changing_parts >= LEAST_CLUSTERS,
    )
    quantile = (1 + confidence) / 2
    t = as_floats(stdtrit(freedom, quantile))
    plain_t = as_floats(stdtrit(np.maximum(having - 1, 1), quantile))
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        share_errors = np.where(is_constant, math.nan, errors / width)
        low_share, high_share = _wilson((values - lowest) / width, share_errors, having, t, plain_t)
        factors = np.exp(t * errors / values)
        kinds = [is_share, lowest == 0]
        low_ends = [lowest + width * low_share, values / factors]
        high_ends = [lowest + width * high_share, values * factors]
        low = np.select(kinds, low_ends, values - t * errors)
        high = np.select(kinds, high_ends, values + t * errors)
    is_known &= np.isfinite(low) & np.isfinite(high)
    return np.where(is_known, low, math.nan), np.where(is_known, high, math.nan)


def _wilson(
    shares: FloatArray, errors: FloatArray, having: IntArray, t: FloatArray, plain_t: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return Wilson's interval of as many independent draws as have these errors.

    NaN as an error counts each part as one draw. What few degrees of freedom add is bounded by one
    draw per part: a share is no less sure than that.
    """
    bounded_shares = np.clip(shares, 0, 1)
    variance = bounded_shares * (1 - bounded_shares)
    by_errors = errors**2 / variance
    by_parts = plain_t**2 / having
    bounded = np.maximum(plain_t**2 * by_errors, np.minimum(t**2 * by_errors, by_parts))
    uncertainty = np.where(np.isnan(errors), by_parts, bounded)
    half = np.sqrt(uncertainty * bounded_shares * (1 - bounded_shares) + uncertainty**2 / 4)
    # the high end is 1 less the low end of the missing share: for a share of 1 it is exactly 1,
    # however numbers are rounded
    low = np.maximum((bounded_shares + uncertainty / 2 - half) / (1 + uncertainty), 0)
    missing_share = 1 - bounded_shares
    missing = np.maximum((missing_share + uncertainty / 2 - half) / (1 + uncertainty), 0)
    return low, 1 - missing


def _notes(having: Mapping[str, int]) -> Iterator[str]:
    """Yield why numbers have no interval.

    Args:
        having: Path of a number → number of parts that have it.
    """
    few = [name for name, count in having.items() if count < LEAST_CLUSTERS]
    alike = [name for name, count in having.items() if count >= LEAST_CLUSTERS]
    if few:
        yield (
            f"no interval of {_listed(few)}: fewer than {LEAST_CLUSTERS} clusters have such a "
            "number"
        )
    if alike:
        yield f"no interval of {_listed(alike)}: fewer than {LEAST_CLUSTERS} clusters change it"


def _listed(names: Sequence[str]) -> str:
    """Return the names of a few numbers, and how many others there are."""
    unlisted = len(names) - _MAX_LISTED_NAMES
    if unlisted <= 0:
        return ", ".join(names)
    return f"{', '.join(names[:_MAX_LISTED_NAMES])} and {unlisted} others"


def numbers_of(result: object) -> dict[str, float]:
    """Return the floats of a result by their path in it: `min_ade`, `ranges/30x30/iou`.

    Whole numbers, texts and None are left out.
    """
    return dict(_numbers(result, ""))


def has_interval(path: str) -> bool:
    """Return whether the jackknife holds for a number: not a total, a setting or a median."""
    return not _is_one_of(path, _PATHS_WITHOUT_INTERVAL)


def range_of(path: str, values: FloatArray, rows: Sequence[Row]) -> tuple[float, float]:
    """Return the lowest and the highest possible value of a number; infinite for no limit.

    Shares are in [0, 1], percents in [0, 100], other numbers with a unit from 0 on, and signed
    numbers have no limit. A number without a row counts as a share if it is in [0, 1] in all draws,
    and otherwise as one that is never below 0 if no draw is.

    Args:
        path: Path of the number.
        values: Numbers in draws of the clusters, shape (D,); NaN where there is nothing to count.
        rows: Rows of the result with patterns as paths; the first that fits the path or its end
            has the unit.
    """
    row = next((row for row in rows if _is_one_of(path, (row.path,))), None)
    if row is not None:
        return (-math.inf, math.inf) if row.is_signed else (0.0, LIMITS.get(row.unit, math.inf))
    finite = values[np.isfinite(values)]
    if finite.min(initial=0.0) < 0:
        return -math.inf, math.inf
    return 0.0, 1.0 if finite.max(initial=0.0) <= 1 else math.inf


def _is_one_of(path: str, patterns: Iterable[str]) -> bool:
    """Return whether a pattern fits the path, or its end, as for the results `beside` others."""
    return any(
        fnmatchcase(path, pattern) or fnmatchcase(path, f"*/{pattern}") for pattern in patterns
    )


def _numbers(value: object, path: str) -> Iterator[tuple[str, float]]:
    """Yield the floats of a value with their paths."""
    parts: Mapping[Any, object] = {}
    if isinstance(value, float):
        yield path, value
    elif is_dataclass(value):
        parts = {field.name: getattr(value, field.name) for field in fields(value)}
    elif isinstance(value, Mapping):
        parts = value
    elif isinstance(value, (list, tuple)):
        parts = dict(enumerate(value))
    for key, part in parts.items():
        name = f"{key:g}" if isinstance(key, float) else str(key)
        yield from _numbers(part, f"{path}/{name}" if path else name)
