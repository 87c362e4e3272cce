"""Two evaluations side by side: which differences are real, which evaluations cannot be compared,
and the permutation test.
"""

import csv
import itertools
import json
import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import binom
from support.expected_errors import assert_raises
from support.generated_bundles import MAIN, change_json, write_bundle

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError, ResultsError
from deepaccident_devkit.evaluation.accident.scoring import exact_parts
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator, ratio, total
from deepaccident_devkit.evaluation.intervals import Resampling
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs import (
    Comparison,
    EvaluationRun,
    SampleSelection,
    compare_bundles,
    evaluate_results,
    save_run,
)
from deepaccident_devkit.evaluation.runs.comparison import (
    PairedTest,
    Swaps,
    holm,
    p_values,
    paired_test,
    swaps_of,
    undecided_text,
)
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup

pytestmark = pytest.mark.slow

Write = Callable[..., Results]
Save = Callable[..., Path]
FEW_RESAMPLES = Resampling(resamples=40)
FIRST = "type1_subtype1_accident/Town03_000/ego_vehicle/001"
COUNT_FAULTS: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "nothing": (lambda counts: counts[FIRST].clear(), "KeyError: 'vpq'"),
    "a text": (lambda counts: counts[FIRST].update(cells="x"), "TypeError"),
    "a short list": (lambda counts: counts[FIRST].update(cells=[]), "IndexError"),
    "a number": (lambda counts: counts[FIRST].update(paths=1), "TypeError"),
    "giants": (lambda counts: counts[FIRST].update(vpq=[[[10**400]] * 4] * 2), "OverflowError"),
    "infinity": (lambda counts: counts[FIRST].update(vpq=[[[math.inf]] * 4] * 2), "OverflowError"),
    "no token": (
        lambda counts: counts.update({"x" * 10**6: counts[FIRST]}),
        "expected a sample token",
    ),
}


@pytest.fixture(scope="module")
def motion_bundles(
    da_b: DeepAccident,
    selection: SampleSelection,
    write_motion: Write,
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, Path]:
    """Evaluate the labels moved by two cells, and by one: the second is better."""
    folder = tmp_path_factory.mktemp("motion")
    bundles = []
    for moved in (2, 1):
        results = write_motion(folder / f"results {moved}", selection.tokens(da_b), moved=moved)
        run = evaluate_results(da_b, results, EvaluationSetup(task="motion"), selection, workers=1)
        bundles.append(save_run(run, folder / f"bundle {moved}"))

    return bundles[0], bundles[1]


@pytest.fixture
def save_bundle(
    run: EvaluationRun, da_b: DeepAccident, write_accidents: Write, tmp_path: Path
) -> Save:
    """Evaluate and save: `(name, moved, setup, **changes of the selection)`."""

    def save(
        name: str, moved: float = 0.1, setup: EvaluationSetup = run.setup, **changes: Any
    ) -> Path:
        selection = replace(run.selection, **changes)
        results = write_accidents(tmp_path / f"{name}.json", selection.tokens(da_b), moved=moved)
        other_run = evaluate_results(da_b, results, setup, selection, workers=1)
        return save_run(other_run, tmp_path / name)

    return save


def numbers_by_name(comparison: Comparison) -> dict[str, Any]:
    return {number.headline or number.number: number for number in comparison.numbers}


@pytest.fixture
def compare_cells(tmp_path: Path) -> Callable[..., Comparison]:
    """Compare two runs by the cells that each hits, of 100 true ones in every cluster."""

    def compare(
        a: Sequence[int], b: Sequence[int], resampling: Resampling | None = None, **options: Any
    ) -> Comparison:
        folders = []
        for name, hit_cells in (("a", a), ("b", b)):
            folder = tmp_path / f"{name}{len(list(tmp_path.iterdir()))}"
            cells = [(hits, 100 - hits) for hits in hit_cells]
            folders.append(write_bundle(folder, cells, **options))

        return compare_bundles(*folders, resampling)

    return compare


HIT_CELLS = [5 * number for number in range(16)]
"""Cells hit in each cluster: clusters differ by far more than two runs do."""


