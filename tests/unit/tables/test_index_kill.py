"""Indexing that is stopped: killed at any moment, by a full disk, by another process; and what is read again."""

import json
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import killed
import pytest
import tiny
from click.testing import CliRunner

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import IndexStoreError
from deepaccident_devkit.release import find_release
from deepaccident_devkit.tables import Tables, indexing
from deepaccident_devkit.tables import index as index_module
from deepaccident_devkit.tables.index import find_indexes
from deepaccident_devkit.tables.manifest import MANIFEST_FILE, SCHEMA_VERSION

pytestmark = pytest.mark.slow

OTHER = "Town05_type001_subtype0001_scenario00007"
THIRD = "Town01_type001_subtype0001_scenario00001"
KILLS = {1: 22, 2: 8}
Job = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def job() -> Iterator[Job]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, killed.__file__]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
    ) as server:
        assert server.stdin is not None and server.stdout is not None  # noqa: PT018 - for the type checker
        asked, answers = server.stdin, server.stdout

        def run(root: Path, index_dir: Path, **options: object) -> dict[str, Any]:
            asked.write(json.dumps({"root": str(root), "index_dir": str(index_dir), **options}) + "\n")
            asked.flush()
            answer: dict[str, Any] = json.loads(answers.readline())
            return answer

        yield run
        asked.close()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    tiny.write_tiny_release(tmp_path / "release")
    return tiny.write_tiny_release(tmp_path / "release", name=OTHER)


def opened(root: Path, index_dir: Path | None = None, **arguments: object) -> DeepAccident:
    return DeepAccident(dataroot=root, index_dir=index_dir, verbose=False, **arguments)  # type: ignore[arg-type]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def index_alone(folder: Path) -> dict[str, bytes]:
    """What a reader opens: all but the shards, which are kept for the next time."""
    return {name: content for name, content in contents(folder).items() if "shards" not in Path(name).parts}


def edit(root: Path, name: str = tiny.NAME) -> None:
    """Take the last box out of a label file, in place: no folder's time moves."""
    path = root / tiny.TYPE / "ego_vehicle" / "label" / name / f"{name}_002.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")


@pytest.mark.parametrize("workers", KILLS)
def test_killed_at_random_moments(own_release: Path, tmp_path: Path, job: Job, workers: int) -> None:
    opened(own_release, tmp_path / "fresh")
    fresh = contents(tmp_path / "fresh")
    seconds = job(own_release, tmp_path / "timed", workers=workers)["seconds"]
    source, kills, stages = random.Random(workers), 0, set()  # noqa: S311 - the same moments every time
    for attempt in range(4 * KILLS[workers]):
        index_dir = tmp_path / str(attempt)
        answer = job(own_release, index_dir, workers=workers, delay=source.uniform(0, seconds))
        assert answer["status"] in (0, -9), answer
        left = contents(index_dir) if index_dir.exists() else {}
        stages.add((sum(name.endswith(".arrow") for name in left), any("tables" in name for name in left)))
        kills += answer["status"] == -9
        seconds = min(seconds, answer["seconds"]) if answer["status"] == 0 else seconds  # the first was a slow one
        opened(own_release, index_dir)
        assert contents(index_dir) == fresh
        shutil.rmtree(index_dir)
        if kills == KILLS[workers]:
            break
    assert kills == KILLS[workers]
    assert len(stages) > 1  # the kills did not all fall into one moment


@pytest.mark.parametrize("after", [False, True])
def test_killed_around_every_renaming_of_a_first_indexing(root: Path, tmp_path: Path, job: Job, after: bool) -> None:
    opened(root, tmp_path / "fresh")
    fresh = contents(tmp_path / "fresh")
    step = 0
    while job(root, tmp_path / str(step), step=step, after=after)["status"] == -9:
        opened(root, tmp_path / str(step))
        assert contents(tmp_path / str(step)) == fresh, step
        step += 1
    assert step == 2 + 1 + 2 + 1  # shards, a table, the tables' folder and the manifest, the mark
    assert contents(tmp_path / str(step)) == fresh


