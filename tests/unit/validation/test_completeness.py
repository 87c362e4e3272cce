"""`validate --files` counts what is here and what is missing by split, agent and channel, only
from folders.
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
from support.command_calls import invoke_command
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import SplitFileError, TokenError
from deepaccident_devkit.release import ScenarioFolder, find_release, write_split_file
from deepaccident_devkit.taxonomy import AGENTS, CHANNEL_FORMAT, CHANNELS
from deepaccident_devkit.validation import release_completeness, validate_release

ENDINGS = {"calib": "pkl", "label": "txt", **CHANNEL_FORMAT}
SCENARIO_TYPE = "type1_subtype1_accident"
ACCIDENT = f"{SCENARIO_TYPE}/Town10HD_type001_subtype0001_scenario00014"
NORMAL = ACCIDENT.replace("accident", "normal")
SIZES_BYTES = dict(zip(ENDINGS, range(10, 20), strict=True))


def run_validate_files(*words: object) -> Result:
    return invoke_command("validate", *words, "--files")


def iter_scenario_files(root: Path, token: str, frames: int) -> Iterator[tuple[str, str, Path]]:
    """Yield agent, kind and path of each file of a scenario, except its meta."""
    folder = ScenarioFolder(root, "", *token.split("/"), AGENTS)
    for agent in AGENTS:
        for kind, ending in ENDINGS.items():
            for frame in range(1, frames + 1):
                yield agent, kind, folder.file(agent, kind, frame, ending)


def write_files(root: Path, *tokens: str, frames: int = 2) -> Path:
    """Write scenarios of files that no reader understands, each kind with its own size."""
    for token in tokens:
        for _, kind, path in iter_scenario_files(root, token, frames):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(bytes(SIZES_BYTES[kind]))
        meta = ScenarioFolder(root, "", *token.split("/"), AGENTS).meta_path
        meta.parent.mkdir(exist_ok=True)
        meta.write_bytes(b"x")
    return root


@pytest.fixture
def linked_release(release_root: Path, tmp_path: Path) -> Path:
    """Return a release with all sensors, from which a test may remove files."""
    root = tmp_path / "release"
    shutil.copytree(
        release_root, root, ignore=shutil.ignore_patterns(".deepaccident"), copy_function=os.link
    )
    return root


def test_a_whole_release_lacks_nothing(release_root: Path) -> None:
    completeness = release_completeness(release_root, workers=1)
    paths = [path for folder in release_root.glob("type*") for path in folder.rglob("*.???")]

    assert (completeness.scenarios, completeness.whole) == (4, 4)
    assert completeness.lacking == {}
    assert completeness.total.missing == 0
    assert completeness.total.expected == 4 * (5 * 10 * 6 + 1)
    assert completeness.total.bytes == sum(path.stat().st_size for path in paths)
    for split in completeness.splits.values():
        agent_counts = [count for count in split.files if count.agent]
        assert {count.expected for count in agent_counts} <= {6 * split.scenarios}


def test_removed_files_are_counted_where_they_were(linked_release: Path) -> None:
    first, second, third, _ = find_release(linked_release).scenarios
    for kind in ENDINGS:
        shutil.rmtree(first.kind_folder("infrastructure", kind))
    empty = second.channel_path("other_vehicle", "Camera_Back", 1)
    clouds = [second.channel_path("ego_vehicle", "lidar01", frame) for frame in (2, 6)]
    for path in (*clouds, empty, third.calib_path("ego_vehicle", 3), third.meta_path):
        path.unlink()  # its content is shared with the session's release
    empty.touch()

    completeness = release_completeness(linked_release, workers=1)
    assert (completeness.scenarios, completeness.whole) == (4, 1)
    assert completeness.total.missing == 10 * 6 + 2 + 1 + 2
    assert completeness.lacking == {
        first.token: dict.fromkeys(ENDINGS, 6),
        second.token: {"lidar01": 2, "Camera_Back": 1},
        third.token: {"calib": 1, "meta": 1},
    }
    assert re.search(r"^infrastructure +6 +6 +36 +6 +6$", completeness.to_text(), re.MULTILINE)


def test_without_sensors_all_of_them_are_missing(own_release: Path) -> None:
    completeness = release_completeness(own_release, workers=1)
    assert (completeness.scenarios, completeness.whole) == (6, 0)
    for split in completeness.splits.values():
        for count in split.files:
            assert count.missing == (count.expected if count.channel in CHANNELS else 0)
    assert re.search(r"^ego_vehicle +- +- +all +all +all$", completeness.to_text(), re.MULTILINE)


def test_the_test_split_ships_without_labels_bev_and_meta(tmp_path: Path) -> None:
    write_files(tmp_path, ACCIDENT)
    write_split_file(tmp_path / "test.txt", [ACCIDENT])
    for pattern in ("*/*/label", "*/*/BEV_instance_camera", "*/meta"):
        for folder in tmp_path.glob(pattern):
            shutil.rmtree(folder)
    completeness = release_completeness(tmp_path, workers=1)
    assert completeness.whole == 1
    assert completeness.total.expected == 5 * 8 * 2
    assert completeness.splits["test"].whole == 1

    scenario = ScenarioFolder(tmp_path, "", *ACCIDENT.split("/"), AGENTS)
    label = scenario.label_path("other_vehicle", 2)
    label.parent.mkdir(parents=True)
    label.write_text("0 0\n")
    assert release_completeness(tmp_path, workers=1).lacking[ACCIDENT]["label"] == 1

    (tmp_path / "test.txt").unlink()
    assert release_completeness(tmp_path, workers=1).total.missing == 5 * 2 * 2 - 1 + 1


def test_the_mini_release_is_one_split(tmp_path: Path) -> None:
    write_files(tmp_path / "DeepAccident_mini", ACCIDENT)
    write_split_file(tmp_path / "train.txt", [ACCIDENT, NORMAL])
    splits = release_completeness(tmp_path, "v1-mini", workers=1).splits
    assert list(splits) == ["v1-mini"]
    assert (splits["v1-mini"].scenarios, splits["v1-mini"].expected) == (1, 20)


@pytest.fixture(scope="module")
def single_scenario_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write one scenario of two frames; a test that removes its files puts them back."""
    return write_files(tmp_path_factory.mktemp("single"), ACCIDENT)


