"""Findings of `validate` on split files that no planted fault shows: known splits, folders and
twins.
"""

import shutil
from pathlib import Path

import pytest
from support import tiny_release
from support.tiny_release import SCENARIO_NAME, SCENARIO_TYPE

from deepaccident_devkit.taxonomy import MINI_SPLITS, SPLITS
from deepaccident_devkit.validation import ValidationReport, validate_release

NORMAL = SCENARIO_TYPE.replace("accident", "normal")
OTHER = "Town05_type001_subtype0001_scenario00007"
LINE = f"{SCENARIO_TYPE} {SCENARIO_NAME}\n"
TWIN_LINE = f"{NORMAL} {SCENARIO_NAME}\n"
QUIET = "ClearNoon -1 -1 -1 -1 -1 -1 -1 14\n"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Write an accident and its twin of train, and another scenario of val."""
    tiny_release.write_tiny_release(tmp_path)
    tiny_release.write_tiny_release(tmp_path, scenario_type=NORMAL, meta=QUIET)
    tiny_release.write_tiny_release(tmp_path, name=OTHER)
    for split in (*SPLITS, *MINI_SPLITS):
        (tmp_path / f"{split}.txt").write_text("")
    (tmp_path / "train.txt").write_text(LINE + TWIN_LINE)
    (tmp_path / "val.txt").write_text(f"{SCENARIO_TYPE} {OTHER}\n")
    return tmp_path


def split_findings(report: ValidationReport) -> dict[str, str]:
    """Return the places of the findings on splits, by code."""
    prefixes = ("split", "twins", "two-places", "in-no-split")
    findings = [finding for finding in report.findings if finding.code.startswith(prefixes)]
    return {finding.code: finding.where for finding in findings}


@pytest.mark.parametrize(
    ("split", "content"), [("train", b"\xff\xfe\x00"), ("val_mini", b"three words here\n")]
)
def test_an_unreadable_split_file_leaves_the_others_known(
    root: Path, split: str, content: bytes
) -> None:
    path = root / f"{split}.txt"
    path.write_bytes(content)
    report = validate_release(root)
    assert split_findings(report)["split-file-unreadable"].startswith(str(path))

    expected = {"train": 2, "val": 1}
    if split in expected:
        expected["unknown"] = expected.pop(split)
    counts = {name: count.scenarios for name, count in report.files.splits.items()}
    assert {name: count for name, count in counts.items() if count} == expected


def test_split_files_that_contradict_the_folders_are_a_finding(own_release: Path) -> None:
    """In layout B the folder names the split of a scenario as well."""
    train_file = own_release / "train.txt"
    line, *other_lines = train_file.read_text().splitlines(keepends=True)
    train_file.write_text("".join(other_lines))
    with (own_release / "val.txt").open("a") as file:
        file.write(line)
    findings = validate_release(own_release, workers=1).findings

    assert {finding.code for finding in findings} == {"splits-contradict"}


def test_a_twin_in_another_splits_folder(own_release: Path) -> None:
    """In layout B, the folders name the splits if there are no split files."""
    for path in own_release.glob("*.txt"):
        path.unlink()
    assert split_findings(validate_release(own_release)) == {}
    (normal,) = (own_release / "val").glob("*_normal")
    shutil.copytree(normal, own_release / "test" / normal.name, dirs_exist_ok=True)
    shutil.rmtree(normal)
    assert set(split_findings(validate_release(own_release))) == {"twins-apart"}


def test_one_name_in_two_families_is_no_twin(root: Path) -> None:
    family = "type1_subtype2_normal"
    tiny_release.write_tiny_release(root, scenario_type=family, meta=QUIET)
    with (root / "val.txt").open("a") as file:
        file.write(f"{family} {SCENARIO_NAME}\n")
    assert split_findings(validate_release(root)) == {}
