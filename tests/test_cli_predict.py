"""`deepaccident predict` with a baseline."""

import shutil
from pathlib import Path

import pytest
from support.command_calls import invoke_command
from support.expected_errors import assert_raises
from support.text_contents import missing_parts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import NotAvailableError, ResultsError
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.evaluation.runs import read_bundle
from deepaccident_devkit.plugins.baselines import Baseline
from deepaccident_devkit.selection.splits import save_selection
from deepaccident_devkit.v2x import Link

pytestmark = pytest.mark.slow


def run(*words: object) -> str:
    return invoke_command("predict", *words).output


def test_predict_writes_all_tasks_of_the_samples_that_are_evaluated(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    options = "--split train --agents all --workers 1"
    text = run("constant_velocity", da_motion.dataroot, *options.split(), "--out", tmp_path)
    names = ["accident.json", "detection.json", "motion"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    for name in names:
        results = read_results(tmp_path / name)
        results.check()
        assert list(results.tokens) == da_motion.samples("train", "evaluate")
        assert results.meta["agents"] == "all"
        assert f"({results.task}, 20 samples)" in text


def test_predict_takes_a_link_a_model_a_horizon_and_a_scope(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    options = "--split train --task accident --latency 0.2 --pose-noise 0.3 --seed 4"
    options += " --agents all --horizon 1.5 --scope all --workers 1"
    run("constant_turn_rate", da_motion.dataroot, *options.split(), "--out", tmp_path)

    (path,) = tmp_path.iterdir()
    assert path.name == "accident.json"
    results = read_results(path)
    link = Link(latency=0.2, pose_noise=0.3, seed=4)
    meta = Baseline(agents="all", model="constant_turn_rate", link=link, horizon=1.5).meta()
    assert {name: results.meta[name] for name in meta} == meta
    tokens = da_motion.evaluation_samples("train", "paper", horizon=1.5, scope="all")
    assert list(results.tokens) == tokens


def test_predict_writes_plans_and_forecasts_that_are_evaluated(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    options = "--split train --samples all --agents all --workers 1 --task planning,forecasting"
    output = run("standing", da_motion.dataroot, *options.split(), "--out", tmp_path)

    assert sorted(path.name for path in tmp_path.iterdir()) == ["forecasting.json", "planning.json"]
    all_tokens = da_motion.samples("train", "all")
    vehicle_tokens = [token for token in all_tokens if "/infrastructure/" not in token]
    for task, tokens in (("planning", vehicle_tokens), ("forecasting", all_tokens)):
        results = read_results(tmp_path / f"{task}.json")
        assert list(results.tokens) == tokens
        assert f"({task}, {len(tokens)} samples)" in output

    path, bundle = tmp_path / "forecasting.json", tmp_path / "bundle"
    command = ("evaluate", "forecasting", da_motion.dataroot, "--split", "train", "--workers", 1)
    output = invoke_command(*command, "--results", path, "--out", bundle).output
    expected = (
        "task           forecasting, protocol clean",
        "minFDE at 3 s, K = 6  ",
        "seen only by a partner",
        "colliding actors",
    )
    assert missing_parts(output, *expected) == []
    rows = read_bundle(bundle).rows()
    assert set(rows) == set(all_tokens)
    assert any(row["min_fde 3 s, K = 1"] is not None for row in rows.values())
    assert "seen by no agent" in (bundle / "report.html").read_text(encoding="utf-8")

    release = ("--dataroot", da_motion.dataroot, "--split", "train")
    output = invoke_command("check", "results", path, *release).output
    assert f"all {len(all_tokens)} samples have a prediction" in output


def test_predict_sends_what_fits_into_a_budget(da_motion: DeepAccident, tmp_path: Path) -> None:
    task = ("--split", "train", "--task", "accident", "--workers", 1)
    sent_bytes = {}
    for name, options in (
        ("single", ""),
        ("all", "--agents all"),
        ("some", "--agents all --budget 5000"),
    ):
        out = tmp_path / name
        run("constant_velocity", da_motion.dataroot, *task, *options.split(), "--out", out)
        results = read_results(out / "accident.json")
        sent_bytes[name] = results.meta["bytes"]

    assert results.meta["link"]["budget"] == sent_bytes["some"]["budget"] == 5000
    assert results.meta["link"]["payload"] == "boxes"
    assert sent_bytes["single"]["mean"] == 0.0
    assert sent_bytes["all"]["partners"] == 4.0
    assert 0 < sent_bytes["some"]["mean"] <= 5000 < sent_bytes["all"]["mean"]


def test_predict_takes_names_of_agents_or_the_available_ones(
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
    assert_raises(
        (
            lambda: run(*words, "--agents", "all", "--out", tmp_path / "all"),
            NotAvailableError,
            "use agents='available'",
        )
    )


def test_predict_of_scenarios_without_an_accident_names_the_scope(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    split_file = tmp_path / "normal.txt"
    save_selection(da_motion.find(designed_accident=False), split_file)
    options = ("--split", split_file, "--task", "accident", "--workers", 1)
    words = ("constant_velocity", da_motion.dataroot, *options, "--out", tmp_path / "out")
    message = (
        r"has no samples to predict; the default scope \(accident\) excludes every scenario of "
        r"this split, .* \(--scope all\)$"
    )
    assert_raises((lambda: run(*words), NotAvailableError, message))
    run(*words, "--scope", "all")


def test_predict_continues_with_the_remaining_tasks(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    options = ("--split", "train", "--workers", 1, "--out", tmp_path)
    words = ("constant_velocity", da_motion.dataroot, *options)
    run(*words, "--task", "accident")
    path = tmp_path / "accident.json"
    modification_time = path.stat().st_mtime_ns

    output = run(*words)

    assert path.stat().st_mtime_ns == modification_time
    assert f"kept {path} (accident, 20 samples)\n" in output
    assert f"wrote {tmp_path / 'detection.json'} (detection, 20 samples)\n" in output
    assert run(*words).count("kept ") == 3
    message = (
        "accident.json: already exists (agents: 'single', asked for 'all')",
        "choose another path",
    )
    assert_raises(
        (lambda: run(*words, "--task", "accident", "--agents", "all"), ResultsError, message)
    )
