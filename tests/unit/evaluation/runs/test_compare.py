"""Two evaluations side by side: which differences are real, and which two cannot be compared."""

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError, ResultsError
from deepaccident_devkit.evaluation import Bootstrap
from deepaccident_devkit.evaluation.metrics.breakdowns import numbers_of
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs import (
    Comparison,
    EvaluationRun,
    SampleSelection,
    compare_bundles,
    evaluate_results,
    save_run,
)
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.splits import save_selection

Write = Callable[..., Results]
Save = Callable[..., Path]
FEW = Bootstrap(resamples=40)


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


class TestNumbers:
    def test_the_better_one_is_named(self, motion_bundles: tuple[Path, Path]) -> None:
        comparison = compare_bundles(*motion_bundles, FEW)
        numbers = by_name(comparison)
        iou, error = numbers["iou 100x100"], numbers["min_ade"]
        assert (iou.real, iou.better, error.real, error.better) == (True, "b", True, "b")
        assert iou.difference == pytest.approx(iou.b - iou.a)
        assert 0 < iou.low <= iou.difference <= iou.high
        assert error.low <= error.high < 0
        assert (iou.reversed, iou.unit) == (0.0, "%")
        assert (comparison.samples, comparison.scenarios, comparison.left_out) == (6, 2, 0)

    def test_the_other_way_round_all_turns(self, motion_bundles: tuple[Path, Path]) -> None:
        forth = by_name(compare_bundles(*motion_bundles, FEW))
        back = by_name(compare_bundles(*motion_bundles[::-1], FEW))
        for name, each in forth.items():
            other = back[name]
            assert (other.a, other.b, other.real, other.reversed) == (each.b, each.a, each.real, each.reversed)
            if each.low is not None:
                assert (other.low, other.high) == (-each.high, -each.low)
        assert back["min_ade"].better == "a"

    def test_headlines_first_then_every_number(self, motion_bundles: tuple[Path, Path], run: EvaluationRun) -> None:
        numbers = compare_bundles(*motion_bundles, FEW).numbers
        headlines = [each.headline is not None for each in numbers]
        assert headlines == sorted(headlines, reverse=True)
        assert [each.headline for each in numbers][:2] == ["iou 30x30", "iou 100x100"]
        assert "ranges/30x30/sq" in {each.number for each in numbers}
        assert len({each.number for each in numbers}) == len(numbers) > 10
        assert set(numbers_of(run.result)) != {each.number for each in numbers}

    def test_itself_differs_in_nothing(self, motion_bundles: tuple[Path, Path]) -> None:
        comparison = compare_bundles(motion_bundles[0], motion_bundles[0], FEW)
        for each in comparison.numbers:
            assert (each.real, each.better) == (False, None)
            assert each.difference in (0.0, None)
        assert "beside the headlines: 0 of" in comparison.notes()[2]

    def test_pairs_make_the_interval_narrow(self, saved: Save, da_b: DeepAccident, tmp_path: Path) -> None:
        """Scenarios differ by far more than the two runs do; resamples that were not paired would not tell them."""
        everything = str(save_selection(da_b.scenario, tmp_path / "everything.txt"))
        comparison = compare_bundles(saved("a", split=everything), saved("b", 0.2, split=everything), FEW)
        apart = by_name(comparison)["position_error"]
        assert apart.difference == pytest.approx(2 * 0.1 * np.sqrt(2))
        assert (apart.real, apart.better) == (True, "a")
        assert apart.high - apart.low < 1e-9

    def test_a_number_of_a_single_scenario_is_never_called_real(self, saved: Save) -> None:
        """An accident and a normal scenario: each resample that has errors of positions has the same one."""
        error = by_name(compare_bundles(saved("a"), saved("b", 1.0), FEW))["position_error"]
        assert error.low == error.high == error.difference
        assert error.difference > 0
        assert not error.real

    def test_one_scenario_has_no_interval(self, saved: Save) -> None:
        comparison = compare_bundles(saved("a", scope="accident"), saved("b", 1.0, scope="accident"), FEW)
        number = by_name(comparison)["position_error"]
        assert (number.low, number.high, number.reversed, number.real) == (None, None, None, False)
        assert number.difference > 1
        assert comparison.notes() == ["no intervals: they are drawn over scenarios, of which there are 1"]

    def test_without_resamples(self, motion_bundles: tuple[Path, Path]) -> None:
        assert not any(each.real for each in compare_bundles(*motion_bundles, Bootstrap(resamples=0)).numbers)


