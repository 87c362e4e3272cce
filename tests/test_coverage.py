"""Intervals hold the truth as often as they say, and differences are not called real by chance: a
quick look.

`python -m benchmarks.coverage` measures the whole tables.
"""

from types import ModuleType

import pytest
from scripts import of_checkout

DRAWS = 400


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    return of_checkout("benchmarks.coverage")


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["shares", "ratios of areas", "means", "differences of two runs' shares"]
)
@pytest.mark.parametrize(("clusters", "least"), [(8, 0.86), (52, 0.9)])
def test_intervals_hold_the_truth(
    benchmark: ModuleType, kind: str, clusters: int, least: float
) -> None:
    """An interval of 90 % called one of 95 %, or the percentile bootstrap of before, fails."""
    cells = list(benchmark.coverage(kind, clusters, DRAWS))
    inner = [cell.new for cell in cells if not cell.ends]
    assert 0.93 <= benchmark.mean(inner) <= 0.975
    assert min(cell.new for cell in cells) >= least
    narrow = [
        cell.new
        for cell in benchmark.coverage(kind, clusters, DRAWS, confidence=0.9)
        if not cell.ends
    ]
    assert benchmark.mean(narrow) < 0.93 + 0.005 * (clusters < 52)
    assert benchmark.mean([cell.old for cell in cells]) < 0.93


@pytest.mark.slow
def test_differences_are_not_called_real_by_chance(benchmark: ModuleType) -> None:
    made = list(benchmark.power(DRAWS))
    falsely = [each for each in made if not each.effect]
    assert max(each.new for each in falsely) <= 0.05 + 3 * (0.05 * 0.95 / DRAWS) ** 0.5
    assert max(each.old for each in falsely) > 0.1
    for each in made:
        if each.effect and each.clusters >= 16:
            assert each.new >= each.old - 0.1 - 3 * (0.25 / DRAWS) ** 0.5
    assert max(each.new for each in made) > 0.9
