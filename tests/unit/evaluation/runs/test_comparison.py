"""Two evaluations side by side: which differences are real, which two cannot be compared; the
permutation test.
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
from generated_bundles import MAIN, write_bundle
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused
from scipy.stats import binom

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
FEW = Resampling(resamples=40)
FIRST = "type1_subtype1_accident/Town03_000/ego_vehicle/001"
COUNT_FAULTS: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "nothing": (lambda counts: counts[FIRST].clear(), "KeyError: 'vpq'"),
    "a text": (lambda counts: counts[FIRST].update(cells="x"), "ValueError"),
    "a short list": (lambda counts: counts[FIRST].update(cells=[]), "IndexError"),
    "a number": (lambda counts: counts[FIRST].update(paths=1), "TypeError"),
    "giants": (lambda counts: counts[FIRST].update(vpq=[[[10**400]] * 4] * 2), "OverflowError"),
    "infinity": (lambda counts: counts[FIRST].update(vpq=[[[math.inf]] * 4] * 2), "OverflowError"),
    "no token": (
        lambda counts: counts.update({"x" * 10**6: counts[FIRST]}),
        "expected a sample's token",
    ),
}


@pytest.fixture(scope="module")
def motion_bundles(
    da_b: DeepAccident,
    selection: SampleSelection,
    write_motion: Write,
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, Path]:
    """The labels moved by two cells, and by one: the second is better."""
    folder, made = tmp_path_factory.mktemp("motion"), []
    for moved in (2, 1):
        results = write_motion(folder / f"results {moved}", selection.tokens(da_b), moved=moved)
        run = evaluate_results(da_b, results, EvaluationSetup(task="motion"), selection, workers=1)
        made.append(save_run(run, folder / f"bundle {moved}"))
    return made[0], made[1]


@pytest.fixture
def saved(run: EvaluationRun, da_b: DeepAccident, write_accidents: Write, tmp_path: Path) -> Save:
    """Evaluate and save: `(name, moved, tokens, setup, **of the selection)`."""

    def save(
        name: str, moved: float = 0.1, setup: EvaluationSetup = run.setup, **selection: Any
    ) -> Path:
        chosen = replace(run.selection, **selection)
        results = write_accidents(tmp_path / f"{name}.json", chosen.tokens(da_b), moved=moved)
        return save_run(evaluate_results(da_b, results, setup, chosen, workers=1), tmp_path / name)

    return save


def by_name(comparison: Comparison) -> dict[str, Any]:
    return {each.headline or each.number: each for each in comparison.numbers}


@pytest.fixture
def generated(tmp_path: Path) -> Callable[..., Comparison]:
    """Compare two runs of the given cells found, of 100 true ones a cluster."""

    def compare(
        a: Sequence[int], b: Sequence[int], resampling: Resampling | None = None, **how: Any
    ) -> Comparison:
        folders = [
            write_bundle(
                tmp_path / f"{name}{len(list(tmp_path.iterdir()))}",
                [(each, 100 - each) for each in run],
                **how,
            )
            for name, run in (("a", a), ("b", b))
        ]
        return compare_bundles(*folders, resampling)

    return compare


HARD = [5 * number for number in range(16)]
"""Cells found in clusters that differ by far more than two runs do."""


def test_the_better_one_is_named(generated: Callable[..., Comparison]) -> None:
    iou = by_name(generated(HARD, [each + 3 + number % 3 for number, each in enumerate(HARD)]))[
        MAIN
    ]
    assert (iou.family, iou.real, iou.better, iou.decision) == ("main", True, "b", "b is better")
    assert iou.difference == pytest.approx(iou.b - iou.a)
    assert 3 < iou.low < iou.difference < iou.high < 5
    assert iou.p == iou.adjusted_p == pytest.approx(1 / 1001)
    assert iou.unit == "%"


def test_pairs_are_compared(generated: Callable[..., Comparison]) -> None:
    """Were the clusters of one run in another order, the same numbers would tell nothing."""
    better = [each + 3 for each in HARD]
    apart = by_name(generated(HARD, better[5:] + better[:5]))[MAIN]
    assert apart.difference == pytest.approx(3)
    assert not apart.real
    assert apart.low < -5 < 10 < apart.high


def test_the_other_headlines_are_tested_together(generated: Callable[..., Comparison]) -> None:
    """Both ranges have the same numbers: by itself one is real, of several it is not."""
    numbers = by_name(
        generated([50] * 10, [50 + each for each in [1, -1, 2, -1, 3, 3, 1, 2, 2, 1]])
    )
    alone, together = numbers[MAIN], numbers["iou 100x100"]
    assert alone.p == together.p == alone.adjusted_p <= 0.05 < together.adjusted_p
    assert (alone.real, together.real, together.better) == (True, False, None)
    tested = [
        each for each in numbers.values() if each.family == "headlines" and each.p is not None
    ]
    assert together.adjusted_p == pytest.approx(min(len(tested) * together.p, 1))
    others = [each for each in numbers.values() if each.family == "other"]
    assert {each.decision for each in others} == {"for exploration"}
    assert not any(each.real for each in others)


def test_itself_differs_in_nothing(generated: Callable[..., Comparison]) -> None:
    for each in generated(HARD, HARD).numbers:
        assert (each.real, each.better, each.low) == (False, None, None)
        assert each.difference in (0.0, None)
        assert each.decision in ("the difference is 0", "nothing to compare", "for exploration")


def test_what_would_decide(generated: Callable[..., Comparison]) -> None:
    iou = by_name(generated([50] * 20, [50 + 3 * (-1) ** number + 1 for number in range(20)]))[MAIN]
    assert not iou.real
    assert iou.decision == "not decided: about 75 scenarios would decide it"  # 7.849 · 9 · 20 / 19


def test_without_resamples(generated: Callable[..., Comparison]) -> None:
    comparison = generated(HARD, [each + 9 for each in HARD], Resampling(resamples=0))
    assert {(each.p, each.low, each.real) for each in comparison.numbers} == {(None, None, False)}
    assert comparison.notes() == ["no intervals and no tests: no resamples were asked for"]


def test_all_of_a_small_one(generated: Callable[..., Comparison]) -> None:
    """Of seven clusters all 64 swaps are tried: none of the others differs as much."""
    made = generated(
        HARD[:7], [each + 9 + number % 2 for number, each in enumerate(HARD[:7])], twins=True
    )
    row = "iou 30x30 (%)    15.000  24.429  +9.429  [+8.934, +9.923]  0.016          b is better"
    assert row in made.to_text().splitlines()
    told = made.to_dict()
    assert (told["samples"], told["clusters"], told["swaps"], told["all_swaps"]) == (
        14,
        7,
        64,
        True,
    )
    assert (told["numbers"][1]["p"], told["numbers"][1]["adjusted_p"]) == (1 / 64, 3 / 64)


def test_json_and_csv_have_every_number(motion_bundles: tuple[Path, Path], tmp_path: Path) -> None:
    comparison = compare_bundles(*motion_bundles, FEW)
    stated = json.loads(json.dumps(comparison.to_dict()))
    (path,) = comparison.to_csv(tmp_path / "new")
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    assert [float(rows[0]["a"]), len(rows)] == [stated["numbers"][0]["a"], len(comparison.numbers)]


def test_others_are_refused_or_left_out(saved: Save) -> None:
    a, b = saved("a"), saved("b", 1.0, agents=("ego_vehicle", "infrastructure"))
    assert_refused(
        (
            lambda: compare_bundles(a, b, FEW),
            EvaluationError,
            r"2 samples only in .*a \(type1.*\); evaluate both at the same",
        ),
    )
    comparison = compare_bundles(a, b, FEW, common=True)
    assert (comparison.samples, comparison.left_out) == (4, 2)
    assert "a, b: only the samples that both have; 2 left out" in comparison.to_text()


def test_a_partial_one_is_marked(
    saved: Save, run: EvaluationRun, da_b: DeepAccident, write_accidents: Write, tmp_path: Path
) -> None:
    results = write_accidents(tmp_path / "some.json", run.selection.tokens(da_b)[1:])
    part = evaluate_results(da_b, results, run.setup, run.selection, allow_partial=True, workers=1)
    comparison = compare_bundles(saved("a"), save_run(part, tmp_path / "part"), FEW, common=True)
    assert comparison.partial == ("b: PARTIAL: 5 of 6 samples",)


def changed(path: Path, change: Callable[[Any], object]) -> None:
    """Another content of a file of JSON."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_other_samples_tasks_and_rules(
    saved: Save, motion_bundles: tuple[Path, Path], run: EvaluationRun
) -> None:
    a, other = (
        saved("a"),
        saved("b", setup=replace(run.setup, switches={"reading.danger_distance": 0.5})),
    )
    assert_refused(
        (
            lambda: compare_bundles(a, motion_bundles[0], FEW),
            EvaluationError,
            ("of the task accident", "one of motion"),
        ),
        (
            lambda: compare_bundles(a, other, FEW),
            EvaluationError,
            (
                r"switches/reading.danger_distance 'absent' and 0.5; "
                r"settings/choices/reading/danger_distance 1.0"
            ),
        ),
        (
            lambda: compare_bundles(a, saved("c", split="train"), FEW, common=True),
            EvaluationError,
            ("have no sample in common",),
        ),
    )


