"""`validate --files`: what is here and what is missing is counted by split, agent and channel, from
folders alone.
"""

import json
import os
import re
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import pytest
from click.testing import Result
from hypothesis import given
from hypothesis import strategies as st
from refusals import assert_refused
from verbs import called

from deepaccident_devkit.errors import SplitFileError, TokenError
from deepaccident_devkit.release import ScenarioFolder, find_release, write_split_file
from deepaccident_devkit.taxonomy import AGENTS, CHANNEL_FORMAT, CHANNELS
from deepaccident_devkit.validation import release_completeness, validate_release

ENDINGS = {"calib": "pkl", "label": "txt", **CHANNEL_FORMAT}
TYPE = "type1_subtype1_accident"
ACCIDENT = f"{TYPE}/Town10HD_type001_subtype0001_scenario00014"
NORMAL = ACCIDENT.replace("accident", "normal")
SIZES = dict(zip(ENDINGS, range(10, 20), strict=True))


def run(*words: object) -> Result:
    return called("validate", *words, "--files")


def files_of(root: Path, token: str, frames: int) -> Iterator[tuple[str, str, Path]]:
    """Agent, kind and path of all files of a scenario but its meta."""
    folder = ScenarioFolder(root, "", *token.split("/"), AGENTS)
    for agent in AGENTS:
        for kind, ending in ENDINGS.items():
            for frame in range(1, frames + 1):
                yield agent, kind, folder.file(agent, kind, frame, ending)


def write_files(root: Path, *tokens: str, frames: int = 2) -> Path:
    """Scenarios of files that no reader understands: of every kind another number of bytes."""
    for token in tokens:
        for _, kind, path in files_of(root, token, frames):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(bytes(SIZES[kind]))
        meta = ScenarioFolder(root, "", *token.split("/"), AGENTS).meta_path
        meta.parent.mkdir(exist_ok=True)
        meta.write_bytes(b"x")
    return root


@pytest.fixture
def linked(release_root: Path, tmp_path: Path) -> Path:
    """A release with all sensors, of which a test may remove files."""
    root = tmp_path / "release"
    shutil.copytree(
        release_root, root, ignore=shutil.ignore_patterns(".deepaccident"), copy_function=os.link
    )
    return root


def test_a_whole_release_lacks_nothing(release_root: Path) -> None:
    found = release_completeness(release_root, workers=1)
    sizes = [
        path.stat().st_size
        for folder in release_root.glob("type*")
        for path in folder.rglob("*.???")
    ]
    assert (found.scenarios, found.whole, found.lacking, found.total.missing) == (4, 4, {}, 0)
    assert (found.total.expected, found.total.bytes) == (4 * (5 * 10 * 6 + 1), sum(sizes))
    for split in found.splits.values():
        assert {each.expected for each in split.files if each.agent} <= {6 * split.scenarios}


def test_removed_files_are_counted_where_they_were(linked: Path) -> None:
    first, second, third, _ = find_release(linked).scenarios
    for kind in ENDINGS:
        shutil.rmtree(first.kind_folder("infrastructure", kind))
    empty = second.channel_path("other_vehicle", "Camera_Back", 1)
    clouds = [second.channel_path("ego_vehicle", "lidar01", frame) for frame in (2, 6)]
    for path in (*clouds, empty, third.calib_path("ego_vehicle", 3), third.meta_path):
        path.unlink()  # its content is shared with the session's release
    empty.touch()
    found = release_completeness(linked, workers=1)
    assert (found.scenarios, found.whole, found.total.missing) == (4, 1, 10 * 6 + 2 + 1 + 2)
    assert found.lacking == {
        first.token: dict.fromkeys(ENDINGS, 6),
        second.token: {"lidar01": 2, "Camera_Back": 1},
        third.token: {"calib": 1, "meta": 1},
    }
    assert re.search(r"^infrastructure +6 +6 +36 +6 +6$", found.to_text(), re.MULTILINE)


def test_without_sensors_all_of_them_are_missing(own_release: Path) -> None:
    found = release_completeness(own_release, workers=1)
    assert (found.scenarios, found.whole) == (6, 0)
    for each in (each for split in found.splits.values() for each in split.files):
        assert each.missing == (each.expected if each.channel in CHANNELS else 0)
    assert re.search(r"^ego_vehicle +- +- +all +all +all$", found.to_text(), re.MULTILINE)


def test_the_test_split_ships_without_labels_bev_and_meta(tmp_path: Path) -> None:
    write_files(tmp_path, ACCIDENT)
    write_split_file(tmp_path / "test.txt", [ACCIDENT])
    for name in ("*/label", "*/BEV_instance_camera", "meta"):
        for folder in tmp_path.glob(f"*/{name}"):
            shutil.rmtree(folder)
    found = release_completeness(tmp_path, workers=1)
    assert (found.whole, found.total.expected, found.splits["test"].whole) == (1, 5 * 8 * 2, 1)
    label = ScenarioFolder(tmp_path, "", *ACCIDENT.split("/"), AGENTS).label_path(
        "other_vehicle", 2
    )
    label.parent.mkdir(parents=True)
    label.write_text("0 0\n")
    assert release_completeness(tmp_path, workers=1).lacking[ACCIDENT]["label"] == 1
    (tmp_path / "test.txt").unlink()
    assert release_completeness(tmp_path, workers=1).total.missing == 5 * 2 * 2 - 1 + 1


