"""The store of one result an item."""

import fcntl
import os
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from processes import wait_for
from refusals import assert_refused
from stored import ITEMS, made, process, store_in

from deepaccident_devkit.errors import ConfigError, OutputFolderError, SomeFailedError
from deepaccident_devkit.support.parallel import Store
from deepaccident_devkit.support.parallel import store as module
from deepaccident_devkit.support.text import warn_once

pytestmark = pytest.mark.slow

WHOLE = b"\n".join(f"{name} {name} settings".encode() for name in ITEMS)


def ended(running: "subprocess.Popen[str]") -> tuple[bool, str]:
    """Whether a process did all, and what it said."""
    _, errors = running.communicate(timeout=300)
    return running.returncode == 0, errors


def marks(folder: Path) -> list[str]:
    """The items that were made, once for each time."""
    return sorted(path.stem for path in (folder / "marks").iterdir())


@pytest.mark.parametrize("workers", [1, 2])
def test_several_processes_share_a_folder(tmp_path: Path, workers: int) -> None:
    for each in [process(tmp_path, workers) for _ in range(3)]:
        good, errors = ended(each)
        assert good, errors
    assert ((tmp_path / "out").read_bytes(), store_in(tmp_path).folder.exists()) == (WHOLE, False)
    if len(list((tmp_path / "wholes").iterdir())) == 1:  # else one began when all was done
        assert marks(tmp_path) == [name.replace("/", ".") for name in ITEMS]


@pytest.mark.parametrize("killed_at", [ITEMS[0], ITEMS[5], ITEMS[-1]])
def test_a_killed_process_costs_nothing_that_is_made(tmp_path: Path, killed_at: str) -> None:
    assert not ended(process(tmp_path, killed_at=killed_at))[0]
    assert not (tmp_path / "out").exists()
    assert list(made(tmp_path).values()) == WHOLE.split(b"\n")
    assert marks(tmp_path) == [name.replace("/", ".") for name in ITEMS]
    assert (tmp_path / "out").read_bytes() == WHOLE


@pytest.mark.parametrize("removed", [".lock", ".making"])
def test_who_holds_a_lock_that_is_gone_does_not_finish(tmp_path: Path, removed: str) -> None:
    """Whoever comes next makes a new file of that name, and both would be alone."""
    store = store_in(tmp_path)
    with store.shared() as turn:
        (store.folder / removed).unlink()
        with store.shared() as another:
            assert not turn.alone(wait=False)
            assert another.alone(wait=False)