def test_other_cells(motion_bundles: tuple[Path, Path], tmp_path: Path) -> None:
    """Labels are made on the predictions' own cells: other cells are another truth."""
    small, axis = copytree(motion_bundles[1], tmp_path / "small"), [-25.0, 25.0, 0.5]
    changed(
        small / "metrics_summary.json", lambda summary: summary["results"]["form"].update(x=axis)
    )
    assert_refused(
        (
            lambda: compare_bundles(motion_bundles[0], small, FEW),
            EvaluationError,
            ("rules: cells/x '[-50.0, 50.0, 0.5]' and '[-25.0, 25.0, 0.5]'",),
        ),
    )


def test_other_labels_and_another_devkit(saved: Save, results: Results) -> None:
    a, b, c = map(saved, "abc")
    token = min(results.tokens).rsplit("/", 2)[0]
    changed(
        b / "scenarios.json", lambda stored: stored["scenarios"][token].update(label="0", boxes="0")
    )
    path = c / "counts.json"
    path.write_text(path.read_text().replace("of devkit ", "of devkit 9."))
    assert_refused(
        (
            lambda: compare_bundles(a, b, FEW),
            EvaluationError,
            (f"calib files of 1 scenarios are not the same ({token})",),
        ),
        (
            lambda: compare_bundles(a, c, FEW),
            EvaluationError,
            ("counts.json: was saved by AccidentEvaluator of devkit 9.",),
        ),
    )


