"""`ReleaseStore` reads the files of a release in archives or at a URL by their path; `FileCache` keeps copies of them.

The cache is a folder of bounded size; who was not used the longest goes first. Several processes use it at once: each
file appears whole, and one that is removed while it is read stays readable.
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
)

FOLDER_VARIABLE: Final = "DEEPACCIDENT_CACHE"
SIZE_VARIABLE: Final = "DEEPACCIDENT_CACHE_SIZE"
_DEFAULT_SIZE: Final = "20G"
# Part of the size that a process may add before it looks at the whole folder again.
_LOOKED_AFTER: Final = 0.05
# Part of the size that is left when something had to go.
_KEPT: Final = 0.9
_SENSOR_KINDS: Final[tuple[FileKind, ...]] = ("image", "lidar", "bev")
# Whether the bytes of archives' members are compared with their checksums; `paths.checksums_compared` sets it.
COMPARES: ContextVar[bool] = ContextVar("compares", default=False)
# Files by name that were read together; `paths.fetched` sets it.
READ_BEFORE: ContextVar[dict[str, bytes] | None] = ContextVar("fetched", default=None)


class FileCache:
    """A folder of copies."""

    def __init__(self, folder: Path, most: int) -> None:
        """Keep at most so many bytes in a folder, or a little more while several processes write."""
        self.folder, self.most = folder, most
        self._added = most  # so that the first one looks

    @classmethod
    def of_user(cls) -> FileCache:
        """The one that the environment names, else in the user's cache folder; raises ConfigError for a wrong size."""
        from platformdirs import user_cache_path

        most = bytes_of(os.environ.get(SIZE_VARIABLE) or _DEFAULT_SIZE)
        if most is None:
            raise ConfigError(
                f"{SIZE_VARIABLE}: expected bytes with K, M, G or T, such as {_DEFAULT_SIZE}"
            )
        folder = os.environ.get(FOLDER_VARIABLE)
        place = (
            Path(folder).expanduser()
            if folder
            else user_cache_path("deepaccident_devkit") / "files"
        )
        return cls(place.absolute(), most)

    def path_of(self, identity: str, name: str) -> Path:
        """Where the copy of a file would lie, of which `identity` is the only one; raises OutputFolderError."""
        digest = hashlib.blake2b(
            identity.encode(errors="surrogateescape"), digest_size=16
        ).hexdigest()
        return place_in(self.folder, f"{digest[:2]}/{digest[2:]}/{name}", opened=True)

    def found(self, path: Path, size: int) -> bool:
        """Whether a copy is there, whole; it counts as used now."""
        try:
            if path.stat().st_size != size:
                return False
            os.utime(path)
        except OSError:
            return False
        return True

    def put(self, path: Path, content: bytes) -> None:
        """Keep a copy; raises OSError if there is no room, which names the folder and the remedy."""
        try:
            self._make_room(len(content))
            write_bytes(path, content)
        except OSError as error:
            raise OSError(
                error.errno,
                f"cannot be kept in {self.folder}: {fault_text(error)}; make room there, or name another folder by "
                f"{FOLDER_VARIABLE} or fewer bytes by {SIZE_VARIABLE}",
            ) from error

    def _make_room(self, size: int) -> None:
        self._added += size
        if self._added <= _LOOKED_AFTER * self.most:
            return
        self._added = size
        there = self._there()
        total = sum(bytes_ for _, bytes_, _ in there) + size
        if total <= self.most:
            return
        for _, bytes_, path in sorted(there):
            if total <= _KEPT * self.most:
                break
            with suppress(OSError):  # another process removes it too
                remove_in(self.folder, path.relative_to(self.folder))
                path.parent.rmdir()
            total -= bytes_

    def _there(self) -> list[tuple[int, int, Path]]:
        """When each copy was used, its bytes, and where it is; none that is being written."""
        found = []
        for path in self.folder.glob("??/*/*"):
            with suppress(OSError):
                if temporary_of(path.name) is None:
                    status = path.stat()
                    found.append((status.st_mtime_ns, status.st_size, path))
        return found


