"""Sources of archives: a local folder, or a URL. Parts of zips are read in place."""

import errno
import logging
import os
import re
import struct
import zipfile
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, Final, TypeVar, cast
from urllib.parse import urlsplit

import numpy as np

from deepaccident_devkit.errors import (
    MAX_REASON_LENGTH,
    DatarootError,
    MissingExtraError,
    shortened,
)
from deepaccident_devkit.release.store.members import (
    FileState,
    Listing,
    Member,
    is_release_file,
    release_folder,
)
from deepaccident_devkit.support.reading import (
    DAMAGED_ARCHIVE,
    LIMITS_VARIABLE,
    RefusedFileError,
    byte_limit,
    check_end,
    fault_text,
    open_file,
    reason_text,
)

_Result = TypeVar("_Result")
# Parts of a URL in a library's message that may be secret: the query and the user.
_SECRETS = re.compile(r"\?\S*|(?<=://)[^/@\s]+@")
# Members with a gap of at most this many bytes are fetched together with the gap.
_MAX_GAP_BYTES = 1 << 16
_MAX_RANGE_BYTES = 64 << 20
# Archives that are open at once in a process; a system allows about 1,000 files.
MAX_OPEN_ARCHIVES: Final = 256
# An archive, its first byte and the byte after the last.
ByteRange = tuple[str, int, int]
# Bytes of a member's header before its name.
HEAD_LENGTH: Final = 30
# Bytes that are read at once for a header of unknown length: a name, and more fields than any
# program adds.
LONGEST_HEAD: Final = HEAD_LENGTH + 512
_HEAD = struct.Struct("<4s22xHH")
_SIGNATURE = b"PK\x03\x04"
_ENCRYPTED = 1
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_REMEDY = "download the archive again"


class Source(ABC):
    """A reader of parts of the archives below a folder or URL."""

    @abstractmethod
    def read(self, archive: str, start: int, stop: int) -> bytes:
        """Read a part of an archive, which is shorter if the archive ends before `stop`.

        Raises OSError, which is a FileNotFoundError for a missing file.
        """

    def read_all(self, ranges: Sequence[ByteRange]) -> list[bytes]:
        """Read several parts of archives; raises OSError."""
        return [self.read(*byte_range) for byte_range in ranges]


class _Archive:
    """An open archive, which is closed when it is no longer used."""

    def __init__(self, descriptor: int) -> None:
        """Take over an open descriptor."""
        self.descriptor = descriptor

    def __del__(self) -> None:
        os.close(self.descriptor)


class LocalSource(Source):
    """A local folder; several threads and forked processes may read an open archive at once."""

    def __init__(self, folder: Path) -> None:
        """Read below this folder."""
        self._folder = folder
        self._opened: dict[str, _Archive] = {}

    def read(self, archive: str, start: int, stop: int) -> bytes:
        """Read a part of an archive."""
        archive_file = self._opened.get(archive) or self._open(archive)
        descriptor = archive_file.descriptor
        content = os.pread(descriptor, stop - start, start)
        while len(content) < stop - start:  # a call returns at most 2 GiB
            missing = stop - start - len(content)
            next_bytes = os.pread(descriptor, missing, start + len(content))
            if not next_bytes:
                break
            content += next_bytes
        return content

    def _open(self, archive: str) -> _Archive:
        """Open an archive, and close the oldest one if too many are open."""
        with open_file(self._folder / archive) as file:
            archive_file = _Archive(os.dup(file.fileno()))
        self._opened[archive] = archive_file
        if len(self._opened) > MAX_OPEN_ARCHIVES:
            self._opened.pop(next(iter(self._opened)), None)
        return archive_file