def test_the_better_one_is_named(compare_cells: Callable[..., Comparison]) -> None:
    better = [hits + 3 + number % 3 for number, hits in enumerate(HIT_CELLS)]
    iou = numbers_by_name(compare_cells(HIT_CELLS, better))[MAIN]

    assert (iou.family, iou.real, iou.better, iou.decision) == ("main", True, "b", "b is better")
    assert iou.difference == pytest.approx(iou.b - iou.a)
    assert 3 < iou.low < iou.difference < iou.high < 5
    assert iou.p == iou.adjusted_p == pytest.approx(1 / 1001)
    assert iou.unit == "%"


def test_pairs_are_compared(compare_cells: Callable[..., Comparison]) -> None:
    """With the clusters of one run in another order, the same numbers show nothing."""
    better = [hits + 3 for hits in HIT_CELLS]
    reordered = better[5:] + better[:5]
    iou = numbers_by_name(compare_cells(HIT_CELLS, reordered))[MAIN]

    assert iou.difference == pytest.approx(3)
    assert not iou.real
    assert iou.low < -5 < 10 < iou.high


def test_the_other_headlines_are_tested_together(compare_cells: Callable[..., Comparison]) -> None:
    """Both ranges have the same numbers, which are real as one test and not as one of several."""
    gains = [1, -1, 2, -1, 3, 3, 1, 2, 2, 1]
    numbers = numbers_by_name(compare_cells([50] * 10, [50 + gain for gain in gains]))
    main, other = numbers[MAIN], numbers["iou 100x100"]
    assert main.p == other.p == main.adjusted_p <= 0.05 < other.adjusted_p
    assert (main.real, other.real, other.better) == (True, False, None)

    headlines = [number for number in numbers.values() if number.family == "headlines"]
    tests = sum(number.p is not None for number in headlines)
    assert other.adjusted_p == pytest.approx(min(tests * other.p, 1))

    exploratory = [number for number in numbers.values() if number.family == "other"]
    assert {number.decision for number in exploratory} == {"for exploration"}
    assert not any(number.real for number in exploratory)


def test_an_evaluation_differs_from_itself_in_nothing(
    compare_cells: Callable[..., Comparison],
) -> None:
    decisions = ("equal", "nothing to compare", "for exploration")
    for number in compare_cells(HIT_CELLS, HIT_CELLS).numbers:
        assert (number.real, number.better, number.low) == (False, None, None)
        assert number.difference in (0.0, None)
        assert number.decision in decisions


def test_what_would_decide(compare_cells: Callable[..., Comparison]) -> None:
    alternating = [50 + 3 * (-1) ** number + 1 for number in range(20)]
    iou = numbers_by_name(compare_cells([50] * 20, alternating))[MAIN]

    assert not iou.real
    assert iou.decision == "inconclusive (would need about 75 scenarios)"  # 7.849 · 9 · 20 / 19


def test_without_resamples(compare_cells: Callable[..., Comparison]) -> None:
    better = [hits + 9 for hits in HIT_CELLS]
    comparison = compare_cells(HIT_CELLS, better, Resampling(resamples=0))

    outcomes = {(number.p, number.low, number.real) for number in comparison.numbers}
    assert outcomes == {(None, None, False)}
    assert comparison.notes() == [
        "no confidence intervals and no tests, since the resamples were set to 0"
    ]


def test_all_swaps_of_few_clusters_are_tried(compare_cells: Callable[..., Comparison]) -> None:
    """Seven clusters have 64 swaps, and none of the others differs as much."""
    hit_cells = HIT_CELLS[:7]
    better = [hits + 9 + number % 2 for number, hits in enumerate(hit_cells)]
    comparison = compare_cells(hit_cells, better, twins=True)

    lines = [" ".join(line.split()) for line in comparison.to_text().splitlines()]
    numbers = "15.000 24.429 +9.429 [+8.934, +9.923] 0.016"
    assert f"IoU, 30 m × 30 m (%) {numbers} b is better" in lines

    payload = comparison.to_dict()
    assert (payload["samples"], payload["clusters"]) == (14, 7)
    assert (payload["swaps"], payload["all_swaps"]) == (64, True)

    second = payload["numbers"][1]
    assert (second["p"], second["adjusted_p"]) == (1 / 64, 3 / 64)


