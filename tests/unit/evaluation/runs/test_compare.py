"""Two evaluations side by side: which differences are real, and which two cannot be compared."""

import csv
import json
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest
from generated_bundles import MAIN, write_bundle
from refusals import assert_refused
from scipy.stats import binom

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError, ResultsError
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.accident.scoring import exact_parts
from deepaccident_devkit.evaluation.intervals import numbers_of
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs import (
    Comparison,
    EvaluationRun,
    SampleSelection,
    compare_bundles,
    evaluate_results,
    save_run,
)
from deepaccident_devkit.evaluation.runs.comparison import ComparedNumber, _text_row
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup

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
    "no token": (lambda counts: counts.update({"x" * 10**6: counts[FIRST]}), "expected a sample's token"),
}


@pytest.fixture(scope="module")
def motion_bundles(
    da_b: DeepAccident, selection: SampleSelection, write_motion: Write, tmp_path_factory: pytest.TempPathFactory
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

    def save(name: str, moved: float = 0.1, setup: EvaluationSetup = run.setup, **selection: Any) -> Path:
        chosen = replace(run.selection, **selection)
        results = write_accidents(tmp_path / f"{name}.json", chosen.tokens(da_b), moved=moved)
        return save_run(evaluate_results(da_b, results, setup, chosen, workers=1), tmp_path / name)

    return save


def by_name(comparison: Comparison) -> dict[str, Any]:
    return {each.headline or each.number: each for each in comparison.numbers}


@pytest.fixture
def generated(tmp_path: Path) -> Callable[..., Comparison]:
    """Compare two runs of the given cells found, of 100 true ones a cluster."""

    def compare(a: Sequence[int], b: Sequence[int], resampling: Resampling | None = None, **how: Any) -> Comparison:
        folders = [
            write_bundle(
                tmp_path / f"{name}{len(list(tmp_path.iterdir()))}", [(each, 100 - each) for each in run], **how
            )
            for name, run in (("a", a), ("b", b))
        ]
        return compare_bundles(*folders, resampling)

    return compare


HARD = [5 * number for number in range(16)]
"""Cells found in clusters that differ by far more than two runs do."""


class TestNumbers:
    def test_the_better_one_is_named(self, generated: Callable[..., Comparison]) -> None:
        iou = by_name(generated(HARD, [each + 3 + number % 3 for number, each in enumerate(HARD)]))[MAIN]
        assert (iou.family, iou.real, iou.better, iou.decision) == ("main", True, "b", "b is better")
        assert iou.difference == pytest.approx(iou.b - iou.a)
        assert 3 < iou.low < iou.difference < iou.high < 5
        assert iou.p == iou.adjusted_p == pytest.approx(1 / 1001)
        assert iou.unit == "%"

    def test_pairs_are_compared(self, generated: Callable[..., Comparison]) -> None:
        """Were the clusters of one run in another order, the same numbers would tell nothing."""
        better = [each + 3 for each in HARD]
        apart = by_name(generated(HARD, better[5:] + better[:5]))[MAIN]
        assert apart.difference == pytest.approx(3)
        assert not apart.real
        assert apart.low < -5 < 10 < apart.high

    def test_the_other_way_round_all_turns(self, generated: Callable[..., Comparison]) -> None:
        better = [each + number % 4 for number, each in enumerate(HARD)]
        forth, back = (by_name(generated(*runs)) for runs in ((HARD, better), (better, HARD)))
        for name, each in forth.items():
            other = back[name]
            assert (other.a, other.b, other.real, other.p) == (each.b, each.a, each.real, each.p)
            if each.low is not None:
                assert (other.low, other.high) == pytest.approx((-each.high, -each.low))
        assert back[MAIN].better == "a"

    def test_headlines_first_then_every_number(self, motion_bundles: tuple[Path, Path], run: EvaluationRun) -> None:
        numbers = compare_bundles(*motion_bundles, FEW).numbers
        assert [each.headline for each in numbers][:2] == ["iou 30x30", "iou 100x100"]
        families = [each.family for each in numbers]
        assert families == ["main", *["headlines"] * families.count("headlines"), *["other"] * families.count("other")]
        assert [each.headline is None for each in numbers] == [each == "other" for each in families]
        assert "ranges/30x30/sq" in {each.number for each in numbers}
        assert len({each.number for each in numbers}) == len(numbers) > 10
        assert set(numbers_of(run.result)) != {each.number for each in numbers}

    def test_the_other_headlines_are_tested_together(self, generated: Callable[..., Comparison]) -> None:
        """Both ranges have the same numbers: by itself one is real, of several it is not."""
        numbers = by_name(generated([50] * 10, [50 + each for each in [1, -1, 2, -1, 3, 3, 1, 2, 2, 1]]))
        alone, together = numbers[MAIN], numbers["iou 100x100"]
        assert alone.p == together.p == alone.adjusted_p <= 0.05 < together.adjusted_p
        assert (alone.real, together.real, together.better) == (True, False, None)
        tested = [each for each in numbers.values() if each.family == "headlines" and each.p is not None]
        assert together.adjusted_p == pytest.approx(min(len(tested) * together.p, 1))
        others = [each for each in numbers.values() if each.family == "other"]
        assert {each.decision for each in others} == {"for exploration"}
        assert not any(each.real for each in others)

    def test_itself_differs_in_nothing(self, generated: Callable[..., Comparison]) -> None:
        for each in generated(HARD, HARD).numbers:
            assert (each.real, each.better, each.low) == (False, None, None)
            assert each.difference in (0.0, None)
            assert each.decision in ("the difference is 0", "nothing to compare", "for exploration")

    @pytest.mark.slow
    def test_twins_are_one_cluster(self, generated: Callable[..., Comparison]) -> None:
        better = [each + 3 + number % 3 for number, each in enumerate(HARD)]
        alone, both = (generated(HARD, better, twins=twins) for twins in (False, True))
        assert (alone.scenarios, alone.clusters, both.scenarios, both.clusters) == (16, 16, 32, 16)
        assert [each.p for each in both.numbers] == [each.p for each in alone.numbers]
        assert by_name(both)[MAIN].high == pytest.approx(by_name(alone)[MAIN].high)

    def test_few_clusters_cannot_decide(self, generated: Callable[..., Comparison]) -> None:
        iou = by_name(generated(HARD[:5], [each + 9 for each in HARD[:5]]))[MAIN]
        assert (iou.real, iou.low) == (False, None)
        assert iou.decision == "no decision is possible with 5 clusters; at least 6 are needed"
        assert by_name(generated(HARD[:6], [each + 9 for each in HARD[:6]]))[MAIN].real

    def test_what_would_decide(self, generated: Callable[..., Comparison]) -> None:
        iou = by_name(generated([50] * 20, [50 + 3 * (-1) ** number + 1 for number in range(20)]))[MAIN]
        assert not iou.real
        assert iou.decision == "not decided: about 75 scenarios would decide it"  # 7.849 · 9 · 20 / 19

    def test_without_resamples(self, generated: Callable[..., Comparison]) -> None:
        comparison = generated(HARD, [each + 9 for each in HARD], Resampling(resamples=0))
        assert {(each.p, each.low, each.real) for each in comparison.numbers} == {(None, None, False)}
        assert comparison.notes() == ["no intervals and no tests: no resamples were asked for"]


class TestForms:
    def test_text(self, motion_bundles: tuple[Path, Path]) -> None:
        text = compare_bundles(*motion_bundles, FEW).to_text()
        head = "motion, protocol released: 6 samples of 2 scenarios\nclusters: 1 (an accident and its twin are one)"
        assert text.startswith(f"{head}\na: {motion_bundles[0]}\n")
        (line,) = (line for line in text.splitlines() if line.startswith("iou 100x100"))
        assert line.endswith("no decision is possible with 1 cluster; at least 8 are needed")
        assert "p: share of all 1 swaps of clusters between a and b" in text
        assert "tested at 5%: iou 30x30; and the other headlines together" in text

    def test_text_of_a_decision(self, generated: Callable[..., Comparison]) -> None:
        text = generated(HARD, [each + 3 + number % 3 for number, each in enumerate(HARD)]).to_text()
        (line,) = (line.split() for line in text.splitlines() if line.startswith("iou 30x30"))
        assert (line[3:6], line[-5:]) == (["37.500", "41.438", "+3.938"], ["+4.393]", "0.001", "b", "is", "better"])
        assert "p: share of 1,000 random swaps" in text

    def test_json_and_csv_have_every_number(self, motion_bundles: tuple[Path, Path], tmp_path: Path) -> None:
        comparison = compare_bundles(*motion_bundles, FEW)
        stated = json.loads(json.dumps(comparison.to_dict()))
        (path,) = comparison.to_csv(tmp_path / "new")
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        assert len(rows) == len(stated["numbers"]) == len(comparison.numbers)
        assert float(rows[0]["a"]) == stated["numbers"][0]["a"] == comparison.numbers[0].a
        assert stated["resampling"] == {"resamples": 40, "confidence": 0.95, "seed": 0}

    def test_the_release_is_not_needed(self, motion_bundles: tuple[Path, Path], tmp_path: Path) -> None:
        copies = [shutil.copytree(each, tmp_path / each.name) for each in motion_bundles]
        for copy in copies:
            path = copy / "metrics_summary.json"
            path.write_text(path.read_text().replace(json.loads(path.read_text())["release"]["dataroot"], "/gone"))
        assert compare_bundles(*copies, FEW).numbers == compare_bundles(*motion_bundles, FEW).numbers


class TestSamples:
    def test_others_are_refused_or_left_out(self, saved: Save) -> None:
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

    def test_nothing_in_common(self, saved: Save) -> None:
        assert_refused(
            (
                lambda: compare_bundles(saved("a"), saved("b", split="train"), FEW, common=True),
                EvaluationError,
                r"have no sample in common",
            ),
        )

    def test_a_partial_one_is_marked(
        self, saved: Save, run: EvaluationRun, da_b: DeepAccident, write_accidents: Write, tmp_path: Path
    ) -> None:
        results = write_accidents(tmp_path / "some.json", run.selection.tokens(da_b)[1:])
        part = evaluate_results(da_b, results, run.setup, run.selection, allow_partial=True, workers=1)
        comparison = compare_bundles(saved("a"), save_run(part, tmp_path / "part"), FEW, common=True)
        assert comparison.partial == ("b: PARTIAL: 5 of 6 samples",)
        assert "b: PARTIAL: 5 of 6 samples" in comparison.to_text()


class TestRefused:
    def test_other_tasks_and_rules(self, saved: Save, motion_bundles: tuple[Path, Path], run: EvaluationRun) -> None:
        a = saved("a")
        assert_refused(
            (
                lambda: compare_bundles(a, motion_bundles[0], FEW),
                EvaluationError,
                r"by the same rules: task 'accident' and 'motion'; protocol .*, and \d+",
            ),
        )
        other = saved("b", setup=replace(run.setup, switches={"reading.danger_distance": 0.5}))
        assert_refused(
            (
                lambda: compare_bundles(a, other, FEW),
                EvaluationError,
                r"switches/reading.danger_distance 'absent' and 0.5; settings/choices/reading/danger_distance 1.0",
            ),
        )

    def test_other_cells(self, motion_bundles: tuple[Path, Path], tmp_path: Path) -> None:
        """Labels are made on the predictions' own cells: other cells are another truth."""
        small = copytree(motion_bundles[1], tmp_path / "small")
        path = small / "metrics_summary.json"
        summary = json.loads(path.read_text())
        summary["results"]["form"]["x"] = [-25.0, 25.0, 0.5]
        path.write_text(json.dumps(summary))
        assert_refused(
            (
                lambda: compare_bundles(motion_bundles[0], small, FEW),
                EvaluationError,
                r"rules: cells/x '\[-50.0, 50.0, 0.5\]' and '\[-25.0, 25.0, 0.5\]'; eval",
            ),
        )

    def test_other_labels(self, saved: Save) -> None:
        a, b = saved("a"), saved("b")
        path = b / "scenarios.json"
        stored = json.loads(path.read_text())
        token = min(stored["scenarios"])
        stored["scenarios"][token]["label"] = "0"
        path.write_text(json.dumps(stored))
        assert_refused(
            (
                lambda: compare_bundles(a, b, FEW),
                EvaluationError,
                rf"calib files of 1 scenarios are not the same \({token}\); evaluate",
            ),
        )

    def test_another_devkit(self, saved: Save) -> None:
        a, b = saved("a"), saved("b")
        path = b / "counts.json"
        path.write_text(path.read_text().replace("of devkit ", "of devkit 9."))
        assert_refused(
            (
                lambda: compare_bundles(a, b, FEW),
                EvaluationError,
                r"counts.json: was saved by AccidentEvaluator of devkit 9.",
            ),
        )


@pytest.mark.slow
@pytest.mark.parametrize(("clusters", "pairs"), [(8, 300), (12, 200), (24, 200)])
def test_equally_good_runs_are_rarely_called_really_different(tmp_path: Path, clusters: int, pairs: int) -> None:
    """Of two runs of the same law, with clusters that are hard for both, at most 5 % but for chance."""
    source, real = np.random.default_rng(clusters), 0
    for pair in range(pairs):
        hard, folders = source.normal(0, 1, clusters), []
        for name in "ab":
            found = source.binomial(20, 1 / (1 + np.exp(hard + source.normal(0, 0.7, clusters))))
            folders.append(
                write_bundle(tmp_path / f"{pair}{name}", [(each, 20 - each) for each in found.tolist()], twins=True)
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
    with pytest.raises(ResultsError, match=rf"counts.json: does not hold counts of its protocol \(.*{told}") as raised:
        compare_bundles(folder, folder)
    assert len(str(raised.value)) < 1000


class TestNumbersThatAskForMemory:
    """In stored counts that a stranger sends: such as a frame of a recording, which has a column each."""

    def test_of_detections(self) -> None:
        evaluator = EvaluationSetup(task="detection").evaluator()
        columns = {name: [[], []] for name in ("tp", "spent", "matches")}
        counts = {"token": "a", "truths": [], "scores": [0.5], "detections": [[10**12], [0]], "excused": [[]] * 3}
        evaluator.add("a", counts | columns | {"errors": [[]] * 6})
        assert_refused(
            (evaluator.compute, EvaluationError, r"detections: expected groups from 0 to \d+, found 10{12} to 10{12}"),
        )

    def test_of_warnings(self) -> None:
        evaluator = EvaluationSetup(task="warning", protocol="clean").evaluator()
        nothing = {"alarms": [], "unjudged": [], "references": [], "involvement": None, "ahead": None, "to_end": None}
        evaluator.add("a", {"recording": "s/t/a", "frame": 10**9, "kind": "others", "beyond": 0} | nothing)
        assert_refused(
            (evaluator.compute, EvaluationError, "s/t/a: expected frames up to 10,000, found 1000000000"),
        )

    @pytest.mark.parametrize("value", [math.nan, math.inf])
    def test_of_accidents(self, value: float) -> None:
        """Of which the remainders never end."""
        assert len(exact_parts([[1.0, value]])) == 1


@pytest.mark.parametrize(("count", "shown"), [(1, 1), (3, 3), (4, 4)])
def test_names_of_many_samples_are_cut(tmp_path: Path, count: int, shown: int) -> None:
    one, more = (write_bundle(tmp_path / f"of {each}", [(1, 1)] * each) for each in (1, count + 1))
    with pytest.raises(EvaluationError, match="only in") as raised:
        compare_bundles(one, more, FEW)
    told, names = str(raised.value).split(";")[0].split(" (")
    assert (told, len(names.split(", "))) == (f"{count} samples only in {more}", shown)
    assert names.endswith("type1_subtype1_accident/Town03_003/ego_vehicle/001, …)") is (count > 3)


@pytest.mark.parametrize(("unlike", "more"), [(2, ""), (3, ""), (4, ", and 1 more"), (5, ", and 2 more")])
def test_unlike_rules_are_told_in_parts(tmp_path: Path, unlike: int, more: str) -> None:
    folders = [write_bundle(tmp_path / name, [(1, 1)] * 2) for name in "ab"]
    path = folders[1] / "metrics_summary.json"
    summary = json.loads(path.read_text())
    summary["settings"] |= {f"x{number}": number for number in range(unlike)}
    path.write_text(json.dumps(summary))
    with pytest.raises(EvaluationError, match="same rules") as raised:
        compare_bundles(*folders, FEW)
    told = "; ".join(f"settings/x{number} 'absent' and {number}" for number in range(min(unlike, 3)))
    assert str(raised.value).endswith(f"by the same rules: {told}{more}; evaluate both in the same way")


def test_the_note_on_exploration_counts(generated: Callable[..., Comparison]) -> None:
    made = generated(HARD[:2], HARD[2:4])
    numbers = [replace(made.numbers[0], family="other", p=p) for p in (0.01, 0.0625, 0.1, 0.04, None)]
    told = replace(made, numbers=(made.numbers[0], *numbers)).notes()
    explored = "for exploration: 2 of 4 other numbers have a p of at most 5%; between equally good runs about 0.2 would"
    assert told[3:] == [f"{explored}, by chance"]
    assert replace(made, numbers=(made.numbers[0], numbers[-1])).notes() == told[:3]


def test_cells_of_the_table() -> None:
    number = ComparedNumber(
        number="x/y",
        headline="y",
        unit="m",
        a=1.0,
        b=None,
        difference=None,
        low=-0.5,
        high=0.25,
        family="main",
        p=0.5,
        adjusted_p=None,
        real=False,
        better=None,
        decision="why",
    )
    assert _text_row(number) == ("y (m)", "1.000", "–", "–", "[-0.500, +0.250]", "–", "why")
    shown = _text_row(replace(number, unit="share", low=None, difference=0.25, adjusted_p=0.0625))
    assert shown == ("y", "1.000", "–", "+0.250", "–", "0.062", "why")
    assert _text_row(replace(number, unit=None, high=None))[:5:4] == ("y", "–")
