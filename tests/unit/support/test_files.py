"""Temporary names: whose they are, and what becomes of those of dead writers."""

import os
import re
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from processes import wait_for
from refusals import assert_refused

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
DAY = 24 * 3600


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def left_by(folder: Path, change: Callable[[str], str] = str, *, age: float = 0.0) -> Path:
    """A temporary file of this process, or with a changed name of another one."""
    path = folder / change(temporary_path(folder / "table.json").name)
    path.touch()
    os.utime(path, (time.time() - age, time.time() - age))
    return path


def test_a_block_that_fails_leaves_nothing(tmp_path: Path) -> None:
    def fail() -> None:
        with replacing(tmp_path / "a") as path, replacing_folder(tmp_path / "b") as folder:
            path.touch()
            (folder / "half").touch()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert names(tmp_path) == []


def test_a_folder_has_the_permissions_of_others(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    with replacing_folder(tmp_path / "made"):
        pass
    assert (tmp_path / "made").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_the_next_run_removes_what_a_killed_one_left(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen([sys.executable, "-c", WRITER, tmp_path], env=environment) as writer:
        wait_for(lambda: list(tmp_path.glob(".table.json.*")))
        remove_leftovers(tmp_path)
        assert [temporary_of(name) for name in names(tmp_path)] == ["run", "table.json"]  # it lives
        os.kill(writer.pid, signal.SIGKILL)
        wait_for(
            lambda: (
                Path(f"/proc/{writer.pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
            )
        )
        write_bytes(tmp_path / "other.json", b"")  # nobody has asked for its status yet
        assert names(tmp_path) == ["other.json"]


def other_process(name: str) -> str:
    return re.sub(r"-\d+-(\d+)\.tmp", r"-1-\1.tmp", name)


def elsewhere(name: str) -> str:
    return re.sub(r"[0-9a-f]{8}-\d+", "0123abcd-999999999", name)


@pytest.mark.parametrize(
    ("kept", "gone", "days"),
    [(str, other_process, (0, 0)), (elsewhere, elsewhere, (0.9, 1.1))],
    ids=[
        "the number of a dead writer is another process's",
        "writers on other hosts are given a day",
    ],
)
def test_whose_leftovers_are_removed(tmp_path: Path, kept, gone, days: tuple[float, float]) -> None:
    fresh = left_by(tmp_path, kept, age=days[0] * DAY)
    left_by(tmp_path, gone, age=days[1] * DAY)
    remove_leftovers(tmp_path)
    assert names(tmp_path) == [fresh.name]


def test_what_may_be_of_others_is_left(tmp_path: Path) -> None:
    kept = {".table.json.123.tmp", ".mine.tmp", "table.json", ".tables-0a1b.tmp"}
    for name in kept:
        left_by(tmp_path, lambda _, name=name: name, age=9 * DAY)
    remove_leftovers(tmp_path)
    assert set(names(tmp_path)) == kept


def test_a_link_is_removed_and_not_what_it_leads_to(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "file").touch()
    dead = left_by(tmp_path, lambda name: name.replace(f"-{os.getpid()}-", "-4194305-"))
    dead.unlink()
    dead.symlink_to(tmp_path / "data")
    remove_leftovers(tmp_path)
    assert (names(tmp_path), names(tmp_path / "data")) == (["data"], ["file"])


def test_plain_names_are_names_on_any_file_system() -> None:
    names = plain_names(
        ["a/b", "A_b", "a?b", "..", "", "x" * 300, f"{'x' * 300}y", "café"],
        reserved=["INDEX.html", "a_b"],
    )
    assert len({name.lower() for name in names.values()} | {"index.html", "a_b"}) == 10
    assert all(
        re.fullmatch(r"[A-Za-z0-9_.-]{1,140}", name) and name.strip(".") for name in names.values()
    )
    given = plain_names(["index.html", "../../up"], reserved=["INDEX.html"])
    assert given == {"index.html": "index.html_2", "../../up": ".._.._up"}


def a_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))


def a_device(path: Path) -> None:
    try:
        os.mknod(path, stat.S_IFCHR | 0o600, os.makedev(1, 3))
    except PermissionError:
        pytest.skip("only root can make a device")


def a_link_to_a_pipe(path: Path) -> None:
    os.mkfifo(path.with_name("pipe"))
    path.symlink_to("pipe")


@pytest.mark.parametrize("make", [os.mkfifo, a_socket, a_device, Path.mkdir, a_link_to_a_pipe])
def test_what_is_no_regular_file_is_not_replaced(
    tmp_path: Path, make: Callable[[Path], object]
) -> None:
    path = tmp_path / "output"
    make(path)
    before = {entry.name: entry.lstat() for entry in tmp_path.iterdir()}
    seen: list[list[str]] = []

    def write() -> None:
        with replacing(path):
            seen.append(names(tmp_path))

    assert_refused(
        (write, OutputFolderError, ("output: ", "not replaced", "give the path of a new file")),
        (lambda: write_bytes(path, b"new"), OutputFolderError, "output: "),
    )
    assert not seen, "something was written beside it before it was refused"
    assert {entry.name: entry.lstat() for entry in tmp_path.iterdir()} == before


@pytest.mark.parametrize("make", [os.mkfifo, a_socket, a_device, Path.touch, a_link_to_a_pipe])
def test_what_is_no_folder_is_not_replaced_by_one(
    tmp_path: Path, make: Callable[[Path], object]
) -> None:
    path = tmp_path / "output"
    make(path)
    before = names(tmp_path)
    with pytest.raises(NotADirectoryError), replacing_folder(path):
        pass
    assert_refused((lambda: writable_folder(path), ConfigError, "give a folder"))
    assert names(tmp_path) == before


def test_nothing_is_written_among_devices_and_open_files(tmp_path: Path) -> None:
    """Such as `/dev/stdout`, where the output of a command goes to a file."""
    (tmp_path / "link").symlink_to("/proc/self/fd")
    with (tmp_path / "opened").open("w") as opened:
        for path in (
            Path(f"/proc/self/fd/{opened.fileno()}"),
            tmp_path / "link" / str(opened.fileno()),
        ):
            assert_refused(
                (
                    lambda path=path: write_bytes(path, b"new"),
                    OutputFolderError,
                    ("open file", "new file"),
                )
            )


def test_a_link_to_a_file_or_to_nothing_is_replaced_itself(tmp_path: Path) -> None:
    target = tmp_path / "target"
    for content in (b"first", b"second"):
        (tmp_path / "link").unlink(missing_ok=True)
        (tmp_path / "link").symlink_to(target)
        write_bytes(tmp_path / "link", content)
        assert not target.exists() or target.read_bytes() == b"kept"
        assert (tmp_path / "link").read_bytes() == content
        target.write_bytes(b"kept")
