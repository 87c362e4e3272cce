"""One result for each item of bulk work, made once by the first process to reach it.

Items are scenarios, for example. Processes, also on several hosts, that run the same command with
the same folder share its items. Each makes items that nobody else is making; one without such an
item waits for the others; then one of them after the other has the folder exclusively. The first
writes what spans the items; the others see that it exists. Another command waits for its turn.

The folder belongs to the devkit, and is hidden from users of the results:

    .lock         shared by all that take part, exclusive before that; names the command
    .making       shared while items are made, exclusive after that
    locks/NAME    held while an item is made
    kept/NAME     a result: its bytes, and a seal of these and of a key of its inputs

Locks are `flock`, which network file systems pass on (docs/clusters.md). The system releases them
when a process ends, however it ends. Where a file system has none, or does not answer, this process
goes on as if it were the only one, and logs this once. A result is written under a temporary name
and renamed: it is complete or missing.
"""

from __future__ import annotations

import errno
import hashlib
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from deepaccident_devkit.errors import DeepAccidentError
from deepaccident_devkit.support.files import place_in, remove_in, write_own
from deepaccident_devkit.support.parallel.batches import run_batch
from deepaccident_devkit.support.parallel.failures import Failure, Tried, check_failures
from deepaccident_devkit.support.reading import FileKind, read_bytes
from deepaccident_devkit.support.text import warn_once

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
# Number of bytes of the seal after a result.
_SEAL_LENGTH: Final = 16
_LOCKS: Final = (".lock", ".making")
# How long a file system may take to answer whether a lock is free.
_ANSWER_SECONDS: Final = 30.0
# How long another process may hold a lock: for a scenario, or for all work of another command.
_WAIT_HOURS: Final = 24
# Devices of the file systems without locks, as far as this process knows.
_without_locks: Final = set[int]()