@given(
    content=st.binary(max_size=40),
    at=st.integers(0, 60),
    byte=st.integers(1, 255),
    cut=st.booleans(),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_damaged_result_is_none(
    tmp_path: Path, content: bytes, at: int, byte: int, cut: bool
) -> None:
    store = Store(tmp_path / "store", tmp_path, "tests", ConfigError)
    store.keep("a/b", "key", content)
    assert store.kept("a/b", "key") == content
    assert store.kept("a/b", "other") is store.kept("a/c", "key") is None
    path = tmp_path / "store" / "kept" / "a" / "b"
    damaged = bytearray(path.read_bytes())
    at %= len(damaged)
    damaged[at] ^= byte
    path.write_bytes(damaged[:at] if cut else damaged)
    assert store.kept("a/b", "key") is None


def test_a_failure_hides_no_result(tmp_path: Path) -> None:
    with pytest.raises(
        SomeFailedError,
        match=r"out: 2 of 12 failed:\n  type/02: type/02: broken\n  type/03: type/03",
    ):
        made(tmp_path, broken=ITEMS[2:4])
    assert not (tmp_path / "out").exists()
    made(tmp_path)
    assert (tmp_path / "out").read_bytes() == WHOLE
    assert len(marks(tmp_path)) == len(
        ITEMS
    )  # of this process; the marks of failures are the same files


@pytest.mark.parametrize(
    "place", ["locks", "locks/type", f"locks/{ITEMS[1]}", "kept", "kept/type", ".lock", ".making"]
)
def test_no_link_is_followed(tmp_path: Path, place: str) -> None:
    folder, outside = tmp_path / "out.unfinished", tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").touch()
    link = folder / place
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(
        outside / "precious" if place.endswith(("lock", "making", ITEMS[1])) else outside
    )
    before = (outside / "precious").stat()
    assert_refused(
        (
            lambda: made(tmp_path),
            OutputFolderError,
            "a symbolic link, which no devkit makes; remove it",
        )
    )
    assert [each.name for each in outside.iterdir()] == ["precious"]
    assert (outside / "precious").stat() == before


def test_who_waits_says_so_and_sees_that_all_is_done(tmp_path: Path) -> None:
    with store_in(tmp_path).shared() as turn:
        running = process(tmp_path)
        wait_for(lambda: len(list((tmp_path / "marks").glob("*"))) == len(ITEMS), seconds=300)
        time.sleep(0.3)
        assert (running.poll(), (tmp_path / "out").exists()) == (None, False)
        turn.end()
        good, errors = ended(running)
    assert (good, "another process doubles there; waiting for it" in errors) == (True, True)


def test_begin_is_called_if_nobody_else_takes_part(tmp_path: Path) -> None:
    store, called = store_in(tmp_path), list[int]()
    with store.shared(lambda: called.append(1)):
        with store.shared(lambda: called.append(2)):
            pass
        with store.shared(lambda: called.append(3)) as other:
            other.end()
    assert called == [1]
    with pytest.raises(ZeroDivisionError), store.shared(tidy=lambda: called.append(0)):
        called.append(1 // 0)
    assert called == [1, 0, 0]


def test_what_cannot_be_written_is_an_error_of_the_caller(tmp_path: Path) -> None:
    def fill() -> None:
        with store_in(tmp_path).shared():
            raise OSError("no room")

    (tmp_path / "file").touch()
    assert_refused(
        (
            fill,
            ConfigError,
            ("out: cannot be written (no room)", "make room there, or choose another"),
        ),
        (
            lambda: store_in(tmp_path / "file").shared().__enter__(),
            ConfigError,
            ("file/out: cannot be written", "room"),
        ),
    )
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.fixture
def forgotten(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What was found and said of file systems is forgotten, before and afterwards."""
    monkeypatch.setattr(module, "_without_locks", set())
    warn_once.cache_clear()
    yield
    warn_once.cache_clear()


def not_locking(number: int) -> Callable[[int, int], None]:
    def flock(_file: int, _kind: int) -> None:
        raise OSError(number, os.strerror(number))

    return flock


def never_answering(_file: int, _kind: int) -> None:
    time.sleep(3600)


@pytest.mark.usefixtures("forgotten")
@pytest.mark.parametrize(
    ("flock", "reason"),
    [
        *((not_locking(number), os.strerror(number)) for number in (38, 37, 95, 22, 5, 13)),
        (never_answering, "no answer within 0.2 s"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_file_system_without_locks(
    flock: Callable[[int, int], None],
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """ENOSYS of Lustre, ENOLCK of NFS, EOPNOTSUPP of FUSE, and whatever else: the work is done,
    which is said once.
    """
    monkeypatch.setattr(fcntl, "flock", flock)
    monkeypatch.setattr(module, "_ANSWER_SECONDS", 0.2)
    for _ in range(2):
        assert list(made(tmp_path).values()) == WHOLE.split(b"\n")
        (tmp_path / "out").unlink()
    [said] = [record.getMessage() for record in caplog.records]
    assert [
        fact
        for fact in (str(tmp_path / "out"), "locks", reason, "twice at once")
        if fact not in said
    ] == []
    assert not store_in(tmp_path).folder.exists()


@pytest.mark.usefixtures("forgotten")
def test_a_lock_that_is_never_given_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "_WAIT_HOURS", 0.0001)
    one, other = (
        Store(tmp_path / "store", tmp_path / "out", "tests", ConfigError, name)
        for name in ("one", "other")
    )
    facts = ("out: another process", "0.0001 hours", str(tmp_path / "store"))
    with one.shared() as turn, one.shared():
        assert_refused(
            (lambda: other.shared().__enter__(), ConfigError, facts),
            (turn.alone, ConfigError, facts),
        )
    assert ["at most 0.0001 hours" in record.getMessage() for record in caplog.records] == [True]
    with other.shared():
        pass


def test_a_disk_that_takes_half_of_a_locks_text_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody else has written it, so there is nobody to wait for."""
    write = os.pwrite
    monkeypatch.setattr(os, "pwrite", lambda file, content, place: write(file, content[:3], place))
    store = Store(tmp_path / "store", tmp_path / "out", "tests", ConfigError, "settings")
    facts = (str(tmp_path / "out"), "No space left", "make room there")
    assert_refused((lambda: store.shared().__enter__(), ConfigError, facts))
