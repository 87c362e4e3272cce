"""Measure how often intervals hold the truth, and how often `compare` calls a difference real,
whether there is one or not.

`python -m benchmarks.coverage` prints the tables.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.coverage_data import (
    Sums,
    differences,
    means,
    middle_interval,
    old_interval,
    ratios,
    shares,
    two_runs,
)
from benchmarks.measure import Figure
from deepaccident_devkit.evaluation.intervals import Resampling, interval_ends
from deepaccident_devkit.evaluation.runs.comparison import p_values, swaps_of
from deepaccident_devkit.support.arrays import FloatArray

DRAWS, CONFIDENCE = 4000, 0.95
CLUSTERS = (8, 16, 52, 104)
TABLE_CLUSTERS = (6, *CLUSTERS)
KINDS: dict[str, Callable[[int, int, np.random.Generator], Iterator[Sums]]] = {
    "shares": shares,
    "ratios of areas": ratios,
    "means": means,
    "differences of two runs' shares": differences,
}
TESTED_CLUSTERS, CORRELATIONS = (6, 8, 10, 16, 32, 52, 104), (0.5, 0.9)
EFFECTS, SHARE = (0.0, 0.05, 0.1), 0.6
_BATCH = 200
"""Draws that are tested with the same random swaps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """Measured coverage of one simulated setting.

    Attributes:
        name: Name of the setting.
        is_extreme: Whether the true share is below 0.1 or above 0.9.
        coverage: Share of the draws in which the interval holds the truth.
        bootstrap_coverage: The same share for the percentile bootstrap that was used before.
    """

    name: str
    is_extreme: bool
    coverage: float
    bootstrap_coverage: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TestRate:
    """How often a difference of two runs is called real.

    Attributes:
        clusters: Number of clusters of both runs.
        correlation: Correlation of the samples in a cluster.
        effect: True difference of the shares.
        rate: Share of the draws in which the test calls the difference real.
        bootstrap_rate: The same share for the paired bootstrap that was used before.
    """

    clusters: int
    correlation: float
    effect: float
    rate: float
    bootstrap_rate: float


def measure(draws: int = DRAWS) -> list[Figure]:
    """Return the figures; few draws give a quick look."""
    figures = []
    for kind in KINDS:
        for clusters in CLUSTERS:
            coverages = [cell.coverage for cell in simulate_coverage(kind, clusters, draws)]
            name = f"coverage_{kind.split()[0]}_{clusters}"
            figures += [
                Figure(f"{name}_mean", mean(coverages)),
                Figure(
                    f"{name}_lowest",
                    min(coverages),
                    bound=0.88 if clusters == 8 else 0.9,
                    higher_is_better=True,
                ),
            ]
    false_rates = [test.rate for test in simulate_tests(draws) if not test.effect]
    highest = Figure("compare_false_real_most", max(false_rates), bound=0.05)
    return [*figures, highest]


def coverage_table(draws: int = DRAWS) -> str:
    """Return the mean and lowest coverage of each kind and number of clusters, now and before."""
    head = (
        "numbers",
        "clusters",
        "settings",
        "mean",
        "at the ends",
        "lowest",
        "which",
        "mean before",
        "lowest before",
    )
    rows = [f"| {' | '.join(head)} |", "|---|---:|---:|---:|---:|---:|---|---:|---:|"]
    for kind in KINDS:
        for clusters in TABLE_CLUSTERS:
            cells = list(simulate_coverage(kind, clusters, draws))
            lowest = min(cells, key=lambda cell: cell.coverage)
            extreme = [cell.coverage for cell in cells if cell.is_extreme]
            inner = [cell.coverage for cell in cells if not cell.is_extreme]
            bootstrap = [cell.bootstrap_coverage for cell in cells]
            texts = (
                kind,
                str(clusters),
                str(len(cells)),
                percent(mean(inner)),
                percent(mean(extreme)) if extreme else "",
                percent(lowest.coverage),
                lowest.name,
                percent(mean(bootstrap)),
                percent(min(bootstrap)),
            )
            rows.append(f"| {' | '.join(texts)} |")
    return "\n".join(rows)


def power_table(draws: int = DRAWS) -> str:
    """Return how often differences are called real, now and before."""
    headings = []
    for effect in EFFECTS:
        heading = f"{effect:+.2f}" if effect else "0 (falsely real)"
        headings.append(f"{heading} | before")
    rows = [
        f"| clusters | correlation | {' | '.join(headings)} |",
        f"|---:|---:|{'---:|---:|' * len(EFFECTS)}",
    ]
    tests = list(simulate_tests(draws))
    for start in range(0, len(tests), len(EFFECTS)):
        row = tests[start : start + len(EFFECTS)]
        texts = [f"{percent(test.rate)} | {percent(test.bootstrap_rate)}" for test in row]
        rows.append(f"| {row[0].clusters} | {row[0].correlation} | {' | '.join(texts)} |")
    return "\n".join(rows)