@dataclass(frozen=True, slots=True)
class Store:
    """The folder of the results of some bulk work; cheap to pickle.

    Attributes:
        folder: Folder, which need not exist. The caller has checked that no link leads there; below
            it none is followed.
        out: Path of the product, for messages.
        task: What a holder of its lock does, such as `writes labels`, for waiting processes.
        error: Error to raise if something cannot be written.
        command: Digest of the product. Only processes with the same command share the folder.
    """

    folder: Path
    out: Path
    task: str
    error: type[DeepAccidentError]
    command: str = ""

    def path(self, name: str) -> Path:
        """Return the path of an item's result; raise OutputFolderError for links."""
        return place_in(self.folder, f"kept/{name}", opened=True)

    def kept(self, name: str, key: str, kind: FileKind = "bundle") -> bytes | None:
        """Return a result; None if it is missing, damaged, or made from other inputs.

        Args:
            name: Name of the item; a path below the folder.
            key: Digest of all that decides the result, such as files and settings.
            kind: Kind of the file, which limits its size.

        Raises:
            OutputFolderError: A link leads there.
        """
        try:
            content = read_bytes(self.path(name), kind)
        except OSError:
            return None
        result, seal = content[:-_SEAL_LENGTH], content[-_SEAL_LENGTH:]
        if seal == _seal(key, result):
            return result
        return None

    def keep(self, name: str, key: str, content: bytes) -> None:
        """Store a result over an earlier one of this name; raise OSError or OutputFolderError."""
        write_own(self.path(name), content + _seal(key, content))

    def drop(self, name: str) -> None:
        """Remove a result, if it exists; raise OSError or OutputFolderError."""
        remove_in(self.folder, f"kept/{name}")

    def remove(self, *, keep: bool = False) -> None:
        """Remove the folder, or all except results, once the product is complete.

        Processes that wait for its locks notice that.

        Raises:
            OSError, OutputFolderError: Something cannot be removed, or there is a link on the way.
        """
        for name in ("locks", *_LOCKS, *(() if keep else ("kept",))):
            remove_in(self.folder, name)
        with suppress(OSError):  # something else is there, or another process has begun again
            self.folder.rmdir()

    @contextmanager
    def shared(
        self,
        begin: Callable[[], object] = lambda: None,
        *,
        tidy: Callable[[], object] = lambda: None,
    ) -> Iterator[_Turn]:
        """Take part in the work on the items, together with other processes, during the block.

        Args:
            begin: Function called before that, if nobody else takes part.
            tidy: Function that removes leftovers of killed processes; called before `begin`, and
                after an error, if nobody else makes items.

        Raises:
            OutputFolderError: The folder or its lock is a link.
            DeepAccidentError: The error `error`, for any OSError: the folder cannot be made or
                written to, the disk is full; or another process holds the lock too long.
        """
        turn = _Turn(self)
        try:
            turn.join(lambda: (tidy(), begin()))
            yield turn
        except BaseException as error:
            with suppress(OSError):
                if turn.alone(wait=False):
                    tidy()
            if isinstance(error, DeepAccidentError) or not isinstance(error, OSError):
                raise
            remedy = "make room there, or choose another folder, and run it again"
            raise self.error(f"{self.out}: cannot be written ({error}); {remedy}") from error
        finally:
            try:
                turn.remove_if_unused()
            finally:
                turn.end()

    def run(
        self, work: Callable[[_Item], _Result], items: Mapping[str, _Item], **engine: Any
    ) -> dict[str, _Result]:
        """Apply `work` to every item that no other process is making, and then to the others.

        The others are done once they have been released.

        Args:
            work: Importable function, or an object that can be pickled. It only gets the item, and
                first checks whether its result exists.
            items: Name → item; names are paths.
            **engine: Arguments of `run_batch`: `workers`, `executor`, `label`, `progress`,
                `places`.

        Returns:
            Name → result, in the order of the items.

        Raises:
            SomeFailedError: Some items failed, as in `Tried`; the others are done.
            OSError: An item cannot be locked, or its result cannot be written.
            ChoiceError, WorkerError: See `run_batch`.
        """
        results: dict[str, _Result | Failure | _InProgress] = {}
        remaining = list(items.items())
        for wait in (False, True):
            if not remaining:
                break
            if wait:
                self.say_waiting()
            locked_work = _LockedWork(self, work, wait=wait)
            done = run_batch(Tried(locked_work), remaining, **engine)
            for (name, _), result in zip(remaining, done, strict=True):
                results[name] = result
            remaining = [item for item in remaining if isinstance(results[item[0]], _InProgress)]
        check_failures(results.items(), str(self.out))
        return {
            name: result
            for name, result in results.items()
            if not isinstance(result, Failure | _InProgress)
        }

    def take(self, file: int, kind: int, *, wait: bool = False) -> bool:
        """Take the lock of an open file; return False if another process holds it.

        If `wait`, it waits for the other process. Raises DeepAccidentError, of the kind `error`, if
        another process holds it too long.
        """
        import fcntl

        device = os.fstat(file).st_dev
        if device in _without_locks:
            return True
        fault = _fault_of_lock(file, kind | fcntl.LOCK_NB, _ANSWER_SECONDS)
        if wait and isinstance(fault, BlockingIOError):
            self.say_waiting()
            fault = _fault_of_lock(file, kind, _WAIT_HOURS * 3600)
            if isinstance(fault, TimeoutError):
                remedy = f"end it, or if there is none any more, remove {self.folder}"
                raise self.error(
                    f"{self.out}: another process has held a lock for {_WAIT_HOURS} hours; {remedy}"
                )
        if fault is None or isinstance(fault, BlockingIOError):
            return fault is None
        _without_locks.add(device)
        warn_once(
            f"{self.out}: its file system has no locks that work ({fault}), so this goes on as if "
            "no other process wrote there; do not run a command twice at once on this folder"
        )
        return True

    def say_waiting(self) -> None:
        """Log once that this process waits for another one, and for how long at most."""
        warn_once(
            f"{self.out}: another process {self.task} there; waiting for it, for at most "
            f"{_WAIT_HOURS} hours"
        )

    def lock_path(self, name: str) -> Path:
        """Return the path of an item's lock; raise OutputFolderError if a link leads there."""
        return place_in(self.folder, f"locks/{name}", opened=True)


