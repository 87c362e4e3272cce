"""Indexing that is killed, that meets a full disk, or that shares its work with other processes."""

import fcntl
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from click.testing import CliRunner
from support import stopped_index_process, tiny_release
from support.expected_errors import assert_raises
from support.linux_processes import wait_for
from support.tiny_release_index import (
    INDEX_FOLDER,
    THIRD_SCENARIO,
    folder_contents,
    open_release,
    remove_last_box,
)

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import IndexStoreError
from deepaccident_devkit.tables import Index, Tables, clear_index
from deepaccident_devkit.tables.index import MANIFEST_FILE

pytestmark = pytest.mark.slow

Job = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def job() -> Iterator[Job]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, stopped_index_process.__file__]
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=environment,
    ) as server:
        assert server.stdin is not None and server.stdout is not None  # noqa: PT018 - for the type checker
        requests, answers = server.stdin, server.stdout

        def run_job(root: Path, index_dir: Path, **options: object) -> dict[str, Any]:
            request = {"root": str(root), "index_dir": str(index_dir), **options}
            requests.write(json.dumps(request) + "\n")
            requests.flush()
            answer: dict[str, Any] = json.loads(answers.readline())
            return answer

        yield run_job
        requests.close()


def read_manifest_and_tables(folder: Path) -> dict[str, bytes]:
    """Return the contents of the files that a reader opens."""
    prefixes = (MANIFEST_FILE, "tables-")
    return {
        name: content
        for name, content in folder_contents(folder).items()
        if Path(name).parts[1].startswith(prefixes)
    }


@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize("refresh", [False, True])
def test_killed_around_every_renaming(
    root: Path, tmp_path: Path, job: Job, after: bool, refresh: bool
) -> None:
    """A reader sees the old index or the new one, and the same command goes on."""
    before = len(open_release(root, tmp_path / "old").annotation)
    remove_last_box(root)
    open_release(root, tmp_path / "fresh")
    fresh = folder_contents(tmp_path / "fresh")
    step, status = 0, -9
    while status == -9:
        index_dir = tmp_path / str(step)
        if refresh:
            shutil.copytree(tmp_path / "old", index_dir)
        status = job(root, index_dir, step=step, after=after, check=True)["status"]
        index = Index.read(index_dir / "v1")
        assert (index is not None) >= refresh
        if index is not None:
            assert len(Tables(index.tables_folder).table("annotation")) in (before, before - 1)
        assert len(open_release(root, index_dir).annotation) in (before, before - 1)
        command = ["check", "index", str(root), "--index-dir", str(index_dir)]
        assert CliRunner().invoke(deepaccident, command).output
        assert folder_contents(index_dir) == fresh, step
        step += 1
    num_kept_rows = 1 if refresh else 2
    num_tables = 3  # a table, the folder of the tables, and the manifest
    num_old_tables = 1 if refresh else 0
    num_locks = 1
    assert step - 1 == num_kept_rows + num_tables + num_old_tables + num_locks


@pytest.mark.parametrize("step", ["indexing.join_tables", "index.write_own"])
def test_a_disk_that_is_full_at_the_end(
    root: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    open_release(root)
    before = read_manifest_and_tables(root / INDEX_FOLDER.parent)
    tiny_release.write_tiny_release(root, name=THIRD_SCENARIO)
    path = f"deepaccident_devkit.tables.{step}"
    monkeypatch.setattr(path, Mock(side_effect=OSError(28, "No space left on device")))
    assert_raises(
        (
            lambda: open_release(root),
            IndexStoreError,
            ("v1: cannot be written", "No space left", "free space there"),
        )
    )
    assert read_manifest_and_tables(root / INDEX_FOLDER.parent) == before


def test_an_index_folder_that_cannot_be_locked(root: Path) -> None:
    (root / INDEX_FOLDER / ".lock").mkdir(parents=True)
    assert_raises(
        (
            lambda: open_release(root),
            IndexStoreError,
            ("v1: cannot be written", "choose another folder"),
        )
    )


@pytest.mark.parametrize("clear", [False, True])
def test_a_process_waits_while_another_makes_the_index(
    root: Path, caplog: pytest.LogCaptureFixture, clear: bool
) -> None:
    if clear:
        open_release(root)
    (root / INDEX_FOLDER).mkdir(parents=True, exist_ok=True)
    with (root / INDEX_FOLDER / ".lock").open("w") as lock:
        lock.write("another command")
        lock.flush()
        fcntl.flock(lock, fcntl.LOCK_SH)
        thread = threading.Thread(target=clear_index if clear else open_release, args=(root,))
        thread.start()
        wait_for(
            lambda: (
                "another process is making an index there; waiting" in caplog.text
                or not thread.is_alive()
            )
        )
        assert (root / INDEX_FOLDER / MANIFEST_FILE).exists() == clear
    thread.join(timeout=60)
    assert (root / INDEX_FOLDER / MANIFEST_FILE).exists() != clear


def test_processes_that_index_at_once_share_the_work(own_release: Path, tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "deepaccident_devkit.cli",
        "index",
        str(own_release),
        "--workers",
        "1",
    ]
    processes = [
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    outputs = [process.communicate(timeout=120) for process in processes]
    assert [process.returncode for process in processes] == [0, 0, 0], outputs
    assert len({stdout for stdout, _ in outputs}) == 1
    open_release(own_release, tmp_path / "fresh")
    assert folder_contents(own_release / INDEX_FOLDER.parent) == folder_contents(tmp_path / "fresh")
