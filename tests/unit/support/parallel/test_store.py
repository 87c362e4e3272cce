"""The store that keeps one result of each item."""

import fcntl
import os
import subprocess
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.expected_errors import assert_raises
from support.linux_processes import wait_for
from support.store_process import ITEM_NAMES, make_items, open_store, start_process

from deepaccident_devkit.errors import ConfigError, OutputFolderError, SomeFailedError
from deepaccident_devkit.support.parallel import Store
from deepaccident_devkit.support.parallel import store as module
from deepaccident_devkit.support.text import warn_once

pytestmark = pytest.mark.slow

WHOLE_OUTPUT = b"\n".join(f"{name} {name} settings".encode() for name in ITEM_NAMES)


def wait_for_end(process: "subprocess.Popen[str]") -> tuple[bool, str]:
    """Wait for a process to end, and return whether it succeeded and its messages."""
    _, errors = process.communicate(timeout=300)
    return process.returncode == 0, errors


def list_made_items(folder: Path) -> list[str]:
    """Return the items that were made, once for each time."""
    return sorted(path.stem for path in (folder / "marks").iterdir())


@pytest.mark.parametrize("workers", [1, 2])
def test_several_processes_share_a_folder(tmp_path: Path, workers: int) -> None:
    for process in [start_process(tmp_path, workers) for _ in range(3)]:
        succeeded, errors = wait_for_end(process)
        assert succeeded, errors

    assert (tmp_path / "out").read_bytes() == WHOLE_OUTPUT
    assert not open_store(tmp_path).folder.exists()
    if len(list((tmp_path / "wholes").iterdir())) == 1:  # otherwise one began when all was done
        assert list_made_items(tmp_path) == [name.replace("/", ".") for name in ITEM_NAMES]


@pytest.mark.parametrize("killed_at", [ITEM_NAMES[0], ITEM_NAMES[5], ITEM_NAMES[-1]])
def test_results_of_a_killed_process_are_not_made_again(tmp_path: Path, killed_at: str) -> None:
    succeeded, _ = wait_for_end(start_process(tmp_path, killed_at=killed_at))
    assert not succeeded
    assert not (tmp_path / "out").exists()
    assert list(make_items(tmp_path).values()) == WHOLE_OUTPUT.split(b"\n")
    assert list_made_items(tmp_path) == [name.replace("/", ".") for name in ITEM_NAMES]
    assert (tmp_path / "out").read_bytes() == WHOLE_OUTPUT


@pytest.mark.parametrize("removed", [".lock", ".making"])
def test_the_holder_of_a_removed_lock_does_not_finish(tmp_path: Path, removed: str) -> None:
    """The next process makes a new file of that name, and both would hold a lock."""
    store = open_store(tmp_path)
    with store.shared() as turn:
        (store.folder / removed).unlink()
        with store.shared() as another_turn:
            assert not turn.alone(wait=False)
            assert another_turn.alone(wait=False)


