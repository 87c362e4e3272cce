"""The one gate through which files are read: regular files, not larger than their kind may be, quoted in few words.

Who sends a file may send a pipe, a device, a bomb or a gigabyte in one line. The gate raises OSError alone; callers
turn it into their own error, which names the remedy.
"""

import errno
import hashlib
import os
import re
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO, Final, Literal, Protocol, TypeAlias

from deepaccident_devkit.errors import shortened

FileKind: TypeAlias = Literal[
    "label",
    "meta",
    "calib",
    "split",
    "image",
    "lidar",
    "bev",
    "index",
    "results",
    "bundle",
    "motion_labels",
    "spec",
    "archive",
    "weights",
]
_MIB: Final = 1 << 20
LIMITS: Final[Mapping[str, int]] = MappingProxyType(
    {
        "label": 48 * _MIB,
        "meta": _MIB,
        "calib": _MIB,
        "split": _MIB,
        "image": 32 * _MIB,
        "lidar": 32 * _MIB,
        "bev": 16 * _MIB,
        "index": 64 * _MIB,
        "results": 1024 * _MIB,
        "bundle": 64 * _MIB,
        "motion_labels": 256 * _MIB,
        "spec": _MIB,
        "archive": 512 * _MIB,
        "weights": 4096 * _MIB,
    }
)
"""Kind of file → bytes that may be read of it at once, and that may be decoded from it at once.

The release and the devkit write far less. The index's tables have no limit: they are mapped, and not read at once.
"""
LIMITS_VARIABLE: Final = "DEEPACCIDENT_LIMITS"
"""The environment variable that changes limits, here and in worker processes: `label=200M lidar=1G`."""
_LIMIT: Final = re.compile(r"([a-z_]+)=(\w+)", re.ASCII)
_SIZE: Final = re.compile(r"([1-9][0-9]{0,11})([KMGT]?)")
_FACTORS: Final = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
_FLAGS: Final = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0)  # no waiting for a pipe


class StoredFile(Protocol):
    """A file that is no file of the system (`release.store`)."""

    def content(self, kind: FileKind) -> bytes:
        """Its bytes; raises OSError as `read_bytes` does."""


_observer: ContextVar[Callable[[Path | StoredFile, bytes], None] | None] = ContextVar("observer", default=None)


NO_NAME: Final = "cannot be a file's name: it holds a NUL character, or half of a pair that stands for one character"


class RefusedFileError(OSError):
    """A file that the gate does not let in; its `strerror` is a clause without the path."""


def limit_of(kind: FileKind) -> int:
    """Bytes that a file of a kind, or what is decoded from it, may have.

    Raises:
        RefusedFileError: `DEEPACCIDENT_LIMITS` cannot be understood.
    """
    changed = os.environ.get(LIMITS_VARIABLE)
    return LIMITS[kind] if not changed else _changed_limits(changed).get(kind, LIMITS[kind])


def bytes_of(text: str) -> int | None:
    """The number that a size in the environment stands for, such as `200M`; None if it cannot be understood."""
    found = _SIZE.fullmatch(text)
    return None if found is None else int(found[1]) * _FACTORS[found[2]]


def read_bytes(path: Path | StoredFile, kind: FileKind) -> bytes:
    """A file's bytes. Plain system calls: `open` would double the time of a small file.

    Args:
        path: a real path, or a file in a store, which reads itself.
        kind: of the file.

    Raises:
        FileNotFoundError: there is no such file.
        RefusedFileError: it is no regular file, or too large for its kind.
        OSError: it cannot be read.
    """
    content = _read(path, kind) if isinstance(path, Path) else path.content(kind)
    if (observer := _observer.get()) is not None:
        observer(path, content)
    return content


