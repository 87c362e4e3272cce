"""How often intervals hold the truth, and how often `compare` finds a difference, there is one or
not.

`python -m benchmarks.coverage` prints the tables.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.coverage_data import (
    Sums,
    differences,
    means,
    middle,
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
SHOWN = (6, *CLUSTERS)
KINDS: dict[str, Callable[[int, int, np.random.Generator], Iterator[Sums]]] = {
    "shares": shares,
    "ratios of areas": ratios,
    "means": means,
    "differences of two runs' shares": differences,
}
TESTED, CORRELATIONS = (6, 8, 10, 16, 32, 52, 104), (0.5, 0.9)
EFFECTS, SHARE = (0.0, 0.05, 0.1), 0.6
_BATCH = 200
"""Draws that are tested with the same random swaps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One simulated setting.

    Attributes:
        name: of it.
        ends: whether the true share is below 0.1 or above 0.9.
        new: share of the draws whose interval holds the truth.
        old: likewise of the percentile bootstrap.
        without: share of the draws without an interval.
    """

    name: str
    ends: bool
    new: float
    old: float
    without: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Tested:
    """How often a difference is called real.

    Attributes:
        clusters: of both runs.
        correlation: of samples in a cluster.
        effect: the true difference of the shares.
        new: share of the draws.
        old: likewise of the paired bootstrap that was before.
    """

    clusters: int
    correlation: float
    effect: float
    new: float
    old: float


def measure(draws: int = DRAWS) -> list[Figure]:
    """The figures; few draws for a quick look."""
    figures = []
    for kind in KINDS:
        for clusters in CLUSTERS:
            cells = list(coverage(kind, clusters, draws))
            name, least = f"coverage_{kind.split()[0]}_{clusters}", 0.88 if clusters == 8 else 0.9
            figures += [
                Figure(name=f"{name}_mean", value=mean([each.new for each in cells])),
                Figure(
                    name=f"{name}_lowest",
                    value=min(each.new for each in cells),
                    bound=least,
                    higher_is_better=True,
                ),
            ]
    tested = [each for each in power(draws) if not each.effect]
    return [
        *figures,
        Figure(name="compare_false_real_most", value=max(each.new for each in tested), bound=0.05),
    ]


def coverage_table(draws: int = DRAWS) -> str:
    """Of each kind and number of clusters: mean and lowest coverage, and what was before."""
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
        for clusters in SHOWN:
            cells = list(coverage(kind, clusters, draws))
            low, ends = (
                min(cells, key=lambda cell: cell.new),
                [cell.new for cell in cells if cell.ends],
            )
            inner, old = [cell.new for cell in cells if not cell.ends], [cell.old for cell in cells]
            words = (
                kind,
                str(clusters),
                str(len(cells)),
                percent(mean(inner)),
                percent(mean(ends)) if ends else "",
                percent(low.new),
                low.name,
                percent(mean(old)),
                percent(min(old)),
            )
            rows.append(f"| {' | '.join(words)} |")
    return "\n".join(rows)


def power_table(draws: int = DRAWS) -> str:
    """How often differences are called real, now and before."""
    shown = [
        f"{effect:+.2f} | before" if effect else "0 (falsely real) | before" for effect in EFFECTS
    ]
    rows = [
        f"| clusters | correlation | {' | '.join(shown)} |",
        f"|---:|---:|{'---:|---:|' * len(EFFECTS)}",
    ]
    made = list(power(draws))
    for at in range(0, len(made), len(EFFECTS)):
        first, *others = made[at : at + len(EFFECTS)]
        words = [f"{percent(each.new)} | {percent(each.old)}" for each in (first, *others)]
        rows.append(f"| {first.clusters} | {first.correlation} | {' | '.join(words)} |")
    return "\n".join(rows)


def alike(draws: int = DRAWS, seed: int = 0) -> float:
    """The most that are falsely called real if all clusters differ by the same amount: of 8 to 24
    clusters.
    """
    source, shares = np.random.default_rng(seed), []
    for clusters in range(8, 25):
        apart = source.choice([-1.0, 1.0], (clusters, draws))
        shares.append(float(real(np.zeros_like(apart), apart, np.ones_like(apart)).mean()))
    return max(shares)


def percent(share: float) -> str:
    return f"{share:.1%}"


def coverage(
    kind: str, clusters: int, draws: int = DRAWS, *, confidence: float = CONFIDENCE, seed: int = 0
) -> Iterator[Cell]:
    """How often intervals hold the truth, cell by cell.

    Args:
        kind: of `KINDS`.
        clusters: how many.
        draws: of each cell.
        confidence: of the intervals.
        seed: equal ones draw equally.
    """
    source = np.random.default_rng([seed, clusters, *map(ord, kind)])
    for sums in KINDS[kind](clusters, draws, source):
        new, old = new_interval(sums, confidence), old_interval(sums, source)
        made = np.isfinite(new[0])
        yield Cell(
            name=sums.name,
            ends=sums.limit == 1 and not 0.1 <= sums.truth <= 0.9,
            new=float(holds(new, sums.truth)[made].mean()) if made.any() else 1.0,
            old=float(holds(old, sums.truth).mean()),
            without=float(1 - made.mean()),
        )


def new_interval(sums: Sums, confidence: float) -> tuple[FloatArray, FloatArray]:
    """The library's: each draw is one number."""
    with np.errstate(invalid="ignore", divide="ignore"):
        whole = sums.above.sum(axis=0) / sums.below.sum(axis=0)
        left_out = (sums.above.sum(axis=0) - sums.above) / (sums.below.sum(axis=0) - sums.below)
    having = np.count_nonzero(sums.below, axis=0)
    ranges = np.broadcast_to((sums.least, sums.limit), (len(whole), 2))
    return interval_ends(whole, left_out, ranges, confidence, having)


