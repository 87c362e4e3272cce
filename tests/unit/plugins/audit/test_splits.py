"""Splits of all kinds: the official one passes, and leaks between sides are reported."""

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest

from deepaccident_devkit.errors import ConfigError, MissingFileError, SplitFileError
from deepaccident_devkit.plugins.audit import AuditReport, audit_splits
from deepaccident_devkit.selection.splits import split_records

ACCIDENT, NORMAL = "type1_subtype1_accident", "type1_subtype1_normal"
NAMES = [f"Town0{number % 5 + 1}_type001_subtype0001_scenario{number:05d}" for number in range(40)]
TOKENS = [f"{kind}/{name}" for kind in (ACCIDENT, NORMAL) for name in NAMES]
FRAMES = range(1, 11)
AuditSides = Callable[..., AuditReport]


@pytest.fixture
def audit_sides(tmp_path: Path) -> AuditSides:
    """Return a function that writes split files with these lines and audits them."""

    def audit(**lines_by_name: list[str]) -> AuditReport:
        for name, lines in lines_by_name.items():
            (tmp_path / f"{name}.txt").write_text("\n".join(lines) + "\n")
        return audit_splits(tmp_path / f"{name}.txt" for name in lines_by_name)

    return audit


def numbers_by_kind(report: AuditReport) -> dict[str, int]:
    return {finding.kind: finding.number for finding in report.findings}


def label_path(token: str, frame: int, root: str = "/data/2023/DeepAccident") -> str:
    kind, name = token.split("/")
    return f"{root}/{kind}/ego_vehicle/label/{name}/{name}_{frame:03d}.txt"


def test_the_official_split_passes_and_so_do_its_subsets(audit_sides: AuditSides) -> None:
    records = []
    for token in TOKENS:
        scenario_type, name = token.split("/")
        record = {
            "token": token,
            "scenario_type": scenario_type,
            "name": name,
            "collision": None,
            "designed_accident": token.startswith(ACCIDENT),
            "road_type": None,
            "spawn_side": None,
            "weather": "Clear",
        }
        records.append(record)
    split = {name: list(tokens) for name, tokens in split_records(records).by_name().items()}  # type: ignore[arg-type]
    train, val, mini = split["train"], split["val"], split["train_mini"]
    report = audit_sides(train=train, val=val, test=split["test"])
    assert report.findings == ()
    assert [row[1] for row in report.tables["sides"]] == ["recordings", 56, 12, 12]
    assert numbers_by_kind(audit_sides(train_mini=mini, val=val)) == {}
    assert numbers_by_kind(audit_sides(train_mini=mini, train=train)) == {"recordings": 10}


@pytest.mark.parametrize("form", ["{0} {1}", "{0}/{1}", "  {0}  {1}  "])
def test_a_random_split_by_names_tears_twins(audit_sides: AuditSides, form: str) -> None:
    lines = [form.format(*token.split("/")) for token in TOKENS]
    Random(1).shuffle(lines)  # noqa: S311
    report = audit_sides(train=lines[:60], val=lines[60:])
    train_numbers = {line.split("scenario")[-1] for line in lines[:60]}
    val_numbers = {line.split("scenario")[-1] for line in lines[60:]}
    assert numbers_by_kind(report) == {"twins": len(train_numbers & val_numbers)}
    assert len(report.findings[0].examples) == 3
    assert "deepaccident split" in report.findings[0].remedy
    assert "FOUND twins: " in report.to_text()


def test_a_random_split_by_frames_puts_recordings_on_both_sides(audit_sides: AuditSides) -> None:
    lines = [label_path(token, frame) for token in TOKENS for frame in FRAMES]
    Random(2).shuffle(lines)  # noqa: S311
    report = audit_sides(train=lines[:400], val=lines[400:])
    assert numbers_by_kind(report) == {"recordings": len(TOKENS)}
    assert [row[2] for row in report.tables["sides"]] == ["frames named", 400, 400]


