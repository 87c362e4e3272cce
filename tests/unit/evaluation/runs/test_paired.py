"""The paired permutation test: of all swaps, of random ones, and what it says where nothing is decided."""

import itertools
import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator, ratio, total
from deepaccident_devkit.evaluation.intervals import Resampling
from deepaccident_devkit.evaluation.runs.comparison import (
    PairedTest,
    Swaps,
    holm,
    p_values,
    paired_test,
    swaps_of,
    undecided,
)


@dataclass(frozen=True)
class Mean:
    mean: float


class Means(Evaluator[Mean]):
    """The mean of the values of samples."""

    @property
    def settings(self) -> dict[str, Any]:
        return {}

    def update(self, token: str, *arguments: Any) -> None:
        self.add(token, {"value": arguments[0], "count": 1})

    def result_of(self, counts: Collection[Counts]) -> Mean:
        return Mean(ratio(total(counts, "value"), total(counts, "count")))


def paired(first: np.ndarray, second: np.ndarray, resampling: Resampling | None = None) -> PairedTest:
    """Of a value a cluster; NaN for none."""
    runs = tuple([[{"value": float(v), "count": 1}] if np.isfinite(v) else [] for v in run] for run in (first, second))
    difference = float(np.nanmean(second) - np.nanmean(first))
    return paired_test(Means(), runs, {"mean": difference}, resampling or Resampling())  # type: ignore[arg-type]


def by_hand(first: np.ndarray, second: np.ndarray) -> float:
    """The share of all swaps after which the two differ as much."""
    apart = second - first
    sums = [abs(sum(signs * apart)) for signs in itertools.product((1, -1), repeat=len(apart))]
    return float(np.mean([each > abs(apart.sum()) - 1e-9 for each in sums]))


@pytest.mark.parametrize("clusters", [2, 5, 8])
def test_p_is_of_all_swaps(clusters: int) -> None:
    source = np.random.default_rng(clusters)
    for _ in range(5):
        first, second = source.normal(0, 1, (2, clusters))
        made = paired(first, second)
        assert (made.swaps.complete, len(made.swaps.swapped)) == (True, 2 ** (clusters - 1))
        assert made.p[0] == pytest.approx(by_hand(first, second))
        first, second = source.integers(0, 3, (2, clusters)) * 1.0
        assert paired(first, second).p[0] == pytest.approx(by_hand(first, second))  # with ties


def test_random_swaps_are_near_all_of_them() -> None:
    first, second = np.random.default_rng(3).normal((0, 0.8), 1, (10, 2)).T
    exact = paired(first, second).p[0]
    made = [paired(first, second, Resampling(resamples=500, seed=seed)) for seed in (1, 1, 2)]
    assert not made[0].swaps.complete
    assert [abs(each.p[0] - exact) < 0.05 for each in made] == [True] * 3
    assert made[0].p[0] == made[1].p[0] != made[2].p[0]
    assert all(each.p[0] >= 1 / 501 for each in made)


def test_half_of_the_ties_of_random_swaps_count() -> None:
    swaps = Swaps(swapped=np.zeros((9, 12), dtype=bool), complete=False)
    swapped = np.array([3, -2, 2, -2, 2, 1, 1, 0, 0])[:, None]
    assert p_values(np.array([2.0]), swapped, swaps)[0] == pytest.approx((1 + 1 + 4 / 2) / 10)
    assert p_values(np.array([3.0]), swapped, swaps)[0] == pytest.approx(2 / 10)  # none differ more
    assert p_values(np.array([0.0]), swapped, swaps)[0] == 1


def test_pairs_are_what_is_tested() -> None:
    """Clusters differ by far more than the runs; were one run's in another order, nothing would be real."""
    hard = np.linspace(0, 10, 12)
    better = hard + 0.1 + np.linspace(0, 0.02, 12)
    assert paired(hard, better).p[0] <= 2 / 1001
    assert paired(hard, np.roll(better, 3)).p[0] > 0.5


def test_clusters_that_do_not_differ_are_not_swapped() -> None:
    first = np.arange(40.0)
    made = paired(first, first + np.where(np.arange(40) % 5 == 0, 1.0, 0.0))
    assert (made.swaps.swapped.shape, made.p[0], paired(first, first).p[0]) == ((2**7, 8), 2 / 2**8, 1)


def test_a_swap_without_the_number_counts_as_more() -> None:
    swaps = Swaps(swapped=np.zeros((4, 3), dtype=bool), complete=True)
    swapped = np.array([[2.0, 2.0], [1.0, math.nan], [-2.0, 0.0], [0.5, 1.0]])
    assert_allclose(p_values(np.array([2.0, math.nan]), swapped, swaps), [0.5, math.nan])
    assert_allclose(p_values(np.array([1.5, 2.0]), swapped, swaps)[1], 0.5)


def test_holm() -> None:
    assert_allclose(holm(np.array([0.01, 0.04, 0.03, 0.005])), [0.03, 0.06, 0.06, 0.02])
    assert_array_equal(holm(np.array([0.9, 0.8])), [1, 1])
    assert len(holm(np.empty(0))) == 0


