"""Indexing that is stopped: killed at any moment, by a full disk; and shared with other
processes.
"""

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

import killed
import pytest
import tiny
from click.testing import CliRunner
from processes import wait_for
from refusals import assert_refused
from tiny_index import INDEX, THIRD, contents, edit, opened

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import IndexStoreError
from deepaccident_devkit.tables import Index, Tables, clear_index
from deepaccident_devkit.tables.index import MANIFEST_FILE

pytestmark = pytest.mark.slow

Job = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def job() -> Iterator[Job]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, killed.__file__]
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=environment,
    ) as server:
        assert server.stdin is not None and server.stdout is not None  # noqa: PT018 - for the type checker
        asked, answers = server.stdin, server.stdout

        def run(root: Path, index_dir: Path, **options: object) -> dict[str, Any]:
            asked.write(
                json.dumps({"root": str(root), "index_dir": str(index_dir), **options}) + "\n"
            )
            asked.flush()
            answer: dict[str, Any] = json.loads(answers.readline())
            return answer

        yield run
        asked.close()


def index_alone(folder: Path) -> dict[str, bytes]:
    """What a reader opens: the manifest and the tables."""
    names = (MANIFEST_FILE, "tables-")
    return {
        name: content
        for name, content in contents(folder).items()
        if Path(name).parts[1].startswith(names)
    }


@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize("refresh", [False, True])
def test_killed_around_every_renaming(
    root: Path, tmp_path: Path, job: Job, after: bool, refresh: bool
) -> None:
    """A reader sees the old index or the new one, and the same command goes on."""
    before = len(opened(root, tmp_path / "old").annotation)
    edit(root)
    opened(root, tmp_path / "fresh")
    fresh = contents(tmp_path / "fresh")
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
        assert len(opened(root, index_dir).annotation) in (before, before - 1)
        assert (
            CliRunner()
            .invoke(deepaccident, ["check", "index", str(root), "--index-dir", str(index_dir)])
            .output
        )
        assert contents(index_dir) == fresh, step
        step += 1
    kept, tables, old = (
        (1, 3, 1) if refresh else (2, 3, 0)
    )  # a table, the tables' folder, and the manifest
    assert step - 1 == kept + tables + old + 1  # the locks


@pytest.mark.parametrize("step", ["indexing.join_tables", "index.write_own"])
def test_a_disk_that_is_full_at_the_end(
    root: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    opened(root)
    before = index_alone(root / INDEX.parent)
    tiny.write_tiny_release(root, name=THIRD)
    path = f"deepaccident_devkit.tables.{step}"
    monkeypatch.setattr(path, Mock(side_effect=OSError(28, "No space left on device")))
    assert_refused(
        (
            lambda: opened(root),
            IndexStoreError,
            ("v1: cannot be written", "No space left", "make room there"),
        )
    )
    assert index_alone(root / INDEX.parent) == before


def test_an_index_folder_that_cannot_be_locked(root: Path) -> None:
    (root / INDEX / ".lock").mkdir(parents=True)
    assert_refused(
        (lambda: opened(root), IndexStoreError, ("v1: cannot be written", "choose another folder"))
    )


@pytest.mark.parametrize("clear", [False, True])
def test_who_finds_another_at_work_waits(
    root: Path, caplog: pytest.LogCaptureFixture, clear: bool
) -> None:
    if clear:
        opened(root)
    (root / INDEX).mkdir(parents=True, exist_ok=True)
    with (root / INDEX / ".lock").open("w") as lock:
        lock.write("another command")
        lock.flush()
        fcntl.flock(lock, fcntl.LOCK_SH)
        thread = threading.Thread(target=clear_index if clear else opened, args=(root,))
        thread.start()
        wait_for(
            lambda: (
                "another process makes an index there; waiting" in caplog.text
                or not thread.is_alive()
            )
        )
        assert (root / INDEX / MANIFEST_FILE).exists() == clear
    thread.join(timeout=60)
    assert (root / INDEX / MANIFEST_FILE).exists() != clear


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
    said = [process.communicate(timeout=120) for process in processes]
    assert [process.returncode for process in processes] == [0, 0, 0], said
    assert len({printed for printed, _ in said}) == 1
    opened(own_release, tmp_path / "fresh")
    assert contents(own_release / INDEX.parent) == contents(tmp_path / "fresh")