class UrlSource(Source):
    """A URL that fsspec can list and read.

    Fsspec takes credentials from its settings and the environment.
    """

    def __init__(self, url: str) -> None:
        """Read below this URL; raises DatarootError if it holds a password or another secret."""
        self.url = checked_url(url)
        self._opened: tuple[int, Any, str] | None = None

    def read(self, archive: str, start: int, stop: int) -> bytes:
        """Read a part of an archive, or of another file."""
        files, root = self._open_file_system()
        path = f"{root}/{archive}"
        content = call_library(lambda: files.cat_file(path, start=start, end=stop))
        return cast("bytes", content)

    def read_all(self, ranges: Sequence[ByteRange]) -> list[bytes]:
        """Read several parts together; adjacent parts are read as one block."""
        from fsspec.utils import merge_offset_ranges

        files, root = self._open_file_system()
        names, starts, stops = (list(column) for column in zip(*ranges, strict=True))
        names, starts, stops = merge_offset_ranges(
            names, starts, stops, max_gap=_MAX_GAP_BYTES, max_block=_MAX_RANGE_BYTES, sort=True
        )
        paths = [f"{root}/{name}" for name in names]
        contents = call_library(lambda: files.cat_ranges(paths, starts, stops, on_error="raise"))
        blocks = dict(zip(zip(names, starts, strict=True), contents, strict=True))
        block_starts: dict[str, list[int]] = {}
        for name, start in sorted(blocks):
            block_starts.setdefault(name, []).append(start)
        parts = []
        for name, start, stop in ranges:
            block_start = max(begin for begin in block_starts[name] if begin <= start)
            block = blocks[name, block_start]
            parts.append(block[start - block_start : stop - block_start])
        return parts

    def list_files(self) -> dict[str, FileState]:
        """Return path from the URL → state of each file below it; raises OSError.

        The state is the file's size in bytes, and a text that changes with the file.
        """
        files, root = self._open_file_system()
        details = call_library(lambda: files.find(root, detail=True))
        states = {}
        for path, detail in details.items():
            if path != root:
                states[path.removeprefix(f"{root}/")] = _read_state(detail)
        return states

    def state_of(self, archive: str) -> FileState:
        """Return an archive's size in bytes, and a text that changes with it; raises OSError."""
        files, root = self._open_file_system()
        return _read_state(call_library(lambda: files.info(f"{root}/{archive}")))

    @contextmanager
    def open_archive(self, archive: str) -> Iterator[Any]:
        """Open an archive as a file with random access; raises OSError."""
        files, root = self._open_file_system()
        with call_library(lambda: files.open(f"{root}/{archive}", "rb")) as file:
            yield file

    def _open_file_system(self) -> tuple[Any, str]:
        """Return fsspec's file system and the URL's path in it; both are made once in a process."""
        if self._opened is None or self._opened[0] != os.getpid():
            fsspec = _import_fsspec(self.url)
            files, root = call_library(lambda: fsspec.core.url_to_fs(self.url))
            self._opened = (os.getpid(), files, root.rstrip("/"))
        return self._opened[1:]


def checked_url(url: str) -> str:
    """Return a URL without a slash at its end.

    Raises DatarootError if the URL has a secret, which the message does not show.
    """
    parts = urlsplit(url)
    if parts.query or parts.password is not None or "@" in parts.netloc:
        raise DatarootError(
            f"{parts.scheme}://{parts.hostname or ''}…: contains a name, a password or a "
            "signature, which the index and messages would show; put the credentials into "
            "fsspec's settings or the environment (docs/reading.md)"
        )
    return url.rstrip("/")


def _import_fsspec(url: str) -> Any:
    """Import fsspec, or raise MissingExtraError."""
    try:
        import fsspec.core
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"{url}: needs fsspec; run pip install '.[cloud]' in a checkout"
        ) from error
    logging.getLogger("fsspec").addHandler(logging.NullHandler())
    return fsspec


def call_library(call: Callable[[], _Result]) -> _Result:
    """Call a function of fsspec, and return its result.

    Any error of an underlying library becomes an OSError with a message that shows no secret.
    """
    try:
        return call()
    except FileNotFoundError:
        raise
    except ImportError as error:
        raise MissingExtraError(f"{error}; run pip install '.[cloud]' in a checkout") from error
    except Exception as error:  # noqa: BLE001 - each file system has errors of its own
        message = str(error)
        number = errno.EIO
        if isinstance(error, OSError):
            message = str(error.strerror) if error.strerror else message
            number = error.errno or number
        message = shortened(_SECRETS.sub("", message) or type(error).__name__, MAX_REASON_LENGTH)
        raise RefusedFileError(number, f"cannot be read ({message})") from None


def _read_state(detail: Any) -> FileState:
    """Return the size of a file, and a text that changes with it, from fsspec's details."""
    size = int(detail.get("size") or 0)
    for name in ("ETag", "etag", "md5Hash", "mtime", "LastModified", "last_modified", "created"):
        if detail.get(name) is not None:
            return size, str(detail[name])
    return size, ""


def source_of(base: str) -> Source:
    """Return the source of a URL or of a folder's absolute path."""
    if "://" in base:
        return UrlSource(base)
    return LocalSource(Path(base))