def test_json_and_csv_have_every_number(motion_bundles: tuple[Path, Path], tmp_path: Path) -> None:
    comparison = compare_bundles(*motion_bundles, FEW_RESAMPLES)
    payload = json.loads(json.dumps(comparison.to_dict()))
    (path,) = comparison.to_csv(tmp_path / "new")
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))

    assert float(rows[0]["a"]) == payload["numbers"][0]["a"]
    assert len(rows) == len(comparison.numbers)


def test_samples_of_one_evaluation_only_are_refused_or_left_out(save_bundle: Save) -> None:
    a = save_bundle("a")
    b = save_bundle("b", 1.0, agents=("ego_vehicle", "infrastructure"))
    assert_raises(
        (
            lambda: compare_bundles(a, b, FEW_RESAMPLES),
            EvaluationError,
            r"2 samples only in .*a \(type1.*\); evaluate both at the same",
        ),
    )

    comparison = compare_bundles(a, b, FEW_RESAMPLES, common=True)
    assert (comparison.samples, comparison.left_out) == (4, 2)
    assert "excluded: 2 samples that only one of the two evaluations has" in comparison.to_text()


def test_a_partial_evaluation_is_marked(
    save_bundle: Save,
    run: EvaluationRun,
    da_b: DeepAccident,
    write_accidents: Write,
    tmp_path: Path,
) -> None:
    tokens = run.selection.tokens(da_b)
    results = write_accidents(tmp_path / "some.json", tokens[1:])
    partial_run = evaluate_results(
        da_b, results, run.setup, run.selection, allow_partial=True, workers=1
    )
    part = save_run(partial_run, tmp_path / "part")

    comparison = compare_bundles(save_bundle("a"), part, FEW_RESAMPLES, common=True)
    assert comparison.partial == ("b: PARTIAL: 5 of 6 samples",)


def test_other_samples_tasks_and_rules_are_refused(
    save_bundle: Save, motion_bundles: tuple[Path, Path], run: EvaluationRun
) -> None:
    a = save_bundle("a")
    other_rules = save_bundle(
        "b", setup=replace(run.setup, switches={"reading.danger_distance": 0.5})
    )
    other_samples = save_bundle("c", split="train")

    assert_raises(
        (
            lambda: compare_bundles(a, motion_bundles[0], FEW_RESAMPLES),
            EvaluationError,
            (
                "of the task accident",
                "of the task motion",
                "compare two evaluations of the same task",
            ),
        ),
        (
            lambda: compare_bundles(a, other_rules, FEW_RESAMPLES),
            EvaluationError,
            (
                r"switches/reading.danger_distance 'absent' and 0.5; "
                r"settings/choices/reading/danger_distance 1.0"
            ),
        ),
        (
            lambda: compare_bundles(a, other_samples, FEW_RESAMPLES, common=True),
            EvaluationError,
            ("have no sample in common",),
        ),
    )


def test_other_cells_are_refused(motion_bundles: tuple[Path, Path], tmp_path: Path) -> None:
    """Labels are made on the predictions' own cells: other cells are another truth."""
    small = copytree(motion_bundles[1], tmp_path / "small")
    axis = [-25.0, 25.0, 0.5]
    change_json(
        small / "metrics_summary.json", lambda summary: summary["results"]["form"].update(x=axis)
    )

    assert_raises(
        (
            lambda: compare_bundles(motion_bundles[0], small, FEW_RESAMPLES),
            EvaluationError,
            ("rules: cells/x '[-50.0, 50.0, 0.5]' and '[-25.0, 25.0, 0.5]'",),
        ),
    )


