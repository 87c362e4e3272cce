"""Where archives lie, a folder of this machine or a URL, and how a part of one is read: zips are read in place."""

from __future__ import annotations

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

from deepaccident_devkit.errors import MOST_TOLD, DatarootError, MissingExtraError, shortened
from deepaccident_devkit.release.store.members import (
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
)

_Result = TypeVar("_Result")
# Parts of a URL in a library's message that may be secret: what is asked for, and who asks.
_SECRETS: Final = re.compile(r"\?\S*|(?<=://)[^/@\s]+@")
_LARGEST_GAP: Final = 1 << 16
# Bytes between two members that are fetched with them, and that are fetched at once.
_LARGEST_RANGE: Final = 64 << 20
# Archives that are open at once in a process; a system allows some 1,000 files.
MOST_OPEN: Final = 256
# An archive, and the first byte and the one after the last.
ByteRange = tuple[str, int, int]
# Bytes of a member's head before its name.
HEAD_LENGTH: Final = 30
# Bytes that are read at once in place of a head's true length: a name, and more fields than any program adds.
LONGEST_HEAD: Final = HEAD_LENGTH + 512
_HEAD: Final = struct.Struct("<4s22xHH")
_SIGNATURE: Final = b"PK\x03\x04"
_ENCRYPTED: Final = 1
_METHODS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_REMEDY: Final = "fetch the archive again"


class Source(ABC):
    """Reads parts of the archives below one place."""

    @abstractmethod
    def read(self, archive: str, start: int, stop: int) -> bytes:
        """Bytes of an archive, as many as are there; raises OSError, of a file that is gone FileNotFoundError."""

    def read_all(self, ranges: Sequence[ByteRange]) -> list[bytes]:
        """Several parts; raises OSError."""
        return [self.read(*each) for each in ranges]


class _Archive:
    """An open archive, which is closed when nobody reads it any more."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor

    def __del__(self) -> None:
        os.close(self.descriptor)


class LocalSource(Source):
    """A folder of this machine. An open archive is read by several threads and forked processes at once."""

    def __init__(self, folder: Path) -> None:
        """Read below this folder."""
        self._folder = folder
        self._opened: dict[str, _Archive] = {}

    def read(self, archive: str, start: int, stop: int) -> bytes:
        """Bytes of an archive."""
        opened = self._opened.get(archive) or self._open(archive)
        descriptor = opened.descriptor
        content = os.pread(descriptor, stop - start, start)
        return (
            content
            if len(content) == stop - start
            else self._rest(descriptor, content, start, stop)
        )

    def _open(self, archive: str) -> _Archive:
        with open_file(self._folder / archive) as file:
            opened = self._opened[archive] = _Archive(os.dup(file.fileno()))
        if len(self._opened) > MOST_OPEN:
            self._opened.pop(next(iter(self._opened)), None)
        return opened

    @staticmethod
    def _rest(descriptor: int, content: bytes, start: int, stop: int) -> bytes:
        """The bytes after `content`, which one call did not give: the system gives at most 2 GiB at once."""
        while len(content) < stop - start and (
            more := os.pread(descriptor, stop - start - len(content), start + len(content))
        ):
            content += more
        return content


class UrlSource(Source):
    """A URL that fsspec can list and read. Its credentials are fsspec's business: its settings, the environment."""

    def __init__(self, url: str) -> None:
        """Read below this URL; raises DatarootError if it holds a password or another secret."""
        self.url = checked_url(url)
        self._opened: tuple[int, Any, str] | None = None

    def read(self, archive: str, start: int, stop: int) -> bytes:
        """Bytes of an archive, or of a file."""
        files, root = self._files()
        return cast(
            "bytes", asked(lambda: files.cat_file(f"{root}/{archive}", start=start, end=stop))
        )

    def read_all(self, ranges: Sequence[ByteRange]) -> list[bytes]:
        """Several parts, together: what lies close together comes as one."""
        from fsspec.utils import merge_offset_ranges

        files, root = self._files()
        names, starts, stops = (list(each) for each in zip(*ranges, strict=True))
        merged = merge_offset_ranges(
            names, starts, stops, max_gap=_LARGEST_GAP, max_block=_LARGEST_RANGE, sort=True
        )
        names, starts, stops = merged
        paths = [f"{root}/{name}" for name in names]
        blocks = asked(lambda: files.cat_ranges(paths, starts, stops, on_error="raise"))
        found = {
            (name, start): block for name, start, block in zip(names, starts, blocks, strict=True)
        }
        firsts: dict[str, list[int]] = {}
        for name, start in sorted(found):
            firsts.setdefault(name, []).append(start)
        result = []
        for name, start, stop in ranges:
            first = max(each for each in firsts[name] if each <= start)
            result.append(found[name, first][start - first : stop - first])
        return result

    def list_files(self) -> dict[str, tuple[int, str]]:
        """The files below the URL: path from there → bytes, and a text that changes with the file; raises OSError."""
        files, root = self._files()
        found = asked(lambda: files.find(root, detail=True))
        return {
            path.removeprefix(f"{root}/"): _state(detail)
            for path, detail in found.items()
            if path != root
        }

    def state_of(self, archive: str) -> tuple[int, str]:
        """An archive's bytes, and a text that changes with it; raises OSError."""
        files, root = self._files()
        return _state(asked(lambda: files.info(f"{root}/{archive}")))

    @contextmanager
    def opened(self, archive: str) -> Iterator[Any]:
        """An archive as a file in which one can move; raises OSError."""
        files, root = self._files()
        with asked(lambda: files.open(f"{root}/{archive}", "rb")) as file:
            yield file

    def _files(self) -> tuple[Any, str]:
        """Fsspec's file system, made again in a forked process, and the path of the URL in it."""
        if self._opened is None or self._opened[0] != os.getpid():
            fsspec = _fsspec(self.url)
            files, root = asked(lambda: fsspec.core.url_to_fs(self.url))
            self._opened = (os.getpid(), files, root.rstrip("/"))
        return self._opened[1:]


