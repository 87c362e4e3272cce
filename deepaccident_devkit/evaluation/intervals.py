"""Intervals of any evaluator's numbers, from how much each changes when one cluster is left out (the jackknife).

A cluster is an accident with its twin (`breakdowns.cluster_of`): its samples show the same junction and traffic, so
the number of clusters, not of samples, says how sure a number is. docs/numbers.md, Intervals, has the formulas;
`python -m benchmarks coverage` measures their coverage.
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
# Fewer have no interval, since its coverage would be too low; and no test at 5 % can decide with fewer.
LEAST_CLUSTERS: Final = 6
# More clusters are joined to so many parts: it costs less, and t hardly changes from 99 degrees of freedom on.
_MOST_PARTS: Final = 100
# Changes below this share of a number (or of its range) are of rounding.
_ROUNDING: Final = 1e-9
_NAMED: Final = 3
# The counts of each cluster's samples.
Clusters = Sequence[Sequence[Counts]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Resampling:
    """The settings of intervals, and of the test of two runs' difference.

    Attributes:
        resamples: number of resamples for intervals and tests, at most; 0 for no intervals and no tests. Numbers are
            computed again with a cluster left out for intervals (at most 100 times), with clusters swapped between two
            runs for a test.
        confidence: share of such intervals that should hold the true number; tests are at 1 − confidence.
        seed: of the random choice of clusters or swaps, if there are more than are taken.
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
                f"confidence: expected a share between 0 and 1, such as 0.95, found {self.confidence!r}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Intervals:
    """Intervals of a result's numbers.

    Attributes:
        ends: number, by its path → (low, high); those without an interval are not there.
        notes: sentences that say which numbers have none, and why.
    """

    ends: Mapping[str, tuple[float, float]]
    notes: tuple[str, ...]


def intervals_of(
    evaluator: Evaluator[Any],
    clusters: Clusters,
    result: object,
    resampling: Resampling | None = None,
) -> Intervals:
    """Intervals of the numbers of a result.

    Args:
        evaluator: whose result.
        clusters: the counts of each cluster, always in the same order.
        result: of all of them together.
        resampling: how; None for the defaults.
    """
    chosen = resampling or Resampling()
    if not chosen.resamples:
        return Intervals(ends={}, notes=())
    if not evaluator.has_intervals:
        return Intervals(ends={}, notes=("no intervals: this protocol has none",))
    if len(clusters) < LEAST_CLUSTERS:
        return Intervals(ends={}, notes=(f"no intervals: {few_clusters(len(clusters))}",))
    numbers = {
        name: each
        for name, each in numbers_of(result).items()
        if math.isfinite(each) and has_interval(name)
    }
    names, values = list(numbers), np.array(list(numbers.values()))
    drawn = draws_of_parts(evaluator, clusters, names, chosen)
    low, high, having = ends_of_draws(
        names, values, drawn, chosen.confidence, evaluator.result_class.rows
    )
    found = np.isfinite(low)
    ends = {name: (float(low[at]), float(high[at])) for at, name in enumerate(names) if found[at]}
    without = {name: int(having[at]) for at, name in enumerate(names) if not found[at]}
    return Intervals(ends=ends, notes=tuple(_notes(without)))


