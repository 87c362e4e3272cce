"""`MeansEvaluator`: sums that are exact in any order, means of scenarios, and draws."""

import json
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.intervals import (
    Resampling,
    intervals_of,
    numbers_of,
    numbers_of_draws,
)
from deepaccident_devkit.evaluation.means import (
    MEAN_OF_SCENARIOS,
    MeansEvaluator,
    MeansResult,
    Sums,
    table_rows,
)
from deepaccident_devkit.evaluation.task import Row, headlines


class LengthsResult(MeansResult):
    """The result of `LengthsEvaluator`."""

    __slots__ = ()
    rows: ClassVar[tuple[Row, ...]] = table_rows(
        columns=(Row("far", "m", "higher"), Row("near", "m", is_headline=False)),
        main_tables=("late",),
        main_row="all",
    )


class LengthsEvaluator(MeansEvaluator[LengthsResult]):
    """An evaluator of means in two tables."""

    result_class = LengthsResult
    protocols: ClassVar[Mapping[str, Any]] = {"clean": Resampling(), "other": Resampling(seed=1)}
    order: ClassVar[Sequence[str]] = ("late", "early", "all")
    main_row = "all"

    def update(self, token: str, *arguments: Any) -> None:
        scenario, values = arguments
        sums = Sums()
        sums.add("early", "some", "near", 1.0)
        for value in values:
            sums.add("late", "all", "far", value)
        self.add(token, sums.counts(scenario))


def evaluator_of(values: Sequence[Sequence[float]], scenarios: int = 8) -> LengthsEvaluator:
    evaluator = LengthsEvaluator()
    for number, sample_values in enumerate(values):
        evaluator.update(f"{number:04d}", f"s{number % scenarios}", sample_values)
    return evaluator


@pytest.fixture
def values() -> list[list[float]]:
    generator = np.random.default_rng(3)
    return [generator.exponential(3, generator.integers(0, 4)).tolist() for _ in range(40)]


def test_tables_rows_and_columns_are_in_order() -> None:
    sums = Sums()
    for row in ("10 s", "b", "2 s", "all", "a"):
        for value in (1.0, 2.0):
            sums.add("early", row, "near", value)

    sums.add("late", "a", "near", np.nan)
    sums.add("late", "a", "far", np.nan)
    evaluator = LengthsEvaluator()
    evaluator.add("t", sums.counts())
    result = evaluator.compute()

    assert {table: [*rows] for table, rows in result.means.items()} == {
        "late": ["a"],
        "early": ["all", "2 s", "10 s", "a", "b"],
    }
    assert [*result.means["late"]["a"]] == ["far", "near"]
    assert result.counted["late"]["a"] == {"far": 0, "near": 0}
    assert result.counted["early"]["a"] == {"near": 2}
    assert headlines(result) == ()
    assert LengthsEvaluator("other").settings["seed"] == 1


def test_rows_are_means_over_their_masks() -> None:
    sums = Sums()
    masks = {"all": np.ones(3, dtype=bool), "few": np.array([True, False, True])}
    columns = {"far": np.array([1.0, 2.0, np.nan]), "near": np.array([np.inf, 5.0, 7.0])}
    sums.add_rows("late", masks, columns)
    evaluator = LengthsEvaluator()
    evaluator.add("t", sums.counts())
    result = evaluator.compute()

    assert result.means["late"] == {
        "all": {"far": 1.5, "near": 6.0},
        "few": {"far": 1.0, "near": 7.0},
    }
    assert result.counted["late"] == {"all": {"far": 2, "near": 2}, "few": {"far": 1, "near": 1}}


def test_sums_are_the_same_in_any_order_and_parts(values: list[list[float]]) -> None:
    evaluator = evaluator_of(values)
    counts = [evaluator.counts[token] for token in sorted(evaluator.tokens)]
    expected = evaluator.compute()
    assert evaluator.result_of(counts[::-1]) == expected

    pooled = [*evaluator.pooled(counts[:16]), *evaluator.pooled(counts[16:])]
    pooled_means = evaluator.result_of(pooled).means["late"]["all"]
    assert pooled_means == expected.means["late"]["all"]

    stored = json.loads(json.dumps(counts))
    assert evaluator.result_of(stored) == expected

    mean = np.mean([*chain(*values)])
    assert expected.means["late"]["all"]["far"] == pytest.approx(mean, abs=1e-9)


def test_the_mean_of_scenarios(values: list[list[float]]) -> None:
    result = evaluator_of(values).compute()
    scenarios = [[*chain(*values[first::8])] for first in range(8)]
    scenario_means = [np.mean(scenario) for scenario in scenarios if scenario]

    mean = result.means["late"][MEAN_OF_SCENARIOS]["far"]
    assert mean == pytest.approx(np.mean(scenario_means), abs=1e-8)
    assert result.counted["late"][MEAN_OF_SCENARIOS]["far"] == len(scenario_means)
    assert MEAN_OF_SCENARIOS not in result.means["early"]


def test_draws_at_once_equal_draws_one_after_another(values: list[list[float]]) -> None:
    evaluator = evaluator_of(values)
    cluster_names = {token: f"c{int(token) % 8}" for token in sorted(evaluator.tokens)}
    clusters = evaluator.clustered(cluster_names)
    repetitions = np.random.default_rng(1).integers(0, 3, (20, len(clusters)))
    names = [*numbers_of(evaluator.compute()), "means/late/nobody/far"]

    expected = []
    for result in Evaluator.resampled(evaluator, clusters, repetitions):
        numbers = numbers_of(result)
        expected.append([numbers.get(name, np.nan) for name in names])

    assert_array_equal(numbers_of_draws(evaluator, clusters, repetitions, names), expected)


def test_a_cluster_without_a_number_does_not_change_it() -> None:
    """The jackknife counts the clusters that change a number, and rounding must add none."""
    draws = np.random.default_rng(5).uniform(0, 9, 80)
    evaluator = evaluator_of(
        [[value] if number % 8 < 5 else [] for number, value in enumerate(draws)]
    )
    cluster_names = {token: f"c{int(token) % 8}" for token in sorted(evaluator.tokens)}
    clusters = evaluator.clustered(cluster_names)

    intervals = intervals_of(evaluator, clusters, evaluator.compute())
    assert intervals.ends == {}
    assert any(
        "fewer than 6 clusters" in note and "means/late/all/far" in note for note in intervals.notes
    )


def test_notes_count_over_the_samples(tmp_path: Path) -> None:
    evaluator = LengthsEvaluator("other")
    for number in range(3):
        sums = Sums()
        sums.note("left out: {sample}", 500 * number)
        sums.note("{plan} of {0.__class__}", number == 2)
        evaluator.add(str(number), sums.counts())

    result = evaluator.compute()
    assert result.notes == ("left out: 1,500 samples", "1 plan of 1 0.__class__")
    assert (result.samples, result.means) == (3, {})
    assert evaluator.compute([]).samples == 0

    resumed = LengthsEvaluator("other").resume(evaluator.save(tmp_path / "kept"))
    assert resumed.compute() == result
