"""Generate numbers of clusters with a known truth, and the intervals and the test that were used
before.

A cluster has few samples, of five agents each, that are strongly correlated: a sample is a hit if a
normal variable is below a limit, and a share (`correlation`) of the variance of that variable
belongs to the cluster.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from deepaccident_devkit.support.arrays import FloatArray

SIZES = ("20 samples", "5 to 20", "0 to 5")
CORRELATIONS = (0.1, 0.5, 0.9)
SHARES = (0.02, 0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 0.95, 0.98)
PAIRED = 0.7
"""Correlation of how hard a cluster is for the two runs."""
OLD_RESAMPLES = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sums:
    """What each cluster of each of D draws adds to a number, which is a ratio of two sums.

    Attributes:
        name: Name of what was generated.
        truth: The number for infinitely many clusters.
        above: Numerators, shape (C, D).
        below: Denominators, shape (C, D).
        limit: Largest possible number.
        minimum: Smallest possible number.
    """

    name: str
    truth: float
    above: FloatArray
    below: FloatArray
    limit: float = 1.0
    minimum: float = 0.0


def draw_samples(kind: str, shape: tuple[int, int], source: np.random.Generator) -> FloatArray:
    """Return how many samples each cluster has, as an array of a shape."""
    if kind == "20 samples":
        return np.full(shape, 20.0)
    if kind == "5 to 20":
        return 5.0 * source.integers(1, 5, shape)
    return 1.0 * source.integers(0, 6, shape)


def draw_hits(
    share: float,
    correlation: float,
    difficulty: FloatArray,
    samples: FloatArray,
    source: np.random.Generator,
) -> FloatArray:
    """Return how many samples of each cluster are hits; `difficulty` is the cluster's own variable,
    standard normal, shape (C, D).
    """
    cluster_part = np.sqrt(correlation) * difficulty
    limit = (ndtri(share) - cluster_part) / np.sqrt(1 - correlation)
    return source.binomial(samples.astype(int), ndtr(limit)).astype(float)


def shares(clusters: int, draws: int, source: np.random.Generator) -> Iterator[Sums]:
    """Yield shares of samples, such as accuracies and rates."""
    for kind in SIZES:
        for correlation in CORRELATIONS:
            for share in SHARES:
                samples = draw_samples(kind, (clusters, draws), source)
                difficulty = source.standard_normal(samples.shape)
                hits = draw_hits(share, correlation, difficulty, samples, source)
                yield Sums(
                    name=f"{kind}, correlation {correlation}, share {share}",
                    truth=share,
                    above=hits,
                    below=samples,
                )


def ratios(clusters: int, draws: int, source: np.random.Generator) -> Iterator[Sums]:
    """Yield ratios of areas, such as IoU: the ratios of clusters vary around the whole by a
    logistic-normal law.
    """
    points, weights = np.polynomial.hermite_e.hermegauss(99)
    for kind in SIZES:
        for middle, spread in ((0.05, 1.0), (0.4, 0.6), (0.9, 0.6), (0.98, 1.0)):
            samples = draw_samples(kind, (clusters, draws), source)
            union = samples * source.gamma(2, 1, samples.shape)
            level = np.log(middle / (1 - middle))
            deviation = source.standard_normal(samples.shape)
            ratio = _logistic(level + spread * deviation)
            expected = _logistic(level + spread * points) @ weights
            truth = float(expected / weights.sum())
            yield Sums(
                name=f"{kind}, ratio {truth:.2f}, spread {spread}",
                truth=truth,
                above=union * ratio,
                below=union,
            )


def means(clusters: int, draws: int, source: np.random.Generator) -> Iterator[Sums]:
    """Yield means of errors of 1 m: `within` is their spread in a cluster, `between` the spread of
    the clusters' lognormal means.
    """
    for kind in SIZES:
        for between, within in ((0.3, 0.5), (0.6, 1.0), (0.0, 1.5)):
            samples = draw_samples(kind, (clusters, draws), source)
            shape = within**-2
            errors = source.gamma(np.maximum(samples, 0.1) * shape, 1 / shape)
            errors *= samples > 0
            deviation = source.standard_normal(samples.shape)
            factor = np.exp(between * deviation - between**2 / 2)
            name = f"{kind}, spread {between} between, {within} within"
            yield Sums(name=name, truth=1.0, above=errors * factor, below=samples, limit=np.inf)


def differences(clusters: int, draws: int, source: np.random.Generator) -> Iterator[Sums]:
    """Yield differences of two runs' shares."""
    for kind in SIZES:
        for correlation in CORRELATIONS:
            for share, effect in ((0.1, 0.05), (0.5, 0.0), (0.6, 0.1), (0.9, 0.05)):
                first, second, samples = two_runs(
                    kind, correlation, share, effect, (clusters, draws), source
                )
                name = f"{kind}, correlation {correlation}, share {share} + {effect}"
                yield Sums(
                    name=name,
                    truth=effect,
                    above=second - first,
                    below=samples,
                    limit=np.inf,
                    minimum=-np.inf,
                )


def two_runs(
    kind: str,
    correlation: float,
    share: float,
    effect: float,
    shape: tuple[int, int],
    source: np.random.Generator,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the hits of two runs and the samples, each of shape (C, D); the share of the second
    run is larger by `effect`.
    """
    common, first_own, second_own = source.standard_normal((3, *shape))
    samples = draw_samples(kind, shape, source)
    first_difficulty = np.sqrt(PAIRED) * common + np.sqrt(1 - PAIRED) * first_own
    second_difficulty = np.sqrt(PAIRED) * common + np.sqrt(1 - PAIRED) * second_own
    first = draw_hits(share, correlation, first_difficulty, samples, source)
    second = draw_hits(share + effect, correlation, second_difficulty, samples, source)
    return first, second, samples


def old_interval(sums: Sums, source: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return the percentile bootstrap that was used before: (D,) low and high ends of 95 %."""
    count = len(sums.above)
    times = source.multinomial(count, np.full(count, 1 / count), OLD_RESAMPLES).astype(float)
    return middle_interval(times, sums)


def middle_interval(times: FloatArray, sums: Sums) -> tuple[FloatArray, FloatArray]:
    """Return (D,) ends of the middle 95 % of the resampled values, without undefined ones."""
    with np.errstate(invalid="ignore", divide="ignore"):
        values = np.sort((times @ sums.above) / (times @ sums.below), axis=0)
    num_defined = np.isfinite(values).sum(axis=0)
    num_outside = (num_defined * 0.025).astype(int)
    draws = np.arange(values.shape[1])
    low = np.minimum(num_outside, num_defined - 1)
    high = np.maximum(num_defined - 1 - num_outside, 0)
    return values[low, draws], values[high, draws]


def _logistic(values: FloatArray) -> FloatArray:
    return 1 / (1 + np.exp(-values))