def difference_intervals(
    evaluator: Evaluator[Any],
    pair: tuple[Clusters, Clusters],
    differences: Mapping[str, float],
    resampling: Resampling,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Intervals of how two sets of counts of the same clusters differ, the same clusters left out of both.

    Args:
        evaluator: of these counts.
        pair: of each set the counts of the same clusters, in the same order.
        differences: number, by its path → second − first, of all clusters together.
        resampling: how.

    Returns:
        (M,) low and (M,) high ends, NaN for none (`interval_ends`), and (M,) standard errors.
    """
    values = np.array(list(differences.values()))
    first, second = (draws_of_parts(evaluator, each, differences, resampling) for each in pair)
    low, high, _ = ends_of_draws(differences, values, second - first, resampling.confidence)
    return low, high, standard_errors(values, np.split(second - first, 2)[1])[0]


def draws_of_parts(
    evaluator: Evaluator[Any], clusters: Clusters, names: Iterable[str], resampling: Resampling
) -> FloatArray:
    """(2P, M) the numbers of these M names in each of the P parts of the clusters alone, then in all but each."""
    parts = parts_of(clusters, resampling)
    others = leaving_out(len(parts))
    return numbers_of_draws(evaluator, parts, np.vstack([1 - others, others]), names)


def ends_of_draws(
    names: Iterable[str],
    values: FloatArray,
    drawn: FloatArray,
    confidence: float,
    rows: Sequence[Row] | None = None,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Intervals of numbers from draws.

    Args:
        names: the paths of M numbers.
        values: (M,) of all parts together.
        drawn: (2P, M) of `draws_of_parts`.
        confidence: as of `interval_ends`.
        rows: Rows of the result that the numbers are of (`range_of`); None for differences, which have no limits.

    Returns:
        (M,) low and (M,) high ends (`interval_ends`), and (M,) how many parts have the number at all.
    """
    alone, left_out = np.split(drawn, 2)
    if rows is None:
        ranges = [(-math.inf, math.inf)] * len(values)
    else:
        ranges = [range_of(name, draws, rows) for name, draws in zip(names, drawn.T, strict=True)]
    having = np.isfinite(alone).sum(axis=0)
    return *interval_ends(values, left_out, np.reshape(ranges, (-1, 2)), confidence, having), having


def few_clusters(count: int) -> str:
    """Says that there are fewer clusters than intervals need."""
    return (
        f"of {count} cluster{'s' * (count != 1)} (an accident and its twin are one); at least {LEAST_CLUSTERS} are "
        "needed"
    )


def parts_of(clusters: Clusters, resampling: Resampling) -> Clusters:
    """The clusters, or where they are many, some of them joined at random to as many parts as can be left out."""
    most = min(_MOST_PARTS, max(resampling.resamples, LEAST_CLUSTERS))
    if len(clusters) <= most:
        return clusters
    order = np.random.default_rng(resampling.seed).permutation(len(clusters)).tolist()
    return [
        [counts for at in order[first::most] for counts in clusters[at]] for first in range(most)
    ]


def leaving_out(count: int) -> IntArray:
    """(P, P) draws of P parts: each without one of them."""
    return 1 - np.eye(count, dtype=np.int64)


def numbers_of_draws(
    evaluator: Evaluator[Any], parts: Clusters, times: IntArray, names: Iterable[str]
) -> FloatArray:
    """(D, M) the numbers of these M names in each of D draws, as `Evaluator.resampled` makes them; NaN for none."""
    listed = list(names)
    at_once = evaluator.drawn_numbers(parts, times, listed)
    if at_once is not None:
        return at_once
    drawn = (numbers_of(result) for result in evaluator.resampled(parts, times))
    rows = [[numbers.get(name, math.nan) for name in listed] for numbers in drawn]
    return np.array(rows).reshape(len(rows), len(listed))  # of no names, too


def standard_errors(values: FloatArray, left_out: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How much numbers vary from one set of clusters to another: the delete-one jackknife.

    Args:
        values: (M,) of all P parts.
        left_out: (P, M) the same numbers without each part.

    Returns:
        (M,) standard errors, NaN where a number hangs on a single part; and (M,) degrees of freedom of t: one less than
        the parts that change a number, and fewer where some change it much more than others, since such an error is
        itself uncertain: P / (kurtosis − 1). At least 1.
    """
    count, apart = len(left_out), left_out - values
    squares = apart**2
    with np.errstate(invalid="ignore", divide="ignore"):
        unlike = count * (squares**2).sum(axis=0) / squares.sum(axis=0) ** 2 - 1  # kurtosis − 1
        freedom = np.fmin(np.count_nonzero(apart, axis=0) - 1, count / np.maximum(unlike, 0))
    return np.sqrt((count - 1) / count * squares.sum(axis=0)), np.fmax(freedom, 1.0)


def interval_ends(
    values: FloatArray,
    left_out: FloatArray,
    ranges: FloatArray,
    confidence: float,
    having: IntArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Intervals by Student's t: of shares as Wilson's, of numbers from 0 on of their logarithms, of others as they are.

    Args:
        values: (M,) numbers of all P parts.
        left_out: (P, M) the same without each part.
        ranges: (M, 2) the least and the most that each can be; infinite for no limit.
        confidence: share of such intervals that should hold the true number.
        having: (M,) how many parts have the number at all; None for all.

    Returns:
        (M,) low and (M,) high ends; NaN for numbers that fewer than `LEAST_CLUSTERS` parts have or change: shares that
        are the same in all parts have an interval, other such numbers none.
    """
    from scipy.special import stdtrit

    least, most = ranges.T
    having = np.full(len(values), len(left_out)) if having is None else having
    width = np.where(np.isfinite(most - least), most - least, np.abs(values))
    errors, freedom = standard_errors(values, left_out)
    same, share = errors <= _ROUNDING * width, np.isfinite(most)
    known = np.where(
        same,
        share & (having >= LEAST_CLUSTERS),
        np.count_nonzero(left_out - values, axis=0) >= LEAST_CLUSTERS,
    )
    t, plain_t = (
        as_floats(stdtrit(each, (1 + confidence) / 2))
        for each in (freedom, np.maximum(having - 1, 1))
    )
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        shares = _wilson(
            (values - least) / width, np.where(same, math.nan, errors / width), having, t, plain_t
        )
        factors = np.exp(t * errors / values)
        kinds = [share, least == 0]
        low = np.select(kinds, [least + width * shares[0], values / factors], values - t * errors)
        high = np.select(kinds, [least + width * shares[1], values * factors], values + t * errors)
    known &= np.isfinite(low) & np.isfinite(high)
    return np.where(known, low, math.nan), np.where(known, high, math.nan)


def _wilson(
    shares: FloatArray, errors: FloatArray, having: IntArray, t: FloatArray, plain_t: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Wilson's interval of as many independent draws as have these errors; NaN as an error takes each part for one.

    What few degrees of freedom add is bounded by one draw a part: a share is no less sure than that.
    """
    inside = np.clip(shares, 0, 1)
    by_errors = errors**2 / (inside * (1 - inside))
    bounded = np.maximum(plain_t**2 * by_errors, np.minimum(t**2 * by_errors, plain_t**2 / having))
    unsure = np.where(np.isnan(errors), plain_t**2 / having, bounded)
    half = np.sqrt(unsure * inside * (1 - inside) + unsure**2 / 4)
    # the high end is 1 less the low one of what is missing: of a share of 1 it is 1, however numbers are rounded
    low, missing = (
        np.maximum((each + unsure / 2 - half) / (1 + unsure), 0) for each in (inside, 1 - inside)
    )
    return low, 1 - missing


def _notes(having: Mapping[str, int]) -> Iterator[str]:
    """Why numbers have no interval; the numbers by how many parts have them."""
    few = [name for name, count in having.items() if count < LEAST_CLUSTERS]
    alike = [name for name, count in having.items() if count >= LEAST_CLUSTERS]
    if few:
        yield f"no interval of {_some(few)}: fewer than {LEAST_CLUSTERS} clusters have such a number"
    if alike:
        yield f"no interval of {_some(alike)}: fewer than {LEAST_CLUSTERS} clusters change it"


def _some(names: Sequence[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names) if more <= 0 else f"{', '.join(names[:_NAMED])} and {more} others"


# Totals, settings, and medians, which jump when a cluster is left out: the jackknife does not hold for them.
_WITHOUT: Final = (
    "false_recordings",
    *("within/*/distance", "threshold", "best_f1", "quiet", "quiet_braking"),
    "median_*",
)


def numbers_of(result: object) -> dict[str, float]:
    """The floats of a result by their path in it: `min_ade`, `ranges/30x30/iou`; whole numbers, texts and None not."""
    return dict(_numbers(result, ""))


def has_interval(path: str) -> bool:
    """Whether a number is one that the jackknife holds for: neither a total, nor a setting, nor a median."""
    return not _is_one_of(path, _WITHOUT)


def range_of(path: str, values: FloatArray, rows: Sequence[Row]) -> tuple[float, float]:
    """Return the least and the most that a number can be; infinite for no limit.

    Shares are in [0, 1], percents in [0, 100], other numbers with a unit from 0 on, and signed numbers have no limit. A
    number without a row is taken for a share if it is in [0, 1] in all draws, and otherwise for one that is never below
    0 if no draw is.

    Args:
        path: Path of the number.
        values: Numbers in draws of the clusters, shape (D,); NaN where there is nothing to count.
        rows: Rows of the result, whose paths are patterns; the first that fits the path or its end gives the unit.
    """
    row = next((row for row in rows if _is_one_of(path, (row.path,))), None)
    if row is not None:
        return (-math.inf, math.inf) if row.is_signed else (0.0, LIMITS.get(row.unit, math.inf))
    finite = values[np.isfinite(values)]
    if finite.min(initial=0.0) < 0:
        return -math.inf, math.inf
    return 0.0, 1.0 if finite.max(initial=0.0) <= 1 else math.inf


def _is_one_of(path: str, patterns: Iterable[str]) -> bool:
    """Whether a pattern fits the path, or its end, as of the results `beside` others."""
    return any(
        fnmatchcase(path, pattern) or fnmatchcase(path, f"*/{pattern}") for pattern in patterns
    )


def _numbers(value: object, path: str) -> Iterator[tuple[str, float]]:
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