def test_the_mini_release_is_one_split(tmp_path: Path) -> None:
    write_files(tmp_path / "DeepAccident_mini", ACCIDENT)
    write_split_file(tmp_path / "train.txt", [ACCIDENT, NORMAL])
    found = release_completeness(tmp_path, "v1-mini", workers=1)
    assert {name: (each.scenarios, each.expected) for name, each in found.splits.items()} == {
        "v1-mini": (1, 20)
    }


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One scenario of two frames; a test that removes files of it puts them back."""
    return write_files(tmp_path_factory.mktemp("single"), ACCIDENT)


@given(st.data())
def test_any_files_may_be_missing(single: Path, data: st.DataObject) -> None:
    """What is missing is what was removed, as long as one label tells how many frames there are."""
    files = list(files_of(single, ACCIDENT, 2))
    kept = data.draw(
        st.sampled_from([each for each in files if each[1] == "label" and each[2].stem[-1] == "2"])
    )
    agents = data.draw(st.sets(st.sampled_from(AGENTS), max_size=2))
    gone = (
        data.draw(st.sets(st.sampled_from(files))) | {each for each in files if each[0] in agents}
    ) - {kept}
    for *_, path in gone:
        path.unlink()
    found = release_completeness(single, workers=1)
    for _, kind, path in gone:
        path.write_bytes(bytes(SIZES[kind]))
    lost = Counter((agent, kind) for agent, kind, _ in gone)
    for each in found.splits["unknown"].files:
        missing, size = lost[each.agent, each.channel], SIZES.get(each.channel, 1)
        assert (each.missing, each.bytes) == (missing, (each.expected - missing) * size)
    assert (found.total.missing, found.whole) == (len(gone), int(not gone))


def test_what_cannot_be_listed_or_read_is_named(tmp_path: Path) -> None:
    write_files(tmp_path, ACCIDENT)
    folder, split = next(tmp_path.glob("*/ego_vehicle/lidar01/*")), tmp_path / "val.txt"
    told = ("has no scenario 'nowhere'",)
    assert_refused(
        (lambda: release_completeness(tmp_path, workers=1, scenarios=["nowhere"]), TokenError, told)
    )
    split.write_text("three words here\n")
    told = ("val.txt:1: expected '<scenario_type> <scenario>'",)
    assert_refused((lambda: release_completeness(tmp_path, workers=1), SplitFileError, told))
    split.unlink()
    shutil.rmtree(folder)
    folder.symlink_to(folder.name)
    assert release_completeness(tmp_path, workers=1).lacking == {ACCIDENT: {"lidar01": 2}}


def test_it_is_printed_for_a_release_that_cannot_be_indexed(tmp_path: Path) -> None:
    """No file can be read, and calib files are missing; no line is wider than 100 columns."""
    write_files(
        tmp_path, *(ACCIDENT.replace("00014", f"{number:05}") for number in range(14, 26)), frames=1
    )
    for agent in AGENTS[1:]:
        shutil.rmtree(tmp_path / TYPE / agent / "calib")
    text = run(tmp_path, "--workers", 1).stdout
    assert max(map(len, text.splitlines()[1:])) <= 100
    assert "--json lists all" in text
    assert json.loads(run(tmp_path, "--json").stdout) == asdict(
        release_completeness(tmp_path, workers=1)
    )
    assert not (tmp_path / ".deepaccident").exists()


def test_some_scenarios_are_counted_alone(release_root: Path) -> None:
    token = "/".join((release_root / "train.txt").read_text().split()[:2])
    found = json.loads(run(release_root, "--scenario", token, "--json").stdout)
    assert (found["scenarios"], found["whole"], list(found["splits"])) == (1, 1, ["train"])


def test_validate_ends_with_it(own_release: Path) -> None:
    """A split file and a folder that cannot be read are findings there, and no error."""
    report = validate_release(own_release, workers=1)
    assert report.files == release_completeness(own_release, workers=1)
    (own_release / "val.txt").write_text("three words here\n")
    scenario = next(own_release.glob("train/*/ego_vehicle/calib/*"))
    (scenario.parents[1] / "lidar01").mkdir()
    (scenario.parents[1] / "lidar01" / scenario.name).symlink_to(scenario.name)
    again = validate_release(own_release, workers=1)
    assert {"split-file-unreadable", "folder-unreadable"} <= {each.code for each in again.findings}
    assert again.files.total == report.files.total
