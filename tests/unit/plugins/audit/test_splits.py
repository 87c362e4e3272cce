"""Splits of all kinds: the official one passes, and what leaks is told."""

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
        {
            "token": token,
            "scenario_type": token.split("/")[0],
            "name": token.split("/")[1],
            "collision": None,
        }
        | {
            "designed_accident": token.startswith(ACCIDENT),
            "road_type": None,
            "spawn_side": None,
            "weather": "Clear",
        }
        for token in TOKENS
    ]
    split = {name: list(tokens) for name, tokens in split_records(records).by_name().items()}  # type: ignore[arg-type]
    report = sides(train=split["train"], val=split["val"], test=split["test"])
    assert report.findings == ()
    assert [row[1] for row in report.tables["sides"]] == ["recordings", 56, 12, 12]
    assert numbers(sides(train_mini=split["train_mini"], val=split["val"])) == {}
    assert numbers(sides(train_mini=split["train_mini"], train=split["train"])) == {
        "recordings": 10
    }


@pytest.mark.parametrize("form", ["{0} {1}", "{0}/{1}", "  {0}  {1}  "])
def test_a_random_split_by_names_tears_twins(sides: Sides, form: str) -> None:
    lines = [form.format(*token.split("/")) for token in TOKENS]
    Random(1).shuffle(lines)  # noqa: S311
    report = sides(train=lines[:60], val=lines[60:])
    torn = len(
        {line.split("scenario")[-1] for line in lines[:60]}
        & {line.split("scenario")[-1] for line in lines[60:]}
    )
    assert numbers(report) == {"twins": torn}
    assert len(report.findings[0].examples) == 3
    assert "deepaccident split" in report.findings[0].remedy
    assert "FOUND twins: " in report.to_text()


def test_a_random_split_by_frames_puts_recordings_on_both_sides(sides: Sides) -> None:
    lines = [path_of(token, frame) for token in TOKENS for frame in FRAMES]
    Random(2).shuffle(lines)  # noqa: S311
    report = sides(train=lines[:400], val=lines[400:])
    assert numbers(report) == {"recordings": len(TOKENS)}
    assert [row[2] for row in report.tables["sides"]] == ["frames named", 400, 400]


@pytest.mark.parametrize(
    "lines",
    [
        (f"{TOKENS[0]}/ego_vehicle/007", f"{TOKENS[0]}/infrastructure/007"),
        (f"{TOKENS[0]}/007", path_of(TOKENS[0], 7)),
        (path_of(TOKENS[0], 7).replace("/", "\\"), path_of(TOKENS[0], 7, "..") + ",1"),
        (
            json.dumps([path_of(TOKENS[0], 7), path_of(TOKENS[1], 8)]),
            f"{TOKENS[0]}/ego_vehicle/007/Camera_Front",
        ),
    ],
)
def test_the_same_moment_on_two_sides(sides: Sides, lines: tuple[str, str]) -> None:
    report = sides(train=[lines[0]], val=[lines[1]])
    assert numbers(report) == {"frames": 1, "recordings": 1}
    assert f"{TOKENS[0]} frame 7" in report.findings[0].examples[0]


def test_a_scenario_beside_one_of_its_frames(sides: Sides) -> None:
    assert numbers(sides(train=[TOKENS[0]], val=[f"{TOKENS[0]}/ego_vehicle/007"])) == {
        "recordings": 1
    }
    assert numbers(sides(train=[TOKENS[0]], val=[TOKENS[40]], test=[TOKENS[1]])) == {"twins": 1}


def test_mini_beside_the_full_release(sides: Sides) -> None:
    mini = path_of(TOKENS[0], 7, "/data/DeepAccident_mini")
    report = sides(train=[mini], val=[path_of(TOKENS[0], 7), path_of(TOKENS[1], 7)])
    assert numbers(report) == {"mini": 1}
    assert numbers(sides(train=[mini], val=[path_of(TOKENS[1], 7, "/data/v1-mini")])) == {}
    assert numbers(sides(mini=[TOKENS[0]], val=[TOKENS[1]])) == {"mini": 1}