class TestForms:
    def test_text(self, motion_bundles: tuple[Path, Path]) -> None:
        comparison = compare_bundles(*motion_bundles, FEW)
        text = comparison.to_text()
        assert text.startswith(f"motion, protocol released: 6 samples of 2 scenarios\na: {motion_bundles[0]}\n")
        (line,) = (line for line in text.splitlines() if line.startswith("iou 100x100"))
        assert "yes, b is better" in line
        drawn = [each for each in comparison.numbers if each.reversed is not None]
        by_chance = 0.05 * len(drawn)
        assert f"{len(drawn)} numbers are compared: if the two were equally good, about {by_chance:.1f} would" in text

    def test_json_and_csv_have_every_number(self, motion_bundles: tuple[Path, Path], tmp_path: Path) -> None:
        comparison = compare_bundles(*motion_bundles, FEW)
        stated = json.loads(json.dumps(comparison.as_dict()))
        with comparison.to_csv(tmp_path / "new" / "numbers.csv").open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        assert len(rows) == len(stated["numbers"]) == len(comparison.numbers)
        assert float(rows[0]["a"]) == stated["numbers"][0]["a"] == comparison.numbers[0].a
        assert stated["bootstrap"] == {"resamples": 40, "confidence": 0.95, "seed": 0}

    def test_the_release_is_not_needed(self, motion_bundles: tuple[Path, Path], tmp_path: Path) -> None:
        copies = [shutil.copytree(each, tmp_path / each.name) for each in motion_bundles]
        for copy in copies:
            path = copy / "metrics_summary.json"
            path.write_text(path.read_text().replace(json.loads(path.read_text())["release"]["dataroot"], "/gone"))
        assert compare_bundles(*copies, FEW).numbers == compare_bundles(*motion_bundles, FEW).numbers


class TestSamples:
    def test_others_are_refused_or_left_out(self, saved: Save) -> None:
        a, b = saved("a"), saved("b", 1.0, agents=("ego_vehicle", "infrastructure"))
        with pytest.raises(EvaluationError, match=r"2 samples only in .*a \(type1.*\); evaluate both at the same"):
            compare_bundles(a, b, FEW)
        comparison = compare_bundles(a, b, FEW, common=True)
        assert (comparison.samples, comparison.left_out) == (4, 2)
        assert "a, b: only the samples that both have; 2 left out" in comparison.to_text()

    def test_nothing_in_common(self, saved: Save) -> None:
        with pytest.raises(EvaluationError, match=r"have no sample in common"):
            compare_bundles(saved("a"), saved("b", split="train"), FEW, common=True)

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
        with pytest.raises(
            EvaluationError, match=r"by other rules: task 'accident' and 'motion'; protocol .*, and \d+"
        ):
            compare_bundles(a, motion_bundles[0], FEW)
        other = saved("b", setup=replace(run.setup, switches={"min_score": 0.5}))
        with pytest.raises(
            EvaluationError, match=r"switches/min_score 'absent' and 0.5; settings/choices/min_score 0.0 and 0.5; eval"
        ):
            compare_bundles(a, other, FEW)

    def test_other_labels(self, saved: Save) -> None:
        a, b = saved("a"), saved("b")
        path = b / "scenarios.json"
        stored = json.loads(path.read_text())
        token = min(stored["scenarios"])
        stored["scenarios"][token]["label"] = "0"
        path.write_text(json.dumps(stored))
        with pytest.raises(
            EvaluationError, match=rf"calib files of 1 scenarios are not the same \({token}\); evaluate"
        ):
            compare_bundles(a, b, FEW)

    def test_another_devkit(self, saved: Save) -> None:
        a, b = saved("a"), saved("b")
        path = b / "counts.json"
        path.write_text(path.read_text().replace("of devkit ", "of devkit 9."))
        with pytest.raises(EvaluationError, match=r"counts.json: was saved by AccidentEvaluator of devkit 9."):
            compare_bundles(a, b, FEW)

    def test_no_bundle(self, tmp_path: Path, saved: Save) -> None:
        with pytest.raises(ResultsError, match=r"nowhere: no such folder"):
            compare_bundles(saved("a"), tmp_path / "nowhere")
