"""Stores of a release's files in archives or at a URL, and a cache of copies of them.

`ReleaseStore` reads files by their path, `FileCache` stores copies in a folder of bounded size; the
least recently used copy is evicted first. Several processes use it at once: each file appears
complete, and a file that is removed while it is read stays readable.
"""

from __future__ import annotations

import hashlib
import os
import zlib
from collections.abc import Iterable
from contextlib import suppress
from contextvars import ContextVar
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.errors import ConfigError, MissingFileError, SensorFileError
from deepaccident_devkit.release.store.members import Member, Members
from deepaccident_devkit.release.store.sources import (
    HEAD_LENGTH,
    LONGEST_HEAD,
    ByteRange,
    Source,
    damaged_member_error,
    head_length,
    member_bytes,
    source_of,
)
from deepaccident_devkit.support.files import place_in, remove_in, temporary_of, write_bytes
from deepaccident_devkit.support.reading import (
    FileKind,
    RefusedFileError,
    bytes_of,
    check_size,
    fault_text,
    reason_text,
)

FOLDER_VARIABLE: Final = "DEEPACCIDENT_CACHE"
SIZE_VARIABLE: Final = "DEEPACCIDENT_CACHE_SIZE"
_DEFAULT_SIZE = "20G"
# A process may add this share of the size before it checks the full folder again.
_RECHECK_SHARE = 0.05
# An eviction reduces the folder to this share of the size.
_EVICTION_SHARE = 0.9
_SENSOR_KINDS: tuple[FileKind, ...] = ("image", "lidar", "bev")
# Whether the bytes of archives' members are compared with their checksums; set by
# `paths.checksums_compared`.
COMPARES: ContextVar[bool] = ContextVar("compares", default=False)
# Files by name that were read together; set by `paths.fetched`.
READ_BEFORE: ContextVar[dict[str, bytes] | None] = ContextVar("fetched", default=None)


class FileCache:
    """A folder of copies of files.

    Attributes:
        folder: The folder.
        max_bytes: Largest size of the folder, bytes.
    """

    def __init__(self, folder: Path, max_bytes: int) -> None:
        """Limit a folder to a size; it may be a little larger while several processes write."""
        self.folder = folder
        self.max_bytes = max_bytes
        self._added = max_bytes  # so that the first copy causes a check

    @classmethod
    def of_user(cls) -> FileCache:
        """Return the cache of the environment, or the one in the user's cache folder.

        Raises ConfigError for a wrong size.
        """
        from platformdirs import user_cache_path

        max_bytes = bytes_of(os.environ.get(SIZE_VARIABLE) or _DEFAULT_SIZE)
        if max_bytes is None:
            raise ConfigError(
                f"{SIZE_VARIABLE}: expected bytes with K, M, G or T, such as {_DEFAULT_SIZE}"
            )
        variable = os.environ.get(FOLDER_VARIABLE)
        if variable:
            folder = Path(variable).expanduser()
        else:
            folder = user_cache_path("deepaccident_devkit") / "files"
        return cls(folder.absolute(), max_bytes)

    def path_of(self, identity: str, name: str) -> Path:
        """Return the path of the copy of a file, by its identity; raises OutputFolderError."""
        content = identity.encode(errors="surrogateescape")
        digest = hashlib.blake2b(content, digest_size=16).hexdigest()
        return place_in(self.folder, f"{digest[:2]}/{digest[2:]}/{name}", opened=True)

    def has_copy(self, path: Path, size: int) -> bool:
        """Return whether a complete copy exists, which then counts as used now."""
        try:
            if path.stat().st_size != size:
                return False
            os.utime(path)
        except OSError:
            return False
        return True

    def put(self, path: Path, content: bytes) -> None:
        """Store a copy; without room, raise OSError with the folder and the remedy."""
        try:
            self._make_room(len(content))
            write_bytes(path, content)
        except OSError as error:
            raise OSError(
                error.errno,
                f"cannot be cached in {self.folder}: {reason_text(error)}; free space there, or "
                f"set another folder with {FOLDER_VARIABLE} or a smaller size with {SIZE_VARIABLE}",
            ) from error

    def _make_room(self, size: int) -> None:
        """Evict copies if a file of this size would make the folder too large."""
        self._added += size
        if self._added <= _RECHECK_SHARE * self.max_bytes:
            return
        self._added = size
        copies = self._list_copies()
        total = sum(copy_bytes for _, copy_bytes, _ in copies) + size
        if total <= self.max_bytes:
            return
        for _, copy_bytes, path in sorted(copies):
            if total <= _EVICTION_SHARE * self.max_bytes:
                break
            with suppress(OSError):  # another process also removes it
                remove_in(self.folder, path.relative_to(self.folder))
                path.parent.rmdir()
            total -= copy_bytes

    def _list_copies(self) -> list[tuple[int, int, Path]]:
        """Return the time of use, size and path of each copy that is not being written."""
        copies = []
        for path in self.folder.glob("??/*/*"):
            with suppress(OSError):
                if temporary_of(path.name) is None:
                    status = path.stat()
                    copies.append((status.st_mtime_ns, status.st_size, path))
        return copies