@pytest.mark.parametrize("after", [False, True])
def test_killed_around_every_renaming_of_a_refresh(root: Path, tmp_path: Path, job: Job, after: bool) -> None:
    before = len(opened(root, tmp_path / "old").annotation)
    edit(root)
    opened(root, tmp_path / "fresh")
    fresh = contents(tmp_path / "fresh")
    step, status = 0, -9
    while status == -9:
        index_dir = tmp_path / str(step)
        shutil.copytree(tmp_path / "old", index_dir)
        status = job(root, index_dir, step=step, after=after, check=True)["status"]
        (index,) = find_indexes(find_release(root), index_dir)
        assert len(Tables(index.tables_folder).table("annotation")) in (before, before - 1)  # a reader, as it was left
        assert len(opened(root, index_dir).annotation) in (before, before - 1)
        result = CliRunner().invoke(deepaccident, ["index", str(root), "--index-dir", str(index_dir), "--check"])
        assert result.exit_code == 0
        assert contents(index_dir) == fresh, step
        step += 1
    assert step - 1 == 1 + 1 + 2 + 1 + 1  # the old tables are removed too


def test_the_next_opening_finishes_what_was_stopped_after_the_manifest(root: Path, tmp_path: Path) -> None:
    opened(root, tmp_path / "index")
    opened(root, tmp_path / "fresh")
    folder = tmp_path / "index" / "v1"
    shutil.copytree(next(folder.glob("tables-*")), folder / "tables-old")
    shutil.copytree(folder / "shards" / tiny.TYPE, folder / "shards" / "type2_subtype1_accident")
    opened(root, tmp_path / "index")
    assert (folder / "tables-old").exists()  # a good index is not looked through at every opening
    (folder / indexing.MARK_FILE).touch()
    opened(root, tmp_path / "index")
    assert contents(folder) == contents(tmp_path / "fresh" / "v1")


