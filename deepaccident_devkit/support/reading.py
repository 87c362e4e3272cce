"""The one way in which files are read: only regular files, within the size limit of their kind.

Whoever sends a file may send a pipe, a device, a bomb or a gigabyte in one line. This module only
raises OSError; callers turn it into their own error, which names the remedy. Zip archives, and
arrays in them, are checked before anything large is made, and compared with their checksums.
"""

import errno
import hashlib
import io
import math
import os
import re
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO, Final, Literal, Protocol, TypeAlias

import numpy as np

from deepaccident_devkit.errors import shortened
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.text import warn_once

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
    "tables",
]
NO_NAME: Final = (
    "cannot be a file's name: it holds a NUL character, or half of a pair that stands for one "
    "character"
)
_MIB: Final = 1 << 20
BYTE_LIMITS: Final[Mapping[str, int]] = MappingProxyType(
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
        "tables": 4096 * _MIB,
    }
)
"""Kind of file → bytes that may be read from it at once, and that may be decoded from it at once.

The release and the devkit write far less. The index's tables have no limit: they are mapped, and
not read at once.
"""
# Environment variable that changes limits, here and in worker processes: `label=200M lidar=1G`.
LIMITS_VARIABLE: Final = "DEEPACCIDENT_LIMITS"
_LIMIT: Final = re.compile(r"([a-z_]+)=(\w+)", re.ASCII)
_SIZE: Final = re.compile(r"([1-9][0-9]{0,11})([KMGT]?)")
_FACTORS: Final = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
# Opening does not wait for the writer of a pipe.
_OPEN_FLAGS: Final = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0)
# First bytes of a member of an archive, of the end of an archive, of the end of a large one, and of
# the locator of that end.
_MEMBER, _END, _LARGE_END, _LOCATOR = b"PK\x03\x04", b"PK\x05\x06", b"PK\x06\x06", b"PK\x06\x07"
# Number of bytes that identify a web page.
_BEGINNING_LENGTH: Final = 256
_END_LENGTH, _LARGE_END_LENGTH, _LOCATOR_LENGTH = 22, 56, 20
# Largest number of bytes of an archive's end, which has a comment at last.
_MAX_END_LENGTH: Final = _LARGE_END_LENGTH + _LOCATOR_LENGTH + _END_LENGTH + (1 << 16) - 1
# Largest number of bytes of the directory of a results file or a bundle.
_MAX_DIRECTORY_LENGTH: Final = 4 << 20
_HEADER_READERS: Final = {(1, 0): "read_array_header_1_0", (2, 0): "read_array_header_2_0"}
# Errors of reading a damaged archive, or an array in it.
DAMAGED_ARCHIVE: Final = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    MemoryError,
    OverflowError,
    RuntimeError,
    SyntaxError,  # a damaged array header
    NotImplementedError,  # an unknown version
    UnicodeError,
    struct.error,  # a directory of the archive that ends early
    tokenize.TokenError,  # an array header with an open bracket
    zipfile.BadZipFile,
    zlib.error,
)


class StoredFile(Protocol):
    """A file that is no file of the system (`release.store`)."""

    def content(self, kind: FileKind) -> bytes:
        """Return its bytes; raise OSError as `read_bytes` does."""


_observer: ContextVar[Callable[[Path | StoredFile, bytes], None] | None] = ContextVar(
    "observer", default=None
)


class RefusedFileError(OSError):
    """A file that is not read; its `strerror` is a clause without the path."""


def byte_limit(kind: FileKind) -> int:
    """Return the limit of bytes of a kind of file, also when decoded; raise RefusedFileError."""
    setting = os.environ.get(LIMITS_VARIABLE)
    if not setting:
        return BYTE_LIMITS[kind]
    return _changed_limits(setting).get(kind, BYTE_LIMITS[kind])


def bytes_of(text: str) -> int | None:
    """Return the number of bytes of a size in the environment, such as `200M`; None if invalid."""
    match = _SIZE.fullmatch(text)
    if match is None:
        return None
    return int(match[1]) * _FACTORS[match[2]]


def read_bytes(path: Path | StoredFile, kind: FileKind) -> bytes:
    """Return the bytes of a file, or of one in a store, which reads itself.

    It uses plain system calls, since `open` would double the time. Raises FileNotFoundError,
    RefusedFileError (no regular file, or too large for its kind), or another OSError.
    """
    content = _read(path, kind) if isinstance(path, Path) else path.content(kind)
    observer = _observer.get()
    if observer is not None:
        observer(path, content)
    return content


