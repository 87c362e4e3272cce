"""The lock of an index folder: one process at a time writes there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from deepaccident_devkit.errors import IndexStoreError
from deepaccident_devkit.files import place_in, say_waiting

if TYPE_CHECKING:
    from filelock import BaseFileLock

LOCK_FILE = ".lock"
_TASK = "makes an index"


@contextmanager
def index_lock(folder: Path, *, wait: bool = True) -> Iterator[bool]:
    """Hold the folder's lock, which the system takes back when a process ends, however it ends.

    Args:
        folder: an index folder; made where it is missing.
        wait: whether to wait, saying so, while another process holds it.

    Yields:
        Whether it is held; always so after waiting.

    Raises:
        IndexStoreError: there can be no lock in this folder, or its lock is a link.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(folder / LOCK_FILE)
    try:
        place_in(folder, LOCK_FILE, opened=True)  # a link's target would be emptied
        _acquire(lock, folder, wait=wait)
    except Timeout:
        pass
    except (OSError, NotImplementedError) as error:  # the latter: a file system without locks
        raise IndexStoreError(f"{folder}: cannot be locked ({error}); give another index_dir=") from error
    try:
        yield lock.is_locked
    finally:
        lock.release()


def _acquire(lock: BaseFileLock, folder: Path, *, wait: bool) -> None:
    from filelock import Timeout

    folder.mkdir(parents=True, exist_ok=True)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        if not wait:
            raise
        say_waiting(folder, _TASK)
        _wait(lock, folder)


def _wait(lock: BaseFileLock, folder: Path) -> None:
    while not lock.is_locked:
        folder.mkdir(parents=True, exist_ok=True)  # gone if the other process cleared the index
        with suppress(FileNotFoundError):
            lock.acquire()
