"""One result an item of bulk work, such as a scenario: made once, by whichever process comes to it first.

Processes, also on several hosts, that are given the same command and the same folder share its items. Each makes what
nobody else is making; one that finds no such item waits for the others; then one of them after the other has the folder
alone. The first writes what spans the items; the others see that it is there. Another command waits for its turn.

The folder is the devkit's own, and hidden from whoever uses what is made:

    .lock         held together by all that take part, and by one alone before that; says for which command
    .making       held together while items are made, and by one alone after that
    locks/NAME    held while an item is made
    kept/NAME     a result: its bytes, and a seal of these and of a key, which says what it was made from

Locks are `flock`, which network file systems pass on (docs/clusters.md). The system takes them back from a process that
ends, however it ends. Where a file system has none, or does not answer, this process goes on as if it were the only
one, and says so once. A result is written under a temporary name and renamed: it is whole or not there.
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
# Bytes after a result.
_SEAL: Final = 16
_LOCKS: Final = (".lock", ".making")
# How long a file system may take to say whether a lock is free.
_ANSWER_SECONDS: Final = 30.0
# How long another process may hold a lock: a scenario, or the whole work of another command.
_WAIT_HOURS: Final = 24
# Devices of the file systems that have no locks, as this process has found.
_without_locks: Final = set[int]()


@dataclass(frozen=True, slots=True)
class Store:
    """The folder of the results of some bulk work; cheap to pickle.

    Attributes:
        folder: it need not exist. The caller has checked that no link leads there; below it none is followed.
        out: the place of what is made, for messages.
        task: what those who hold its lock do, such as `writes labels`, for who waits for them.
        error: raised if something cannot be written.
        command: a digest of what is made. Only those who make the same share the folder.
    """

    folder: Path
    out: Path
    task: str
    error: type[DeepAccidentError]
    command: str = ""

    def path(self, name: str) -> Path:
        """Where the result of an item lies; raises OutputFolderError if a link leads there, or it is one."""
        return place_in(self.folder, f"kept/{name}", opened=True)

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
            content = read_bytes(self.path(name), kind)
        except OSError:
            return None
        return content[:-_SEAL] if content[-_SEAL:] == _seal(key, content[:-_SEAL]) else None

    def keep(self, name: str, key: str, content: bytes) -> None:
        """Keep a result in place of an earlier one of this name; raises OSError or OutputFolderError."""
        write_own(self.path(name), content + _seal(key, content))

    def drop(self, name: str) -> None:
        """Remove a result, if it is there; raises OSError or OutputFolderError."""
        remove_in(self.folder, f"kept/{name}")

    def remove(self, *, keep: bool = False) -> None:
        """Remove all of it, or all but results, once the whole is written; who waits for its locks sees that.

        Raises:
            OSError, OutputFolderError: something cannot be removed, or there is a link on the way.
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
        """Take part in the work on the items, together with others, while the block runs.

        Args:
            begin: called before that, if nobody else takes part.
            tidy: removes what killed processes left; called before `begin`, and after an error, if nobody else makes
                items.

        Raises:
            OutputFolderError: the folder or its lock is a link.
            DeepAccidentError: of the kind `error`, for any OSError: the folder cannot be made or written to, the disk
                is full; or another process holds the lock too long.
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
                turn.tidy()
            finally:
                turn.end()

    def run(
        self, work: Callable[[_Item], _Result], items: Mapping[str, _Item], **how: Any
    ) -> dict[str, _Result]:
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
        results: dict[str, _Result | Failure | _AtHand] = {}
        left = list(items.items())
        for wait in (False, True):
            if wait and left:
                self.say_waiting()
            done = run_batch(Tried(_Alone(self, work, wait=wait)), left, **how) if left else []
            results |= {name: result for (name, _), result in zip(left, done, strict=True)}
            left = [each for each in left if isinstance(results[each[0]], _AtHand)]
        check_failures(results.items(), str(self.out))
        return {
            name: each for name, each in results.items() if not isinstance(each, Failure | _AtHand)
        }

    def take(self, file: int, kind: int, *, wait: bool = False) -> bool:
        """Take the lock of an open file; false if another process holds it and this one does not wait.

        Raises DeepAccidentError, of the kind `error`, if another process holds it too long.
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
            f"{self.out}: its file system has no locks that work ({fault}), so this goes on as if no other process "
            "wrote there; do not run a command twice at once on this folder"
        )
        return True

    def say_waiting(self) -> None:
        """Say once that this process waits for another one, and for how long at most."""
        warn_once(
            f"{self.out}: another process {self.task} there; waiting for it, for at most {_WAIT_HOURS} hours"
        )

    def lock_path(self, name: str) -> Path:
        """The lock of an item; raises OutputFolderError if a link leads there."""
        return place_in(self.folder, f"locks/{name}", opened=True)