def checked_url(url: str) -> str:
    """A URL without a slash at its end; raises DatarootError, which does not show the secret, if it holds one."""
    parts = urlsplit(url)
    if parts.query or parts.password is not None or "@" in parts.netloc:
        raise DatarootError(
            f"{parts.scheme}://{parts.hostname or ''}…: holds a name, a password or a signature, which the index and "
            "messages would show; give it by fsspec's settings or the environment (docs/reading.md)"
        )
    return url.rstrip("/")


def _fsspec(url: str) -> Any:
    try:
        import fsspec.core
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"{url}: needs fsspec: in a checkout, pip install '.[cloud]'"
        ) from error
    logging.getLogger("fsspec").addHandler(logging.NullHandler())
    return fsspec


def asked(call: Callable[[], _Result]) -> _Result:
    """What a call of fsspec returns; whatever a library below raises becomes an OSError whose words hold no secret."""
    try:
        return call()
    except FileNotFoundError:
        raise
    except ImportError as error:
        raise MissingExtraError(f"{error}; in a checkout: pip install '.[cloud]'") from error
    except Exception as error:  # noqa: BLE001 - each file system has errors of its own
        said = str(error.strerror) if isinstance(error, OSError) and error.strerror else str(error)
        said = shortened(_SECRETS.sub("", said) or type(error).__name__, MOST_TOLD)
        number = error.errno if isinstance(error, OSError) and error.errno else errno.EIO
        raise RefusedFileError(number, f"cannot be read ({said})") from None


def _state(detail: Any) -> tuple[int, str]:
    for name in ("ETag", "etag", "md5Hash", "mtime", "LastModified", "last_modified", "created"):
        if detail.get(name) is not None:
            return int(detail.get("size") or 0), str(detail[name])
    return int(detail.get("size") or 0), ""


def source_of(base: str) -> Source:
    """The source of a URL or of a folder's absolute path."""
    return UrlSource(base) if "://" in base else LocalSource(Path(base))


