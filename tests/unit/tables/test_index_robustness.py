"""Indexes that were damaged, abandoned or remade by somebody else, and releases whose folders are odd."""

import logging
import os
import pickle
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import tiny
from click.testing import CliRunner
from filelock import FileLock
from processes import is_running

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import BrokenReleaseError, ChoiceError, DatarootError, IndexStoreError
from deepaccident_devkit.parallel import run_batch

OTHER = "Town05_type001_subtype0001_scenario00007"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    tiny.write_tiny_release(tmp_path / "release")
    return tiny.write_tiny_release(tmp_path / "release", name=OTHER)


def opened(root: Path | str, **arguments: object) -> DeepAccident:
    return DeepAccident(dataroot=root, verbose=False, **arguments)  # type: ignore[arg-type]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_a_relative_dataroot_survives_chdir(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(root.parent)
    release = opened(root.name, index_dir="index")
    pickled = pickle.dumps(release)
    monkeypatch.chdir("/")
    assert release.get_sample_data_path(f"{tiny.TOKEN}/ego_vehicle/001/lidar01").parent.parent.is_relative_to(root)
    copy = pickle.loads(pickled)
    assert len(copy.track) == len(release.track) > 0


def test_a_home_folder_is_found(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(root.parent))
    assert len(opened(f"~/{root.name}").scenario) == 2


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["cut", "one byte", "empty", "a folder"])
def test_a_damaged_shard_is_made_again(root: Path, damage: str) -> None:
    opened(root)
    (shard,) = root.glob(f".deepaccident/v1/shards/{tiny.TYPE}/{tiny.NAME}.arrow")
    whole = shard.read_bytes()
    if damage == "cut":
        shard.write_bytes(whole[: len(whole) // 2])
    elif damage == "one byte":
        shard.write_bytes(whole[:5000] + bytes([whole[5000] ^ 1]) + whole[5001:])
    elif damage == "empty":
        shard.write_bytes(b"")
    else:
        shard.unlink()
        shard.mkdir()
    tiny.write_tiny_release(root, name="Town01_type001_subtype0001_scenario00001")
    if damage == "a folder":
        with pytest.raises(IndexStoreError, match="the index cannot be written"):
            opened(root)
        shard.rmdir()
    assert len(opened(root).scenario) == 3
    assert shard.read_bytes() == whole


@pytest.mark.parametrize("damage", ["cut", "gone", "one byte"])
def test_damaged_tables_are_made_again(root: Path, damage: str) -> None:
    tables = opened(root).tables_folder
    before = contents(tables)
    track = tables / "track.arrow"
    arguments = ["index", str(root)]
    if damage == "cut":
        track.write_bytes(track.read_bytes()[:100])
    elif damage == "gone":
        track.unlink()
    else:
        whole = track.read_bytes()
        track.write_bytes(whole[:2000] + bytes([whole[2000] ^ 1]) + whole[2001:])
        arguments.append("--check")  # only it reads what has the right size
    assert CliRunner().invoke(deepaccident, arguments).exit_code == 0
    assert contents(tables) == before


def test_a_file_in_a_folders_place_breaks_its_scenario_alone(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    labels = root / tiny.TYPE / "ego_vehicle" / "label" / tiny.NAME
    shutil.rmtree(labels)
    labels.write_text("")
    with pytest.raises(BrokenReleaseError, match=rf"1 of 2 scenarios are broken:\n.*\n.*{labels}: cannot be listed"):
        opened(root)
    assert [scenario["name"] for scenario in opened(root, on_error="skip").scenario] == [OTHER]
    assert f"left out {tiny.TOKEN}" in caplog.text


def test_an_agent_that_is_a_file_breaks_the_scenarios_of_its_type(root: Path) -> None:
    good = "type1_subtype2_accident"
    tiny.write_tiny_release(root, scenario_type=good)
    agent = root / tiny.TYPE / "other_vehicle"
    shutil.rmtree(agent)
    agent.write_text("")
    with pytest.raises(BrokenReleaseError, match=r"2 of 3 scenarios are broken(.|\n)*other_vehicle.*Not a directory"):
        opened(root)
    assert [scenario["scenario_type"] for scenario in opened(root, on_error="skip").scenario] == [good]


def test_a_path_that_is_no_utf8_is_refused(tmp_path: Path) -> None:
    odd = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff"))
    odd.mkdir()
    with pytest.raises(DatarootError, match="is not UTF-8"):
        opened(odd)


def test_an_open_release_outlives_a_new_index(root: Path) -> None:
    release = opened(root)
    pickled = pickle.dumps(release)
    tiny.write_tiny_release(root, name="Town01_type001_subtype0001_scenario00001")
    assert len(opened(root).scenario) == 3
    assert len(release.scenario) == 2
    assert len(release.track[:]) == len(release.track) > 0
    with pytest.raises(IndexStoreError, match="the index was made again; open the release again"):
        pickle.loads(pickled)


def test_tables_that_vanish_while_they_are_opened(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from deepaccident_devkit import deepaccident as facade

    original, calls = facade.open_index, []

    def overtaken(*arguments: object, **options: object) -> object:
        index = original(*arguments, **options)  # type: ignore[arg-type]
        calls.append(index)
        if len(calls) == 1:
            shutil.rmtree(index.tables_folder)  # as another process does that has made newer ones
        return index

    monkeypatch.setattr(facade, "open_index", overtaken)
    assert len(opened(root).scenario) == 2
    assert len(calls) == 2


def test_what_a_stopped_process_left_is_removed(root: Path) -> None:
    folder = root / ".deepaccident" / "v1"
    (folder / ".tables-0123.abcd").mkdir(parents=True)
    (folder / ".tables-0123.abcd" / ".track.size.part").write_bytes(b"half")
    (folder / "shards" / tiny.TYPE).mkdir(parents=True)
    (folder / "shards" / tiny.TYPE / f".{OTHER}.arrow.1.tmp").write_bytes(b"half")
    (folder / ".manifest.json.1.tmp").write_bytes(b"half")
    opened(root)
    fresh = root.parent / "fresh"
    opened(root, index_dir=fresh)
    assert contents(folder) == contents(fresh / "v1")


def test_a_process_waits_for_another_that_indexes(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = root / ".deepaccident" / "v1"
    folder.mkdir(parents=True)
    lock = FileLock(folder / ".lock")
    lock.acquire()
    result: list[DeepAccident] = []
    thread = threading.Thread(target=lambda: result.append(opened(root)))
    with caplog.at_level(logging.WARNING):
        thread.start()
        while "another process makes an index there" not in caplog.text and thread.is_alive():
            time.sleep(0.01)
        assert not result
        lock.release()
        thread.join(timeout=60)
    assert len(result[0].scenario) == 2


def test_a_scenario_without_meta_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: object) -> None:
    release = opened(tiny.write_tiny_release(tmp_path, meta=None))
    assert f"meta/{tiny.NAME}.txt: missing or not readable: weather and collision" in caplog.text
    release.list_scenarios()
    assert "collision unknown" in capsys.readouterr().out  # type: ignore[attr-defined]


def test_scenarios_that_lack_the_same_are_told_in_one_line(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    for meta in root.glob("*/meta/*.txt"):
        meta.unlink()
    opened(root)
    (told,) = [record.getMessage() for record in caplog.records]
    assert told.startswith(f"2 scenarios, such as {root / tiny.TYPE}/meta/")
    assert told.endswith(": missing or not readable: weather and collision of this scenario are unknown")


@pytest.mark.parametrize("frames", [3, 6])
def test_an_accident_that_does_not_end_where_meta_says_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, frames: int
) -> None:
    root = tiny.write_tiny_release(tmp_path, frames=frames)
    for _ in range(2):  # indexed, and opened again
        opened(root)
        assert "times to the impact are wrong; see: deepaccident validate" in caplog.text
        caplog.clear()
    whole = tiny.write_tiny_release(tmp_path / "whole")
    opened(whole)
    assert not caplog.records


def test_workers_below_one_are_refused(root: Path) -> None:
    with pytest.raises(ChoiceError, match="workers: expected a number of at least 1, or None, found 0"):
        opened(root, workers=0)


@pytest.mark.slow
def test_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    script = (
        "import os, pathlib, sys\n"
        "from test_index_robustness import wait_and_tell\n"
        "from deepaccident_devkit.parallel import run_batch\n"
        "run_batch(wait_and_tell, [sys.argv[1] + '/a', sys.argv[1] + '/b'], workers=2)\n"
    )
    path = os.pathsep.join([str(Path(__file__).parent), str(Path(tiny.__file__).parent), *sys.path])
    parent = subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], env={**os.environ, "PYTHONPATH": path})
    while len(list(tmp_path.iterdir())) < 2:
        assert parent.poll() is None
        time.sleep(0.05)
    time.sleep(0.1)
    workers = [int(file.read_text()) for file in tmp_path.iterdir()]
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 20
    while any(map(is_running, workers)):
        assert time.monotonic() < deadline, "a worker outlived its parent"
        time.sleep(0.05)


def wait_and_tell(path: str) -> None:
    Path(path).write_text(str(os.getpid()))
    time.sleep(60)


def test_run_batch_needs_no_items() -> None:
    assert run_batch(wait_and_tell, [], workers=3) == []
