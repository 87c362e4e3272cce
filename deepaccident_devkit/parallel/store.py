"""One result an item of bulk work, such as a scenario: made once, by whichever process comes to it first.

Processes, also on several hosts, that are given the same command and the same folder share its items. Each makes what
nobody else is making; one that finds no such item waits for the others; then one of them after the other has the folder
alone. The first writes what spans the items; the others see that it is there.

The folder is the devkit's own, and hidden from whoever uses what is made:

    .lock         held together while items are made, and by one alone before and after that
    locks/NAME    held while an item is made
    kept/NAME     a result: its bytes, and a seal of these and of a key, which says what it was made from

Locks are `flock`, which network file systems pass on (docs/clusters.md). The system takes them back from a process that
ends, however it ends. A result is written under a temporary name and renamed: it is whole or not there.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from deepaccident_devkit.errors import DeepAccidentError
from deepaccident_devkit.files import place_in, remove_in, say_waiting, write_bytes
from deepaccident_devkit.parallel.batches import run_batch
from deepaccident_devkit.parallel.failures import Failure, Tried, check_failures
from deepaccident_devkit.reading import FileKind, read_bytes

Item = TypeVar("Item")
Result = TypeVar("Result")
_SEAL: Final = 16
"""Bytes after a result."""
_LOCK: Final = ".lock"


@dataclass(frozen=True, slots=True)
class Store:
    """The folder of the results of some bulk work; cheap to pickle.

    Attributes:
        folder: it need not exist. The caller has checked that no link leads there; below it none is followed.
        out: the place of what is made, for messages.
        task: what those who hold its lock do, such as `writes labels`, for who waits for them.
        error: raised if something cannot be written.
    """

    folder: Path
    out: Path
    task: str
    error: type[DeepAccidentError]

    def kept(self, name: str, key: str, kind: FileKind = "bundle") -> bytes | None:
        """A result; None if there is none that was made from what `key` says, or it is damaged.

        Args:
            name: of the item; a path below the folder.
            key: a digest of all that decides the result, such as files and settings.
            kind: of the file, which limits its size.

        Raises:
            OutputFolderError: a link leads there.
        """
        try:
            content = read_bytes(place_in(self.folder, f"kept/{name}", opened=True), kind)
        except OSError:
            return None
        return content[:-_SEAL] if content[-_SEAL:] == _seal(key, content[:-_SEAL]) else None

    def keep(self, name: str, key: str, content: bytes) -> None:
        """Keep a result in place of an earlier one of this name; raises OSError or OutputFolderError."""
        write_bytes(place_in(self.folder, f"kept/{name}"), content + _seal(key, content))

    def drop(self, name: str) -> None:
        """Remove a result, if it is there; raises OSError or OutputFolderError."""
        remove_in(self.folder, f"kept/{name}")

    def remove(self) -> None:
        """Remove all of it, once what it was for is written; whoever waits for its lock sees that it is gone."""
        for name in ("kept", "locks", _LOCK):
            remove_in(self.folder, name)
        with suppress(OSError):  # something else is there, or another process has begun again
            self.folder.rmdir()

    @contextmanager
    def shared(self, begin: Callable[[], object] = lambda: None) -> Iterator[Turn]:
        """Take part in the work on the items, together with others, while the block runs.

        Args:
            begin: called before, if nobody else takes part: what removes the files of killed processes.

        Raises:
            OutputFolderError: the folder or its lock is a link.
            DeepAccidentError: of the kind `error`, for any OSError: the folder cannot be made or written to, its file
                system has no locks, the disk is full.
        """
        turn = Turn(self)
        try:
            turn.join(begin)
            yield turn
        except DeepAccidentError:
            raise
        except OSError as error:
            remedy = "make room there, or choose another folder, and run it again"
            raise self.error(f"{self.out}: cannot be written ({error}); {remedy}") from error
        finally:
            turn.end()

    def run(self, work: Callable[[Item], Result], items: Mapping[str, Item], **how: Any) -> dict[str, Result]:
        """Apply `work` to every item that no other process has at hand; then to those, once they have been let go.

        Args:
            work: an importable function, or an object that can be pickled. It has the item alone, and looks first
                whether its result is there.
            items: name → item; names are paths.
            **how: of `run_batch`: `workers`, `executor`, `label`, `progress`, `places`.

        Returns:
            Name → result, in the order of the items.

        Raises:
            SomeFailedError: some items failed, as `Tried` has it; the others are done.
            OSError: an item cannot be locked, or its result cannot be written.
            ChoiceError, WorkerError: as of `run_batch`.
        """
        results: dict[str, Result | Failure | _AtHand] = {}
        left = list(items.items())
        for wait in (False, True):
            if wait and left:
                say_waiting(self.out, self.task)
            done = run_batch(Tried(_Alone(self, work, wait=wait)), left, **how) if left else []
            results |= {name: result for (name, _), result in zip(left, done, strict=True)}
            left = [each for each in left if isinstance(results[each[0]], _AtHand)]
        check_failures(results.items(), str(self.out))
        return {name: each for name, each in results.items() if not isinstance(each, Failure | _AtHand)}

    def lock_path(self, name: str) -> Path:
        """The lock of an item; raises OutputFolderError if a link leads there."""
        return place_in(self.folder, f"locks/{name}", opened=True)


class Turn:
    """The part of one process in the work on a store: first beside others, at the end alone."""

    def __init__(self, store: Store) -> None:
        """Hold nothing yet."""
        self._store = store
        self._file = -1

    def join(self, begin: Callable[[], object]) -> None:
        """Take the lock together with others; as of `Store.shared`."""
        import fcntl

        while True:
            self.end()
            self._file = _opened(self._path)
            with suppress(BlockingIOError):
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if self._is_there():
                    begin()
                fcntl.flock(self._file, fcntl.LOCK_UN)
            self._take(fcntl.LOCK_SH)
            if self._is_there():  # else another process has finished just now
                return

    def alone(self) -> bool:
        """Wait until no other process takes part; whether the store is there still, so that nobody has finished."""
        import fcntl

        fcntl.flock(self._file, fcntl.LOCK_UN)  # NFS: two that hold it together would wait for each other
        self._take(fcntl.LOCK_EX)
        return self._is_there()

    def end(self) -> None:
        """Give the lock back, if it is held."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    @property
    def _path(self) -> Path:
        return place_in(self._store.folder, _LOCK, opened=True)

    def _take(self, kind: int) -> None:
        import fcntl

        try:
            fcntl.flock(self._file, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            say_waiting(self._store.out, self._store.task)
            fcntl.flock(self._file, kind)

    def _is_there(self) -> bool:
        """Whether the lock that is held is the one that others find by its name."""
        try:
            found, held = os.stat(self._path, follow_symlinks=False), os.fstat(self._file)  # noqa: PTH116
        except OSError:
            return False
        return (found.st_dev, found.st_ino) == (held.st_dev, held.st_ino)


@dataclass(frozen=True, slots=True)
class _AtHand:
    """In place of a result: another process has the item."""


@dataclass(frozen=True, slots=True)
class _Alone(Generic[Item, Result]):
    """Work on an item whose lock is held; cheap to pickle."""

    store: Store
    work: Callable[[Item], Result]
    wait: bool

    def __call__(self, named: tuple[str, Item]) -> Result | _AtHand:
        import fcntl

        name, item = named
        file = _opened(self.store.lock_path(name))
        try:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | (0 if self.wait else fcntl.LOCK_NB))
            except BlockingIOError:
                return _AtHand()
            return self.work(item)
        finally:
            os.close(file)


def unfinished_folder(out: Path) -> Path:
    """The folder beside `out` for what is not finished; raises OutputFolderError if it is a link."""
    place = out.absolute()
    return place_in(place.parent, f"{place.name}.unfinished", opened=True)


def _opened(lock: Path) -> int:
    """The file of a lock, which is made where it is not there; its folder too."""
    while True:
        lock.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # another process has just removed the folder
            return os.open(lock, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


def _seal(key: str, content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=_SEAL, key=hashlib.blake2b(key.encode()).digest()).digest()
