"""The lock of an index folder: one process at a time writes there."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from deepaccident_devkit.errors import IndexStoreError

if TYPE_CHECKING:
    from filelock import BaseFileLock

logger = logging.getLogger(__name__)

LOCK_FILE = ".lock"


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

    if (folder / LOCK_FILE).is_symlink():  # it would be emptied
        raise IndexStoreError(f"{folder / LOCK_FILE}: a symbolic link, which no devkit makes; remove it")
    lock = FileLock(folder / LOCK_FILE)
    try:
        _acquire(lock, folder, wait=wait)
    except Timeout:
        pass
    except (OSError, NotImplementedError) as error:  # the latter: a file system without locks
        raise IndexStoreError(f"{folder}: cannot be locked ({error}); give another index_dir=") from error
    try:
        yield lock.is_locked
    finally:
        lock.release()


def _acquire(lock: "BaseFileLock", folder: Path, *, wait: bool) -> None:
    from filelock import Timeout

    folder.mkdir(parents=True, exist_ok=True)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        if not wait:
            raise
        logger.warning("%s: another process makes this index; waiting for it", folder)
        _wait(lock, folder)


def _wait(lock: "BaseFileLock", folder: Path) -> None:
    while not lock.is_locked:
        folder.mkdir(parents=True, exist_ok=True)  # gone if the other process cleared the index
        with suppress(FileNotFoundError):
            lock.acquire()