class ReleaseStore:
    """The files of one release that have no paths of their own.

    Cheap to pickle; safe in forks and threads.

    Attributes:
        place: The archive, the folder of archives or the URL, as in messages.
        base: Folder or URL that the archives' names are relative to.
        list_file: List of the files.
    """

    def __init__(self, location: str, base: str, list_file: Path) -> None:
        """Open an existing list of a store's files; raises IndexStoreError for a damaged one."""
        self.place = location
        self.base = base
        self.list_file = list_file
        self.members = Members(list_file)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return a form that only holds paths; a process opens each store once."""
        return opened_store, (self.place, self.base, self.list_file)

    def __repr__(self) -> str:
        return f"ReleaseStore({self.place!r})"

    @property
    def is_remote(self) -> bool:
        """Whether the store is at a URL."""
        return "://" in self.base

    @property
    def state(self) -> str:
        """Text that changes with the archives."""
        return self.list_file.name

    @property
    def places(self) -> tuple[Path, ...]:
        """Paths that workers must be able to read."""
        if self.is_remote:
            return (self.list_file,)
        return Path(self.place), self.list_file

    def read(self, name: str, kind: FileKind) -> bytes:
        """Read a file's bytes.

        Copies of sensor files at a URL are stored in the user's cache (`FileCache`). Raises
        FileNotFoundError, RefusedFileError if the file is too large for its kind or damaged, or any
        other OSError.
        """
        contents = READ_BEFORE.get()
        if contents is not None and name in contents:
            return contents[name]
        member = self._find_member(name)
        check_size(member.size, kind)
        if self.is_remote and kind in _SENSOR_KINDS:
            with suppress(FileNotFoundError):  # another process has just evicted it
                return self._cache_copy(name, member).read_bytes()
        return self._read_member(name, member)

    def local_path(self, name: str) -> Path:
        """Return the path of a file's copy in the user's cache, which may evict it later.

        Raises MissingFileError, SensorFileError, or ConfigError if the environment gives the cache
        an invalid size.
        """
        try:
            member = self._find_member(name)
            return self._cache_copy(name, member)
        except FileNotFoundError:
            raise MissingFileError(
                f"{self.place}/{name}: no such file; add the archive that contains it"
            ) from None
        except OSError as error:
            raise SensorFileError(f"{self.place}/{name}: {fault_text(error)}") from error

    def fetch(self, names: Iterable[str]) -> dict[str, bytes]:
        """Read small files together; return name → bytes. Raises OSError.

        Missing and damaged files are left out.
        """
        members = []
        for name in names:
            member = self.members.find(name)
            if member is not None:
                members.append((name, member))
        if not members:
            return {}
        ranges = [self._locate_member(name, member) for name, member in members]
        parts = self._source.read_all(ranges)
        contents = {}
        for (name, member), part in zip(members, parts, strict=True):
            with suppress(RefusedFileError):  # a separate read raises the error
                contents[name] = part if member.offset < 0 else _extract_member(part, member)
        return contents

    @cached_property
    def _source(self) -> Source:
        """Source of the archives."""
        return source_of(self.base)

    @cached_property
    def _cache(self) -> FileCache:
        """Cache for files at a URL."""
        return FileCache.of_user()

    def _find_member(self, name: str) -> Member:
        """Return a file of the store, or raise FileNotFoundError."""
        member = self.members.find(name)
        if member is None:
            raise FileNotFoundError(f"{self.place}/{name}")
        return member

    def _cache_copy(self, name: str, member: Member) -> Path:
        """Return the path of a file's copy in the cache; make the copy if it does not exist."""
        identity = f"{self.place}\n{name}\n{self.members.number_of(member)}"
        path = self._cache.path_of(identity, name.rpartition("/")[2])
        if not self._cache.has_copy(path, member.size):
            self._cache.put(path, self._read_member(name, member))
        return path

    def _locate_member(self, name: str, member: Member) -> ByteRange:
        """Return the part of an archive that is sure to hold a whole file."""
        archive = self.members.archives[member.archive]
        if member.offset < 0:  # the archive is a folder
            file_name = name.rpartition("/")[2]
            return f"{archive}/{file_name}".lstrip("/"), 0, member.size
        return archive, member.offset, member.offset + LONGEST_HEAD + member.stored

    def _read_member(self, name: str, member: Member) -> bytes:
        """Read the bytes of a file."""
        archive, start, stop = self._locate_member(name, member)
        if member.offset < 0:
            return self._source.read(archive, start, stop)
        if self.is_remote:  # a second request would cost more than the superfluous bytes
            content = self._source.read(archive, start, stop)
            return _extract_member(content, member)
        head = self._source.read(archive, start, start + HEAD_LENGTH)
        content_start = member.offset + head_length(head)
        content = self._source.read(archive, content_start, content_start + member.stored)
        return _decode_member(content, member)


def _extract_member(content: bytes, member: Member) -> bytes:
    """Return a member's bytes from the bytes of an archive that begin with the member's header."""
    start = head_length(content[:HEAD_LENGTH])
    return _decode_member(content[start : start + member.stored], member)


def _decode_member(content: bytes, member: Member) -> bytes:
    """Return a member's bytes from the bytes stored in the archive; raises RefusedFileError."""
    if len(content) < member.stored:
        raise damaged_member_error("the archive ends before this file")
    content = member_bytes(content, member)
    if COMPARES.get() and zlib.crc32(content) != member.version:
        raise damaged_member_error("its bytes do not match its checksum")
    return content


@lru_cache(maxsize=4)
def opened_store(location: str, base: str, list_file: Path) -> ReleaseStore:
    """Return the store of a list of files, opened once in each process."""
    return ReleaseStore(location, base, list_file)
