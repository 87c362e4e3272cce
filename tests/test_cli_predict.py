"""`deepaccident predict` with a baseline."""

import shutil
from pathlib import Path

import pytest
from refusals import assert_refused
from verbs import called

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import NotAvailableError, ResultsError
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.evaluation.runs import read_bundle
from deepaccident_devkit.plugins.baselines import Baseline
from deepaccident_devkit.selection.splits import save_selection
from deepaccident_devkit.v2x import Link

pytestmark = pytest.mark.slow


def run(*words: object) -> str:
    return called("predict", *words).output


def test_predict_writes_all_tasks_of_the_samples_that_are_evaluated(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    options = "--split train --agents all --workers 1"
    text = run("constant_velocity", da_motion.dataroot, *options.split(), "--out", tmp_path)
    names = ["accident.json", "detection.json", "motion"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    for results in (read_results(tmp_path / name) for name in names):
        results.check()
        assert list(results.tokens) == da_motion.samples("train", "evaluate")
        assert (results.meta["agents"], f"{results.task}: 20 samples in" in text) == ("all", True)


def test_predict_takes_a_link_a_model_a_horizon_and_a_scope(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    options = "--split train --task accident --latency 0.2 --pose-noise 0.3 --seed 4"
    options += " --agents all --horizon 1.5 --scope all --workers 1"
    run("constant_turn_rate", da_motion.dataroot, *options.split(), "--out", tmp_path)
    (path,) = tmp_path.iterdir()
    results, link = read_results(path), Link(latency=0.2, pose_noise=0.3, seed=4)
    told = Baseline(agents="all", model="constant_turn_rate", link=link, horizon=1.5).meta()
    assert (path.name, {name: results.meta[name] for name in told}) == ("accident.json", told)
    assert list(results.tokens) == da_motion.evaluation_samples(
        "train", "paper", horizon=1.5, scope="all"
    )


def test_predict_writes_plans_and_forecasts_that_are_evaluated(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    options = "--split train --samples all --agents all --workers 1"
    text = run(
        "standing",
        da_motion.dataroot,
        *options.split(),
        "--task",
        "planning,forecasting",
        "--out",
        tmp_path,
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["forecasting.json", "planning.json"]
    everything = da_motion.samples("train", "all")
    for task, own in (
        ("planning", [each for each in everything if "/infrastructure/" not in each]),
        ("forecasting", everything),
    ):
        results = read_results(tmp_path / f"{task}.json")
        assert (list(results.tokens), f"{task}: {len(own)} samples in" in text) == (own, True)
    words = ("forecasting", da_motion.dataroot, "--split", "train", "--workers", 1)
    words = (*words, "--results", tmp_path / "forecasting.json", "--out", tmp_path / "bundle")
    told = called("evaluate", *words).output
    lines = (
        "task         forecasting, protocol clean",
        "min_fde 3 s, K = 6  ",
        "seen by a partner alone",
        "collider",
    )
    assert [each for each in lines if each not in told] == []
    rows = read_bundle(tmp_path / "bundle").rows()
    assert set(rows) == set(everything)
    assert any(row["min_fde 3 s, K = 1"] is not None for row in rows.values())
    assert "seen by nobody" in (tmp_path / "bundle" / "report.html").read_text(encoding="utf-8")
    told = called(
        "check",
        "results",
        tmp_path / "forecasting.json",
        "--dataroot",
        da_motion.dataroot,
        "--split",
        "train",
    )
    assert f"all {len(everything)} samples have a prediction" in told.output


def test_predict_sends_what_fits_into_a_budget(da_motion: DeepAccident, tmp_path: Path) -> None:
    words = (
        "constant_velocity",
        da_motion.dataroot,
        "--split",
        "train",
        "--task",
        "accident",
        "--workers",
        1,
    )
    sent = {}
    for name, options in (
        ("single", ""),
        ("all", "--agents all"),
        ("some", "--agents all --budget 5000"),
    ):
        run(*words, *options.split(), "--out", tmp_path / name)
        results = read_results(tmp_path / name / "accident.json")
        sent[name] = results.meta["bytes"]
    assert results.meta["link"]["budget"] == 5000
    assert results.meta["link"]["payload"] == "boxes"
    assert (sent["single"]["mean"], sent["all"]["partners"], sent["some"]["budget"]) == (
        0.0,
        4.0,
        5000,
    )
    assert 0 < sent["some"]["mean"] <= 5000 < sent["all"]["mean"]


def test_predict_takes_names_and_the_agents_that_are_there(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    root = tmp_path / "release"
    shutil.copytree(
        da_motion.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident", "infrastructure")
    )
    words = ("constant_velocity", root, "--split", "train", "--task", "accident", "--workers", 1)
    for agents, meta in (
        ("available", "available"),
        ("ego_vehicle,other_vehicle", ["ego_vehicle", "other_vehicle"]),
    ):
        run(*words, "--agents", agents, "--out", tmp_path / agents)
        assert read_results(tmp_path / agents / "accident.json").meta["agents"] == meta
    assert_refused(
        (
            lambda: run(*words, "--agents", "all", "--out", tmp_path / "all"),
            NotAvailableError,
            "use agents='available'",
        )
    )


def test_predict_of_scenarios_without_an_accident_names_the_scope(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    normal = tmp_path / "normal.txt"
    save_selection(da_motion.find(designed_accident=False), normal)
    words = (
        "constant_velocity",
        da_motion.dataroot,
        "--split",
        normal,
        "--task",
        "accident",
        "--workers",
        1,
    )
    told = (
        r"has no samples to predict; the scope accident, .* leaves out all 1 of its "
        r"scenarios, .* \(--scope all\)$"
    )
    assert_refused((lambda: run(*words, "--out", tmp_path / "out"), NotAvailableError, told))
    run(*words, "--scope", "all", "--out", tmp_path / "out")


def test_predict_goes_on_with_the_tasks_that_are_left(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    words = (
        "constant_velocity",
        da_motion.dataroot,
        "--split",
        "train",
        "--workers",
        1,
        "--out",
        tmp_path,
    )
    run(*words, "--task", "accident")
    path = tmp_path / "accident.json"
    before, text = path.stat().st_mtime_ns, run(*words)
    assert path.stat().st_mtime_ns == before
    assert f"accident: 20 samples in {path}, which were there already\n" in text
    assert f"detection: 20 samples in {tmp_path / 'detection.json'}\n" in text
    assert run(*words).count("which were there already") == 3
    told = (
        "accident.json: is there already (agents: 'single', asked for 'all')",
        "choose another path",
    )
    assert_refused(
        (lambda: run(*words, "--task", "accident", "--agents", "all"), ResultsError, told)
    )
