"""All reading of files: only regular files are read, up to the size limit of their kind.

An untrusted file may be a pipe, a device, a decompression bomb or a gigabyte in one line. This
module only raises OSError; callers turn it into their own errors, which name the remedy. Zip
archives, and arrays in them, are checked before anything large is made, and compared with their
checksums.
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
NO_NAME: Final = "cannot be a file name: it contains a NUL character, or half of a surrogate pair"
_MIB = 1 << 20
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
_LIMIT = re.compile(r"([a-z_]+)=(\w+)", re.ASCII)
_SIZE = re.compile(r"([1-9][0-9]{0,11})([KMGT]?)")
_FACTORS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
# Opening does not wait for the writer of a pipe.
_OPEN_FLAGS = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0)
# First bytes of a member of an archive, of the archive's end record, of the end record of a large
# archive, and of the record that locates it.
_MEMBER = b"PK\x03\x04"
_END = b"PK\x05\x06"
_LARGE_END = b"PK\x06\x06"
_LOCATOR = b"PK\x06\x07"
# Number of bytes that identify a web page.
_BEGINNING_LENGTH = 256
# Number of bytes of these records.
_END_LENGTH = 22
_LARGE_END_LENGTH = 56
_LOCATOR_LENGTH = 20
# Largest number of bytes of an archive's end records, the last of which ends with a comment.
_MAX_END_LENGTH = _LARGE_END_LENGTH + _LOCATOR_LENGTH + _END_LENGTH + (1 << 16) - 1
# Largest number of bytes of the directory of a results file or a bundle.
_MAX_DIRECTORY_LENGTH = 4 << 20
_HEADER_READERS = {(1, 0): "read_array_header_1_0", (2, 0): "read_array_header_2_0"}
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
    """A file outside the file system, such as a member of an archive (`release.store`)."""

    def content(self, kind: FileKind) -> bytes:
        """Return the file's bytes, with the errors of `read_bytes`."""


_observer: ContextVar[Callable[[Path | StoredFile, bytes], None] | None] = ContextVar(
    "observer", default=None
)


class RefusedFileError(OSError):
    """A file that is not read; its `strerror` is a clause without the path."""


def byte_limit(kind: FileKind) -> int:
    """Return the largest number of bytes of a kind of file, which also holds after decoding.

    Raises RefusedFileError if the environment sets limits that cannot be understood.
    """
    setting = os.environ.get(LIMITS_VARIABLE)
    if not setting:
        return BYTE_LIMITS[kind]
    return _parse_limits(setting).get(kind, BYTE_LIMITS[kind])


def bytes_of(text: str) -> int | None:
    """Return the number of bytes that a size such as `200M` stands for; None if it is invalid."""
    match = _SIZE.fullmatch(text)
    if match is None:
        return None
    return int(match[1]) * _FACTORS[match[2]]


def read_bytes(path: Path | StoredFile, kind: FileKind) -> bytes:
    """Read the bytes of a file; a `StoredFile` reads itself.

    Plain system calls are used, since `open` would double the time. FileNotFoundError is raised if
    the file does not exist, RefusedFileError if it is not a regular file or is too large for its
    kind, and another OSError if it cannot be read.
    """
    content = _read_file(path, kind) if isinstance(path, Path) else path.content(kind)
    observer = _observer.get()
    if observer is not None:
        observer(path, content)
    return content


