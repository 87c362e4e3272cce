"""Generated numbers of clusters whose truth is known, and the intervals and the test that were
before.

A cluster has few samples, of five agents each, that are strongly correlated: a sample is a hit
    where a normal variable
is below a limit, a share of whose variance (`correlation`) is the cluster's own.
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
"""How much of what makes a cluster hard is so for both runs: the correlation of their clusters."""
OLD_RESAMPLES = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sums:
    """What each cluster of each of D draws adds to a number, which is a ratio of two sums.

    Attributes:
        name: what was generated.
        truth: the number of infinitely many clusters.
        above: (C, D).
        below: (C, D).
        limit: the most that the number can be.
        least: the least.
    """

    name: str
    truth: float
    above: FloatArray
    below: FloatArray
    limit: float = 1.0
    least: float = 0.0


def sizes(kind: str, shape: tuple[int, int], source: np.random.Generator) -> FloatArray:
    """How many samples each cluster has."""
    if kind == "20 samples":
        return np.full(shape, 20.0)
    if kind == "5 to 20":
        return 5.0 * source.integers(1, 5, shape)
    return 1.0 * source.integers(0, 6, shape)


def hits(
    share: float,
    correlation: float,
    hard: FloatArray,
    samples: FloatArray,
    source: np.random.Generator,
) -> FloatArray:
    """How many samples of each cluster are hits; `hard` is the cluster's own variable."""
    chance = ndtr((ndtri(share) - np.sqrt(correlation) * hard) / np.sqrt(1 - correlation))
    return source.binomial(samples.astype(int), chance).astype(float)


def shares(clusters: int, draws: int, source: np.random.Generator) -> Iterator[Sums]:
    """Shares of samples: accuracies, rates."""
    for kind in SIZES:
        for correlation in CORRELATIONS:
            for share in SHARES:
                samples = sizes(kind, (clusters, draws), source)
                found = hits(
                    share, correlation, source.standard_normal(samples.shape), samples, source
                )
                yield Sums(
                    name=f"{kind}, correlation {correlation}, share {share}",
                    truth=share,
                    above=found,
                    below=samples,
                )


def ratios(clusters: int, draws: int, source: np.random.Generator) -> Iterator[Sums]:
    """Ratios of areas, such as IoU: that of a cluster varies around the whole one's by a
    logistic-normal law.
    """
    points, weights = np.polynomial.hermite_e.hermegauss(99)
    for kind in SIZES:
        for middle, spread in ((0.05, 1.0), (0.4, 0.6), (0.9, 0.6), (0.98, 1.0)):
            samples = sizes(kind, (clusters, draws), source)
            union = samples * source.gamma(2, 1, samples.shape)
            level = np.log(middle / (1 - middle))
            ratio = _logistic(level + spread * source.standard_normal(samples.shape))
            truth = float(_logistic(level + spread * points) @ weights / weights.sum())
            yield Sums(
                name=f"{kind}, ratio {truth:.2f}, spread {spread}",
                truth=truth,
                above=union * ratio,
                below=union,
            )


def means(clusters: int, draws: int, source: np.random.Generator) -> Iterator[Sums]:
    """Means of errors of 1 m, whose spread in a cluster is `within`, and of clusters' lognormal
    ones `between`.
    """
    for kind in SIZES:
        for between, within in ((0.3, 0.5), (0.6, 1.0), (0.0, 1.5)):
            samples = sizes(kind, (clusters, draws), source)
            shape = within**-2
            inside = source.gamma(np.maximum(samples, 0.1) * shape, 1 / shape) * (samples > 0)
            factor = np.exp(between * source.standard_normal(samples.shape) - between**2 / 2)
            name = f"{kind}, spread {between} between, {within} within"
            yield Sums(name=name, truth=1.0, above=inside * factor, below=samples, limit=np.inf)


def differences(clusters: int, draws: int, source: np.random.Generator) -> Iterator[Sums]:
    """Differences of two runs' shares."""
    for kind in SIZES:
        for correlation in CORRELATIONS:
            for share, more in ((0.1, 0.05), (0.5, 0.0), (0.6, 0.1), (0.9, 0.05)):
                first, second, samples = two_runs(
                    kind, correlation, share, more, (clusters, draws), source
                )
                name = f"{kind}, correlation {correlation}, share {share} + {more}"
                yield Sums(
                    name=name,
                    truth=more,
                    above=second - first,
                    below=samples,
                    limit=np.inf,
                    least=-np.inf,
                )


def two_runs(
    kind: str,
    correlation: float,
    share: float,
    more: float,
    shape: tuple[int, int],
    source: np.random.Generator,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Hits of two runs, the second of which has a share that is so much more, and the samples; each
    (C, D).
    """
    common, *own = source.standard_normal((3, *shape))
    samples = sizes(kind, shape, source)
    first, second = (
        hits(
            each,
            correlation,
            np.sqrt(PAIRED) * common + np.sqrt(1 - PAIRED) * hard,
            samples,
            source,
        )
        for each, hard in zip((share, share + more), own, strict=True)
    )
    return first, second, samples


def old_interval(sums: Sums, source: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """The percentile bootstrap that was before: (D,) low and high ends of 95 %."""
    count = len(sums.above)
    times = source.multinomial(count, np.full(count, 1 / count), OLD_RESAMPLES).astype(float)
    return middle(times, sums)


def middle(times: FloatArray, sums: Sums) -> tuple[FloatArray, FloatArray]:
    """(D,) the ends of the middle 95 % of what resamples give; those without the number do not
    count.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        values = np.sort((times @ sums.above) / (times @ sums.below), axis=0)
    known = np.isfinite(values).sum(axis=0)
    beside, draws = (known * 0.025).astype(int), np.arange(values.shape[1])
    return values[np.minimum(beside, known - 1), draws], values[
        np.maximum(known - 1 - beside, 0), draws
    ]


def _logistic(values: FloatArray) -> FloatArray:
    return 1 / (1 + np.exp(-values))