def list_zip(file: BinaryIO, archive: str, shown: str) -> Listing:
    """The files of a release in an archive, which errors show as `shown`; only its directory is read.

    `archive` is its path from the store's place: the folders on it and its name without `.zip` count as folders that
    lead to the members. Raises DatarootError, also for a member that is encrypted or compressed by an unknown method.
    """
    size = file.seek(0, os.SEEK_END)
    try:
        check_end(file, byte_limit("archive"))
        with zipfile.ZipFile(file) as opened:
            entries = opened.infolist()
    except RefusedFileError as error:  # by the gate, or by a URL
        sound = (
            f"; if the archive is sound, set {LIMITS_VARIABLE}=archive=4G"
            if error.errno == errno.EFBIG
            else ""
        )
        raise DatarootError(f"{shown}: {fault_text(error)}{sound}") from error
    except DAMAGED_ARCHIVE as error:
        told = shortened(fault_text(error), MOST_TOLD)
        raise DatarootError(
            f"{shown}: not a readable zip archive ({told}; {size:,} bytes); {_REMEDY}"
        ) from error
    leading = PurePosixPath(archive).with_suffix("").parts
    folder_of: dict[str, str | None] = {}
    number_of: dict[str, int] = {}
    folder, names, rows = [], [], []
    for entry in entries:
        above, _, name = entry.filename.replace("\\", "/").rpartition(
            "/"
        )  # old tools of Windows write backslashes
        if above not in folder_of:
            folder_of[above] = release_folder((*leading, *PurePosixPath(above).parts))
        found = folder_of[above]
        if found is None or not name or not is_release_file(found, name):
            continue
        _check_entry(entry, shown, size)
        folder.append(number_of.setdefault(found, len(number_of)))
        names.append(name)
        deflated = entry.compress_type == zipfile.ZIP_DEFLATED
        rows.append(
            (entry.header_offset, entry.compress_size, entry.file_size, entry.CRC, deflated)
        )
    columns = zip(*rows, strict=True) if rows else ((),) * 5
    numbers = {
        name: np.array(column) for name, column in zip(Member._fields[1:], columns, strict=True)
    }
    return Listing(
        archive=archive,
        folders=[*number_of],
        folder=np.array(folder, int),
        names=names,
        numbers=numbers,
    )


def member_bytes(content: bytes, member: Member) -> bytes:
    """The bytes of a member, from those that are stored; checksums are not compared. Raises RefusedFileError."""
    if member.deflated:
        decoder = zlib.decompressobj(-zlib.MAX_WBITS)
        try:
            content = decoder.decompress(content, member.size + 1)
        except zlib.error as error:
            raise damaged_member_error(f"cannot be decompressed ({error})") from error
    if len(content) != member.size:
        raise damaged_member_error(f"{len(content):,} bytes in place of {member.size:,}")
    return content


def head_length(head: bytes) -> int:
    """Bytes before a member's content, by the beginning of its head; raises RefusedFileError if there is no head."""
    if len(head) < HEAD_LENGTH:
        raise damaged_member_error("the archive ends before it")
    signature, name, extra = _HEAD.unpack_from(head)
    if signature != _SIGNATURE:
        raise damaged_member_error("no head at its place")
    return HEAD_LENGTH + int(name) + int(extra)


def damaged_member_error(what: str) -> RefusedFileError:
    """The error of a member that cannot be read, whose clause says why."""
    return RefusedFileError(errno.EIO, f"damaged in its archive ({what})")


def _check_entry(entry: zipfile.ZipInfo, shown: str, size: int) -> None:
    """Raise DatarootError if a member cannot be read in place."""
    fault = ""
    if entry.flag_bits & _ENCRYPTED:
        fault = "encrypted; unpack the archive with its password"
    elif entry.compress_type not in _METHODS:
        fault = f"compressed by method {entry.compress_type}; unpack the archive, or pack it again as an ordinary zip"
    elif not 0 <= entry.header_offset <= size - HEAD_LENGTH - entry.compress_size:
        fault = f"said to lie beyond the archive; {_REMEDY}"
    elif entry.compress_type == zipfile.ZIP_STORED and entry.compress_size != entry.file_size:
        fault = f"stored with two sizes; {_REMEDY}"
    if fault:
        raise DatarootError(f"{shown}: its member {shortened(entry.filename)} is {fault}")