def _read_file(path: Path, kind: FileKind) -> bytes:
    descriptor, size = _open_regular_file(path)
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

    This holds within the block, in this thread. Checksums thus cover exactly the bytes that
    something was made from, without reading them again.
    """
    token = _observer.set(observer)
    try:
        yield
    finally:
        _observer.reset(token)


def open_file(path: Path) -> BinaryIO:
    """Open a regular file of any size for reading in parts, with the errors of `read_bytes`."""
    descriptor, _ = _open_regular_file(path)
    return os.fdopen(descriptor, "rb")


def mapped_file(path: Path) -> Any:
    """Map a regular file of any size into memory, as a `pyarrow.Buffer`.

    On a file system that cannot map files it is read instead, which is logged once for each folder.
    The errors are as in `open_file`.
    """
    import pyarrow as pa

    with open_file(path) as file:
        try:
            return pa.memory_map(str(path)).read_buffer()
        except OSError as error:
            if os.strerror(errno.ENOMEM) in str(error):
                raise  # there is no room to read it either
        warn_once(
            f"{path.parent}: files cannot be memory-mapped there and are read completely; to save "
            "memory, use another folder (--index-dir for the index)"
        )
        return pa.py_buffer(file.read())


def file_checksum(path: Path) -> str:
    """Return a checksum of a file's bytes; 1.8 GB of tables take 2 s.

    The errors are as in `open_file`.
    """
    checksum = hashlib.blake2b(digest_size=16)
    with open_file(path) as file:
        while block := file.read(_MIB):
            checksum.update(block)
    return checksum.hexdigest()


def check_size(size: int, kind: FileKind, subject: str = "") -> None:
    """Raise RefusedFileError if a file of a kind, or its part `subject`, has too many bytes."""
    limit = byte_limit(kind)
    if size > limit:
        beginning = f"{subject} takes" if subject else "has"
        sufficient_mib = -(-size // _MIB)  # rounded up
        raise RefusedFileError(
            errno.EFBIG,
            f"{beginning} {size:,} bytes, more than {limit:,}, the limit for {kind}; if the file "
            f"is correct, set {LIMITS_VARIABLE}={kind}={sufficient_mib}M",
        )


def irregular_text(mode: int) -> str | None:
    """Describe what is not a regular file, such as `not a regular file (a named pipe)`.

    None is returned for a regular file. `mode` is the mode that `stat` returns. Opening a pipe
    waits for its writer, and a device may have no end.
    """
    if stat.S_ISREG(mode):
        return None
    kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket"}
    kind = kinds.get(stat.S_IFMT(mode), "a device")
    return f"not a regular file ({kind})"


def fault_text(error: Exception) -> str:
    """Return the message of an error without the path: `cannot be read (Permission denied)`."""
    if isinstance(error, OSError) and not isinstance(error, RefusedFileError):
        return f"cannot be read ({reason_text(error)})"
    return reason_text(error)


def reason_text(error: Exception) -> str:
    """Return only the reason in an error, for a message of its own: `Permission denied`."""
    message = error.strerror if isinstance(error, OSError) else None
    return message or str(error) or type(error).__name__


def _open_regular_file(path: Path) -> tuple[int, int]:
    """Open a file, and return descriptor and size; raise OSError if it is not a regular file."""
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
def _parse_limits(text: str) -> Mapping[str, int]:
    """Parse the environment variable's limits; raise RefusedFileError if they are invalid."""
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
    """Open the archive in a file, or in a file's bytes, if its directory needs little memory.

    OSError is raised if the file cannot be read, and zipfile.BadZipFile if the archive does not
    start at the first byte and end at the last one.
    """
    with io.BytesIO(source) if isinstance(source, bytes) else open_file(source) as file:
        check_end(file, _MAX_DIRECTORY_LENGTH)
    # It is opened again by its path, so that the archive closes the file.
    archive = zipfile.ZipFile(io.BytesIO(source) if isinstance(source, bytes) else source)
    offsets = [entry.header_offset for entry in archive.infolist()]
    if min(offsets, default=0):
        archive.close()
        raise zipfile.BadZipFile("bytes precede the archive")
    return archive


def read_member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, kind: FileKind) -> bytes:
    """Read the content of an archive's member, which agrees with its stored size and checksum.

    Raises one of `DAMAGED_ARCHIVE`.
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
    """Read the array `<name>.npy` in an archive.

    Raises KeyError if there is no such member, and otherwise one of `DAMAGED_ARCHIVE`.
    """
    entry = archive.getinfo(f"{name}.npy")
    content = read_member(archive, entry, kind)
    return array_of(content, kind)


def array_of(content: bytes, kind: FileKind) -> AnyArray:
    """Return the array of numbers or text in the bytes of a `.npy` file; it is writable.

    Its size is the one in the header. Raises one of `DAMAGED_ARCHIVE`, which is an OSError if the
    array would be larger than its kind may be.
    """
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    if version not in _HEADER_READERS:
        raise ValueError(f"its array has the unknown version {version}")
    shape, fortran, dtype = getattr(np.lib.format, _HEADER_READERS[version])(file)
    if dtype.kind not in "biufcU" or min(shape, default=0) < 0:
        raise ValueError(
            f"expected numbers or text, found shape {shape} of {shortened(str(dtype))}"
        )
    size = math.prod(shape) * dtype.itemsize
    actual_size = len(content) - file.tell()
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

    Python needs about twenty times the directory's size of memory. Raises RefusedFileError for a
    directory of more than `max_length` bytes, and zipfile.BadZipFile for a damaged end.
    """
    size = file.seek(0, os.SEEK_END)
    start = file.seek(max(0, size - _MAX_END_LENGTH))
    tail = file.read(_MAX_END_LENGTH)
    end = tail.rfind(_END)
    if end < 0:
        file.seek(0)
        raise zipfile.BadZipFile(_describe_missing_end(file.read(_BEGINNING_LENGTH)))
    comment_length = _read_number(tail, end + 20, 2)
    if end + _END_LENGTH + comment_length != len(tail):
        raise zipfile.BadZipFile("bytes follow the end of the archive")
    directory_length = _read_number(tail, end + 12, 4)
    locator = end - _LOCATOR_LENGTH
    if locator >= 0 and tail.startswith(_LOCATOR, locator):
        large_end = locator - _LARGE_END_LENGTH
        located_at = _read_number(tail, locator + 8, 8)
        is_record = tail.startswith(_LARGE_END, max(0, large_end))
        if not is_record or located_at != start + large_end:
            raise zipfile.BadZipFile("its end is damaged")
        directory_length = _read_number(tail, large_end + 40, 8)
    if directory_length > max_length:
        raise RefusedFileError(
            errno.EFBIG,
            f"the archive's directory has {directory_length:,} bytes, more than {max_length:,}",
        )


def _describe_missing_end(beginning: bytes) -> str:
    """Describe a file that lacks an archive's end, by its first bytes."""
    if beginning.startswith(_MEMBER):
        return "the end is missing, as after an interrupted download or copy"
    if beginning.lstrip().startswith(b"<"):
        return "not a zip archive, but a web page"
    if beginning:
        return "not a zip archive"
    return "the file is empty"


def _read_number(content: bytes, offset: int, length: int) -> int:
    """Return the unsigned number in `length` bytes of the content."""
    field = content[offset : offset + length]
    return int.from_bytes(field, "little")