@pytest.mark.parametrize(
    "lines",
    [
        (f"{TOKENS[0]}/ego_vehicle/007", f"{TOKENS[0]}/infrastructure/007"),
        (f"{TOKENS[0]}/007", label_path(TOKENS[0], 7)),
        (label_path(TOKENS[0], 7).replace("/", "\\"), label_path(TOKENS[0], 7, "..") + ",1"),
        (
            json.dumps([label_path(TOKENS[0], 7), label_path(TOKENS[1], 8)]),
            f"{TOKENS[0]}/ego_vehicle/007/Camera_Front",
        ),
    ],
)
def test_the_same_moment_on_two_sides_is_reported(
    audit_sides: AuditSides, lines: tuple[str, str]
) -> None:
    report = audit_sides(train=[lines[0]], val=[lines[1]])
    assert numbers_by_kind(report) == {"frames": 1, "recordings": 1}
    assert f"{TOKENS[0]} frame 7" in report.findings[0].examples[0]


def test_a_scenario_beside_one_of_its_frames_is_reported(audit_sides: AuditSides) -> None:
    scenario, twin, other = TOKENS[0], TOKENS[40], TOKENS[1]
    report = audit_sides(train=[scenario], val=[f"{scenario}/ego_vehicle/007"])
    assert numbers_by_kind(report) == {"recordings": 1}
    report = audit_sides(train=[scenario], val=[twin], test=[other])
    assert numbers_by_kind(report) == {"twins": 1}


def test_mini_beside_the_full_release_is_reported(audit_sides: AuditSides) -> None:
    mini = label_path(TOKENS[0], 7, "/data/DeepAccident_mini")
    other_mini = label_path(TOKENS[1], 7, "/data/v1-mini")
    full = [label_path(TOKENS[0], 7), label_path(TOKENS[1], 7)]
    assert numbers_by_kind(audit_sides(train=[mini], val=full)) == {"mini": 1}
    assert numbers_by_kind(audit_sides(train=[mini], val=[other_mini])) == {}
    assert numbers_by_kind(audit_sides(mini=[TOKENS[0]], val=[TOKENS[1]])) == {"mini": 1}