@given(st.data())
def test_any_files_may_be_missing(single_scenario_root: Path, data: st.DataObject) -> None:
    """Exactly the removed files are missing, as long as one label shows the number of frames."""
    files = list(iter_scenario_files(single_scenario_root, ACCIDENT, 2))
    last_labels = [file for file in files if file[1] == "label" and file[2].stem[-1] == "2"]
    remaining_label = data.draw(st.sampled_from(last_labels))
    agents = data.draw(st.sets(st.sampled_from(AGENTS), max_size=2))
    removed_files = data.draw(st.sets(st.sampled_from(files)))
    removed_files |= {file for file in files if file[0] in agents}
    removed_files.discard(remaining_label)

    for *_, path in removed_files:
        path.unlink()
    completeness = release_completeness(single_scenario_root, workers=1)
    for _, kind, path in removed_files:
        path.write_bytes(bytes(SIZES_BYTES[kind]))

    removed_counts = Counter((agent, kind) for agent, kind, _ in removed_files)
    for count in completeness.splits["unknown"].files:
        assert count.missing == removed_counts[count.agent, count.channel]
        size_bytes = SIZES_BYTES.get(count.channel, 1)
        assert count.bytes == (count.expected - count.missing) * size_bytes
    assert completeness.total.missing == len(removed_files)
    assert completeness.whole == int(not removed_files)


def test_scenarios_split_files_and_folders_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    write_files(tmp_path, ACCIDENT)
    split = tmp_path / "val.txt"
    assert_raises(
        (
            lambda: release_completeness(tmp_path, workers=1, scenarios=["nowhere"]),
            TokenError,
            ("has no scenario 'nowhere'",),
        )
    )
    split.write_text("three words here\n")
    message = ("val.txt:1: expected '<scenario_type> <scenario>'",)
    assert_raises((lambda: release_completeness(tmp_path, workers=1), SplitFileError, message))

    split.unlink()
    folder = next(tmp_path.glob("*/ego_vehicle/lidar01/*"))
    shutil.rmtree(folder)
    folder.symlink_to(folder.name)
    assert release_completeness(tmp_path, workers=1).lacking == {ACCIDENT: {"lidar01": 2}}


def test_counts_are_printed_for_a_release_that_cannot_be_indexed(tmp_path: Path) -> None:
    """No file can be read, and calib files are missing; no line is wider than 100 columns."""
    tokens = [ACCIDENT.replace("00014", f"{number:05}") for number in range(14, 26)]
    write_files(tmp_path, *tokens, frames=1)
    for agent in AGENTS[1:]:
        shutil.rmtree(tmp_path / SCENARIO_TYPE / agent / "calib")

    text = run_validate_files(tmp_path, "--workers", 1).stdout
    assert max(map(len, text.splitlines()[1:])) <= 100
    assert "--json lists all" in text
    payload = json.loads(run_validate_files(tmp_path, "--json").stdout)
    assert payload == asdict(release_completeness(tmp_path, workers=1))
    assert not (tmp_path / ".deepaccident").exists()


def test_only_the_chosen_scenarios_are_counted(release_root: Path) -> None:
    token = "/".join((release_root / "train.txt").read_text().split()[:2])
    payload = json.loads(run_validate_files(release_root, "--scenario", token, "--json").stdout)
    assert (payload["scenarios"], payload["whole"]) == (1, 1)
    assert list(payload["splits"]) == ["train"]


def test_a_validation_report_ends_with_the_completeness(own_release: Path) -> None:
    """A split file and a folder that cannot be read are findings there, and no error."""
    report = validate_release(own_release, workers=1)
    assert report.files == release_completeness(own_release, workers=1)

    (own_release / "val.txt").write_text("three words here\n")
    scenario = next(own_release.glob("train/*/ego_vehicle/calib/*"))
    link = scenario.parents[1] / "lidar01" / scenario.name
    link.parent.mkdir()
    link.symlink_to(scenario.name)
    damaged_report = validate_release(own_release, workers=1)
    codes = {finding.code for finding in damaged_report.findings}
    assert {"split-file-unreadable", "folder-unreadable"} <= codes
    assert damaged_report.files.total == report.files.total