def test_other_labels_and_another_devkit_are_refused(save_bundle: Save, results: Results) -> None:
    bundle, other_labels, other_devkit = map(save_bundle, "abc")
    scenario = min(results.tokens).rsplit("/", 2)[0]
    change_json(
        other_labels / "scenarios.json",
        lambda content: content["scenarios"][scenario].update(label="0", boxes="0"),
    )
    path = other_devkit / "counts.json"
    path.write_text(path.read_text().replace("of devkit ", "of devkit 9."))

    assert_raises(
        (
            lambda: compare_bundles(bundle, other_labels, FEW_RESAMPLES),
            EvaluationError,
            (f"calib files differ in 1 scenario ({scenario})",),
        ),
        (
            lambda: compare_bundles(bundle, other_devkit, FEW_RESAMPLES),
            EvaluationError,
            ("counts.json: was saved by AccidentEvaluator of devkit 9.",),
        ),
    )


@pytest.mark.parametrize(("clusters", "pairs"), [(12, 200)])
def test_equally_good_runs_are_rarely_called_really_different(
    tmp_path: Path, clusters: int, pairs: int
) -> None:
    """Two runs of the same law differ in at most 5 % of the pairs, but for chance.

    Clusters that are hard for one run are hard for the other, too.
    """
    generator = np.random.default_rng(clusters)
    real_differences = 0
    for pair in range(pairs):
        difficulty = generator.normal(0, 1, clusters)
        folders = []
        for name in "ab":
            noise = generator.normal(0, 0.7, clusters)
            hit_cells = generator.binomial(20, 1 / (1 + np.exp(difficulty + noise)))
            cells = [(hits, 20 - hits) for hits in hit_cells.tolist()]
            folders.append(write_bundle(tmp_path / f"{pair}{name}", cells, twins=True))
        comparison = compare_bundles(*folders, Resampling(resamples=200, seed=pair))
        real_differences += numbers_by_name(comparison)[MAIN].real

    assert real_differences <= binom.ppf(0.995, pairs, 0.05)
    assert real_differences > 0


@pytest.mark.parametrize("fault", COUNT_FAULTS)
def test_damaged_counts_are_a_fault_of_the_bundle(tmp_path: Path, fault: str) -> None:
    change, reason = COUNT_FAULTS[fault]
    folder = write_bundle(tmp_path / "a", [(3, 1)] * 3)
    change_json(folder / "counts.json", lambda content: change(content["counts"]))

    message = rf"counts.json: does not contain counts of its protocol \(.*{reason}"
    with pytest.raises(ResultsError, match=message):
        compare_bundles(folder, folder)


def test_counts_of_detections_that_ask_for_memory() -> None:
    evaluator = EvaluationSetup(task="detection").evaluator()
    columns = {name: [[], []] for name in ("tp", "spent", "matches")}
    counts = {
        "token": "a",
        "truths": [],
        "scores": [0.5],
        "detections": [[10**12], [0]],
        "excused": [[]] * 3,
    }
    evaluator.add("a", counts | columns | {"errors": [[]] * 6})

    assert_raises(
        (
            evaluator.compute,
            EvaluationError,
            r"detections: expected groups from 0 to \d+, found 10{12} to 10{12}",
        ),
    )


def test_counts_of_warnings_that_ask_for_memory() -> None:
    evaluator = EvaluationSetup(task="warning", protocol="clean").evaluator()
    nothing = {
        "alarms": [],
        "unjudged": [],
        "references": [],
        "involvement": None,
        "ahead": None,
        "to_end": None,
    }
    evaluator.add(
        "a", {"recording": "s/t/a", "frame": 10**9, "kind": "others", "beyond": 0} | nothing
    )

    assert_raises(
        (
            evaluator.compute,
            EvaluationError,
            "s/t/a: expected frames up to 10,000, found 1000000000",
        ),
    )


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_counts_of_accidents_with_endless_remainders(value: float) -> None:
    assert len(exact_parts([[1.0, value]])) == 1


@dataclass(frozen=True)
class Mean:
    mean: float


class MeanEvaluator(Evaluator[Mean]):
    """An evaluator of the mean of the samples' values."""

    @property
    def settings(self) -> dict[str, Any]:
        return {}

    def update(self, token: str, *arguments: Any) -> None:
        self.add(token, {"value": arguments[0], "count": 1})

    def result_of(self, counts: Collection[Counts]) -> Mean:
        return Mean(ratio(total(counts, "value"), total(counts, "count")))