def test_files_that_are_no_splits(sides: Sides, tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"two or more split files, or dataroots, a side each, found .*train\.txt"
    ):
        sides(train=[TOKENS[0]])
    with pytest.raises(
        SplitFileError, match=r"val\.txt:2: expected a scenario's type and name, .*found 'Town03_x'"
    ):
        sides(train=[TOKENS[0]], val=["", "Town03_x"])
    with pytest.raises(MissingFileError, match=r"no\.txt: no such file"):
        audit_splits([tmp_path / "train.txt", tmp_path / "no.txt"])
    (tmp_path / "odd.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SplitFileError, match=r"odd\.txt: not a text file"):
        audit_splits([tmp_path / "train.txt", tmp_path / "odd.txt"])


def test_an_empty_side_is_compared_with_nothing(sides: Sides) -> None:
    report = sides(train=[""], val=[TOKENS[0], TOKENS[1]])
    assert (report.findings, report.exit_status, report.compared) == ((), 2, {"sides": 0})
    assert sides(train=[TOKENS[2]], test=[""], val=[TOKENS[0]]).compared == {"sides": 2}


def test_hostile_lines_end_soon(sides: Sides) -> None:
    assert (
        numbers(sides(train=[f"{ACCIDENT}/" * 20_000 + TOKENS[0]], val=["_" * 100_000 + TOKENS[1]]))
        == {}
    )


def copied(root: Path, copy: Path) -> Path:
    """Link a release's files, which are removed and renamed in the copy, but not written."""
    return Path(
        shutil.copytree(
            root, copy, ignore=shutil.ignore_patterns(".deepaccident"), copy_function=os.link
        )
    )


def unchanged(root: Path) -> None:
    """Leave a release as it is."""


def only_agents(root: Path, *agents: str) -> None:
    for folder in root.glob("type*/*"):
        if folder.name not in (*agents, "meta"):
            shutil.rmtree(folder)


def only_frames(root: Path, frames: range, first: int | None = None) -> None:
    """Keep some frames, and count them from another first one."""
    for path in sorted(root.glob("*/*/*/*/*_[0-9][0-9][0-9].*")):
        stem, _, number = path.stem.rpartition("_")
        if int(number) not in frames:
            path.unlink()
        elif first is not None:
            path.rename(
                path.with_name(f"{stem}_{int(number) - frames[0] + first:03d}{path.suffix}")
            )


def renamed(root: Path, change: Callable[[str], str]) -> None:
    for path in sorted(root.rglob("Town*"), key=lambda path: -len(path.parts)):
        path.rename(path.with_name(change(path.name)))


def renumbered(root: Path) -> None:
    renamed(root, lambda name: name.replace("scenario000", "scenario090"))


def without(root: Path, ending: str) -> None:
    for folder in root.glob(f"*_{ending}"):
        shutil.rmtree(folder)


@pytest.mark.parametrize(
    ("mine", "theirs", "wanted"),
    [
        (unchanged, unchanged, {"recordings": 2, "twins": 2}),
        (
            lambda root: without(root, "normal"),
            lambda root: without(root, "accident"),
            {"twins": 1},
        ),
        (
            lambda root: only_agents(root, "ego_vehicle", "ego_vehicle_behind"),
            lambda root: only_agents(root, "infrastructure", "other_vehicle"),
            {"recordings": 2, "twins": 2},
        ),
        (
            lambda root: only_frames(root, range(1, 18)),
            lambda root: only_frames(root, range(18, 36)),
            {"recordings": 2, "twins": 2},
        ),
        (
            lambda root: only_frames(root, range(1, 36, 2)),
            lambda root: only_frames(root, range(2, 36, 2), first=1),
            {"recordings": 2, "twins": 2},
        ),
    ],
    ids=["copy", "twins", "agents", "halves", "odd"],
)
def test_dataroots_with_parts_of_a_recording_on_both_sides(
    motion_root: Path,
    tmp_path: Path,
    mine: Callable[[Path], None],
    theirs: Callable[[Path], None],
    wanted: dict[str, int],
) -> None:
    sides = copied(motion_root, tmp_path / "mine"), copied(motion_root, tmp_path / "theirs")
    mine(sides[0])
    theirs(sides[1])
    report = audit_splits(sides)
    assert numbers(report) == wanted
    for finding in report.findings:
        assert str(sides[0]) in finding.examples[0]
        assert str(sides[1]) in finding.examples[0]
    renumbered(sides[1])
    if wanted != {"twins": 1}:
        assert numbers(audit_splits(sides))["recordings"] >= 2


def test_dataroots_with_other_scenarios_of_the_same_names(
    motion_root: Path, release_root_b: Path, tmp_path: Path
) -> None:
    names = sorted({path.stem for path in motion_root.rglob("meta/*.txt")})
    others = sorted({path.stem for path in release_root_b.rglob("meta/*.txt")})
    other = copied(release_root_b, tmp_path / "other")
    new_names = dict(zip(others, names, strict=False))
    renamed(
        other,
        lambda name: re.sub(r"^Town\w*scenario\d+", lambda m: new_names.get(m[0], m[0]), name),
    )
    assert {*names} <= {path.stem for path in other.rglob("meta/*.txt")}
    assert numbers(audit_splits([motion_root, other])) == {}


def test_dataroots_without_labels_have_nothing_to_compare(
    motion_root: Path, tmp_path: Path
) -> None:
    other = copied(motion_root, tmp_path / "other")
    for folder in sorted(other.glob("*/*/label/*")):
        shutil.rmtree(folder)
    report = audit_splits([motion_root, other])
    assert report.tables["sides"] == [
        ("side", "recordings"),
        (str(motion_root), 2),
        (str(other), 0),
    ]
    with pytest.raises(
        ConfigError, match=r"files, or dataroots, a side each, found .*motion, .*\.txt"
    ):
        audit_splits([motion_root, motion_root / "train.txt"])
