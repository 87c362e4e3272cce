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
_SEAL_LENGTH = 16
_LOCKS = (".lock", ".making")
# How long a file system may take to answer whether a lock is free.
_ANSWER_SECONDS = 30.0
# How long another process may hold a lock: for a scenario, or for all work of another command.
_WAIT_HOURS = 24
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

    def read_result(self, name: str, key: str, kind: FileKind = "bundle") -> bytes | None:
        """Return a stored result; None if it is missing, damaged, or made from other inputs.

        Args:
            name: Name of the item, a path below the folder.
            key: Digest of all that decides the result, such as files and settings.
            kind: Kind of the file, which limits its size.

        Raises:
            OutputFolderError: If a link leads there.
        """
        try:
            content = read_bytes(self.path(name), kind)
        except OSError:
            return None
        result = content[:-_SEAL_LENGTH]
        seal = content[-_SEAL_LENGTH:]
        if seal == _make_seal(key, result):
            return result
        return None

    def write_result(self, name: str, key: str, content: bytes) -> None:
        """Store a result, replacing an earlier one; raise OSError or OutputFolderError."""
        sealed_content = content + _make_seal(key, content)
        write_own(self.path(name), sealed_content)

    def drop(self, name: str) -> None:
        """Remove a result, if it exists; raise OSError or OutputFolderError."""
        remove_in(self.folder, f"kept/{name}")

    def remove(self, *, keep: bool = False) -> None:
        """Remove the folder once the product is complete; with `keep`, all except the results.

        Processes that wait for its locks notice that.

        Raises:
            OSError, OutputFolderError: If something cannot be removed, or a link is on the way.
        """
        names = ["locks", *_LOCKS]
        if not keep:
            names.append("kept")
        for name in names:
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
            begin: Function that is called first if no other process takes part.
            tidy: Function that removes leftovers of killed processes; it is called before `begin`,
                and after an error, if no other process makes items.

        Raises:
            OutputFolderError: If the folder or its lock is a link.
            DeepAccidentError: `error`, if the folder cannot be made or written to, if the disk is
                full (or for any other OSError), or if another process holds the lock too long.
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
            remedy = "free space there, or choose another folder, and run the command again"
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

        The others are done once the processes that made them have released them.

        Args:
            work: Importable function, or an object that can be pickled. It gets only the item, and
                first checks whether its result exists.
            items: Name → item; names are paths.
            **engine: Arguments of `run_batch`: `workers`, `executor`, `label`, `progress`,
                `places`.

        Returns:
            Name → result, in the order of the items.

        Raises:
            SomeFailedError: If some items failed, as in `Tried`; the others are done.
            OSError: If an item cannot be locked, or its result cannot be written.
            ChoiceError, WorkerError: As in `run_batch`.
        """
        results: dict[str, _Result | Failure | _InProgress] = {}
        remaining = list(items.items())
        for wait in (False, True):
            if not remaining:
                break
            if wait:
                self.say_waiting()
            locked_work = _LockedWork(self, work, wait=wait)
            new_results = run_batch(Tried(locked_work), remaining, **engine)
            for (name, _), result in zip(remaining, new_results, strict=True):
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

        With `wait`, it waits for the other process. Raises `error` if the other process holds the
        lock too long.
        """
        import fcntl

        device = os.fstat(file).st_dev
        if device in _without_locks:
            return True
        fault = _request_lock(file, kind | fcntl.LOCK_NB, _ANSWER_SECONDS)
        if wait and isinstance(fault, BlockingIOError):
            self.say_waiting()
            fault = _request_lock(file, kind, _WAIT_HOURS * 3600)
            if isinstance(fault, TimeoutError):
                remedy = f"end that process, or, if no such process runs, remove {self.folder}"
                raise self.error(
                    f"{self.out}: another process has held a lock for {_WAIT_HOURS} hours; {remedy}"
                )
        if fault is None or isinstance(fault, BlockingIOError):
            return fault is None
        _without_locks.add(device)
        warn_once(
            f"{self.out}: file locks do not work on this file system ({fault}), so other processes "
            "that write there go unnoticed; do not run two commands on this folder at once"
        )
        return True

    def say_waiting(self) -> None:
        """Log once that this process waits for another one, and the longest time that it waits."""
        warn_once(
            f"{self.out}: another process {self.task} there; waiting for it for at most "
            f"{_WAIT_HOURS} hours"
        )

    def lock_path(self, name: str) -> Path:
        """Return the path of an item's lock; raise OutputFolderError if a link leads there."""
        return place_in(self.folder, f"locks/{name}", opened=True)