def _read(path: Path, kind: FileKind) -> bytes:
    descriptor, size = _open_regular(path)
    try:
        check_size(size, kind)
        content = os.read(descriptor, size)
        # A file may grow, or not know its size.
        if len(content) < size or os.read(descriptor, 1):
            with os.fdopen(os.dup(descriptor), "rb") as file:
                file.seek(0)
                content = file.read(byte_limit(kind) + 1)
            check_size(len(content), kind)
    finally:
        os.close(descriptor)
    return content


@contextmanager
def observed(observer: Callable[[Path | StoredFile, bytes], None]) -> Iterator[None]:
    """Pass the path and the bytes of every file that `read_bytes` reads to `observer`.

    This holds in the block, in this thread. So checksums cover exactly the bytes that something was
    made from, without a second reading.
    """
    token = _observer.set(observer)
    try:
        yield
    finally:
        _observer.reset(token)


def open_file(path: Path) -> BinaryIO:
    """Open a regular file of any size, to read bounded parts of it; raise as `read_bytes`."""
    descriptor, _ = _open_regular(path)
    return os.fdopen(descriptor, "rb")


def mapped_file(path: Path) -> Any:
    """Map a regular file of any size into memory, as a `pyarrow.Buffer`; raise as `open_file`.

    Some file systems cannot map files: then it is read, which is logged once for a folder.
    """
    import pyarrow as pa

    with open_file(path) as file:
        try:
            return pa.memory_map(str(path)).read_buffer()
        except OSError as error:
            if os.strerror(errno.ENOMEM) in str(error):
                raise  # there is no room to read it either
        warn_once(
            f"{path.parent}: files cannot be mapped into memory there, so they are read as a "
            "whole; another folder, for an index by --index-dir, needs less memory"
        )
        return pa.py_buffer(file.read())


def file_checksum(path: Path) -> str:
    """Return a checksum of a file's bytes; 1.8 GB of tables take 2 s. Raise as `open_file` does."""
    checksum = hashlib.blake2b(digest_size=16)
    with open_file(path) as file:
        while block := file.read(_MIB):
            checksum.update(block)
    return checksum.hexdigest()


def check_size(size: int, kind: FileKind, subject: str = "") -> None:
    """Raise RefusedFileError for too many bytes of a kind; `subject` is empty for the file."""
    limit = byte_limit(kind)
    if size > limit:
        head = f"{subject} takes" if subject else "has"
        more = (
            f"more than {limit:,}, the limit for {kind}; if the file is sound, set "
            f"{LIMITS_VARIABLE}={kind}"
        )
        raise RefusedFileError(errno.EFBIG, f"{head} {size:,} bytes, {more}={-(-size // _MIB)}M")


def irregular_text(mode: int) -> str | None:
    """Return what is no regular file: `not a regular file (a named pipe)`; None for regular files.

    `mode` is the mode that `stat` returns. Opening a pipe waits for its writer, and a device may
    have no end.
    """
    if stat.S_ISREG(mode):
        return None
    kind = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket"}.get(
        stat.S_IFMT(mode)
    )
    return f"not a regular file ({kind or 'a device'})"


def fault_text(error: Exception) -> str:
    """Return the message of an error without the path: `cannot be read (Permission denied)`."""
    if not isinstance(error, OSError):
        return str(error) or type(error).__name__
    message = error.strerror or str(error)
    if isinstance(error, RefusedFileError):
        return message
    return f"cannot be read ({message})"


def _open_regular(path: Path) -> tuple[int, int]:
    """Return the descriptor of a regular file, and its size; raise OSError."""
    try:
        descriptor = os.open(path, _OPEN_FLAGS)
    except ValueError:  # the message of Python depends on its version
        raise RefusedFileError(errno.EINVAL, NO_NAME) from None
    try:
        status = os.fstat(descriptor)
        irregular = irregular_text(status.st_mode)
        if irregular is not None:
            raise RefusedFileError(errno.EINVAL, irregular)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor, status.st_size


@lru_cache(maxsize=8)
def _changed_limits(text: str) -> Mapping[str, int]:
    """Return the limits that the environment variable changes."""
    limits = {}
    for word in text.replace(",", " ").split():
        match = _LIMIT.fullmatch(word)
        size = None if match is None else bytes_of(match[2])
        if match is None or size is None or match[1] not in BYTE_LIMITS:
            kinds = ", ".join(BYTE_LIMITS)
            raise RefusedFileError(
                errno.EINVAL,
                f"{LIMITS_VARIABLE}: expected <kind>=<bytes> with K, M or G, such as label=200M, "
                f"of {kinds}; found {shortened(word)!r}",
            )
        limits[match[1]] = size
    return limits


