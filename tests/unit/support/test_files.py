"""Temporary names: which process they belong to, and how leftovers of dead writers are removed."""

import os
import re
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from support.expected_errors import assert_raises
from support.linux_processes import wait_for

from deepaccident_devkit.errors import ConfigError, OutputFolderError
from deepaccident_devkit.support.files import (
    plain_names,
    remove_leftovers,
    replacing,
    replacing_folder,
    temporary_of,
    temporary_path,
    writable_folder,
    write_bytes,
)

WRITER = """
import sys, time
from pathlib import Path
from deepaccident_devkit.support.files import replacing, replacing_folder
folder = Path(sys.argv[1])
with replacing(folder / "table.json") as path, replacing_folder(folder / "run") as run:
    (run / "half").touch()
    path.touch()
    time.sleep(60)
"""
DAY_S = 24 * 3600


def list_names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def leave_temporary_file(
    folder: Path, change_name: Callable[[str], str] = str, *, age_s: float = 0.0
) -> Path:
    """Leave a temporary file of this process, or of another one if its name is changed."""
    path = folder / change_name(temporary_path(folder / "table.json").name)
    path.touch()
    modified_s = time.time() - age_s
    os.utime(path, (modified_s, modified_s))
    return path


def test_a_block_that_fails_leaves_nothing(tmp_path: Path) -> None:
    def fail() -> None:
        with replacing(tmp_path / "a") as path, replacing_folder(tmp_path / "b") as folder:
            path.touch()
            (folder / "half").touch()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert list_names(tmp_path) == []


def test_a_folder_has_the_permissions_of_others(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    with replacing_folder(tmp_path / "made"):
        pass
    assert (tmp_path / "made").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_the_next_run_removes_the_leftovers_of_a_killed_one(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen([sys.executable, "-c", WRITER, tmp_path], env=environment) as writer:
        wait_for(lambda: list(tmp_path.glob(".table.json.*")))
        remove_leftovers(tmp_path)
        targets = [temporary_of(name) for name in list_names(tmp_path)]
        assert targets == ["run", "table.json"]  # the writer still runs

        os.kill(writer.pid, signal.SIGKILL)
        status = Path(f"/proc/{writer.pid}/stat")
        wait_for(lambda: status.read_text().rpartition(")")[2].split()[0] == "Z")
        write_bytes(tmp_path / "other.json", b"")  # no process has asked for its status yet
        assert list_names(tmp_path) == ["other.json"]


def rename_to_other_process(name: str) -> str:
    return re.sub(r"-\d+-(\d+)\.tmp", r"-1-\1.tmp", name)


def rename_to_other_host(name: str) -> str:
    return re.sub(r"[0-9a-f]{8}-\d+", "0123abcd-999999999", name)


@pytest.mark.parametrize(
    ("rename_remaining", "rename_removed", "ages_days"),
    [
        (str, rename_to_other_process, (0, 0)),
        (rename_to_other_host, rename_to_other_host, (0.9, 1.1)),
    ],
    ids=[
        "the number of a dead writer is another process's",
        "writers on other hosts are given a day",
    ],
)
def test_leftovers_of_dead_writers_are_removed(
    tmp_path: Path, rename_remaining, rename_removed, ages_days: tuple[float, float]
) -> None:
    remaining_path = leave_temporary_file(tmp_path, rename_remaining, age_s=ages_days[0] * DAY_S)
    leave_temporary_file(tmp_path, rename_removed, age_s=ages_days[1] * DAY_S)
    remove_leftovers(tmp_path)
    assert list_names(tmp_path) == [remaining_path.name]


def test_files_that_may_belong_to_others_are_left(tmp_path: Path) -> None:
    foreign_names = {".table.json.123.tmp", ".mine.tmp", "table.json", ".tables-0a1b.tmp"}
    for name in foreign_names:
        leave_temporary_file(tmp_path, lambda _, name=name: name, age_s=9 * DAY_S)
    remove_leftovers(tmp_path)
    assert set(list_names(tmp_path)) == foreign_names


def test_a_link_is_removed_but_not_its_target(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "file").touch()
    link = leave_temporary_file(
        tmp_path, lambda name: name.replace(f"-{os.getpid()}-", "-4194305-")
    )
    link.unlink()
    link.symlink_to(tmp_path / "data")
    remove_leftovers(tmp_path)

    assert list_names(tmp_path) == ["data"]
    assert list_names(tmp_path / "data") == ["file"]


def test_plain_names_are_names_on_any_file_system() -> None:
    names = plain_names(
        ["a/b", "A_b", "a?b", "..", "", "x" * 300, f"{'x' * 300}y", "café"],
        reserved=["INDEX.html", "a_b"],
    )
    assert len({name.lower() for name in names.values()} | {"index.html", "a_b"}) == 10
    for name in names.values():
        assert re.fullmatch(r"[A-Za-z0-9_.-]{1,140}", name)
        assert name.strip(".")
    reserved_names = plain_names(["index.html", "../../up"], reserved=["INDEX.html"])
    assert reserved_names == {"index.html": "index.html_2", "../../up": ".._.._up"}


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))