def test_files_that_are_no_splits_are_refused(audit_sides: AuditSides, tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError,
        match=r"at least two split files, or dataroots, one per side, found .*train\.txt",
    ):
        audit_sides(train=[TOKENS[0]])
    with pytest.raises(
        SplitFileError,
        match=r"val\.txt:2: expected the type and name of a scenario, .*found 'Town03_x'",
    ):
        audit_sides(train=[TOKENS[0]], val=["", "Town03_x"])
    with pytest.raises(MissingFileError, match=r"no\.txt: no such file"):
        audit_splits([tmp_path / "train.txt", tmp_path / "no.txt"])
    (tmp_path / "odd.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SplitFileError, match=r"odd\.txt: not a text file"):
        audit_splits([tmp_path / "train.txt", tmp_path / "odd.txt"])


def test_an_empty_side_is_compared_with_nothing(audit_sides: AuditSides) -> None:
    report = audit_sides(train=[""], val=[TOKENS[0], TOKENS[1]])
    assert report.findings == ()
    assert report.exit_status == 2
    assert report.compared == {"sides": 0}
    report = audit_sides(train=[TOKENS[2]], test=[""], val=[TOKENS[0]])
    assert report.compared == {"sides": 2}


def test_hostile_lines_end_soon(audit_sides: AuditSides) -> None:
    many_folders = f"{ACCIDENT}/" * 20_000 + TOKENS[0]
    long_name = "_" * 100_000 + TOKENS[1]
    assert numbers_by_kind(audit_sides(train=[many_folders], val=[long_name])) == {}


def link_release(root: Path, copy: Path) -> Path:
    """Link a release's files, so that tests may remove and rename them, but not write to them."""
    ignore = shutil.ignore_patterns(".deepaccident")
    return Path(shutil.copytree(root, copy, ignore=ignore, copy_function=os.link))


def leave_unchanged(root: Path) -> None:
    pass


def keep_agents(root: Path, *agents: str) -> None:
    for folder in root.glob("type*/*"):
        if folder.name not in (*agents, "meta"):
            shutil.rmtree(folder)


def keep_frames(root: Path, frames: range, first: int | None = None) -> None:
    """Keep some frames, and renumber them from `first` on if it is given."""
    for path in sorted(root.glob("*/*/*/*/*_[0-9][0-9][0-9].*")):
        stem, _, number = path.stem.rpartition("_")
        if int(number) not in frames:
            path.unlink()
        elif first is not None:
            new_number = int(number) - frames[0] + first
            path.rename(path.with_name(f"{stem}_{new_number:03d}{path.suffix}"))


def rename_scenarios(root: Path, change: Callable[[str], str]) -> None:
    for path in sorted(root.rglob("Town*"), key=lambda path: -len(path.parts)):
        path.rename(path.with_name(change(path.name)))


def renumber_scenarios(root: Path) -> None:
    rename_scenarios(root, lambda name: name.replace("scenario000", "scenario090"))


def remove_kind(root: Path, kind: str) -> None:
    for folder in root.glob(f"*_{kind}"):
        shutil.rmtree(folder)


@pytest.mark.parametrize(
    ("change_mine", "change_theirs", "numbers"),
    [
        (leave_unchanged, leave_unchanged, {"recordings": 2, "twins": 2}),
        (
            lambda root: remove_kind(root, "normal"),
            lambda root: remove_kind(root, "accident"),
            {"twins": 1},
        ),
        (
            lambda root: keep_agents(root, "ego_vehicle", "ego_vehicle_behind"),
            lambda root: keep_agents(root, "infrastructure", "other_vehicle"),
            {"recordings": 2, "twins": 2},
        ),
        (
            lambda root: keep_frames(root, range(1, 18)),
            lambda root: keep_frames(root, range(18, 36)),
            {"recordings": 2, "twins": 2},
        ),
        (
            lambda root: keep_frames(root, range(1, 36, 2)),
            lambda root: keep_frames(root, range(2, 36, 2), first=1),
            {"recordings": 2, "twins": 2},
        ),
    ],
    ids=["copy", "twins", "agents", "halves", "odd"],
)
def test_dataroots_with_parts_of_a_recording_on_both_sides_are_reported(
    motion_root: Path,
    tmp_path: Path,
    change_mine: Callable[[Path], None],
    change_theirs: Callable[[Path], None],
    numbers: dict[str, int],
) -> None:
    mine = link_release(motion_root, tmp_path / "mine")
    theirs = link_release(motion_root, tmp_path / "theirs")
    change_mine(mine)
    change_theirs(theirs)
    report = audit_splits([mine, theirs])
    assert numbers_by_kind(report) == numbers
    for finding in report.findings:
        assert str(mine) in finding.examples[0]
        assert str(theirs) in finding.examples[0]

    renumber_scenarios(theirs)
    if numbers != {"twins": 1}:
        assert numbers_by_kind(audit_splits([mine, theirs]))["recordings"] >= 2


def test_dataroots_with_other_scenarios_of_the_same_names_pass(
    motion_root: Path, release_root_b: Path, tmp_path: Path
) -> None:
    names = sorted({path.stem for path in motion_root.rglob("meta/*.txt")})
    other_names = sorted({path.stem for path in release_root_b.rglob("meta/*.txt")})
    new_names = dict(zip(other_names, names, strict=False))

    def rename(name: str) -> str:
        return re.sub(
            r"^Town\w*scenario\d+",
            lambda match: new_names.get(match[0], match[0]),
            name,
        )

    other = link_release(release_root_b, tmp_path / "other")
    rename_scenarios(other, rename)
    assert {*names} <= {path.stem for path in other.rglob("meta/*.txt")}
    assert numbers_by_kind(audit_splits([motion_root, other])) == {}


def test_dataroots_without_labels_have_nothing_to_compare(
    motion_root: Path, tmp_path: Path
) -> None:
    other = link_release(motion_root, tmp_path / "other")
    for folder in sorted(other.glob("*/*/label/*")):
        shutil.rmtree(folder)
    report = audit_splits([motion_root, other])
    assert report.tables["sides"] == [
        ("side", "recordings"),
        (str(motion_root), 2),
        (str(other), 0),
    ]
    with pytest.raises(
        ConfigError, match=r"files, or dataroots, one per side, found .*motion, .*\.txt"
    ):
        audit_splits([motion_root, motion_root / "train.txt"])
