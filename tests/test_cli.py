"""The command line, end to end: the verbs on real folders, their grammar, their errors."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner
from tiny import NAME, TYPE, write_tiny_release

from deepaccident_devkit import DeepAccident, __version__
from deepaccident_devkit.cli import deepaccident, verbs
from deepaccident_devkit.motion import LABEL_PROTOCOLS, LabelFiles, MotionLabelConfig
from deepaccident_devkit.release import read_split_file
from deepaccident_devkit.splits import official_split
from deepaccident_devkit.synth import SynthConfig


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "deepaccident_devkit.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def test_synth_index_info_end_to_end(tmp_path: Path) -> None:
    out = tmp_path / "my release"
    made = run("synth", out, "--scenarios", 2, "--frames", 3, "--size", "64x36", "--layout", "B", "--seed", 7)
    assert made.returncode == 0, made.stderr
    assert f"deepaccident info {out}" in made.stdout or "deepaccident info" in made.stdout
    indexed = run("index", out)
    assert (indexed.returncode, "2 scenarios, 30 samples" in indexed.stdout) == (0, True)
    text = run("info", out)
    assert text.returncode == 0
    squeezed = " ".join(text.stdout.split())
    for line in (
        "layout B",
        "train 2 of 483",
        "type1_subtype1_accident 1",
        "Camera_Front 10",
    ):
        assert line in squeezed
    counts = json.loads(run("info", out, "--json").stdout)
    assert counts["tables"]["sample"] == 30
    assert counts["splits"] == {"train": 2, "val": 0, "test": 0}
    assert counts["agents"]["infrastructure"] == 2
    release = DeepAccident(dataroot=out)
    assert release.load_image(release.sample_data[0]).shape == (36, 64, 3)


def test_errors_are_one_message_and_status_2(tmp_path: Path) -> None:
    for verb in ("info", "index"):
        failed = run(verb, tmp_path / "nowhere")
        assert failed.returncode == 2
        assert failed.stderr.startswith(f"error: {tmp_path / 'nowhere'}: does not exist; give the folder")
        assert "Traceback" not in failed.stderr
        assert failed.stdout == ""


@pytest.mark.slow
def test_a_broken_release_is_listed_and_may_be_skipped(own_release: Path) -> None:
    broken = next(own_release.glob("train/*/ego_vehicle/label/*/*_002.txt"))
    broken.write_text("0 0\ncar 1 2 3 4\n")
    failed = run("info", own_release)
    assert failed.returncode == 2
    assert "1 of 6 scenarios are broken" in failed.stderr
    assert f"{broken}:2: expected 13 fields, found 5" in failed.stderr
    skipped = run("info", own_release, "--on-error", "skip")
    assert skipped.returncode == 0
    assert "left out as broken:" in skipped.stdout
    assert "WARNING: left out" in skipped.stderr


def commands(group: click.Group, *words: str) -> Iterator[tuple[str, ...]]:
    """The words of all commands below a group, and of the group itself."""
    yield words
    for name in group.list_commands(click.Context(group)):
        command = group.get_command(click.Context(group), name)
        assert command is not None
        yield from commands(command, *words, name) if isinstance(command, click.Group) else [(*words, name)]


OF_FILES = ("--version", "--workers", "--scheduler")
NOT_OF_ALL = {"validate": OF_FILES, "train": (), "explore": (), "results": ()}
"""Verb on a release → the options of a release that it has; those that are left out run in one process, say."""


@pytest.mark.slow
def test_all_verbs_have_one_grammar_and_a_help_that_says_everything() -> None:
    for words in commands(deepaccident):
        text = CliRunner().invoke(deepaccident, [*words, "--help"]).output
        options, _, advanced = text.partition("\nAdvanced:\n")
        assert not re.search(r"^  (-\w, )?--[\w-]+( [A-Z]+)?$(?!\n {4})", text, re.MULTILINE), (
            "an option without a help"
        )
        for name in ("--index-dir", "--scheduler", "--on-error"):
            assert f"  {name} " not in options
        if " DATAROOT" in text.splitlines()[0]:
            for name in NOT_OF_ALL.get(words[-1], (*OF_FILES, "--index-dir", "--on-error")):
                assert f"  {name} " in (options if name in OF_FILES[:2] else advanced), words
    assert len({words[0] for words in commands(deepaccident) if words}) == 16


def test_wrong_usage_is_status_2() -> None:
    runner = CliRunner()
    assert runner.invoke(deepaccident, ["info"]).exit_code == 2
    assert runner.invoke(deepaccident, ["dance"]).exit_code == 2
    assert runner.invoke(deepaccident, ["--version"]).output == f"deepaccident, version {__version__}\n"
    assert runner.invoke(deepaccident, ["--all"]).exit_code == 2


def test_versions_for_a_report() -> None:
    lines = [line.split() for line in CliRunner().invoke(deepaccident, ["--version", "--all"]).output.splitlines()]
    told = {words[0]: words[1:] for words in lines}
    assert told["deepaccident"] == [__version__]
    assert told["numpy"] == [np.__version__]
    assert {"Python", "system", "torch", "mcap"} <= told.keys()
    assert told.keys().isdisjoint({"ruff", "sphinx", "deepaccident_devkit"})


@pytest.mark.slow
def test_index_check_sees_an_edit_that_folder_times_hide(own_release: Path) -> None:
    run("index", own_release)
    label = next(own_release.glob("train/*/ego_vehicle/label/*/*_001.txt"))
    lines = label.read_text().splitlines()
    label.write_text("\n".join(lines[:-1]) + "\n")
    before, after = (json.loads(run("info", own_release, "--json").stdout)["tables"]["annotation"] for _ in range(2))
    assert before == after
    assert run("index", own_release, "--check").returncode == 0
    assert json.loads(run("info", own_release, "--json").stdout)["tables"]["annotation"] == before - 1


def imported(*words: str) -> set[str]:
    """The devkit's parts that a command imports, and NumPy."""
    code = f"""if True:
        import sys
        from deepaccident_devkit.cli import deepaccident
        deepaccident({words!r}, standalone_mode=False)
        print("IMPORTED", *sys.modules)"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    names = done.stdout.rpartition("IMPORTED")[2].split()
    return {name.removeprefix("deepaccident_devkit.") for name in names if name.startswith("deepaccident_devkit.")} | (
        {"numpy"} & set(names)
    )


def test_a_verb_does_not_wait_for_what_others_import() -> None:
    assert imported("info", "--help").isdisjoint({"evaluation", "render", "export", "safety"})
    assert imported("evaluate", "motion", "--help").isdisjoint({"render", "cli.evaluate_bundles", "export"})
    assert imported("--help").isdisjoint({"numpy", "cli.options", "deepaccident"})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mcap", "mmdet3d", "nuscenes", "opencood", "parquet", "questions", "webdataset"])
def test_an_export_imports_its_own_format_alone(name: str) -> None:
    shared = {"bulk", "format", "frames"}
    own = {name} | ({"nuscenes", "released_infos"} if name == "mmdet3d" else set())
    found = {each.split(".")[1] for each in imported("export", name, "--help") if each.startswith("export.")}
    assert found <= shared | own
    assert name == "mcap" or own <= found


def test_an_option_says_what_its_field_says() -> None:
    @verbs.verb()
    @verbs.field_option(SynthConfig, "unplanned")
    @verbs.field_option(SynthConfig, "layout")
    @verbs.field_option(SynthConfig, "exact")
    @verbs.field_option(SynthConfig, "view", default="open")
    def made(**options: object) -> None:
        click.echo(json.dumps(options))

    assert json.loads(CliRunner().invoke(made, ["--layout", "b"]).output) == {
        "unplanned": 0.1, "layout": "B", "exact": False, "view": "open",
    }  # fmt: skip
    text = " ".join(CliRunner().invoke(made, ["--help"]).output.split())
    assert (
        "Share of accidents that differ from the design: with a pedestrian or a third vehicle. [default: 0.1]" in text
    )
    assert "Whether calib files are the same at each frame" in text


@pytest.mark.slow
def test_split_makes_the_official_split_and_writes_it(tmp_path: Path) -> None:
    root = tmp_path / "release"
    name = "Town03_type001_subtype0001_scenario000"
    for number in range(14):
        write_tiny_release(root, frames=6, agents=("ego_vehicle",), name=f"{name}{number:02d}")
    made = run("split", root, "--out", tmp_path / "new", "--json")
    assert made.returncode == 0, made.stderr
    report = json.loads(made.stdout)
    assert report["scenarios"] == {"train": 10, "val": 2, "test": 2, "train_mini": 2, "val_mini": 0}
    assert f"written: {tmp_path / 'new' / 'val_mini.txt'}" in made.stderr
    by_library = official_split(DeepAccident(dataroot=root)).by_name()
    assert {path.stem: tuple(read_split_file(path)) for path in (tmp_path / "new").iterdir()} == by_library
    again = run("split", root, "--out", tmp_path / "new", "--seed", 1)
    assert (again.returncode, "train.txt: is there already" in again.stderr) == (2, True)
    assert run("split", root, "--out", tmp_path / "new", "--seed", 1, "--overwrite").returncode == 0
    assert tuple(read_split_file(tmp_path / "new" / "train.txt")) != by_library["train"]


@pytest.mark.slow
def test_split_saves_a_selection(own_release: Path, tmp_path: Path) -> None:
    saved = run(
        "split", own_release, "--where", "collision=true", "--where", "split=train", "--out", tmp_path / "a.txt"
    )
    assert saved.returncode == 0, saved.stderr
    found = DeepAccident(dataroot=own_release).find(collision=True, split="train")
    assert read_split_file(tmp_path / "a.txt") == [scenario["token"] for scenario in found]
    assert f"scenarios {len(found)}" in " ".join(saved.stdout.split())
    assert run("split", own_release, "--out", tmp_path / "b.txt").returncode == 0
    everything = [scenario["token"] for scenario in DeepAccident(dataroot=own_release).scenario]
    assert read_split_file(tmp_path / "b.txt") == everything
    assert run("split", own_release, "--out", tmp_path / "d.txt", "--seed", 1).returncode == 2
    assert run("split", own_release, "--where", "split=train", "--out", tmp_path / "b").returncode == 2
    for options in (("--seed", 3), ("--seed", 17)):
        refused = run("split", own_release, "--where", "split=train", "--out", tmp_path / "c.txt", *options)
        assert (refused.returncode, (tmp_path / "c.txt").exists()) == (2, False)
        assert (
            f"{options[0]} changes nothing with --where or a split file: it is for the official split" in refused.stderr
        )
    wrong = run("split", own_release, "--where", "wether=Clear")
    assert (wrong.returncode, wrong.stderr.startswith("error: scenarios cannot be found by 'wether'")) == (2, True)


@pytest.mark.slow
def test_info_lists_the_scenarios_of_where(own_release: Path) -> None:
    some = json.loads(run("info", own_release, "--json", "--where", "designed_accident=true").stdout)
    assert [each["designed_accident"] for each in some] == [True] * 3
    count, *lines = run("info", own_release, "--where", "designed_accident=true").stdout.splitlines()
    assert count == "3 of 6 scenarios match"
    assert [line.split()[0] for line in lines] == [each["token"] for each in some]
    none = run("info", own_release, "--where", "length=1..2").stdout
    assert none == "no scenario matches length=1..2; deepaccident info --fields lists what can be asked for\n"
    wrong = run("info", own_release, "--where", "town=Twon03")
    assert (wrong.returncode, "town: found 'Twon03'; possible are Town03" in wrong.stderr) == (2, True)


@pytest.mark.slow
def test_stats_prints_and_writes_tables_and_figures(own_release: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "stats"
    made = run("info", own_release, "--statistics", "--where", "designed_accident=true", "--out", out)
    assert made.returncode == 0, made.stderr
    assert "selected: 3 of 6 scenarios" in made.stdout
    names = {path.name for path in out.iterdir()}
    assert f"written: {len(names)} files in {out}" in made.stdout
    assert {"statistics.json", "ends.csv", "collision_pairs.csv", "scenarios.png", "collisions.png"} <= names
    assert not any(name.endswith(".tmp") for name in names)
    whole = run("info", own_release, "--statistics", "--json")
    content = json.loads(whole.stdout)
    assert (content["scenarios"]["total"], content["selected"]) == (6, False)
    assert content["counts"]["collisions"]["counts"]["yes"]["total"] == 3
    assert json.loads((out / "statistics.json").read_text())["scenarios"]["total"] == 3
    misplaced = run("info", own_release, "--out", out)
    assert (misplaced.returncode, "--out changes nothing without --statistics" in misplaced.stderr) == (2, True)


@pytest.mark.slow
def test_stats_says_before_anything_else_what_it_cannot_write(own_release: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    faults = {
        "": "expected a folder to write to, found an empty path",
        tmp_path / "file": "file is a file; give a folder",
        tmp_path / "file" / "new" / "folder": "file is a file; give a folder",
        "/proc/nowhere": "no file can be written there; give a folder that you may write to",
    }
    for out, why in faults.items():
        failed = run("info", own_release, "--statistics", "--out", out)
        assert (failed.returncode, failed.stdout, why in failed.stderr) == (2, "", True), failed.stderr
        assert "Traceback" not in failed.stderr


@pytest.mark.slow
def test_stats_of_nothing(own_release: Path, tmp_path: Path) -> None:
    nothing = run("info", own_release, "--statistics", "--where", "length=1..2")
    assert nothing.returncode == 0
    assert "selected: 0 of 6 scenarios" in nothing.stdout
    assert "no scenario meets the filters, so there is nothing to count" in nothing.stdout
    failed = run("info", own_release, "--statistics", "--where", "length=1..2", "--out", tmp_path / "new")
    assert (failed.returncode, failed.stdout) == (2, "")
    assert "no scenario matches --where, so there is nothing to write" in failed.stderr
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_labels_writes_a_split_and_goes_on_where_it_stopped(own_release: Path, tmp_path: Path) -> None:
    out, agents = tmp_path / "new" / "labels", ("ego_vehicle", "infrastructure")
    verb = ("labels", own_release, "--split", "train", "--out", out, "--workers", 2)
    made = run(*verb, "--agents", ",".join(agents), "--switch", "half_cell_shift=no", "--switch", "own_box_default=no")
    release = DeepAccident(dataroot=own_release)
    scenarios = release.split_scenarios("train")
    assert (made.returncode, made.stdout) == (
        0,
        f"{8 * len(scenarios)} samples in {out}: {2 * len(scenarios)} files written, 0 were there already\n",
    ), made.stderr
    assert "motion labels: 100%" in made.stderr
    rules = replace(LABEL_PROTOCOLS["released"], half_cell_shift=False, own_box_default=False)
    files = LabelFiles(out, MotionLabelConfig(protocol=rules))
    assert {token.rsplit("/", 1)[0] for token in files} == {f"{one}/{agent}" for one in scenarios for agent in agents}
    kept = run(*verb, "--agents", "infrastructure", "--switch", "half_cell_shift=no", "--switch", "own_box_default=no")
    assert (kept.returncode, f"0 files written, {len(scenarios)} were there already" in kept.stdout) == (0, True)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    other = run(*verb, "--protocol", "clean")
    assert (other.returncode, other.stdout) == (2, "")
    assert other.stderr.startswith(f"error: {out}: holds labels of another configuration (")
    assert "drawn_when: 'present', asked for 'since'" in other.stderr
    batches = run(*verb, "--agents", "infrastructure", "--names", "fiery")
    assert "names: None, asked for 'fiery'" in batches.stderr
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    verb = ("labels", own_release, "--split", "train", "--out", tmp_path / "batches", "--names", "fiery")
    made = run(*verb, "--preset", "fiery", "--samples", "all", "--agents", "infrastructure")
    assert made.returncode == 0, made.stderr
    token = release.samples("train", "all")[-1]
    with np.load(tmp_path / "batches" / f"{token}.npz", allow_pickle=False) as file:
        for name, array in release.motion_labels(token, "fiery").as_batch("fiery").items():
            np.testing.assert_array_equal(file[name], array)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "told"),
    [
        (
            ("--agents", "ego_vehicle,pole"),
            "--agents: expected one of ego_vehicle, ego_vehicle_behind,",
        ),
        (("--agents", ""), "found ''"),
        (("--agents", "ego_vehicle,"), "found ''"),
        (("--switch", "half_cell_shift"), "--switch: expected NAME=VALUE, found 'half_cell_shift'"),
        (("--switch", "half_cell_shift=maybe"), "--switch: expected yes or no for one of own_box_moved_twice,"),
        (("--switch", "warp=exact"), "found warp=exact"),
        (("--preset", "lift-splat"), "'lift-splat' is not one of"),
        (("--seen-by", "nobody"), "'nobody' is not one of"),
        (("--samples", "some"), "'some' is not one of"),
        (("--workers", "0"), "0 is not in the range"),
        (("--split", "tset"), "error: split: expected one of train, val, test, train_mini, val_mini, found 'tset'"),
        (("--split", "mine.txt"), "error: mine.txt: "),
        (("--names", "lss"), "'lss' is not one of 'fiery', 'beverse', 'deepaccident'"),
        (("--out", ""), "error: expected a folder of motion labels, found an empty path; give '.' for the current one"),
        (("--out", "/proc/nowhere"), "cannot be written"),
    ],
)
def test_labels_says_what_is_wrong_and_writes_nothing(
    own_release: Path, tmp_path: Path, options: tuple[str, ...], told: str
) -> None:
    failed = run("labels", own_release, "--split", "train", "--out", tmp_path / "labels", *options)
    assert (failed.returncode, failed.stdout) == (2, "")
    assert told in " ".join(failed.stderr.split())
    assert "Traceback" not in failed.stderr
    assert not (tmp_path / "labels").exists()


def test_labels_looks_at_its_folder_before_it_indexes(own_release: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for out, told in {
        tmp_path / "file": "file: is a file; give a folder",
        own_release: "is not empty and holds no motion labels; choose a new folder",
    }.items():
        failed = run("labels", own_release, "--split", "train", "--out", out)
        assert (failed.returncode, failed.stdout, told in failed.stderr) == (2, "", True), failed.stderr
    assert not (own_release / ".deepaccident").exists()


@pytest.mark.slow
def test_labels_of_what_has_none(tmp_path: Path) -> None:
    write_tiny_release(tmp_path / "test", labelled=False)
    (tmp_path / "mine.txt").write_text(f"{TYPE} {NAME}\n")
    failed = run("labels", tmp_path / "test", "--split", tmp_path / "mine.txt", "--out", tmp_path / "labels")
    assert (failed.returncode, "none of its samples here has labels" in failed.stderr) == (2, True), failed.stderr
    write_tiny_release(tmp_path / "partial", agents=("ego_vehicle",))
    verb = ("labels", tmp_path / "partial", "--split", tmp_path / "mine.txt", "--out", tmp_path / "labels")
    for options, told in {
        ("--agents", "infrastructure"): "has no labelled samples of infrastructure for --samples",
        ("--seen-by", "+other"): "agents: other_vehicle is not in this release",
    }.items():
        failed = run(*verb, *options)
        assert (failed.returncode, told in failed.stderr) == (2, True), failed.stderr
    assert not (tmp_path / "labels").exists()
    assert run(*verb, "--seen-by", "single").returncode == 0


def test_a_verb_that_is_nearly_written_is_named() -> None:
    for word, told in {
        "rendr": "No such command 'rendr'. Did you mean 'render'?",
        "xyz": "No such command 'xyz'.\n",
    }.items():
        result = CliRunner().invoke(deepaccident, [word, "out"])
        assert (result.exit_code, told in result.output) == (2, True)