def _read(path: Path, kind: FileKind) -> bytes:
    descriptor, size = _opened(path)
    try:
        check_size(size, kind)
        content = os.read(descriptor, size)
        if len(content) < size or os.read(descriptor, 1):  # a file that grows, or does not know its size
            with os.fdopen(os.dup(descriptor), "rb") as file:
                file.seek(0)
                content = file.read(limit_of(kind) + 1)
            check_size(len(content), kind)
    finally:
        os.close(descriptor)
    return content


@contextmanager
def observed(observer: Callable[[Path | StoredFile, bytes], None]) -> Iterator[None]:
    """Show `observer` the path and the bytes of every file that `read_bytes` reads in the block, in this thread.

    So checksums are taken of just the bytes that something was made from, without a second reading.
    """
    token = _observer.set(observer)
    try:
        yield
    finally:
        _observer.reset(token)


def open_file(path: Path) -> BinaryIO:
    """A file of any size, opened for readers that take it in bounded parts (`open_zip`).

    Raises:
        FileNotFoundError: there is no such file.
        RefusedFileError: it is no regular file.
        OSError: it cannot be read.
    """
    descriptor, _ = _opened(path)
    return os.fdopen(descriptor, "rb")


def file_checksum(path: Path) -> str:
    """A checksum of a file's bytes; 1.8 GB of tables take 2 s. Raises as `open_file` does."""
    checksum = hashlib.blake2b(digest_size=16)
    with open_file(path) as file:
        while block := file.read(_MIB):
            checksum.update(block)
    return checksum.hexdigest()


def check_size(size: int, kind: FileKind, what: str = "") -> None:
    """Refuse what would be larger than its kind may be.

    Args:
        size: bytes.
        kind: of the file.
        what: what has this size, in words, such as `its array`; empty for the file itself.

    Raises:
        RefusedFileError: `size` is above the limit.
    """
    if size > (limit := limit_of(kind)):
        head = f"{what} takes" if what else "has"
        more = f"more than {limit:,}, the limit for {kind}; if the file is sound, set {LIMITS_VARIABLE}={kind}"
        raise RefusedFileError(errno.EFBIG, f"{head} {size:,} bytes, {more}={-(-size // _MIB)}M")


def irregular_text(mode: int) -> str | None:
    """What is in a file's place, by the mode that `stat` gives: `not a regular file (a named pipe)`; else None.

    Opening a pipe waits for its writer, and a device may have no end.
    """
    if stat.S_ISREG(mode):
        return None
    kind = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket"}.get(stat.S_IFMT(mode))
    return f"not a regular file ({kind or 'a device'})"


def fault_text(error: Exception) -> str:
    """What an error says, as a clause without the path: `cannot be read (Permission denied)`."""
    if not isinstance(error, OSError):
        return str(error) or type(error).__name__
    said = error.strerror or str(error)
    return said if isinstance(error, RefusedFileError) else f"cannot be read ({said})"


def _opened(path: Path) -> tuple[int, int]:
    """The descriptor of a regular file, and its size; raises OSError."""
    try:
        descriptor = os.open(path, _FLAGS)
    except ValueError:  # what Python says of it depends on its version
        raise RefusedFileError(errno.EINVAL, NO_NAME) from None
    try:
        status = os.fstat(descriptor)
        if (irregular := irregular_text(status.st_mode)) is not None:
            raise RefusedFileError(errno.EINVAL, irregular)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor, status.st_size


@lru_cache(maxsize=8)
def _changed_limits(text: str) -> Mapping[str, int]:
    """The limits that the environment variable changes."""
    limits = {}
    for word in text.replace(",", " ").split():
        found = _LIMIT.fullmatch(word)
        size = None if found is None else bytes_of(found[2])
        if found is None or size is None or found[1] not in LIMITS:
            known = ", ".join(LIMITS)
            said = f"{LIMITS_VARIABLE}: expected <kind>=<bytes> with K, M or G, such as label=200M, of {known}; found"
            raise RefusedFileError(errno.EINVAL, f"{said} {shortened(word)!r}")
        limits[found[1]] = size
    return limits
