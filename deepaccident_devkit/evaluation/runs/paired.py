"""The paired permutation test of two runs: how much would they differ if the counts of some clusters were swapped?

If both are equally good, it is chance which counts of a cluster are whose: swapped ones give differences as probable as
the observed one. That holds for any evaluator's numbers and for any number of clusters. Swapped are whole clusters (an
accident and its twin), since samples of one show the same few seconds, and clusters that are hard for both must not
hide their difference.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.intervals import (
    Clusters,
    Resampling,
    difference_intervals,
    has_interval,
    numbers_of_draws,
)
from deepaccident_devkit.support.arrays import BoolArray, FloatArray

_ROUNDING: Final = 1e-9
"""Differences that differ by at most this share of them count as equal."""
_POWER: Final = 0.8
"""The chance that the stated number of scenarios decides a difference."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Swaps:
    """Which clusters are swapped.

    Attributes:
        swapped: (S, C) of C clusters. If all swaps are taken, these are the half of them that leave the first cluster
            as it is: the others swap all that these do not, and give the same differences with the other sign.
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
    if 2 ** max(clusters - 1, 0) <= resampling.resamples:
        numbers = np.arange(2 ** max(clusters - 1, 0))[:, None]
        return Swaps(swapped=(numbers << 1) >> np.arange(clusters) & 1 == 1, complete=True)
    source = np.random.default_rng(resampling.seed)
    return Swaps(swapped=source.integers(2, size=(resampling.resamples, clusters)) == 1, complete=False)


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
    evaluator: Evaluator[Any], runs: tuple[Clusters, Clusters], differences: Mapping[str, float], resampling: Resampling
) -> PairedTest:
    """Test the differences of two runs.

    Args:
        evaluator: that knows both runs' counts.
        runs: of each the counts of the same clusters, in the same order.
        differences: number, by its path → second − first, of all clusters together.
        resampling: how.
    """
    resampling = resampling if evaluator.has_intervals else replace(resampling, resamples=0)
    names, observed = list(differences), np.array(list(differences.values()))
    low, high, errors, p = (np.full(len(names), math.nan) for _ in range(4))
    unlike = [one != other for one, other in zip(*runs, strict=True)]
    swaps = swaps_of(sum(unlike), resampling)
    if resampling.resamples:
        ordered = [[run[at] for at in np.argsort(np.logical_not(unlike), kind="stable")] for run in runs]
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
    """(S, M) second − first of the M numbers of these names, after each of S swaps; NaN for none.

    Args:
        evaluator: that knows both runs' counts.
        pairs: of each run the counts of the C clusters that are swapped, then of those that stay.
        swaps: which of the C are swapped.
        names: of numbers, by their paths.
    """
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
    number changes in few clusters, and all of them would make the test by far too strict.

    Args:
        differences: (M,) observed.
        swapped: (S, M) after the swaps; NaN counts as more.
        swaps: which they are.

    Returns:
        (M,) in (0, 1]; NaN where the observed difference is.
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
    """Why a difference is not real, and what would decide it.

    Args:
        test: of all numbers.
        at: which of them.
        together: how many numbers are tested together.
        scenarios: that the clusters are of.
    """
    difference, level = abs(float(test.differences[at])), (1 - test.resampling.confidence) / together
    if math.isnan(difference):
        return "nothing to compare"
    if difference == 0:
        return "the difference is 0"
    if not test.resampling.resamples:
        return "not tested: no resamples were asked for, or the protocol has none"
    if test.swaps.least_p > level:
        return f"no decision is possible with {_too_few(test, level)} are needed"
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