def open_zip(source: Path | bytes) -> zipfile.ZipFile:
    """Open the archive in a file or in its bytes, if its directory needs little memory.

    Raises OSError, or zipfile.BadZipFile if it does not begin at the first and end at the last
    byte.
    """
    with io.BytesIO(source) if isinstance(source, bytes) else open_file(source) as file:
        check_end(file, _MAX_DIRECTORY_LENGTH)
    # It is opened again by its path, so that the archive closes the file.
    archive = zipfile.ZipFile(io.BytesIO(source) if isinstance(source, bytes) else source)
    if min(map(attrgetter("header_offset"), archive.infolist()), default=0):
        archive.close()
        raise zipfile.BadZipFile("bytes precede the archive")
    return archive


def read_member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, kind: FileKind) -> bytes:
    """Return the content of an archive's member; raise `DAMAGED_ARCHIVE`.

    It agrees with its stored size and checksum.
    """
    for size in (entry.file_size, entry.compress_size):
        check_size(size, kind, shortened(entry.filename))
    if entry.flag_bits & 1 or entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise zipfile.BadZipFile("a member is encrypted or compressed by an unknown method")
    try:
        with archive.open(entry) as file:
            content = file.read(entry.file_size + 1)  # it may unpack to much more
    except EOFError:
        raise zipfile.BadZipFile("a member ends early") from None
    if len(content) != entry.file_size:
        raise zipfile.BadZipFile(
            f"a member has {len(content):,} bytes, its stored size is {entry.file_size:,}"
        )
    return content


def read_array(archive: zipfile.ZipFile, name: str, kind: FileKind) -> AnyArray:
    """Return the array `<name>.npy` of an archive; raise `DAMAGED_ARCHIVE`, KeyError if missing."""
    return array_of(read_member(archive, archive.getinfo(f"{name}.npy"), kind), kind)


def array_of(content: bytes, kind: FileKind) -> AnyArray:
    """Return the array of numbers or text in the bytes of a `.npy`; it is writable.

    It has the size in its header. Raises `DAMAGED_ARCHIVE`: an OSError if it would be larger than
    its kind may be.
    """
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    if version not in _HEADER_READERS:
        raise ValueError(f"version {version} of its array is unknown")
    shape, fortran, dtype = getattr(np.lib.format, _HEADER_READERS[version])(file)
    if dtype.kind not in "biufcU" or min(shape, default=0) < 0:
        raise ValueError(
            f"expected numbers or text, found shape {shape} of {shortened(str(dtype))}"
        )
    size, actual_size = math.prod(shape) * dtype.itemsize, len(content) - file.tell()
    check_size(size, kind, "its array")
    if size != actual_size:
        raise ValueError(
            f"its array has {actual_size:,} bytes, but its shape {shape} of {dtype} needs {size:,}"
        )
    flat: AnyArray = np.frombuffer(content, dtype, offset=file.tell()).copy()
    if fortran:
        return flat.reshape(shape[::-1]).T
    return flat.reshape(shape)


def check_end(file: BinaryIO, max_length: int) -> None:
    """Check the end of an archive before Python reads its directory.

    Python needs about twenty times the memory of the directory. Raises RefusedFileError for a
    directory of more than `max_length` bytes, and zipfile.BadZipFile for a damaged end.
    """
    size = file.seek(0, os.SEEK_END)
    start = file.seek(max(0, size - _MAX_END_LENGTH))
    tail = file.read(_MAX_END_LENGTH)
    end = tail.rfind(_END)
    if end < 0:
        file.seek(0)
        raise zipfile.BadZipFile(_no_end_text(file.read(_BEGINNING_LENGTH)))
    if end + _END_LENGTH + _number(tail, end + 20, 2) != len(tail):
        raise zipfile.BadZipFile("bytes follow the end of the archive")
    directory, large = _number(tail, end + 12, 4), end - _LOCATOR_LENGTH
    if large >= 0 and tail.startswith(_LOCATOR, large):
        record = large - _LARGE_END_LENGTH
        if (
            not tail.startswith(_LARGE_END, max(0, record))
            or _number(tail, large + 8, 8) != start + record
        ):
            raise zipfile.BadZipFile("its end is damaged")
        directory = _number(tail, record + 40, 8)
    if directory > max_length:
        raise RefusedFileError(
            errno.EFBIG,
            f"the archive's directory has {directory:,} bytes, more than {max_length:,}",
        )


def _no_end_text(beginning: bytes) -> str:
    """Return what a file without an archive's end is, by its first bytes."""
    if beginning.startswith(_MEMBER):
        return "its end is missing, so the download or the copy broke off"
    if beginning.lstrip().startswith(b"<"):
        return "not a zip archive, but a web page"
    if beginning:
        return "not a zip archive"
    return "the file is empty"


def _number(content: bytes, offset: int, length: int) -> int:
    return int.from_bytes(content[offset : offset + length], "little")