def holds(ends: tuple[FloatArray, FloatArray], truth: float) -> np.ndarray:
    return (ends[0] <= truth + 1e-12) & (truth - 1e-12 <= ends[1])


def power(draws: int = DRAWS, seed: int = 0) -> Iterator[Tested]:
    """How often a difference of two runs' shares is called real at 5 %."""
    source = np.random.default_rng(seed)
    for clusters in TESTED:
        for correlation in CORRELATIONS:
            for effect in EFFECTS:
                runs = two_runs("5 to 20", correlation, SHARE, effect, (clusters, draws), source)
                batches = [
                    [each[:, at : at + _BATCH] for each in runs] for at in range(0, draws, _BATCH)
                ]
                new = [real(*batch, seed=number) for number, batch in enumerate(batches)]
                old = [old_real(*batch, source) for batch in batches]
                yield Tested(
                    clusters=clusters,
                    correlation=correlation,
                    effect=effect,
                    new=float(np.concatenate(new).mean()),
                    old=float(np.concatenate(old).mean()),
                )


def real(
    first: FloatArray, second: FloatArray, samples: FloatArray, *, seed: int = 0
) -> np.ndarray:
    """(D,) whether the library's test calls the difference of each draw real."""
    swaps = swaps_of(len(first), Resampling(seed=seed))
    signs = 1.0 - 2.0 * swaps.swapped
    apart, below = second - first, samples.sum(axis=0)
    return p_values(apart.sum(axis=0) / below, signs @ apart / below, swaps) <= 1 - CONFIDENCE


def old_real(
    first: FloatArray, second: FloatArray, samples: FloatArray, source: np.random.Generator
) -> np.ndarray:
    """(D,) whether the middle 95 % of 1,000 paired resamples lie on one side of 0."""
    count = len(first)
    times = source.multinomial(count, np.full(count, 1 / count), 1000).astype(float)
    low, high = middle(times, Sums(name="", truth=0, above=second - first, below=samples))
    return (low > 0) | (high < 0)


def mean(values: list[float]) -> float:
    return sum(values) / len(values)


def main() -> None:
    """Print both tables, and how often differences that are alike in all clusters are called
    real.
    """
    print(f"Intervals of 95 %, {DRAWS:,} draws for each setting:\n\n{coverage_table()}\n")
    print(f"How often a difference is called real:\n\n{power_table()}\n")
    print(f"Of differences that are alike in all clusters: {percent(alike())}")


if __name__ == "__main__":
    main()
