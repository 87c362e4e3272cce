"""The command line, end to end: the verbs on real folders, their grammar, their errors."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from support.command_calls import invoke_command, run_command, walk_commands
from support.text_contents import missing_parts
from support.tiny_release import SCENARIO_NAME, SCENARIO_TYPE, write_tiny_release

from deepaccident_devkit import DeepAccident, __version__
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.motion import LABEL_PROTOCOLS, LabelFiles, MotionLabelConfig
from deepaccident_devkit.release import read_split_file
from deepaccident_devkit.selection.splits import official_split


@pytest.mark.slow
def test_synth_index_info_end_to_end(tmp_path: Path) -> None:
    out = tmp_path / "my release"
    size = ("--scenarios", 2, "--frames", 3, "--size", "64x36")
    process = run_command("synth", out, *size, "--layout", "B", "--seed", 7)
    assert "deepaccident info" in process.stdout
    assert "2 scenarios, 30 samples" in run_command("index", out).stdout

    text = " ".join(run_command("info", out).stdout.split())
    expected = (
        "layout B",
        "train 2 of 483",
        "collision scenarios false 1 true 1",
        "type1_subtype1_accident 1",
        "Camera_Front 10",
    )
    assert missing_parts(text, *expected) == []

    counts = json.loads(run_command("info", out, "--json").stdout)
    assert counts["tables"]["sample"] == 30
    assert counts["agents"]["infrastructure"] == 2
    assert counts["splits"] == {"train": 2, "val": 0, "test": 0}
    release = DeepAccident(dataroot=out)
    assert release.load_image(release.sample_data[0]).shape == (36, 64, 3)


def test_errors_are_one_message_and_status_2(tmp_path: Path) -> None:
    root = tmp_path / "nowhere"
    process = run_command("info", root, status=2)
    assert process.stderr.startswith(f"error: {root}: does not exist; pass the folder")
    assert process.stdout == ""


FAILING_COMMAND = """
import sys
from deepaccident_devkit import cli
from deepaccident_devkit.errors import MissingFileError

def fail(command):
    if "memory" in sys.argv:
        raise MemoryError("Unable to allocate 9.9 TiB")
    head = "Caught MissingFileError in DataLoader worker process 0.\\nOriginal Traceback (most recent call last):"
    raise MissingFileError(f"{head}\\n  …\\ndeepaccident_devkit.errors.MissingFileError: a.jpg: no such file")