def make_device(path: Path) -> None:
    try:
        os.mknod(path, stat.S_IFCHR | 0o600, os.makedev(1, 3))
    except PermissionError:
        pytest.skip("only root can make a device")


def link_to_pipe(path: Path) -> None:
    os.mkfifo(path.with_name("pipe"))
    path.symlink_to("pipe")


@pytest.mark.parametrize(
    "make_path", [os.mkfifo, make_socket, make_device, Path.mkdir, link_to_pipe]
)
def test_a_path_that_is_no_regular_file_is_not_replaced(
    tmp_path: Path, make_path: Callable[[Path], object]
) -> None:
    path = tmp_path / "output"
    make_path(path)
    entries = {entry.name: entry.lstat() for entry in tmp_path.iterdir()}
    names_while_writing: list[list[str]] = []

    def write() -> None:
        with replacing(path):
            names_while_writing.append(list_names(tmp_path))

    assert_raises(
        (write, OutputFolderError, ("output: ", "not replaced", "give the path of a new file")),
        (lambda: write_bytes(path, b"new"), OutputFolderError, "output: "),
    )
    assert not names_while_writing, "something was written beside it before it was refused"
    assert {entry.name: entry.lstat() for entry in tmp_path.iterdir()} == entries


@pytest.mark.parametrize(
    "make_path", [os.mkfifo, make_socket, make_device, Path.touch, link_to_pipe]
)
def test_a_path_that_is_no_folder_is_not_replaced_by_one(
    tmp_path: Path, make_path: Callable[[Path], object]
) -> None:
    path = tmp_path / "output"
    make_path(path)
    names = list_names(tmp_path)

    with pytest.raises(NotADirectoryError), replacing_folder(path):
        pass
    assert_raises((lambda: writable_folder(path), ConfigError, "give a folder"))
    assert list_names(tmp_path) == names


def test_open_files_of_a_process_are_not_replaced(tmp_path: Path) -> None:
    """One of them is `/dev/stdout` if the output of a command goes to a file."""
    (tmp_path / "link").symlink_to("/proc/self/fd")
    with (tmp_path / "opened").open("w") as opened:
        number = str(opened.fileno())
        for path in (Path("/proc/self/fd", number), tmp_path / "link" / number):
            call = partial(write_bytes, path, b"new")
            assert_raises((call, OutputFolderError, ("open file", "new file")))


def test_a_link_to_a_file_or_to_nothing_is_replaced_itself(tmp_path: Path) -> None:
    link = tmp_path / "link"
    target = tmp_path / "target"
    for content in (b"first", b"second"):
        link.unlink(missing_ok=True)
        link.symlink_to(target)
        write_bytes(link, content)
        assert not target.exists() or target.read_bytes() == b"kept"
        assert link.read_bytes() == content
        target.write_bytes(b"kept")
