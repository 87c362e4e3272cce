"""What `validate` says of split files: unreadable ones, repeated lines, twins that were taken apart."""

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


def of_splits(report: ValidationReport) -> dict[str, list[str]]:
    """Code → where, of findings on splits."""
    found: dict[str, list[str]] = {}
    for finding in report.findings:
        if finding.code.startswith(("split", "twins", "two-places", "in-no-split")):
            found.setdefault(finding.code, []).append(finding.where)
    return found


def test_good_files_are_no_finding(root: Path) -> None:
    assert of_splits(validate_release(root)) == {}


@pytest.mark.slow
@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"one_word\n", b"three words here\n"])
@pytest.mark.parametrize("split", [*SPLITS, *MINI_SPLITS])
def test_a_file_of_garbage_leaves_the_others_known(root: Path, split: str, content: bytes) -> None:
    (root / f"{split}.txt").write_bytes(content)
    report = validate_release(root)
    (where,) = of_splits(report).pop("split-file-unreadable")
    assert where.startswith(str(root / f"{split}.txt"))
    known = {"train": 2, "val": 1}
    lost = known.pop(split, 0)
    here = {name: each.scenarios for name, each in report.files.splits.items() if each.scenarios}
    assert here == {**known, **({"unknown": lost} if lost else {})}


def test_every_garbage_file_is_named(root: Path) -> None:
    for split in ("train", "val_mini"):
        (root / f"{split}.txt").write_text("one_word\n")
    wheres = of_splits(validate_release(root))["split-file-unreadable"]
    assert wheres == [f"{root / 'train.txt'}:1", f"{root / 'val_mini.txt'}:1"]


@pytest.mark.parametrize("split", ["train", "train_mini"])
def test_repeated_lines(root: Path, split: str) -> None:
    (root / f"{split}.txt").write_text(f"{LINE}\n{TWIN}  {LINE}")
    report = validate_release(root)
    assert of_splits(report) == {"split-file-repeats": [str(root / f"{split}.txt")]}
    (finding,) = [finding for finding in report.findings if finding.code == "split-file-repeats"]
    assert finding.what == f"lists more than once: {LINE.strip()}"
    assert not report.is_good


@pytest.mark.parametrize("split", ["val", "test"])
def test_twins_apart(root: Path, split: str) -> None:
    (root / "train.txt").write_text(LINE)
    path = root / f"{split}.txt"
    path.write_text(path.read_text() + TWIN)
    report = validate_release(root)
    twin = f"{NORMAL}/{tiny.NAME}"
    assert of_splits(report) == {"twins-apart": [tiny.TOKEN, twin]}
    (finding,) = [finding for finding in report.findings if finding.code == "twins-apart" and finding.scenario == twin]
    assert finding.what == f"is of {split}, its twin {tiny.TOKEN} of train"
    assert (finding.severity, finding.known) == ("warning", False)


def test_a_twin_in_another_splits_folder(own_release: Path) -> None:
    """Layout B without split files: the folders tell."""
    for path in own_release.glob("*.txt"):
        path.unlink()
    assert of_splits(validate_release(own_release)) == {}
    moved = [path for path in (own_release / "val").glob("*_normal/**/*") if path.is_file()]
    for path in moved:
        target = own_release / "test" / path.relative_to(own_release / "val")
        target.parent.mkdir(parents=True, exist_ok=True)
        path.rename(target)
    for folder in (own_release / "val").glob("*_normal"):
        shutil.rmtree(folder)
    assert set(of_splits(validate_release(own_release))) == {"twins-apart"}


def test_one_name_in_two_families_is_no_twin(root: Path) -> None:
    family = "type1_subtype2_normal"
    tiny.write_tiny_release(root, scenario_type=family, meta=QUIET)
    with (root / "val.txt").open("a") as file:
        file.write(f"{family} {tiny.NAME}\n")
    assert of_splits(validate_release(root)) == {}
