"""Intervals of any evaluator's numbers, from their changes when a cluster is left out (jackknife).

A cluster is an accident with its twin (`breakdowns.cluster_of`). Its samples show the same junction
and traffic, so the certainty of a number depends on the number of clusters, not of samples. The
section "Intervals" of docs/numbers.md states the formulas; `python -m benchmarks coverage` measures
the coverage.
"""

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
from deepaccident_devkit.support.text import counted

# Default number of resamples for evaluations and comparisons, in the library and on the command
# line.
RESAMPLES: Final = 1000
MAX_RESAMPLES: Final = 100_000
# Smallest number of clusters for an interval. With fewer, the coverage would be too low, and a test
# at 5 % could never decide.
MIN_CLUSTERS: Final = 6
# Largest number of parts. If there are more clusters, they are joined, which saves time; t hardly
# changes beyond 99 degrees of freedom.
_MAX_PARTS = 100
# Changes below this fraction of a number (or of its range) are rounding errors.
_ROUNDING_SHARE = 1e-9
# A note lists at most this many names.
_MAX_LISTED_NAMES = 3
# The jackknife is not valid for totals and settings, nor for medians, which jump when a cluster is
# left out.
_PATHS_WITHOUT_INTERVAL = (
    "false_recordings",
    *("within/*/distance", "threshold", "best_f1", "quiet", "quiet_braking"),
    *("median_*", "id_switches", "fragments", "mostly_tracked"),
)
# Range of a number without limits.
_NO_LIMITS = (-math.inf, math.inf)
# The counts of each cluster's samples.
Clusters = Sequence[Sequence[Counts]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Resampling:
    """Settings of intervals, and of the test whether two runs differ.

    Attributes:
        resamples: Largest number of resamples for intervals and tests; 0 disables both. For
            intervals, numbers are computed again without each cluster (at most 100 times); for
            tests, with clusters swapped between two runs.
        confidence: Share of intervals that should contain the true number; the level of tests is
            1 − confidence.
        seed: Seed of the random choice of clusters or swaps, if not all of them are used.
    """

    resamples: int = RESAMPLES
    confidence: float = 0.95
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the fields; raise ConfigError if one is out of range."""
        if type(self.resamples) is not int or not 0 <= self.resamples <= MAX_RESAMPLES:
            expected = f"a whole number from 0 to {MAX_RESAMPLES:,}"
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
        notes: Sentences that say why numbers have no interval.
    """

    ends: Mapping[str, tuple[float, float]]
    notes: tuple[str, ...]


def intervals_of(
    evaluator: Evaluator[Any],
    clusters: Clusters,
    result: object,
    resampling: Resampling | None = None,
) -> Intervals:
    """Compute the intervals of a result's numbers.

    Args:
        evaluator: Evaluator of the result.
        clusters: Counts of each cluster, always in the same order.
        result: Result over all clusters.
        resampling: Settings; None for the defaults.
    """
    settings = resampling or Resampling()
    if not settings.resamples:
        return Intervals(ends={}, notes=())
    if not evaluator.has_intervals:
        return Intervals(ends={}, notes=("no confidence intervals: this protocol has none",))
    if len(clusters) < MIN_CLUSTERS:
        pairs = counted(len(clusters), "scenario pair")
        note = f"no confidence intervals: {pairs}, at least {MIN_CLUSTERS} needed"
        return Intervals(ends={}, notes=(note,))
    numbers = {}
    for name, number in numbers_of(result).items():
        if math.isfinite(number) and has_interval(name):
            numbers[name] = number
    names = list(numbers)
    values = np.array([*numbers.values()])
    drawn_values = draws_of_parts(evaluator, clusters, names, settings)
    rows = evaluator.result_class.rows
    low, high, part_counts = ends_of_draws(names, values, drawn_values, settings.confidence, rows)
    ends = {}
    parts_without_interval = {}
    for index, name in enumerate(names):
        if np.isfinite(low[index]):
            ends[name] = float(low[index]), float(high[index])
        else:
            parts_without_interval[name] = int(part_counts[index])
    return Intervals(ends=ends, notes=tuple(_explain_missing(parts_without_interval)))


def difference_intervals(
    evaluator: Evaluator[Any],
    pair: tuple[Clusters, Clusters],
    differences: Mapping[str, float],
    resampling: Resampling,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute intervals of the differences between two sets of counts for the same clusters.

    Each draw leaves the same clusters out of both sets.

    Args:
        evaluator: Evaluator of these counts.
        pair: Two sets of counts for the same clusters, in the same order.
        differences: Path of a number → second − first, over all clusters.
        resampling: Settings of the intervals.

    Returns:
        Low and high ends, (M,) each, NaN if there is no interval (see `interval_ends`), and
        standard errors, (M,).
    """
    values = np.array([*differences.values()])
    first_clusters, second_clusters = pair
    first_values = draws_of_parts(evaluator, first_clusters, differences, resampling)
    second_values = draws_of_parts(evaluator, second_clusters, differences, resampling)
    drawn_values = second_values - first_values
    low, high, _ = ends_of_draws(differences, values, drawn_values, resampling.confidence)
    _, left_out = np.split(drawn_values, 2)
    errors, _ = standard_errors(values, left_out)
    return low, high, errors


def draws_of_parts(
    evaluator: Evaluator[Any], clusters: Clusters, names: Iterable[str], resampling: Resampling
) -> FloatArray:
    """Compute M numbers from each single part of the clusters, and from all parts but one.

    Returns:
        Numbers, shape (2P, M). First for each of the P parts by itself, then without each part.
    """
    parts = pool_clusters(clusters, resampling)
    leave_one_out = leave_one_out_draws(len(parts))
    times = np.vstack([1 - leave_one_out, leave_one_out])
    return numbers_of_draws(evaluator, parts, times, names)


def ends_of_draws(
    names: Iterable[str],
    values: FloatArray,
    drawn: FloatArray,
    confidence: float,
    rows: Sequence[Row] | None = None,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Compute the intervals of numbers from draws.

    Args:
        names: Paths of M numbers.
        values: (M,) numbers over all parts.
        drawn: (2P, M) numbers from `draws_of_parts`.
        confidence: Share of intervals that should contain the true number.
        rows: Rows of the result that contains these numbers (see `range_of`); None for differences,
            which have no limits.

    Returns:
        Low and high ends, (M,) each (see `interval_ends`), and the number of parts that have each
        number, (M,).
    """
    single_parts, left_out = np.split(drawn, 2)
    if rows is None:
        ranges = [_NO_LIMITS] * len(values)
    else:
        ranges = []
        for name, drawn_values in zip(names, drawn.T, strict=True):
            ranges.append(range_of(name, drawn_values, rows))
    part_counts = np.isfinite(single_parts).sum(axis=0)
    limits = np.reshape(ranges, (-1, 2))
    low, high = interval_ends(values, left_out, limits, confidence, part_counts)
    return low, high, part_counts


def pool_clusters(clusters: Clusters, resampling: Resampling) -> Clusters:
    """Join the clusters at random into fewer parts if there are too many."""
    part_count = min(_MAX_PARTS, max(resampling.resamples, MIN_CLUSTERS))
    if len(clusters) <= part_count:
        return clusters
    generator = np.random.default_rng(resampling.seed)
    order = generator.permutation(len(clusters)).tolist()
    parts = []
    for start in range(part_count):
        part: list[Counts] = []
        for index in order[start::part_count]:
            part += clusters[index]
        parts.append(part)
    return parts


def leave_one_out_draws(count: int) -> IntArray:
    """Return P draws of P parts, each without one of the parts, shape (P, P)."""
    is_left_out = np.eye(count, dtype=np.int64)
    return 1 - is_left_out


def numbers_of_draws(
    evaluator: Evaluator[Any], parts: Clusters, times: IntArray, names: Iterable[str]
) -> FloatArray:
    """Compute M numbers in each of D draws, shape (D, M); missing numbers are NaN.

    Args:
        evaluator: Evaluator of the counts.
        parts: Counts of P groups of samples.
        times: (D, P) how often each draw contains each group.
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
    numbers_by_draw = np.array(rows)
    return numbers_by_draw.reshape(len(rows), len(paths))  # two axes even without names


def standard_errors(values: FloatArray, left_out: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute the standard errors of numbers by the delete-one jackknife.

    Args:
        values: (M,) numbers over all P parts.
        left_out: (P, M) numbers without each part.

    Returns:
        (M,) standard errors, NaN if a number depends on a single part; and (M,) degrees of freedom
        of t, at least 1: one less than the number of parts that change the number. If some parts
        change it much more than others, the error itself is uncertain, and the degrees of freedom
        are reduced to P / (kurtosis − 1).
    """
    count = len(left_out)
    changes = left_out - values
    squares = changes**2
    variation = squares.sum(axis=0)
    changing_parts = np.count_nonzero(changes, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        kurtosis = count * (squares**2).sum(axis=0) / variation**2
        freedom = np.fmin(changing_parts - 1, count / np.maximum(kurtosis - 1, 0))
    errors = np.sqrt((count - 1) / count * variation)
    return errors, np.fmax(freedom, 1.0)


def interval_ends(
    values: FloatArray,
    left_out: FloatArray,
    ranges: FloatArray,
    confidence: float,
    having: IntArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Compute the ends of intervals with Student's t.

    Shares have Wilson intervals. The intervals of numbers that are never negative are computed for
    their logarithms, and intervals of all other numbers for the numbers themselves.

    Args:
        values: (M,) numbers over all P parts.
        left_out: (P, M) numbers without each part.
        ranges: (M, 2) lowest and highest possible value; infinite for no limit.
        confidence: Share of intervals that should contain the true number.
        having: (M,) number of parts that have each number; None if all parts have all numbers.

    Returns:
        (M,) low and (M,) high ends; NaN if fewer than `MIN_CLUSTERS` parts have or change the
        number. A share that is the same in all parts still has an interval; other numbers that are
        the same in all parts have none.
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
        is_share & (having >= MIN_CLUSTERS),
        changing_parts >= MIN_CLUSTERS,
    )
    quantile = (1 + confidence) / 2
    t = as_floats(stdtrit(freedom, quantile))
    plain_t = as_floats(stdtrit(np.maximum(having - 1, 1), quantile))
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        share_errors = np.where(is_constant, math.nan, errors / width)
        shares = (values - lowest) / width
        low_share, high_share = _wilson_interval(shares, share_errors, having, t, plain_t)
        factors = np.exp(t * errors / values)
        kinds = [is_share, lowest == 0]
        low_ends = [lowest + width * low_share, values / factors]
        high_ends = [lowest + width * high_share, values * factors]
        low = np.select(kinds, low_ends, values - t * errors)
        high = np.select(kinds, high_ends, values + t * errors)
    is_known &= np.isfinite(low) & np.isfinite(high)
    return np.where(is_known, low, math.nan), np.where(is_known, high, math.nan)


def _wilson_interval(
    shares: FloatArray, errors: FloatArray, having: IntArray, t: FloatArray, plain_t: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Compute Wilson's interval for the number of independent draws that leads to these errors.

    If an error is NaN, each part counts as one draw. Few degrees of freedom widen an interval at
    most to the interval of one draw per part, since a share is never less certain.

    Args:
        shares: (M,) shares over all parts.
        errors: (M,) standard errors.
        having: (M,) number of parts that have each share.
        t: (M,) quantiles of Student's t for the degrees of freedom of the errors.
        plain_t: (M,) quantiles for as many degrees of freedom as there are parts, minus one.
    """
    bounded_shares = np.clip(shares, 0, 1)
    missing_shares = 1 - bounded_shares
    variance = bounded_shares * missing_shares
    by_errors = errors**2 / variance
    by_parts = plain_t**2 / having
    bounded = np.maximum(plain_t**2 * by_errors, np.minimum(t**2 * by_errors, by_parts))
    uncertainty = np.where(np.isnan(errors), by_parts, bounded)
    half_width = np.sqrt(uncertainty * bounded_shares * missing_shares + uncertainty**2 / 4)
    scale = 1 + uncertainty
    low = (bounded_shares + uncertainty / 2 - half_width) / scale
    # the high end is 1 minus the low end of the complementary share, so that it is exactly 1 for a
    # share of 1, however numbers are rounded
    low_missing = (missing_shares + uncertainty / 2 - half_width) / scale
    return np.maximum(low, 0), 1 - np.maximum(low_missing, 0)


def _explain_missing(part_counts: Mapping[str, int]) -> Iterator[str]:
    """Yield sentences that say why numbers have no interval.

    Args:
        part_counts: Path of a number without an interval → number of parts that have the number.
    """
    in_few_parts = []
    unchanged = []
    for name, count in part_counts.items():
        if count < MIN_CLUSTERS:
            in_few_parts.append(name)
        else:
            unchanged.append(name)
    if in_few_parts:
        yield (
            f"no interval for {_list_names(in_few_parts)}: fewer than {MIN_CLUSTERS} clusters "
            "have such a number"
        )
    if unchanged:
        yield (
            f"no interval for {_list_names(unchanged)}: fewer than {MIN_CLUSTERS} clusters change "
            "it"
        )


def _list_names(names: Sequence[str]) -> str:
    """List the first names in a text, and say how many more there are."""
    unlisted = len(names) - _MAX_LISTED_NAMES
    if unlisted <= 0:
        return ", ".join(names)
    return f"{', '.join(names[:_MAX_LISTED_NAMES])} and {counted(unlisted, 'other')}"


def numbers_of(result: object) -> dict[str, float]:
    """Return the floats in a result by path, such as `min_ade` or `ranges/30x30/iou`.

    Integers, texts and None are left out.
    """
    return dict(_walk_numbers(result, ""))


def has_interval(path: str) -> bool:
    """Return whether the jackknife is valid for a number: not for totals, settings and medians."""
    return not _fits_pattern(path, _PATHS_WITHOUT_INTERVAL)


def range_of(path: str, values: FloatArray, rows: Sequence[Row]) -> tuple[float, float]:
    """Return the lowest and the highest possible value of a number; infinite for no limit.

    Shares are in [0, 1], percentages are in [0, 100], other numbers with a unit are at least 0, and
    signed numbers have no limit. A number without a row counts as a share if it is in [0, 1] in all
    draws, and has no limit if it is negative in a draw.

    Args:
        path: Path of the number.
        values: (D,) values in draws of the clusters; NaN if there is nothing to count.
        rows: Rows of the result, whose paths are patterns; the first row that matches the path, or
            its end, determines the unit.
    """
    for row in rows:
        if _fits_pattern(path, (row.path,)):
            if row.is_signed:
                return _NO_LIMITS
            return 0.0, LIMITS.get(row.unit, math.inf)
    finite_values = values[np.isfinite(values)]
    if finite_values.min(initial=0.0) < 0:
        return _NO_LIMITS
    if finite_values.max(initial=0.0) <= 1:
        return 0.0, 1.0
    return 0.0, math.inf


def _fits_pattern(path: str, patterns: Iterable[str]) -> bool:
    """Return whether a pattern matches a path or its end, since results can contain others."""
    for pattern in patterns:
        if fnmatchcase(path, pattern) or fnmatchcase(path, f"*/{pattern}"):
            return True
    return False


def _walk_numbers(value: object, path: str) -> Iterator[tuple[str, float]]:
    """Yield the path and value of each float in `value`, which is at `path`."""
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
        yield from _walk_numbers(part, f"{path}/{name}" if path else name)