class _Turn:
    """One process's part in the work on a store: first shared, at the end exclusive."""

    def __init__(self, store: Store) -> None:
        """Start without locks."""
        self._store = store
        self._lock = self._making = -1

    def join(self, begin: Callable[[], object]) -> None:
        """Take part together with other processes of the same command; see `Store.shared`."""
        import fcntl

        command, has_other_command = self._store.command.encode(), False
        while True:
            self.end()
            self._lock, self._making = (
                _open_lock(place_in(self._store.folder, name, opened=True)) for name in _LOCKS
            )
            take = self._store.take
            if take(self._lock, fcntl.LOCK_EX, wait=has_other_command) and self._is_current():
                begin()
                os.ftruncate(self._lock, 0)
                if os.pwrite(self._lock, command, 0) < len(command):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            take(self._lock, fcntl.LOCK_UN)
            take(self._lock, fcntl.LOCK_SH, wait=True)
            has_other_command = os.pread(self._lock, len(command) + 1, 0) != command
            if (
                not has_other_command
                and take(self._making, fcntl.LOCK_SH, wait=True)
                and self._is_current()
            ):
                return  # otherwise another process has just finished, or makes something else

    def alone(self, *, wait: bool = True) -> bool:
        """Wait until no other process makes items; return whether this process has the store.

        False if one of the others has finished meanwhile and removed the store. Without `wait` it
        is also False if others make items.
        """
        import fcntl

        if self._making < 0:  # it could not join
            return False
        # On NFS, two processes that share the lock would wait for each other.
        self._store.take(self._making, fcntl.LOCK_UN)
        return self._store.take(self._making, fcntl.LOCK_EX, wait=wait) and self._is_current()

    def remove_if_unused(self) -> None:
        """Remove the store if it has no results and nobody makes items.

        A worker may still make items after its caller was stopped.
        """
        folder = self._store.folder
        with suppress(OSError):
            if not self.alone(wait=False) or any(folder.glob("kept/*")):
                return
            locks = folder / "locks"
            lock_attempt = _LockedWork(self._store, str, wait=False)
            names = [str(path.relative_to(locks)) for path in locks.glob("**/*") if path.is_file()]
            if not any(isinstance(lock_attempt((name, "")), _InProgress) for name in names):
                self._store.remove()

    def end(self) -> None:
        """Release the locks that are held."""
        for file in (self._making, self._lock):
            if file >= 0:
                os.close(file)
        self._lock = self._making = -1

    def _is_current(self) -> bool:
        """Return whether the open locks are the ones that others find by their names."""
        opened = zip(_LOCKS, (self._lock, self._making), strict=True)
        try:
            return all(
                os.path.samestat((self._store.folder / name).lstat(), os.fstat(file))
                for name, file in opened
            )
        except OSError:
            return False


@dataclass(frozen=True, slots=True)
class _InProgress:
    """A mark instead of a result: another process is making the item."""


@dataclass(frozen=True, slots=True)
class _LockedWork(Generic[_Item, _Result]):
    """Work on an item under its lock; cheap to pickle."""

    store: Store
    work: Callable[[_Item], _Result]
    wait: bool

    def __call__(self, named_item: tuple[str, _Item]) -> _Result | _InProgress:
        import fcntl

        name, item = named_item
        file = _open_lock(self.store.lock_path(name))
        try:
            if self.store.take(file, fcntl.LOCK_EX, wait=self.wait):
                return self.work(item)
            return _InProgress()
        finally:
            os.close(file)


def unfinished_folder(out: Path) -> Path:
    """Return the folder beside `out` for unfinished work; raise OutputFolderError for a link."""
    path = out.absolute()
    return place_in(path.parent, f"{path.name}.unfinished", opened=True)


def _open_lock(lock: Path) -> int:
    """Open the file of a lock, which is made if necessary, with its folder."""
    while True:
        lock.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # another process has just removed the folder
            return os.open(lock, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


def _fault_of_lock(file: int, kind: int, seconds: float) -> OSError | None:
    """Request the lock of an open file; return None if it is taken, otherwise the error.

    It is TimeoutError if there is no answer within some seconds. The call is made in a thread of
    its own, since a file server that has gone may never answer it.
    """
    import fcntl

    fault: OSError | None = TimeoutError(f"no answer within {seconds:g} s")

    def ask() -> None:
        nonlocal fault
        try:
            fcntl.flock(file, kind)
            fault = None
        except OSError as error:
            fault = error

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(seconds)
    return fault


def _seal(key: str, content: bytes) -> bytes:
    key_digest = hashlib.blake2b(key.encode()).digest()
    return hashlib.blake2b(content, digest_size=_SEAL_LENGTH, key=key_digest).digest()
