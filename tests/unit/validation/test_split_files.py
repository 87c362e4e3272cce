"""What `validate` says of split files where no planted fault tells: what is still known, folders,
twins.
"""

import shutil
from pathlib import Path

import pytest
import tiny

from deepaccident_devkit.taxonomy import MINI_SPLITS, SPLITS
from deepaccident_devkit.validation import ValidationReport, validate_release

NORMAL = tiny.TYPE.replace("accident", "normal")
OTHER = "Town05_type001_subtype0001_scenario00007"
LINE, TWIN = f"{tiny.TYPE} {tiny.NAME}\n", f"{NORMAL} {tiny.NAME}\n"
QUIET = "ClearNoon -1 -1 -1 -1 -1 -1 -1 14\n"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """An accident and its twin of train, and another scenario of val."""
    tiny.write_tiny_release(tmp_path)
    tiny.write_tiny_release(tmp_path, scenario_type=NORMAL, meta=QUIET)
    tiny.write_tiny_release(tmp_path, name=OTHER)
    for split in (*SPLITS, *MINI_SPLITS):
        (tmp_path / f"{split}.txt").write_text("")
    (tmp_path / "train.txt").write_text(LINE + TWIN)
    (tmp_path / "val.txt").write_text(f"{tiny.TYPE} {OTHER}\n")
    return tmp_path


def of_splits(report: ValidationReport) -> dict[str, str]:
    """Code → where, of findings on splits."""
    kinds = ("split", "twins", "two-places", "in-no-split")
    return {
        finding.code: finding.where for finding in report.findings if finding.code.startswith(kinds)
    }


@pytest.mark.parametrize(
    ("split", "content"), [("train", b"\xff\xfe\x00"), ("val_mini", b"three words here\n")]
)
def test_a_file_of_garbage_leaves_the_others_known(root: Path, split: str, content: bytes) -> None:
    (root / f"{split}.txt").write_bytes(content)
    report, known = validate_release(root), {"train": 2, "val": 1}
    assert of_splits(report)["split-file-unreadable"].startswith(str(root / f"{split}.txt"))
    lost = known.pop(split, 0)
    here = {name: each.scenarios for name, each in report.files.splits.items() if each.scenarios}
    assert here == {**known, **({"unknown": lost} if lost else {})}


def test_split_files_against_folders(own_release: Path) -> None:
    """In layout B the folder says too of which split a scenario is."""
    line, *others = (own_release / "train.txt").read_text().splitlines(keepends=True)
    (own_release / "train.txt").write_text("".join(others))
    with (own_release / "val.txt").open("a") as file:
        file.write(line)
    assert {each.code for each in validate_release(own_release, workers=1).findings} == {
        "splits-contradict"
    }


def test_a_twin_in_another_splits_folder(own_release: Path) -> None:
    """Layout B without split files: the folders tell."""
    for path in own_release.glob("*.txt"):
        path.unlink()
    assert of_splits(validate_release(own_release)) == {}
    (normal,) = (own_release / "val").glob("*_normal")
    shutil.copytree(normal, own_release / "test" / normal.name, dirs_exist_ok=True)
    shutil.rmtree(normal)
    assert set(of_splits(validate_release(own_release))) == {"twins-apart"}


def test_one_name_in_two_families_is_no_twin(root: Path) -> None:
    family = "type1_subtype2_normal"
    tiny.write_tiny_release(root, scenario_type=family, meta=QUIET)
    with (root / "val.txt").open("a") as file:
        file.write(f"{family} {tiny.NAME}\n")
    assert of_splits(validate_release(root)) == {}