class _Turn:
    """The part of one process in the work on a store: first beside others, at the end alone."""

    def __init__(self, store: Store) -> None:
        """Hold nothing yet."""
        self._store = store
        self._lock = self._making = -1

    def join(self, begin: Callable[[], object]) -> None:
        """Take part together with others who make the same; as of `Store.shared`."""
        import fcntl

        command, others = self._store.command.encode(), False
        while True:
            self.end()
            self._lock, self._making = (
                _opened(place_in(self._store.folder, name, opened=True)) for name in _LOCKS
            )
            take = self._store.take
            if take(self._lock, fcntl.LOCK_EX, wait=others) and self._is_there():
                begin()
                os.ftruncate(self._lock, 0)
                if os.pwrite(self._lock, command, 0) < len(command):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            take(self._lock, fcntl.LOCK_UN)
            take(self._lock, fcntl.LOCK_SH, wait=True)
            others = os.pread(self._lock, len(command) + 1, 0) != command
            if not others and take(self._making, fcntl.LOCK_SH, wait=True) and self._is_there():
                return  # else another process has finished just now, or makes something else

    def alone(self, *, wait: bool = True) -> bool:
        """Wait until no other process makes items; no, if one of them has finished meanwhile and removed the store.

        If this process does not wait, and others make items, the answer is no too.
        """
        import fcntl

        if self._making < 0:  # it could not join
            return False
        self._store.take(
            self._making, fcntl.LOCK_UN
        )  # NFS: two that hold it together would wait for each other
        return self._store.take(self._making, fcntl.LOCK_EX, wait=wait) and self._is_there()

    def tidy(self) -> None:
        """Remove the store if nothing is kept and nobody makes items, nor a worker whose caller was stopped."""
        folder = self._store.folder
        with suppress(OSError):
            if not self.alone(wait=False) or any(folder.glob("kept/*")):
                return
            locks = folder / "locks"
            held = _Alone(self._store, str, wait=False)
            names = [str(path.relative_to(locks)) for path in locks.glob("**/*") if path.is_file()]
            if not any(isinstance(held((name, "")), _AtHand) for name in names):
                self._store.remove()

    def end(self) -> None:
        """Give the locks back that are held."""
        for file in (self._making, self._lock):
            if file >= 0:
                os.close(file)
        self._lock = self._making = -1

    def _is_there(self) -> bool:
        """Whether the locks that are open are those that others find by their names."""
        opened = zip(_LOCKS, (self._lock, self._making), strict=True)
        try:
            return all(
                os.path.samestat((self._store.folder / name).lstat(), os.fstat(file))
                for name, file in opened
            )
        except OSError:
            return False


@dataclass(frozen=True, slots=True)
class _AtHand:
    """In place of a result: another process has the item."""


@dataclass(frozen=True, slots=True)
class _Alone(Generic[_Item, _Result]):
    """Work on an item whose lock is held; cheap to pickle."""

    store: Store
    work: Callable[[_Item], _Result]
    wait: bool

    def __call__(self, named: tuple[str, _Item]) -> _Result | _AtHand:
        import fcntl

        name, item = named
        file = _opened(self.store.lock_path(name))
        try:
            return (
                self.work(item)
                if self.store.take(file, fcntl.LOCK_EX, wait=self.wait)
                else _AtHand()
            )
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


def _fault_of_lock(file: int, kind: int, seconds: float) -> OSError | None:
    """Ask for the lock of an open file; None if it is taken, TimeoutError if there is no answer in so many seconds.

    The call is made in a thread of its own, since a file server that is gone may never answer it.
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
    return hashlib.blake2b(
        content, digest_size=_SEAL, key=hashlib.blake2b(key.encode()).digest()
    ).digest()