def test_the_interval_is_students() -> None:
    """Of differences of ± 1 around 3: 19 degrees of freedom, and t = 2.093 at 95 % and 1.729 at 90 %."""
    first, second = np.zeros(20), 3 + np.tile([1.0, -1.0], 10)
    error = math.sqrt(20 / 19) / math.sqrt(20)
    for confidence, t in ((0.95, 2.093), (0.9, 1.729)):
        made = paired(first, second, Resampling(confidence=confidence))
        assert_allclose([made.low[0], made.high[0]], [3 - t * error, 3 + t * error], atol=1e-3)
    assert_allclose(made.errors, error)


class TestUndecided:
    def test_clusters_that_are_too_few(self) -> None:
        made = paired(np.zeros(5), np.arange(5) + 1.0)
        assert undecided(made, 0, 1, 5) == "no decision is possible with 5 clusters; at least 6 are needed"
        assert undecided(made, 0, 4, 5) == "no decision is possible with 5 clusters; at least 8 are needed"
        few = paired(np.zeros(30), np.eye(30)[0])
        text = "no decision is possible with 1 of 30 clusters in which the two differ; at least 6 are needed"
        assert undecided(few, 0, 1, 30) == text

    def test_resamples_that_are_too_few(self) -> None:
        made = paired(np.zeros(30), np.arange(30) + 1.0, Resampling(resamples=10))
        assert undecided(made, 0, 1, 30) == "no decision is possible with 10 resamples; at least 19 are needed"
        assert undecided(paired(np.zeros(9), np.ones(9), Resampling(resamples=0)), 0, 1, 9).startswith("not tested: ")

    def test_no_difference(self) -> None:
        assert undecided(paired(np.zeros(8), np.tile([1.0, -1.0], 4)), 0, 1, 8) == "the difference is 0"
        nothing = np.full(8, math.nan)
        with np.errstate(all="ignore"), pytest.warns(RuntimeWarning):
            assert undecided(paired(np.zeros(8), nothing), 0, 1, 8) == "nothing to compare"

    def test_how_many_would_decide(self) -> None:
        """A difference of 0.5 with a spread of 2: (1.96 + 0.84)² = 7.849 times the square of their ratio."""
        made = paired(np.zeros(20), 0.5 + np.tile([2.0, -2.0], 10))
        assert made.p[0] > 0.05
        clusters = 7.849 * 20 / 19 * 4 / 0.5**2
        needed = math.ceil(clusters * 2 / 10) * 10  # two scenarios each, with two digits
        assert undecided(made, 0, 1, 40) == f"not decided: about {needed} scenarios would decide it"


def test_all_swaps_or_random_ones() -> None:
    assert swaps_of(3, Resampling()).swapped.tolist() == [[a, b, c] for c in (0, 1) for b in (0, 1) for a in (0,)]
    assert swaps_of(0, Resampling()).swapped.shape == (1, 0)
    assert swaps_of(11, Resampling(resamples=1000)).swapped.shape == (1000, 11)
    assert swaps_of(5, Resampling(resamples=0)).swapped.shape == (0, 5)


@pytest.mark.parametrize(
    ("clusters", "resamples", "complete"),
    [
        (0, 1, True),
        (1, 1, True),
        (2, 1, False),
        (2, 2, True),
        (4, 7, False),
        (4, 8, True),
        (5, 8, False),
        (11, 1024, True),
    ],
)
def test_up_to_which_number_all_swaps_are_taken(clusters: int, resamples: int, *, complete: bool) -> None:
    made = swaps_of(clusters, Resampling(resamples=resamples))
    number = 2 ** max(clusters - 1, 0) if complete else resamples
    assert (made.complete, made.swapped.shape) == (complete, (number, clusters))
    assert made.least_p == (1 / number if complete else 1 / (number + 1))
    assert not complete or not made.swapped[:, :1].any()


@pytest.mark.parametrize(
    ("observed", "complete", "p"),
    [(1.0, True, 3 / 4), (1 + 5e-10, True, 3 / 4), (1 + 3e-9, True, 1 / 4), (2.0, True, 1 / 4)],
)
def test_equal_but_for_rounding(observed: float, p: float, *, complete: bool) -> None:
    swaps = Swaps(swapped=np.zeros((4, 3), dtype=bool), complete=complete)
    assert p_values(np.array([observed]), np.array([[2.0], [1.0], [-1.0], [0.0]]), swaps)[0] == p


@pytest.mark.parametrize(
    ("error", "scenarios", "told"),
    [
        (0.0, 9, None),
        (0.1, 9, "9"),
        (0.1, 10, "10"),
        (0.5, 40, "79"),
        (0.5, 100, "200"),
        (5.0, 100, "20,000"),
        (1.0, 64, "510"),
    ],
)
def test_how_many_scenarios_would_decide(error: float, scenarios: int, told: str | None) -> None:
    """At least those that there are; in two digits, rounded up."""
    made = replace(paired(np.zeros(8), np.tile([3.0, -1.0], 4)), errors=np.array([error]))
    other = replace(made, differences=-made.differences)
    assert (
        undecided(made, 0, 1, scenarios)
        == undecided(other, 0, 1, scenarios)
        == ("not decided" if told is None else f"not decided: about {told} scenarios would decide it")
    )