def compare_means(
    first: np.ndarray, second: np.ndarray, resampling: Resampling | None = None
) -> PairedTest:
    """Compare the means of two runs with one value in each cluster; NaN stands for no sample."""
    runs: Any = tuple(
        [[{"value": float(value), "count": 1}] if np.isfinite(value) else [] for value in values]
        for values in (first, second)
    )
    difference = {"mean": float(np.nanmean(second) - np.nanmean(first))}
    return paired_test(MeanEvaluator(), runs, difference, resampling or Resampling())


def share_of_swaps_by_hand(first: np.ndarray, second: np.ndarray) -> float:
    """Return the share of all swaps after which the two runs differ at least as much."""
    differences = second - first
    as_far = []
    for signs in itertools.product((1, -1), repeat=len(differences)):
        swapped = abs(sum(signs * differences))
        as_far.append(swapped > abs(differences.sum()) - 1e-9)

    return float(np.mean(as_far))


@pytest.mark.parametrize("clusters", [2, 5, 8])
def test_p_is_the_share_of_all_swaps(clusters: int) -> None:
    generator = np.random.default_rng(clusters)
    for _ in range(5):
        first, second = generator.normal(0, 1, (2, clusters))
        test = compare_means(first, second)
        assert (test.swaps.complete, len(test.swaps.swapped)) == (True, 2 ** (clusters - 1))
        assert test.p[0] == pytest.approx(share_of_swaps_by_hand(first, second))

        first, second = generator.integers(0, 3, (2, clusters)) * 1.0  # with ties
        test = compare_means(first, second)
        assert test.p[0] == pytest.approx(share_of_swaps_by_hand(first, second))


def test_random_swaps_are_near_all_of_them() -> None:
    first, second = np.random.default_rng(3).normal((0, 0.8), 1, (10, 2)).T
    exact_p = compare_means(first, second).p[0]
    tests = [
        compare_means(first, second, Resampling(resamples=500, seed=seed)) for seed in (1, 1, 2)
    ]

    assert not tests[0].swaps.complete

    ps = [test.p[0] for test in tests]
    for p in ps:
        assert abs(p - exact_p) < 0.05
        assert p >= 1 / 501

    assert ps[0] == ps[1] != ps[2]


def test_half_of_the_ties_of_random_swaps_count() -> None:
    swaps = Swaps(swapped=np.zeros((9, 12), dtype=bool), complete=False)
    swapped = np.array([3, -2, 2, -2, 2, 1, 1, 0, 0])[:, None]

    (p,) = p_values(np.array([2.0]), swapped, swaps)
    assert p == pytest.approx((1 + 1 + 4 / 2) / 10)

    (p,) = p_values(np.array([3.0]), swapped, swaps)
    assert p == pytest.approx(2 / 10)  # no swap differs more

    (p,) = p_values(np.array([0.0]), swapped, swaps)
    assert p == 1


def test_a_swap_without_the_number_counts_as_more() -> None:
    swaps = Swaps(swapped=np.zeros((4, 3), dtype=bool), complete=True)
    swapped = np.array(
        [
            [2.0, 2.0],
            [1.0, math.nan],
            [-2.0, 0.0],
            [0.5, 1.0],
        ]
    )

    assert_allclose(p_values(np.array([2.0, math.nan]), swapped, swaps), [0.5, math.nan])
    assert_allclose(p_values(np.array([1.5, 2.0]), swapped, swaps)[1], 0.5)


def test_holm() -> None:
    assert_allclose(holm(np.array([0.01, 0.04, 0.03, 0.005])), [0.03, 0.06, 0.06, 0.02])
    assert_array_equal(holm(np.array([0.9, 0.8])), [1, 1])
    assert len(holm(np.empty(0))) == 0