@pytest.mark.parametrize(("clusters", "pairs"), [(12, 200)])
def test_equally_good_runs_are_rarely_called_really_different(
    tmp_path: Path, clusters: int, pairs: int
) -> None:
    """Of two runs of the same law, with clusters that are hard for both, at most 5 % but for
    chance.
    """
    source, real = np.random.default_rng(clusters), 0
    for pair in range(pairs):
        hard, folders = source.normal(0, 1, clusters), []
        for name in "ab":
            found = source.binomial(20, 1 / (1 + np.exp(hard + source.normal(0, 0.7, clusters))))
            folders.append(
                write_bundle(
                    tmp_path / f"{pair}{name}",
                    [(each, 20 - each) for each in found.tolist()],
                    twins=True,
                )
            )
        real += by_name(compare_bundles(*folders, Resampling(resamples=200, seed=pair)))[MAIN].real
    assert real <= binom.ppf(0.995, pairs, 0.05)
    assert real > 0


@pytest.mark.parametrize("fault", COUNT_FAULTS)
def test_counts_that_are_none_are_a_fault_of_the_bundle(tmp_path: Path, fault: str) -> None:
    change, told = COUNT_FAULTS[fault]
    folder = write_bundle(tmp_path / "a", [(3, 1)] * 3)
    state = json.loads((folder / "counts.json").read_text())
    change(state["counts"])
    (folder / "counts.json").write_text(json.dumps(state))
    with pytest.raises(
        ResultsError, match=rf"counts.json: does not hold counts of its protocol \(.*{told}"
    ):
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
    assert_refused(
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
    assert_refused(
        (
            evaluator.compute,
            EvaluationError,
            "s/t/a: expected frames up to 10,000, found 1000000000",
        ),
    )


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_counts_of_accidents_whose_remainders_never_end(value: float) -> None:
    """Of which the remainders never end."""
    assert len(exact_parts([[1.0, value]])) == 1


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


def paired(
    first: np.ndarray, second: np.ndarray, resampling: Resampling | None = None
) -> PairedTest:
    """Of a value a cluster; NaN for none."""
    runs = tuple(
        [[{"value": float(v), "count": 1}] if np.isfinite(v) else [] for v in run]
        for run in (first, second)
    )
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
    """Of differences of ± 1 around 3: 19 degrees of freedom, and t = 2.093 at 95 % and 1.729 at 90
    %.
    """
    first, second = np.zeros(20), 3 + np.tile([1.0, -1.0], 10)
    error = math.sqrt(20 / 19) / math.sqrt(20)
    for confidence, t in ((0.95, 2.093), (0.9, 1.729)):
        made = paired(first, second, Resampling(confidence=confidence))
        assert_allclose([made.low[0], made.high[0]], [3 - t * error, 3 + t * error], atol=1e-3)
    assert_allclose(made.errors, error)


def test_clusters_that_are_too_few() -> None:
    made = paired(np.zeros(5), np.arange(5) + 1.0)
    assert (
        undecided_text(made, 0, 1, 5)
        == "no decision is possible with 5 clusters; at least 6 are needed"
    )
    assert (
        undecided_text(made, 0, 4, 5)
        == "no decision is possible with 5 clusters; at least 8 are needed"
    )
    few = paired(np.zeros(30), np.eye(30)[0])
    text = (
        "no decision is possible with 1 of 30 clusters in which the two differ; "
        "at least 6 are needed"
    )
    assert undecided_text(few, 0, 1, 30) == text


def test_resamples_that_are_too_few() -> None:
    made = paired(np.zeros(30), np.arange(30) + 1.0, Resampling(resamples=10))
    assert (
        undecided_text(made, 0, 1, 30)
        == "no decision is possible with 10 resamples; at least 19 are needed"
    )
    assert undecided_text(
        paired(np.zeros(9), np.ones(9), Resampling(resamples=0)), 0, 1, 9
    ).startswith("not tested: ")


def test_no_difference_decides_nothing() -> None:
    assert (
        undecided_text(paired(np.zeros(8), np.tile([1.0, -1.0], 4)), 0, 1, 8)
        == "the difference is 0"
    )
    nothing = np.full(8, math.nan)
    with np.errstate(all="ignore"), pytest.warns(RuntimeWarning):
        assert undecided_text(paired(np.zeros(8), nothing), 0, 1, 8) == "nothing to compare"


def test_all_swaps_or_random_ones() -> None:
    assert swaps_of(3, Resampling()).swapped.tolist() == [
        [a, b, c] for c in (0, 1) for b in (0, 1) for a in (0,)
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
def test_up_to_which_number_all_swaps_are_taken(
    clusters: int, resamples: int, *, complete: bool
) -> None:
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
        undecided_text(made, 0, 1, scenarios)
        == undecided_text(other, 0, 1, scenarios)
        == (
            "not decided"
            if told is None
            else f"not decided: about {told} scenarios would decide it"
        )
    )