def test_a_stopped_refresh_that_cannot_be_finished_still_opens(
    root: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    opened(root)
    (root / ".deepaccident" / "v1" / indexing.MARK_FILE).touch()
    monkeypatch.setattr(indexing, "write_manifest", full_disk)
    assert len(opened(root).scenario) == 2
    assert "No space left" in caplog.text
    (root / ".deepaccident" / "v1" / indexing.MARK_FILE).touch()
    monkeypatch.setattr(index_module, "is_writable_folder", lambda _path: False)
    assert len(opened(root).scenario) == 2


def full_disk(*_arguments: object) -> None:
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("limit", [0, 50_000, 100_000, 500_000])
def test_a_full_disk_while_indexing(own_release: Path, tmp_path: Path, job: Job, limit: int) -> None:
    """A limit on files' sizes stands for the disk: at first for the shards, then for columns, then for a table."""
    index_dir = tmp_path / "index"
    opened(own_release, index_dir)
    before = index_alone(index_dir)
    label = next(own_release.glob("train/*/ego_vehicle/label/*/*_001.txt"))
    label.write_text("\n".join(label.read_text().splitlines()[:-1]) + "\n")
    answer = job(own_release, index_dir, limit=limit, check=True)
    assert answer["status"] == 1
    assert answer["message"].startswith(f"IndexStoreError: {index_dir / 'v1'}: the index cannot be written (")
    assert answer["message"].endswith("make room there or give another index_dir=")
    assert index_alone(index_dir) == before
    assert not [name for name in contents(index_dir) if ".tmp" in name or ".part" in name]
    assert len(list((index_dir / "v1").iterdir())) == 4  # manifest, lock, shards and tables
    assert job(own_release, index_dir, check=True)["status"] == 0
    opened(own_release, tmp_path / "fresh")
    assert contents(index_dir) == contents(tmp_path / "fresh")


def test_a_disk_that_is_full_at_the_manifest(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened(root)
    before = index_alone(root / ".deepaccident")
    tiny.write_tiny_release(root, name=THIRD)
    monkeypatch.setattr(indexing, "write_manifest", full_disk)
    with pytest.raises(IndexStoreError, match=r"No space left on device\); make room there or give another index_dir="):
        opened(root)
    assert index_alone(root / ".deepaccident") == before


def test_an_index_folder_that_cannot_be_locked(root: Path, tmp_path: Path) -> None:
    (tmp_path / "index" / "v1" / ".lock").mkdir(parents=True)
    with pytest.raises(IndexStoreError, match=r"cannot be locked .*; give another index_dir="):
        opened(root, tmp_path / "index")


def with_schema(root: Path, version: object) -> Path:
    path = root / ".deepaccident" / "v1" / MANIFEST_FILE
    path.write_text(json.dumps({**json.loads(path.read_text()), "schema_version": version}))
    return path


def test_a_newer_devkits_index_is_refused_and_kept(root: Path, tmp_path: Path) -> None:
    opened(root)
    path = with_schema(root, SCHEMA_VERSION + 1)
    before = contents(root)
    sentence = (
        rf"{path}: a newer devkit's index \(schema version {SCHEMA_VERSION + 1}, this devkit's is {SCHEMA_VERSION}\); "
        r"update the devkit, give another index_dir=, or remove the index with: deepaccident index DATAROOT --clear"
    )
    with pytest.raises(IndexStoreError, match=sentence):
        opened(root)
    assert contents(root) == before
    assert len(opened(root, tmp_path / "own").scenario) == 2
    assert CliRunner().invoke(deepaccident, ["index", str(root), "--clear"]).exit_code == 0
    assert len(opened(root).scenario) == 2


@pytest.mark.parametrize(
    "text", ["older", "", "{", "[]", "null", '{"schema_version": "2"}', "[" * 100_000, '{"schema_version": true}', "\0"]
)
def test_an_older_or_damaged_manifest_is_made_again(root: Path, text: str) -> None:
    opened(root)
    folder = root / ".deepaccident"
    before = contents(folder)
    path = with_schema(root, SCHEMA_VERSION - 1)
    if text != "older":
        path.write_text(text)
    assert len(opened(root).scenario) == 2
    assert contents(folder) == before


@pytest.mark.parametrize("damage", [{"table_files": {}}, {"table_files": {"track.arrow": [float("inf"), ""]}}])
def test_a_manifest_that_names_no_whole_tables_is_made_again(root: Path, damage: dict[str, object]) -> None:
    opened(root)
    path = root / ".deepaccident" / "v1" / MANIFEST_FILE
    before = path.read_bytes()
    path.write_text(json.dumps({**json.loads(before), **damage}))
    assert len(opened(root).scenario) == 2
    assert path.read_bytes() == before


def test_a_refresh_reads_just_what_was_edited_added_or_removed(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []
    original = indexing.read_scenario
    monkeypatch.setattr(
        indexing,
        "read_scenario",
        lambda scenario, scan: (read.append(scenario.name), original(scenario, scan))[1],
    )

    def refreshed(*options: str) -> int:
        read.clear()
        assert CliRunner().invoke(deepaccident, ["index", str(root), *options]).exit_code == 0
        fresh = root.parent / "fresh"
        names = list(read)
        shutil.rmtree(fresh, ignore_errors=True)
        count = len(opened(root, fresh).annotation)
        assert contents(root / ".deepaccident") == contents(fresh)
        read[:] = names
        return count

    before = refreshed()
    assert sorted(read) == [tiny.NAME, OTHER]
    edit(root, OTHER)
    assert refreshed("--check") == before - 1
    assert read == [OTHER]
    tiny.write_tiny_release(root, scenario_type="type1_subtype2_accident", name=THIRD)
    assert refreshed() > before
    assert read == [THIRD]
    shutil.rmtree(root / "type1_subtype2_accident")
    assert refreshed() == before - 1
    assert read == []


def test_two_processes_that_index_at_once(own_release: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "deepaccident_devkit.cli", "index", str(own_release), "--workers", "1"]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    said = [process.communicate(timeout=120) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
    assert said[0][0] == said[1][0]
    opened(own_release, tmp_path / "fresh")
    assert contents(own_release / ".deepaccident") == contents(tmp_path / "fresh")
