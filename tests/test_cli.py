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
from tiny import NAME, TYPE, write_tiny_release
from verbs import called, commands, ran

from deepaccident_devkit import DeepAccident, __version__
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.motion import LABEL_PROTOCOLS, LabelFiles, MotionLabelConfig
from deepaccident_devkit.release import read_split_file
from deepaccident_devkit.selection.splits import official_split


@pytest.mark.slow
def test_synth_index_info_end_to_end(tmp_path: Path) -> None:
    out = tmp_path / "my release"
    made = ran(
        "synth",
        out,
        "--scenarios",
        2,
        "--frames",
        3,
        "--size",
        "64x36",
        "--layout",
        "B",
        "--seed",
        7,
    )
    assert "deepaccident info" in made.stdout
    assert "2 scenarios, 30 samples" in ran("index", out).stdout
    text = " ".join(ran("info", out).stdout.split())
    wanted = (
        "layout B",
        "train 2 of 483",
        "collision scenarios false 1 true 1",
        "type1_subtype1_accident 1",
        "Camera_Front 10",
    )
    assert [line for line in wanted if line not in text] == []
    counts = json.loads(ran("info", out, "--json").stdout)
    assert (counts["tables"]["sample"], counts["agents"]["infrastructure"]) == (30, 2)
    assert counts["splits"] == {"train": 2, "val": 0, "test": 0}
    release = DeepAccident(dataroot=out)
    assert release.load_image(release.sample_data[0]).shape == (36, 64, 3)


def test_errors_are_one_message_and_status_2(tmp_path: Path) -> None:
    failed = ran("info", tmp_path / "nowhere", status=2)
    assert failed.stderr.startswith(
        f"error: {tmp_path / 'nowhere'}: does not exist; give the folder"
    )
    assert failed.stdout == ""


FAILING = """
import sys
from deepaccident_devkit import cli
from deepaccident_devkit.errors import MissingFileError

def fail(command):
    if "memory" in sys.argv:
        raise MemoryError("Unable to allocate 9.9 TiB")
    told = "Caught MissingFileError in DataLoader worker process 0.\\nOriginal Traceback (most recent call last):"
    raise MissingFileError(f"{told}\\n  …\\ndeepaccident_devkit.errors.MissingFileError: a.jpg: no such file")

cli.run_interruptibly = fail
cli.main()
"""  # noqa: E501


def test_of_an_error_in_a_loaders_worker_the_message_is_told_alone() -> None:
    failed = subprocess.run(
        [sys.executable, "-c", FAILING], check=False, capture_output=True, text=True
    )
    assert (failed.returncode, failed.stderr) == (2, "error: a.jpg: no such file\n")
    failed = subprocess.run(
        [sys.executable, "-c", FAILING, "memory"], check=False, capture_output=True, text=True
    )
    assert (failed.returncode, failed.stderr[:24]) == (2, "error: memory ran out; u")


@pytest.mark.slow
def test_a_broken_release_is_listed_and_may_be_skipped(own_release: Path) -> None:
    broken = next(own_release.glob("train/*/ego_vehicle/label/*/*_002.txt"))
    broken.write_text("0 0\ncar 1 2 3 4\n")
    told = ran("info", own_release, status=2).stderr
    assert "1 of 6 scenarios are broken" in told
    assert f"{broken}:2: expected 13 fields, found 5" in told
    skipped = ran("info", own_release, "--on-error", "skip")
    assert ("left out as broken:" in skipped.stdout, "WARNING: left out" in skipped.stderr) == (
        True,
        True,
    )


OF_FILES = ("--version", "--workers", "--scheduler")
NOT_OF_ALL = {"validate": OF_FILES, "release": OF_FILES, "scores": ("--version",)}
NOT_OF_ALL |= dict.fromkeys(("train", "explore", "results", "sensor-setups"), ())
"""Verb on a release → the options of a release that it has; those that are left out run in one
process, say.
"""


@pytest.mark.slow
def test_all_verbs_have_one_grammar_and_a_help_that_says_everything() -> None:
    for words, _ in commands(deepaccident):
        text = called(*words, "--help").output
        options, _, advanced = text.partition("\nAdvanced:\n")
        assert not re.search(r"^  (-\w, )?--[\w-]+( [A-Z]+)?$(?!\n {4})", text, re.MULTILINE), (
            "an option without a help"
        )
        for name in ("--index-dir", "--scheduler", "--on-error"):
            assert f"  {name} " not in options
        if " DATAROOT" in text.splitlines()[0]:
            for name in NOT_OF_ALL.get(words[-1], (*OF_FILES, "--index-dir", "--on-error")):
                assert f"  {name} " in (options if name in OF_FILES[:2] else advanced), words
    assert len({words[0] for words, _ in commands(deepaccident) if words}) == 19