def test_the_interval_is_students() -> None:
    """Differences of ± 1 around 3 have 19 degrees of freedom: t = 2.093 at 95 %, 1.729 at 90 %."""
    first = np.zeros(20)
    second = 3 + np.tile([1.0, -1.0], 10)
    error = math.sqrt(20 / 19) / math.sqrt(20)
    for confidence, t in ((0.95, 2.093), (0.9, 1.729)):
        test = compare_means(first, second, Resampling(confidence=confidence))
        assert_allclose([test.low[0], test.high[0]], [3 - t * error, 3 + t * error], atol=1e-3)

    assert_allclose(test.errors, error)


def test_clusters_that_are_too_few() -> None:
    test = compare_means(np.zeros(5), np.arange(5) + 1.0)
    text = "no decision is possible with 5 clusters; at least 6 are needed"
    assert undecided_text(test, 0, 1, 5) == text

    text = "no decision is possible with 5 clusters; at least 8 are needed"
    assert undecided_text(test, 0, 4, 5) == text

    test = compare_means(np.zeros(30), np.eye(30)[0])
    text = (
        "no decision is possible with 1 of 30 clusters in which the two differ; "
        "at least 6 are needed"
    )
    assert undecided_text(test, 0, 1, 30) == text


def test_resamples_that_are_too_few() -> None:
    test = compare_means(np.zeros(30), np.arange(30) + 1.0, Resampling(resamples=10))
    text = "no decision is possible with 10 resamples; at least 19 are needed"
    assert undecided_text(test, 0, 1, 30) == text

    untested = compare_means(np.zeros(9), np.ones(9), Resampling(resamples=0))
    assert undecided_text(untested, 0, 1, 9).startswith("not tested: ")


def test_no_difference_decides_nothing() -> None:
    test = compare_means(np.zeros(8), np.tile([1.0, -1.0], 4))
    assert undecided_text(test, 0, 1, 8) == "equal"

    unknown = np.full(8, math.nan)
    with np.errstate(all="ignore"), pytest.warns(RuntimeWarning):
        assert undecided_text(compare_means(np.zeros(8), unknown), 0, 1, 8) == "nothing to compare"


def test_all_swaps_or_random_ones() -> None:
    assert swaps_of(3, Resampling()).swapped.tolist() == [
        [0, 0, 0],
        [0, 1, 0],
        [0, 0, 1],
        [0, 1, 1],
    ]
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
def test_all_swaps_are_taken_up_to_the_number_of_resamples(
    clusters: int, resamples: int, *, complete: bool
) -> None:
    swaps = swaps_of(clusters, Resampling(resamples=resamples))
    number = 2 ** max(clusters - 1, 0) if complete else resamples

    assert (swaps.complete, swaps.swapped.shape) == (complete, (number, clusters))
    assert swaps.least_p == (1 / number if complete else 1 / (number + 1))
    assert not complete or not swaps.swapped[:, :1].any()


@pytest.mark.parametrize(
    ("observed", "complete", "p"),
    [(1.0, True, 3 / 4), (1 + 5e-10, True, 3 / 4), (1 + 3e-9, True, 1 / 4), (2.0, True, 1 / 4)],
)
def test_differences_equal_but_for_rounding_are_ties(
    observed: float, p: float, *, complete: bool
) -> None:
    swaps = Swaps(swapped=np.zeros((4, 3), dtype=bool), complete=complete)
    swapped = np.array([[2.0], [1.0], [-1.0], [0.0]])
    assert p_values(np.array([observed]), swapped, swaps)[0] == p


@pytest.mark.parametrize(
    ("error", "scenarios", "number_text"),
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
def test_how_many_scenarios_would_decide(
    error: float, scenarios: int, number_text: str | None
) -> None:
    """The number is at least that of the scenarios, and rounded up to two digits."""
    test = compare_means(np.zeros(8), np.tile([3.0, -1.0], 4))
    better = replace(test, errors=np.array([error]))
    worse = replace(better, differences=-better.differences)

    if number_text is None:
        text = "inconclusive"
    else:
        text = f"inconclusive (would need about {number_text} scenarios)"
    assert undecided_text(better, 0, 1, scenarios) == text
    assert undecided_text(worse, 0, 1, scenarios) == text