def list_zip(file: BinaryIO, archive: str, location: str) -> Listing:
    """List the files of a release in an archive; only the archive's directory is read.

    Args:
        file: The open archive.
        archive: Path of the archive from the store's base. Its folders, and its name without
            `.zip`, count as folders that lead to the members.
        location: Name of the archive in messages.

    Raises:
        DatarootError: If the archive cannot be read, or if a member is encrypted or compressed by
            an unknown method.
    """
    size = file.seek(0, os.SEEK_END)
    try:
        check_end(file, byte_limit("archive"))
        with zipfile.ZipFile(file) as zip_file:
            entries = zip_file.infolist()
    except RefusedFileError as error:  # by `check_end`, or by a URL
        remedy = ""
        if error.errno == errno.EFBIG:
            remedy = f"; if the archive is correct, set {LIMITS_VARIABLE}=archive=4G"
        raise DatarootError(f"{location}: {fault_text(error)}{remedy}") from error
    except DAMAGED_ARCHIVE as error:
        fault = shortened(reason_text(error), MAX_REASON_LENGTH)
        raise DatarootError(
            f"{location}: not a readable zip archive ({fault}; {size:,} bytes); {_REMEDY}"
        ) from error
    leading_folders = PurePosixPath(archive).with_suffix("").parts
    release_folders: dict[str, str | None] = {}
    folder_numbers: dict[str, int] = {}
    folder = []
    names = []
    rows = []
    for entry in entries:
        # Old tools of Windows write backslashes.
        zip_folder, _, name = entry.filename.replace("\\", "/").rpartition("/")
        if zip_folder not in release_folders:
            parts = (*leading_folders, *PurePosixPath(zip_folder).parts)
            release_folders[zip_folder] = release_folder(parts)
        release_name = release_folders[zip_folder]
        if release_name is None or not name or not is_release_file(release_name, name):
            continue
        _check_entry(entry, location, size)
        folder.append(folder_numbers.setdefault(release_name, len(folder_numbers)))
        names.append(name)
        deflated = entry.compress_type == zipfile.ZIP_DEFLATED
        rows.append(
            (entry.header_offset, entry.compress_size, entry.file_size, entry.CRC, deflated)
        )
    columns = zip(*rows, strict=True) if rows else ((),) * 5
    numbers = dict(zip(Member._fields[1:], map(np.array, columns), strict=True))
    return Listing(
        archive=archive,
        folders=[*folder_numbers],
        folder=np.array(folder, int),
        names=names,
        numbers=numbers,
    )


def member_bytes(content: bytes, member: Member) -> bytes:
    """Return the bytes of a member from its stored bytes; checksums are not compared.

    Raises RefusedFileError.
    """
    if member.deflated:
        decoder = zlib.decompressobj(-zlib.MAX_WBITS)
        try:
            content = decoder.decompress(content, member.size + 1)
        except zlib.error as error:
            raise damaged_member_error(f"cannot be decompressed ({error})") from error
    if len(content) != member.size:
        raise damaged_member_error(f"{len(content):,} bytes instead of {member.size:,}")
    return content


def head_length(head: bytes) -> int:
    """Return the length of a member's header, which precedes its content, from its first bytes.

    Raises RefusedFileError if there is no header.
    """
    if len(head) < HEAD_LENGTH:
        raise damaged_member_error("the archive ends before this file")
    signature, name_length, extra_length = _HEAD.unpack_from(head)
    if signature != _SIGNATURE:
        raise damaged_member_error("no head at its place")
    return HEAD_LENGTH + int(name_length) + int(extra_length)


def damaged_member_error(fault: str) -> RefusedFileError:
    """Return the error of a member that cannot be read because of a fault."""
    return RefusedFileError(errno.EIO, f"damaged in its archive ({fault})")


def _check_entry(entry: zipfile.ZipInfo, location: str, size: int) -> None:
    """Raise DatarootError if a member cannot be read in place."""
    fault = ""
    if entry.flag_bits & _ENCRYPTED:
        fault = "encrypted; unpack the archive with its password"
    elif entry.compress_type not in _METHODS:
        fault = (
            f"compressed by method {entry.compress_type}; unpack the archive, "
            "or pack it again as an ordinary zip"
        )
    elif not 0 <= entry.header_offset <= size - HEAD_LENGTH - entry.compress_size:
        fault = f"listed at a place outside the archive; {_REMEDY}"
    elif entry.compress_type == zipfile.ZIP_STORED and entry.compress_size != entry.file_size:
        fault = f"stored with two sizes; {_REMEDY}"
    if fault:
        raise DatarootError(f"{location}: its member {shortened(entry.filename)} is {fault}")