class ReleaseStore:
    """The files of one release that have no paths of their own. Cheap to pickle; safe in forks and threads.

    Attributes:
        place: the archive, the folder of archives or the URL, as messages name it.
        base: what the archives' names are relative to.
        list_file: the list of the files.
    """

    def __init__(self, place: str, base: str, list_file: Path) -> None:
        """Open the list of a store's files, which is there; raises IndexStoreError if it cannot be read."""
        self.place, self.base, self.list_file = place, base, list_file
        self.members = Members(list_file)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle places; a process opens each store once."""
        return opened_store, (self.place, self.base, self.list_file)

    def __repr__(self) -> str:
        return f"ReleaseStore({self.place!r})"

    @property
    def is_remote(self) -> bool:
        """Whether it is at a URL."""
        return "://" in self.base

    @property
    def state(self) -> str:
        """A text that changes with the archives."""
        return self.list_file.name

    @property
    def places(self) -> tuple[Path, ...]:
        """What workers must see to read it."""
        return (self.list_file,) if self.is_remote else (Path(self.place), self.list_file)

    def read(self, name: str, kind: FileKind) -> bytes:
        """A file's bytes; of a URL, sensor files are kept in the user's cache (`FileCache`).

        Raises FileNotFoundError, RefusedFileError if it is too large for its kind or damaged, or any other OSError.
        """
        if (known := READ_BEFORE.get()) is not None and name in known:
            return known[name]
        member = self._member(name)
        check_size(member.size, kind)
        if self.is_remote and kind in _SENSOR_KINDS:
            with suppress(FileNotFoundError):  # another process has just made room
                return self._kept(name, member).read_bytes()
        return self._bytes(name, member)

    def local_path(self, name: str) -> Path:
        """A real path of a file's bytes, in the user's cache; it may be gone when that is full of newer ones.

        Raises MissingFileError, SensorFileError, or ConfigError if the environment names a wrong size of the cache.
        """
        try:
            return self._kept(name, self._member(name))
        except FileNotFoundError:
            raise MissingFileError(
                f"{self.place}/{name}: no such file; add the archive that holds it"
            ) from None
        except OSError as error:
            raise SensorFileError(f"{self.place}/{name}: {fault_text(error)}") from error

    def fetch(self, names: Iterable[str]) -> dict[str, bytes]:
        """Small files by name, read together, without those that are not there or damaged; raises OSError."""
        wanted = [
            (name, member) for name in names if (member := self.members.find(name)) is not None
        ]
        if not wanted:
            return {}
        contents = self._source.read_all([self._range(name, member) for name, member in wanted])
        found = {}
        for (name, member), content in zip(wanted, contents, strict=True):
            with suppress(RefusedFileError):  # read by itself it says why
                found[name] = content if member.offset < 0 else _cut_out(content, member)
        return found

    @cached_property
    def _source(self) -> Source:
        return source_of(self.base)

    @cached_property
    def _cache(self) -> FileCache:
        return FileCache.of_user()

    def _member(self, name: str) -> Member:
        member = self.members.find(name)
        if member is None:
            raise FileNotFoundError(f"{self.place}/{name}")
        return member

    def _kept(self, name: str, member: Member) -> Path:
        path = self._cache.path_of(
            f"{self.place}\n{name}\n{self.members.number_of(member)}", name.rpartition("/")[2]
        )
        if not self._cache.found(path, member.size):
            self._cache.put(path, self._bytes(name, member))
        return path

    def _range(self, name: str, member: Member) -> ByteRange:
        archive = self.members.archives[member.archive]
        if member.offset < 0:
            return f"{archive}/{name.rpartition('/')[2]}".lstrip("/"), 0, member.size
        return archive, member.offset, member.offset + LONGEST_HEAD + member.stored

    def _bytes(self, name: str, member: Member) -> bytes:
        archive, first, last = self._range(name, member)
        if member.offset < 0:
            return self._source.read(archive, first, last)
        if self.is_remote:  # one question costs more than the bytes that are too many
            return _cut_out(self._source.read(archive, first, last), member)
        start = member.offset + head_length(self._source.read(archive, first, first + HEAD_LENGTH))
        return _decoded(self._source.read(archive, start, start + member.stored), member)


def _cut_out(content: bytes, member: Member) -> bytes:
    """A member's bytes, from those of an archive from its head on."""
    start = head_length(content[:HEAD_LENGTH])
    return _decoded(content[start : start + member.stored], member)


def _decoded(content: bytes, member: Member) -> bytes:
    if len(content) < member.stored:
        raise damaged_member_error("the archive ends before it")
    content = member_bytes(content, member)
    if COMPARES.get() and zlib.crc32(content) != member.version:
        raise damaged_member_error("its bytes do not agree with its checksum")
    return content


@lru_cache(maxsize=4)
def opened_store(place: str, base: str, list_file: Path) -> ReleaseStore:
    """The store of a list of files, opened once a process."""
    return ReleaseStore(place, base, list_file)
