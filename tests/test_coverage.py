"""A quick check that intervals hold the truth often enough, and that few differences are chance.

`python -m benchmarks.coverage` measures the whole tables.
"""

from types import ModuleType

import pytest
from support.repository_scripts import import_from_checkout

NUM_DRAWS = 400


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    return import_from_checkout("benchmarks.coverage")


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["shares", "ratios of areas", "means", "differences of two runs' shares"]
)
@pytest.mark.parametrize(("clusters", "min_coverage"), [(8, 0.86), (52, 0.9)])
def test_intervals_hold_the_truth(
    benchmark: ModuleType, kind: str, clusters: int, min_coverage: float
) -> None:
    """The test can tell 95 % from 90 %, and the interval from the former percentile bootstrap."""
    cells = list(benchmark.simulate_coverage(kind, clusters, NUM_DRAWS))
    inner = [cell.coverage for cell in cells if not cell.is_extreme]
    assert 0.93 <= benchmark.mean(inner) <= 0.975
    assert min(cell.coverage for cell in cells) >= min_coverage

    narrow_cells = benchmark.simulate_coverage(kind, clusters, NUM_DRAWS, confidence=0.9)
    inner = [cell.coverage for cell in narrow_cells if not cell.is_extreme]
    assert benchmark.mean(inner) < 0.93 + 0.005 * (clusters < 52)
    assert benchmark.mean([cell.bootstrap_coverage for cell in cells]) < 0.93


@pytest.mark.slow
def test_differences_are_not_called_real_by_chance(benchmark: ModuleType) -> None:
    cells = list(benchmark.simulate_tests(NUM_DRAWS))
    cells_without_effect = [cell for cell in cells if not cell.effect]
    max_share_error = 3 * (0.05 * 0.95 / NUM_DRAWS) ** 0.5
    assert max(cell.rate for cell in cells_without_effect) <= 0.05 + max_share_error
    assert max(cell.bootstrap_rate for cell in cells_without_effect) > 0.1
    for cell in cells:
        if cell.effect and cell.clusters >= 16:
            assert cell.rate >= cell.bootstrap_rate - 0.1 - 3 * (0.25 / NUM_DRAWS) ** 0.5
    assert max(cell.rate for cell in cells) > 0.9