@given(
    content=st.binary(max_size=40),
    offset=st.integers(0, 60),
    byte=st.integers(1, 255),
    is_cut=st.booleans(),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_damaged_result_is_none(
    tmp_path: Path, content: bytes, offset: int, byte: int, is_cut: bool
) -> None:
    store = Store(tmp_path / "store", tmp_path, "tests", ConfigError)
    store.write_result("a/b", "key", content)

    assert store.read_result("a/b", "key") == content
    assert store.read_result("a/b", "other") is store.read_result("a/c", "key") is None
    path = tmp_path / "store" / "kept" / "a" / "b"
    damaged_content = bytearray(path.read_bytes())
    offset %= len(damaged_content)
    damaged_content[offset] ^= byte
    path.write_bytes(damaged_content[:offset] if is_cut else damaged_content)
    assert store.read_result("a/b", "key") is None


def test_a_failure_hides_no_result(tmp_path: Path) -> None:
    message = r"out: 2 of 12 failed:\n  type/02: type/02: broken\n  type/03: type/03"
    with pytest.raises(SomeFailedError, match=message):
        make_items(tmp_path, broken=ITEM_NAMES[2:4])
    assert not (tmp_path / "out").exists()
    make_items(tmp_path)
    assert (tmp_path / "out").read_bytes() == WHOLE_OUTPUT
    # one mark for each item, because the marks of failures are the same files
    assert len(list_made_items(tmp_path)) == len(ITEM_NAMES)


@pytest.mark.parametrize(
    "name",
    ["locks", "locks/type", f"locks/{ITEM_NAMES[1]}", "kept", "kept/type", ".lock", ".making"],
)
def test_no_link_is_followed(tmp_path: Path, name: str) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    file = outside / "precious"
    file.touch()
    link = tmp_path / "out.unfinished" / name
    link.parent.mkdir(parents=True, exist_ok=True)
    is_file = name.endswith(("lock", "making", ITEM_NAMES[1]))
    link.symlink_to(file if is_file else outside)
    status = file.stat()

    message = "is a symbolic link, which the devkit never creates; remove it"
    assert_raises((lambda: make_items(tmp_path), OutputFolderError, message))
    assert list(outside.iterdir()) == [file]
    assert file.stat() == status


def test_a_waiting_process_says_so_and_ends_when_all_is_done(tmp_path: Path) -> None:
    marks = tmp_path / "marks"
    with open_store(tmp_path).shared() as turn:
        process = start_process(tmp_path)
        wait_for(lambda: len(list(marks.glob("*"))) == len(ITEM_NAMES), seconds=300)
        time.sleep(0.3)
        assert process.poll() is None
        assert not (tmp_path / "out").exists()
        turn.end()
        succeeded, errors = wait_for_end(process)

    assert succeeded
    assert "another process doubles there; waiting for it" in errors


def test_begin_is_called_only_if_no_other_process_takes_part(tmp_path: Path) -> None:
    store = open_store(tmp_path)
    calls: list[int] = []
    with store.shared(lambda: calls.append(1)):
        with store.shared(lambda: calls.append(2)):
            pass
        with store.shared(lambda: calls.append(3)) as other:
            other.end()

    assert calls == [1]
    with pytest.raises(ZeroDivisionError), store.shared(tidy=lambda: calls.append(0)):
        calls.append(1 // 0)
    assert calls == [1, 0, 0]


def test_a_folder_that_cannot_be_written_is_an_error_of_the_caller(tmp_path: Path) -> None:
    def fill_disk() -> None:
        with open_store(tmp_path).shared():
            raise OSError("no room")

    (tmp_path / "file").touch()
    assert_raises(
        (
            fill_disk,
            ConfigError,
            ("out: cannot be written (no room)", "free space there, or choose another"),
        ),
        (
            lambda: open_store(tmp_path / "file").shared().__enter__(),
            ConfigError,
            ("file/out: cannot be written", "free space"),
        ),
    )
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.fixture
def clean_lock_state(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Forget the findings and warnings on file systems, before and afterwards."""
    monkeypatch.setattr(module, "_without_locks", set())
    warn_once.cache_clear()
    yield
    warn_once.cache_clear()


def make_failing_flock(number: int) -> Callable[[int, int], None]:
    def flock(_file: int, _kind: int) -> None:
        raise OSError(number, os.strerror(number))

    return flock


def hang_in_flock(_file: int, _kind: int) -> None:
    time.sleep(3600)


@pytest.mark.usefixtures("clean_lock_state")
@pytest.mark.parametrize(
    ("flock", "reason"),
    [
        *((make_failing_flock(number), os.strerror(number)) for number in (38, 37, 95, 22, 5, 13)),
        (hang_in_flock, "no answer within 0.2 s"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_work_is_done_on_a_file_system_without_locks(
    flock: Callable[[int, int], None],
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The errors are ENOSYS of Lustre, ENOLCK of NFS, EOPNOTSUPP of FUSE and others: the work is
    done, with one warning.
    """
    monkeypatch.setattr(fcntl, "flock", flock)
    monkeypatch.setattr(module, "_ANSWER_SECONDS", 0.2)
    for _ in range(2):
        assert list(make_items(tmp_path).values()) == WHOLE_OUTPUT.split(b"\n")
        (tmp_path / "out").unlink()
    [message] = [record.getMessage() for record in caplog.records]

    for text in (str(tmp_path / "out"), "locks", reason, "two commands on this folder at once"):
        assert text in message
    assert not open_store(tmp_path).folder.exists()


@pytest.mark.usefixtures("clean_lock_state")
def test_waiting_for_a_lock_that_is_never_released_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "_WAIT_HOURS", 0.0001)
    open_named_store = partial(Store, tmp_path / "store", tmp_path / "out", "tests", ConfigError)
    store = open_named_store("one")
    other_store = open_named_store("other")
    texts = ("out: another process", "0.0001 hours", str(tmp_path / "store"))
    with store.shared() as turn, store.shared():
        assert_raises(
            (lambda: other_store.shared().__enter__(), ConfigError, texts),
            (turn.alone, ConfigError, texts),
        )
    [message] = [record.getMessage() for record in caplog.records]

    assert "at most 0.0001 hours" in message
    with other_store.shared():
        pass


def test_a_disk_that_takes_half_of_a_locks_text_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No other process wrote the text, so there is no process to wait for."""
    write = os.pwrite
    monkeypatch.setattr(
        os, "pwrite", lambda file, content, offset: write(file, content[:3], offset)
    )
    store = Store(tmp_path / "store", tmp_path / "out", "tests", ConfigError, "settings")
    facts = (str(tmp_path / "out"), "No space left", "free space there")

    assert_raises((lambda: store.shared().__enter__(), ConfigError, facts))