class _Turn:
    """The part of one process in the work on a store: first shared, at the end exclusive."""

    def __init__(self, store: Store) -> None:
        """Start without locks."""
        self._store = store
        # Descriptors of the two lock files; −1 if they are not open.
        self._lock = -1
        self._making = -1

    def join(self, begin: Callable[[], object]) -> None:
        """Take part together with other processes of the same command; see `Store.shared`."""
        import fcntl

        command = self._store.command.encode()
        has_other_command = False
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

        The result is False if another process has meanwhile finished and removed the store; without
        `wait`, also if other processes make items.
        """
        import fcntl

        if self._making < 0:  # it could not join
            return False
        # On NFS, two processes that share the lock would wait for each other.
        self._store.take(self._making, fcntl.LOCK_UN)
        return self._store.take(self._making, fcntl.LOCK_EX, wait=wait) and self._is_current()

    def remove_if_unused(self) -> None:
        """Remove the store if it has no results and no process makes items.

        A worker may still make items after its caller was stopped.
        """
        folder = self._store.folder
        with suppress(OSError):
            if not self.alone(wait=False) or any(folder.glob("kept/*")):
                return
            locks = folder / "locks"
            lock_attempt = _LockedWork(self._store, str, wait=False)
            names = [str(path.relative_to(locks)) for path in locks.glob("**/*") if path.is_file()]
            for name in names:
                if isinstance(lock_attempt((name, "")), _InProgress):
                    return
            self._store.remove()

    def end(self) -> None:
        """Release the locks that are held."""
        for file in (self._making, self._lock):
            if file >= 0:
                os.close(file)
        self._lock = -1
        self._making = -1

    def _is_current(self) -> bool:
        """Return whether the open locks are the ones that other processes find by their names."""
        try:
            for name, file in zip(_LOCKS, (self._lock, self._making), strict=True):
                named_status = (self._store.folder / name).lstat()
                if not os.path.samestat(named_status, os.fstat(file)):
                    return False
        except OSError:
            return False
        return True


@dataclass(frozen=True, slots=True)
class _InProgress:
    """A mark that takes the place of a result: another process is making the item."""


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
    """Open a lock file and return its descriptor; file and folder are made if necessary."""
    while True:
        lock.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # another process has just removed the folder
            return os.open(lock, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


def _request_lock(file: int, kind: int, seconds: float) -> OSError | None:
    """Request the lock of an open file; return None if it was taken, otherwise the error.

    The error is a TimeoutError if there is no answer within `seconds`. The call is made in a thread
    of its own, since a file server that has gone may never answer.
    """
    import fcntl

    fault: OSError | None = TimeoutError(f"no answer within {seconds:g} s")

    def lock_file() -> None:
        nonlocal fault
        try:
            fcntl.flock(file, kind)
            fault = None
        except OSError as error:
            fault = error

    thread = threading.Thread(target=lock_file, daemon=True)
    thread.start()
    thread.join(seconds)
    return fault


def _make_seal(key: str, content: bytes) -> bytes:
    """Return a keyed digest of a result's bytes."""
    key_digest = hashlib.blake2b(key.encode()).digest()
    seal = hashlib.blake2b(content, digest_size=_SEAL_LENGTH, key=key_digest)
    return seal.digest()
