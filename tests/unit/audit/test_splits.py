"""Splits of all kinds: the official one passes, and what leaks is told."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest

from deepaccident_devkit.audit import AuditReport, audit_splits
from deepaccident_devkit.errors import ConfigError, MissingFileError, SplitFileError
from deepaccident_devkit.splits import split_records

ACCIDENT, NORMAL = "type1_subtype1_accident", "type1_subtype1_normal"
NAMES = [f"Town0{number % 5 + 1}_type001_subtype0001_scenario{number:05d}" for number in range(40)]
TOKENS = [f"{kind}/{name}" for kind in (ACCIDENT, NORMAL) for name in NAMES]
FRAMES = range(1, 11)
Sides = Callable[..., AuditReport]


@pytest.fixture
def sides(tmp_path: Path) -> Sides:
    """The audit of files with these lines, by name."""

    def audited(**lines: list[str]) -> AuditReport:
        for name, each in lines.items():
            (tmp_path / f"{name}.txt").write_text("\n".join(each) + "\n")
        return audit_splits(tmp_path / f"{name}.txt" for name in lines)

    return audited


def numbers(report: AuditReport) -> dict[str, int]:
    return {finding.kind: finding.number for finding in report.findings}


def path_of(token: str, frame: int, root: str = "/data/2023/DeepAccident") -> str:
    kind, name = token.split("/")
    return f"{root}/{kind}/ego_vehicle/label/{name}/{name}_{frame:03d}.txt"


def test_the_official_split_passes_and_so_do_its_subsets(sides: Sides) -> None:
    records = [
        {"token": token, "scenario_type": token.split("/")[0], "name": token.split("/")[1], "collision": None}
        | {"designed_accident": token.startswith(ACCIDENT), "road_type": None, "spawn_side": None, "weather": "Clear"}
        for token in TOKENS
    ]
    split = {name: list(tokens) for name, tokens in split_records(records).by_name().items()}  # type: ignore[arg-type]
    report = sides(train=split["train"], val=split["val"], test=split["test"])
    assert (report.findings, report.to_text().splitlines()[0]) == ((), "Nothing was found.")
    assert [row[1] for row in report.tables["sides"]] == ["recordings", 56, 12, 12]
    assert numbers(sides(train_mini=split["train_mini"], val=split["val"])) == {}
    assert numbers(sides(train_mini=split["train_mini"], train=split["train"])) == {"recordings": 10}


@pytest.mark.parametrize("form", ["{0} {1}", "{0}/{1}", "  {0}  {1}  "])
def test_a_random_split_by_names_tears_twins(sides: Sides, form: str) -> None:
    lines = [form.format(*token.split("/")) for token in TOKENS]
    Random(1).shuffle(lines)  # noqa: S311
    report = sides(train=lines[:60], val=lines[60:])
    torn = len(
        {line.split("scenario")[-1] for line in lines[:60]} & {line.split("scenario")[-1] for line in lines[60:]}
    )
    assert numbers(report) == {"twins": torn}
    assert "twin pairs torn apart, as by a random split by names" in report.to_text()
    assert len(report.findings[0].examples) == 3
    assert "deepaccident split" in report.findings[0].remedy


def test_a_random_split_by_frames_puts_recordings_on_both_sides(sides: Sides) -> None:
    lines = [path_of(token, frame) for token in TOKENS for frame in FRAMES]
    Random(2).shuffle(lines)  # noqa: S311
    report = sides(train=lines[:400], val=lines[400:])
    assert numbers(report) == {"recordings": len(TOKENS)}
    assert "as by a random split by frames" in report.to_text()
    assert [row[2] for row in report.tables["sides"]] == ["frames named", 400, 400]


@pytest.mark.parametrize(
    "lines",
    [
        (f"{TOKENS[0]}/ego_vehicle/007", f"{TOKENS[0]}/infrastructure/007"),
        (f"{TOKENS[0]}/007", path_of(TOKENS[0], 7)),
        (path_of(TOKENS[0], 7).replace("/", "\\"), path_of(TOKENS[0], 7, "..") + ",1"),
        (json.dumps([path_of(TOKENS[0], 7), path_of(TOKENS[1], 8)]), f"{TOKENS[0]}/ego_vehicle/007/Camera_Front"),
    ],
)
def test_the_same_moment_on_two_sides(sides: Sides, lines: tuple[str, str]) -> None:
    report = sides(train=[lines[0]], val=[lines[1]])
    assert numbers(report) == {"frames": 1, "recordings": 1}
    assert f"{TOKENS[0]} frame 7" in report.findings[0].examples[0]


def test_a_scenario_beside_one_of_its_frames(sides: Sides) -> None:
    assert numbers(sides(train=[TOKENS[0]], val=[f"{TOKENS[0]}/ego_vehicle/007"])) == {"recordings": 1}
    assert numbers(sides(train=[TOKENS[0]], val=[TOKENS[40]], test=[TOKENS[1]])) == {"twins": 1}


def test_mini_beside_the_full_release(sides: Sides, tmp_path: Path) -> None:
    mini = path_of(TOKENS[0], 7, "/data/DeepAccident_mini")
    report = sides(train=[mini], val=[path_of(TOKENS[0], 7), path_of(TOKENS[1], 7)])
    assert numbers(report) == {"mini": 1}
    assert "other recordings" in report.to_text()
    assert numbers(sides(train=[mini], val=[path_of(TOKENS[1], 7, "/data/v1-mini")])) == {}
    assert numbers(sides(mini=[TOKENS[0]], val=[TOKENS[1]])) == {"mini": 1}
    (tmp_path / "DeepAccident_mini").mkdir()
    (tmp_path / "DeepAccident_mini" / "train.txt").write_text(TOKENS[0])
    assert numbers(audit_splits([tmp_path / "DeepAccident_mini" / "train.txt", tmp_path / "val.txt"])) == {"mini": 1}


def test_files_that_are_no_splits(sides: Sides, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"two or more split files, or dataroots, a side each, found .*train\.txt"):
        sides(train=[TOKENS[0]])
    with pytest.raises(SplitFileError, match=r"val\.txt:2: expected a scenario's type and name, .*found 'Town03_x'"):
        sides(train=[TOKENS[0]], val=["", "Town03_x"])
    with pytest.raises(MissingFileError, match=r"no\.txt: no such file"):
        audit_splits([tmp_path / "train.txt", tmp_path / "no.txt"])
    (tmp_path / "odd.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SplitFileError, match=r"odd\.txt: not a text file"):
        audit_splits([tmp_path / "train.txt", tmp_path / "odd.txt"])


def test_hostile_lines_end_soon(sides: Sides) -> None:
    assert numbers(sides(train=[f"{ACCIDENT}/" * 20_000 + TOKENS[0]], val=["_" * 100_000 + TOKENS[1]])) == {}


def test_releases_share_recordings_of_a_name_and_the_same_labels(motion_root: Path, tmp_path: Path) -> None:
    """Of a name alone nothing is said."""
    for name in ("copy", "other"):
        shutil.copytree(motion_root, tmp_path / name, ignore=shutil.ignore_patterns(".deepaccident"))
    labels = sorted(tmp_path.glob("other/*/*/label/*/*_001.txt"))
    for label in labels:
        label.write_bytes(label.read_bytes() + b"\n")
    [found] = audit_splits([motion_root, tmp_path / "copy"]).findings
    assert (found.kind, found.number) == ("recordings", 2)
    assert str(motion_root) in found.examples[0]
    assert str(tmp_path / "copy") in found.examples[0]
    report = audit_splits([motion_root, tmp_path / "other"])
    assert (len(labels), report.findings) == (10, ())
    assert report.tables["sides"][1:] == [(str(motion_root), 2), (str(tmp_path / "other"), 2)]
    with pytest.raises(ConfigError, match=r"files, or dataroots, a side each, found .*motion, .*\.txt"):
        audit_splits([motion_root, motion_root / "train.txt"])