def alike(draws: int = DRAWS, seed: int = 0) -> float:
    """Return the largest share that is falsely called real, for 8 to 24 clusters that all differ by
    the same amount.
    """
    source = np.random.default_rng(seed)
    shares = []
    for clusters in range(8, 25):
        cluster_differences = source.choice([-1.0, 1.0], (clusters, draws))
        is_real = is_called_real(
            np.zeros_like(cluster_differences),
            cluster_differences,
            np.ones_like(cluster_differences),
        )
        shares.append(float(is_real.mean()))
    return max(shares)


def percent(share: float) -> str:
    return f"{share:.1%}"


def simulate_coverage(
    kind: str, clusters: int, draws: int = DRAWS, *, confidence: float = CONFIDENCE, seed: int = 0
) -> Iterator[Cell]:
    """Yield how often intervals hold the truth, setting by setting.

    Args:
        kind: Kind of number, a key of `KINDS`.
        clusters: Number of clusters.
        draws: Number of draws of each setting.
        confidence: Confidence of the intervals.
        seed: Seed of the random numbers.
    """
    source = np.random.default_rng([seed, clusters, *map(ord, kind)])
    for sums in KINDS[kind](clusters, draws, source):
        interval = new_interval(sums, confidence)
        bootstrap = old_interval(sums, source)
        is_finite = np.isfinite(interval[0])
        holds_truth = holds(interval, sums.truth)[is_finite]
        yield Cell(
            name=sums.name,
            is_extreme=sums.limit == 1 and not 0.1 <= sums.truth <= 0.9,
            coverage=float(holds_truth.mean()) if len(holds_truth) else 1.0,
            bootstrap_coverage=float(holds(bootstrap, sums.truth).mean()),
        )


def new_interval(sums: Sums, confidence: float) -> tuple[FloatArray, FloatArray]:
    """Return the interval of the library for each draw, as (D,) lower and upper ends."""
    above = sums.above.sum(axis=0)
    below = sums.below.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        values = above / below
        left_out = (above - sums.above) / (below - sums.below)
    filled_clusters = np.count_nonzero(sums.below, axis=0)
    ranges = np.broadcast_to((sums.minimum, sums.limit), (len(values), 2))
    return interval_ends(values, left_out, ranges, confidence, filled_clusters)


def holds(interval: tuple[FloatArray, FloatArray], truth: float) -> np.ndarray:
    """Return (D,) whether the interval of each draw holds the truth, up to rounding."""
    low, high = interval
    return (low <= truth + 1e-12) & (truth - 1e-12 <= high)


def simulate_tests(draws: int = DRAWS, seed: int = 0) -> Iterator[TestRate]:
    """Yield how often a difference of two runs' shares is called real at 5 %."""
    source = np.random.default_rng(seed)
    for clusters in TESTED_CLUSTERS:
        for correlation in CORRELATIONS:
            for effect in EFFECTS:
                runs = two_runs("5 to 20", correlation, SHARE, effect, (clusters, draws), source)
                batches = [
                    [array[:, start : start + _BATCH] for array in runs]
                    for start in range(0, draws, _BATCH)
                ]
                is_real = [is_called_real(*batch, seed=i) for i, batch in enumerate(batches)]
                is_old_real = [is_called_real_by_bootstrap(*batch, source) for batch in batches]
                yield TestRate(
                    clusters=clusters,
                    correlation=correlation,
                    effect=effect,
                    rate=float(np.concatenate(is_real).mean()),
                    bootstrap_rate=float(np.concatenate(is_old_real).mean()),
                )


def is_called_real(
    first: FloatArray, second: FloatArray, samples: FloatArray, *, seed: int = 0
) -> np.ndarray:
    """Return (D,) whether the library's test calls the difference of each draw real."""
    swaps = swaps_of(len(first), Resampling(seed=seed))
    signs = 1.0 - 2.0 * swaps.swapped
    difference = second - first
    count = samples.sum(axis=0)
    observed = difference.sum(axis=0) / count
    swapped = signs @ difference / count
    return p_values(observed, swapped, swaps) <= 1 - CONFIDENCE


def is_called_real_by_bootstrap(
    first: FloatArray, second: FloatArray, samples: FloatArray, source: np.random.Generator
) -> np.ndarray:
    """Return (D,) whether the middle 95 % of 1,000 paired resamples lie on one side of 0."""
    count = len(first)
    times = source.multinomial(count, np.full(count, 1 / count), 1000).astype(float)
    sums = Sums(name="", truth=0, above=second - first, below=samples)
    low, high = middle_interval(times, sums)
    return (low > 0) | (high < 0)


def mean(values: list[float]) -> float:
    return sum(values) / len(values)


def main() -> None:
    """Print both tables, and how often differences that are the same in all clusters are called
    real.
    """
    print(f"Intervals of 95 %, {DRAWS:,} draws for each setting:\n\n{coverage_table()}\n")
    print(f"How often a difference is called real:\n\n{power_table()}\n")
    print(f"Of differences that are alike in all clusters: {percent(alike())}")


if __name__ == "__main__":
    main()
