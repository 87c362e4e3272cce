"""The five doors of each task lead to the numbers of a whole evaluation."""

from pathlib import Path

import pytest
from evaluation_runs import stored_run

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.runs.setups import TASKS, EvaluationSetup, TaskName

TOP = Path(__file__).parents[3]


@pytest.mark.parametrize(
    ("task", "protocol"),
    [("motion", "released"), ("accident", "boxes"), ("detection", "paper"), ("warning", "clean")],
)
def test_read_truth_counts_result_summary(
    task: TaskName, protocol: str, da_motion: DeepAccident, tmp_path: Path
) -> None:
    setup = EvaluationSetup(task=task, protocol=protocol)
    run, results = stored_run(da_motion, setup, tmp_path / "results")
    doors, counts = TASKS[task], []
    assert results.task in doors.kinds
    for token in results.tokens:
        prediction = doors.read(results, da_motion, token, setup.rules)
        truth = doors.truth(da_motion, token, setup.rules, results.form, setup.horizon)
        counts.append(doors.counts(token, prediction, *truth, setup.rules))
    summary = doors.summary(doors.result(counts, setup.rules))
    assert summary["samples"] == len(results) > 1
    assert summary == run.result.as_dict()


@pytest.mark.slow
def test_a_sample_enters_few_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOP))
    from benchmarks.entered import walks

    made = walks()
    for walk in ("motion, released", "accident, boxes"):
        own = [module for module in made[walk] if module.startswith("deepaccident_devkit.evaluation")]
        assert len(made[walk]) <= 35, walk
        assert len(own) <= 10, walk