cli.run_interruptibly = fail
cli.main()
"""  # noqa: E501


def test_an_error_in_a_loader_worker_is_printed_without_its_traceback() -> None:
    command = [sys.executable, "-c", FAILING_COMMAND]
    process = subprocess.run(command, check=False, capture_output=True, text=True)
    assert (process.returncode, process.stderr) == (2, "error: a.jpg: no such file\n")

    command.append("memory")
    process = subprocess.run(command, check=False, capture_output=True, text=True)
    assert (process.returncode, process.stderr[:24]) == (2, "error: out of memory; us")


@pytest.mark.slow
def test_a_broken_release_is_listed_and_may_be_skipped(own_release: Path) -> None:
    broken = next(own_release.glob("train/*/ego_vehicle/label/*/*_002.txt"))
    broken.write_text("0 0\ncar 1 2 3 4\n")

    message = run_command("info", own_release, status=2).stderr
    assert "errors in 1 of 6 scenarios" in message
    assert f"{broken}:2: expected 13 fields, found 5" in message

    process = run_command("info", own_release, "--on-error", "skip")
    assert "excluded as broken:" in process.stdout
    assert "warning: excluded" in process.stderr


FILE_OPTIONS = ("--version", "--workers", "--scheduler")
RELEASE_OPTIONS = (*FILE_OPTIONS, "--index-dir", "--on-error")
REDUCED_OPTIONS = {"validate": FILE_OPTIONS, "release": FILE_OPTIONS, "scores": ("--version",)}
REDUCED_OPTIONS |= dict.fromkeys(("train", "explore", "results", "sensor-setups"), ())
"""Verb on a release that does not have all release options → the ones that it has."""


@pytest.mark.slow
def test_all_verbs_have_one_grammar_and_a_help_that_says_everything() -> None:
    for words, _ in walk_commands(deepaccident):
        text = invoke_command(*words, "--help").output
        options, _, advanced = text.partition("\nAdvanced:\n")
        option_without_help = r"^  (-\w, )?--[\w-]+( [A-Z]+)?$(?!\n {4})"
        assert not re.search(option_without_help, text, re.MULTILINE), "an option without a help"
        for name in ("--index-dir", "--scheduler", "--on-error"):
            assert f"  {name} " not in options
        if " DATAROOT" in text.splitlines()[0]:
            for name in REDUCED_OPTIONS.get(words[-1], RELEASE_OPTIONS):
                section = options if name in FILE_OPTIONS[:2] else advanced
                assert f"  {name} " in section, words

    verbs = {words[0] for words, _ in walk_commands(deepaccident) if words}
    assert len(verbs) == 19


def test_versions_for_a_report() -> None:
    assert invoke_command("--version").output == f"deepaccident, version {__version__}\n"
    lines = invoke_command("--version", "--all").output.splitlines()
    versions = {words[0]: words[1:] for words in map(str.split, lines)}
    assert versions["deepaccident"] == [__version__]
    assert versions["numpy"] == [np.__version__]
    assert {"Python", "system", "torch", "mcap"} <= versions.keys()
    assert versions.keys().isdisjoint({"ruff", "sphinx", "deepaccident_devkit"})


@pytest.mark.slow
def test_index_check_sees_an_edit_that_folder_times_hide(own_release: Path) -> None:
    run_command("index", own_release)
    label = next(own_release.glob("train/*/ego_vehicle/label/*/*_001.txt"))
    label.write_text("\n".join(label.read_text().splitlines()[:-1]) + "\n")

    num_boxes = count_boxes(own_release)
    assert count_boxes(own_release) == num_boxes
    run_command("check", "index", own_release)
    assert count_boxes(own_release) == num_boxes - 1


def count_boxes(root: Path) -> int:
    counts = json.loads(run_command("info", root, "--json").stdout)
    return int(counts["tables"]["annotation"])


def imported_modules(*words: str) -> set[str]:
    """Return the modules of the devkit that a command imports, and `numpy` if it imports it."""
    code = f"""if True:
        import sys
        from deepaccident_devkit.cli import deepaccident
        deepaccident({words!r}, standalone_mode=False)
        print("IMPORTED", *sys.modules)"""
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True
    )
    names = process.stdout.rpartition("IMPORTED")[2].split()
    return {
        name.removeprefix("deepaccident_devkit.")
        for name in names
        if name == "numpy" or name.startswith("deepaccident_devkit.")
    }


@pytest.mark.parametrize(
    ("words", "unneeded_modules"),
    [
        ("info --help", {"evaluation", "render", "export", "safety"}),
        ("evaluate motion --help", {"render", "cli.evaluate_bundles", "export"}),
        ("--help", {"numpy", "cli.options", "deepaccident"}),
    ],
)
def test_a_verb_does_not_wait_for_the_imports_of_others(
    words: str, unneeded_modules: set[str]
) -> None:
    assert imported_modules(*words.split()).isdisjoint(unneeded_modules)


@pytest.mark.slow
def test_split_makes_the_official_split_and_writes_it(tmp_path: Path) -> None:
    root, out = tmp_path / "release", tmp_path / "new"
    name = "Town03_type001_subtype0001_scenario000"
    for number in range(14):
        write_tiny_release(root, frames=6, agents=("ego_vehicle",), name=f"{name}{number:02d}")

    process = run_command("split", root, "--out", out, "--json")

    assert json.loads(process.stdout)["scenarios"] == {
        "train": 10,
        "val": 2,
        "test": 2,
        "train_mini": 2,
        "val_mini": 0,
    }
    assert f"wrote {out / 'val_mini.txt'}" in process.stderr
    split = official_split(DeepAccident(dataroot=root)).by_name()
    assert {path.stem: tuple(read_split_file(path)) for path in out.iterdir()} == split

    other_seed = ("split", root, "--out", out, "--seed", 1)
    assert "train.txt: already exists" in run_command(*other_seed, status=2).stderr
    run_command(*other_seed, "--overwrite")
    assert tuple(read_split_file(out / "train.txt")) != split["train"]


@pytest.mark.slow
def test_split_saves_a_selection(own_release: Path, tmp_path: Path) -> None:
    selection = ("--where", "collision=true", "--where", "split=train")
    process = run_command("split", own_release, *selection, "--out", tmp_path / "selected.txt")
    run_command("split", own_release, "--out", tmp_path / "all.txt")

    release = DeepAccident(dataroot=own_release)
    selected = [scenario["token"] for scenario in release.find(collision=True, split="train")]
    assert read_split_file(tmp_path / "selected.txt") == selected
    assert f"scenarios {len(selected)}" in " ".join(process.stdout.split())
    all_tokens = [scenario["token"] for scenario in release.scenario]
    assert read_split_file(tmp_path / "all.txt") == all_tokens


@pytest.mark.slow
def test_info_lists_the_scenarios_of_where(own_release: Path) -> None:
    command = ("info", own_release, "--where", "designed_accident=true")
    scenarios = json.loads(run_command(*command, "--json").stdout)
    assert [scenario["designed_accident"] for scenario in scenarios] == [True] * 3

    count, *lines = run_command(*command).stdout.splitlines()
    assert count == "3 of 6 scenarios match"
    assert [line.split()[0] for line in lines] == [scenario["token"] for scenario in scenarios]

    message = run_command("info", own_release, "--where", "length=1..2").stdout
    assert (
        message == "no scenario matches length=1..2; deepaccident info --fields lists "
        "the possible filters\n"
    )


@pytest.mark.slow
def test_stats_prints_and_writes_tables_and_figures(own_release: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "stats"
    process = run_command(
        "info", own_release, "--statistics", "--where", "designed_accident=true", "--out", out
    )

    names = {path.name for path in out.iterdir()}
    assert {
        "statistics.json",
        "ends.csv",
        "collision_pairs.csv",
        "scenarios.png",
        "collisions.png",
    } <= names
    assert "selected: 3 of 6 scenarios" in process.stdout
    assert f"wrote {len(names)} files to {out}" in process.stdout
    assert [*out.glob("*.tmp")] == []
    selected = json.loads((out / "statistics.json").read_text())
    assert selected["scenarios"]["total"] == 3

    statistics = json.loads(run_command("info", own_release, "--statistics", "--json").stdout)
    assert statistics["scenarios"]["total"] == 6
    assert statistics["selected"] is False
    assert statistics["counts"]["collisions"]["counts"]["yes"]["total"] == 3


@pytest.mark.slow
def test_labels_writes_a_split_and_goes_on_where_it_stopped(
    own_release: Path, tmp_path: Path
) -> None:
    out = tmp_path / "new" / "labels"
    agents = ("ego_vehicle", "infrastructure")
    command = ("labels", own_release, "--split", "train", "--out", out, "--workers", 2)
    switches = ("--switch", "half_cell_shift=no", "--switch", "own_box_default=no")

    process = run_command(*command, "--agents", ",".join(agents), *switches)

    scenarios = DeepAccident(dataroot=own_release).split_scenarios("train")
    num_samples, num_files = 8 * len(scenarios), 2 * len(scenarios)
    assert process.stdout == (
        f"wrote {out}: {num_samples} samples ({num_files} new files, 0 already there)\n"
    )
    assert "Writing motion labels: 100%" in process.stderr
    rules = replace(LABEL_PROTOCOLS["released"], half_cell_shift=False, own_box_default=False)
    files = LabelFiles(out, MotionLabelConfig(protocol=rules))
    assert {token.rsplit("/", 1)[0] for token in files} == {
        f"{scenario}/{agent}" for scenario in scenarios for agent in agents
    }

    process = run_command(*command, "--agents", "infrastructure", *switches)
    assert f"0 new files, {len(scenarios)} already there" in process.stdout

    contents = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    process = run_command(*command, "--protocol", "clean", status=2)
    assert process.stderr.startswith(f"error: {out}: contains labels with other settings (")
    assert "drawn_when: 'present', asked for 'since'" in process.stderr
    assert process.stdout == ""
    process = run_command(*command, "--agents", "infrastructure", "--names", "fiery", status=2)
    assert "names: None, asked for 'fiery'" in process.stderr
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == contents


@pytest.mark.slow
def test_labels_writes_batches_by_their_names(own_release: Path, tmp_path: Path) -> None:
    out = tmp_path / "batches"
    selection = ("--split", "train", "--samples", "all", "--agents", "infrastructure")
    names = ("--names", "fiery", "--preset", "fiery")
    run_command("labels", own_release, *selection, "--out", out, *names)

    release = DeepAccident(dataroot=own_release)
    token = release.samples("train", "all")[-1]
    batch = release.motion_labels(token, "fiery").as_batch("fiery")
    with np.load(out / f"{token}.npz", allow_pickle=False) as file:
        for name, array in batch.items():
            np.testing.assert_array_equal(file[name], array)


def test_labels_looks_at_its_folder_before_it_indexes(own_release: Path) -> None:
    words = ["labels", str(own_release), "--split", "train", "--out", str(own_release)]
    result = CliRunner().invoke(deepaccident, words)
    assert "is not empty and contains no motion labels; choose a new folder" in str(
        result.exception
    )
    assert not (own_release / ".deepaccident").exists()


@pytest.mark.slow
def test_labels_are_refused_for_samples_without_them(tmp_path: Path) -> None:
    write_tiny_release(tmp_path / "test", labelled=False)
    write_tiny_release(tmp_path / "partial", agents=("ego_vehicle",))
    (tmp_path / "mine.txt").write_text(f"{SCENARIO_TYPE} {SCENARIO_NAME}\n")
    options = ("--split", tmp_path / "mine.txt", "--out", tmp_path / "labels")
    for name, more_options, message in (
        ("test", (), "no sample of this split has labels"),
        (
            "partial",
            ("--agents", "infrastructure"),
            "has no labelled samples of infrastructure with --samples",
        ),
        ("partial", ("--seen-by", "+other"), "agents: other_vehicle is not in this release"),
    ):
        command = ("labels", tmp_path / name, *options, *more_options)
        assert message in run_command(*command, status=2).stderr
    assert not (tmp_path / "labels").exists()
    run_command("labels", tmp_path / "partial", *options, "--seen-by", "single")