def test_versions_for_a_report() -> None:
    assert called("--version").output == f"deepaccident, version {__version__}\n"
    lines = [line.split() for line in called("--version", "--all").output.splitlines()]
    told = {words[0]: words[1:] for words in lines}
    assert (told["deepaccident"], told["numpy"]) == ([__version__], [np.__version__])
    assert {"Python", "system", "torch", "mcap"} <= told.keys()
    assert told.keys().isdisjoint({"ruff", "sphinx", "deepaccident_devkit"})


@pytest.mark.slow
def test_index_check_sees_an_edit_that_folder_times_hide(own_release: Path) -> None:
    ran("index", own_release)
    label = next(own_release.glob("train/*/ego_vehicle/label/*/*_001.txt"))
    label.write_text("\n".join(label.read_text().splitlines()[:-1]) + "\n")
    before, after = (
        json.loads(ran("info", own_release, "--json").stdout)["tables"]["annotation"]
        for _ in range(2)
    )
    ran("check", "index", own_release)
    checked = json.loads(ran("info", own_release, "--json").stdout)["tables"]["annotation"]
    assert (after, checked) == (before, before - 1)


def imported(*words: str) -> set[str]:
    """The devkit's parts that a command imports, and NumPy."""
    code = f"""if True:
        import sys
        from deepaccident_devkit.cli import deepaccident
        deepaccident({words!r}, standalone_mode=False)
        print("IMPORTED", *sys.modules)"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True
    )
    names = done.stdout.rpartition("IMPORTED")[2].split()
    return {
        name.removeprefix("deepaccident_devkit.")
        for name in names
        if name.startswith("deepaccident_devkit.")
    } | ({"numpy"} & set(names))


@pytest.mark.parametrize(
    ("words", "others"),
    [
        ("info --help", {"evaluation", "render", "export", "safety"}),
        ("evaluate motion --help", {"render", "cli.evaluate_bundles", "export"}),
        ("--help", {"numpy", "cli.options", "deepaccident"}),
    ],
)
def test_a_verb_does_not_wait_for_what_others_import(words: str, others: set[str]) -> None:
    assert imported(*words.split()).isdisjoint(others)


@pytest.mark.slow
def test_split_makes_the_official_split_and_writes_it(tmp_path: Path) -> None:
    root = tmp_path / "release"
    name = "Town03_type001_subtype0001_scenario000"
    for number in range(14):
        write_tiny_release(root, frames=6, agents=("ego_vehicle",), name=f"{name}{number:02d}")
    made = ran("split", root, "--out", tmp_path / "new", "--json")
    assert json.loads(made.stdout)["scenarios"] == {
        "train": 10,
        "val": 2,
        "test": 2,
        "train_mini": 2,
        "val_mini": 0,
    }
    assert f"written: {tmp_path / 'new' / 'val_mini.txt'}" in made.stderr
    by_library = official_split(DeepAccident(dataroot=root)).by_name()
    assert {
        path.stem: tuple(read_split_file(path)) for path in (tmp_path / "new").iterdir()
    } == by_library
    again = ("split", root, "--out", tmp_path / "new", "--seed", 1)
    assert "train.txt: is there already" in ran(*again, status=2).stderr
    ran(*again, "--overwrite")
    assert tuple(read_split_file(tmp_path / "new" / "train.txt")) != by_library["train"]


@pytest.mark.slow
def test_split_saves_a_selection(own_release: Path, tmp_path: Path) -> None:
    some = ("--where", "collision=true", "--where", "split=train")
    saved = ran("split", own_release, *some, "--out", tmp_path / "a.txt")
    found = [
        scenario["token"]
        for scenario in DeepAccident(dataroot=own_release).find(collision=True, split="train")
    ]
    assert read_split_file(tmp_path / "a.txt") == found
    assert f"scenarios {len(found)}" in " ".join(saved.stdout.split())
    ran("split", own_release, "--out", tmp_path / "b.txt")
    everything = [scenario["token"] for scenario in DeepAccident(dataroot=own_release).scenario]
    assert read_split_file(tmp_path / "b.txt") == everything


@pytest.mark.slow
def test_info_lists_the_scenarios_of_where(own_release: Path) -> None:
    wanted = ("info", own_release, "--where", "designed_accident=true")
    some = json.loads(ran(*wanted, "--json").stdout)
    assert [each["designed_accident"] for each in some] == [True] * 3
    count, *lines = ran(*wanted).stdout.splitlines()
    assert (count, [line.split()[0] for line in lines]) == (
        "3 of 6 scenarios match",
        [each["token"] for each in some],
    )
    none = ran("info", own_release, "--where", "length=1..2").stdout
    assert (
        none == "no scenario matches length=1..2; deepaccident info --fields lists "
        "what can be asked for\n"
    )


@pytest.mark.slow
def test_stats_prints_and_writes_tables_and_figures(own_release: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "stats"
    made = ran(
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
    told = ("selected: 3 of 6 scenarios", f"written: {len(names)} files in {out}")
    assert ([each for each in told if each not in made.stdout], [*out.glob("*.tmp")]) == ([], [])
    content = json.loads(ran("info", own_release, "--statistics", "--json").stdout)
    of_some = json.loads((out / "statistics.json").read_text())["scenarios"]["total"]
    assert (content["scenarios"]["total"], of_some, content["selected"]) == (6, 3, False)
    assert content["counts"]["collisions"]["counts"]["yes"]["total"] == 3


@pytest.mark.slow
def test_labels_writes_a_split_and_goes_on_where_it_stopped(
    own_release: Path, tmp_path: Path
) -> None:
    out, agents = tmp_path / "new" / "labels", ("ego_vehicle", "infrastructure")
    verb = ("labels", own_release, "--split", "train", "--out", out, "--workers", 2)
    switches = ("--switch", "half_cell_shift=no", "--switch", "own_box_default=no")
    made = ran(*verb, "--agents", ",".join(agents), *switches)
    scenarios = DeepAccident(dataroot=own_release).split_scenarios("train")
    whole = (
        f"{8 * len(scenarios)} samples in {out}: {2 * len(scenarios)} files "
        f"written, 0 were there already\n"
    )
    assert (made.stdout, "motion labels: 100%" in made.stderr) == (whole, True)
    rules = replace(LABEL_PROTOCOLS["released"], half_cell_shift=False, own_box_default=False)
    files = LabelFiles(out, MotionLabelConfig(protocol=rules))
    assert {token.rsplit("/", 1)[0] for token in files} == {
        f"{one}/{agent}" for one in scenarios for agent in agents
    }
    kept = ran(*verb, "--agents", "infrastructure", *switches)
    assert f"0 files written, {len(scenarios)} were there already" in kept.stdout
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    other = ran(*verb, "--protocol", "clean", status=2)
    assert other.stderr.startswith(f"error: {out}: holds labels of another configuration (")
    assert ("drawn_when: 'present', asked for 'since'" in other.stderr, other.stdout) == (True, "")
    named = ran(*verb, "--agents", "infrastructure", "--names", "fiery", status=2)
    assert "names: None, asked for 'fiery'" in named.stderr
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


@pytest.mark.slow
def test_labels_writes_batches_by_their_names(own_release: Path, tmp_path: Path) -> None:
    verb = (
        "labels",
        own_release,
        "--split",
        "train",
        "--out",
        tmp_path / "batches",
        "--names",
        "fiery",
    )
    ran(*verb, "--preset", "fiery", "--samples", "all", "--agents", "infrastructure")
    release = DeepAccident(dataroot=own_release)
    token = release.samples("train", "all")[-1]
    with np.load(tmp_path / "batches" / f"{token}.npz", allow_pickle=False) as file:
        for name, array in release.motion_labels(token, "fiery").as_batch("fiery").items():
            np.testing.assert_array_equal(file[name], array)


def test_labels_looks_at_its_folder_before_it_indexes(own_release: Path) -> None:
    result = CliRunner().invoke(
        deepaccident, ["labels", *map(str, (own_release, "--split", "train", "--out", own_release))]
    )
    assert "is not empty and holds no motion labels; choose a new folder" in str(result.exception)
    assert not (own_release / ".deepaccident").exists()


@pytest.mark.slow
def test_labels_of_what_has_none(tmp_path: Path) -> None:
    write_tiny_release(tmp_path / "test", labelled=False)
    write_tiny_release(tmp_path / "partial", agents=("ego_vehicle",))
    (tmp_path / "mine.txt").write_text(f"{TYPE} {NAME}\n")
    options = ("--split", tmp_path / "mine.txt", "--out", tmp_path / "labels")
    for root, more, told in (
        ("test", (), "none of its samples here has labels"),
        (
            "partial",
            ("--agents", "infrastructure"),
            "has no labelled samples of infrastructure for --samples",
        ),
        ("partial", ("--seen-by", "+other"), "agents: other_vehicle is not in this release"),
    ):
        assert told in ran("labels", tmp_path / root, *options, *more, status=2).stderr
    assert not (tmp_path / "labels").exists()
    ran("labels", tmp_path / "partial", *options, "--seen-by", "single")
