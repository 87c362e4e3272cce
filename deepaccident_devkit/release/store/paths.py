"""`StorePath`: a file or folder of a release that lies in archives or at a URL, with the part of Path that is used."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import total_ordering
from pathlib import Path, PurePath, PurePosixPath
from typing import Final, TypeAlias

from deepaccident_devkit.errors import (
    DatarootError,
    MissingFileError,
    NotAvailableError,
    ReleaseError,
)
from deepaccident_devkit.release.store.store import COMPARES, READ_BEFORE, ReleaseStore
from deepaccident_devkit.support.reading import FileKind, fault_text, read_bytes

REMEDY: Final = "restore the file from its archive"


@dataclass(frozen=True, slots=True)
class StoreStatus:
    """What `stat` says of a file in a store, by the names of `os.stat_result`."""

    st_mode: int
    st_size: int
    st_mtime_ns: int
    """A number that changes with the file, and with its archive."""


@total_ordering
@dataclass(frozen=True, slots=True, repr=False, eq=False)
class StorePath:
    """A path in a store; equal to another one of the same text.

    Attributes:
        store: where it is read.
        inside: the path in the release, with `/` between names; empty for the release's folder.
    """

    store: ReleaseStore
    inside: str = ""

    def __truediv__(self, below: str | PurePath) -> StorePath:
        """A path below this one."""
        text = below if isinstance(below, str) else below.as_posix()
        return StorePath(self.store, f"{self.inside}/{text}".strip("/") if text else self.inside)

    def __str__(self) -> str:
        """The store's place and the path in it."""
        return f"{self.store.place}/{self.inside}" if self.inside else self.store.place

    def __repr__(self) -> str:
        return f"StorePath({str(self)!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StorePath) and str(self) == str(other)

    def __lt__(self, other: StorePath) -> bool:
        return str(self) < str(other)

    def __hash__(self) -> int:
        return hash(str(self))

    @property
    def name(self) -> str:
        """The last name; of the release's folder that of the archive or of the URL's end."""
        return PurePosixPath(str(self)).name

    @property
    def stem(self) -> str:
        """The last name without its ending."""
        return PurePosixPath(self.name).stem

    @property
    def parent(self) -> StorePath:
        """The folder above; the release's folder is its own."""
        return StorePath(self.store, self.inside.rpartition("/")[0])

    def resolve(self) -> StorePath:
        """Itself: there are no links."""
        return self

    def exists(self) -> bool:
        """Whether there is such a file or folder."""
        return self.is_file() or self.is_dir()

    def is_file(self) -> bool:
        """Whether there is such a file."""
        return self.store.members.find(self.inside) is not None

    def is_dir(self) -> bool:
        """Whether there is such a folder."""
        return self.store.members.has_folder(self.inside)

    def stat(self) -> StoreStatus:
        """Size and kind; raises FileNotFoundError."""
        members = self.store.members
        member = members.find(self.inside)
        if member is not None:
            return StoreStatus(stat.S_IFREG, member.size, members.number_of(member))
        if self.is_dir():
            return StoreStatus(stat.S_IFDIR, 0, 0)
        raise FileNotFoundError(str(self))

    def local_path(self) -> Path:
        """A real path with its content; raises as `ReleaseStore.local_path` does."""
        return self.store.local_path(self.inside)

    def content(self, kind: FileKind) -> bytes:
        """The file's bytes, as `support.reading.read_bytes` gives them; raises OSError."""
        return self.store.read(self.inside, kind)


# Where something of a release lies: a real path, or one in a store.
ReleasePath: TypeAlias = Path | StorePath


def places_of(root: ReleasePath) -> tuple[Path, ...]:
    """What workers must see to read a release."""
    return (root,) if isinstance(root, Path) else root.store.places


def read_content(
    path: ReleasePath, kind: FileKind, fault: type[ReleaseError], remedy: str = REMEDY
) -> bytes:
    """A file's bytes; raises MissingFileError, and `fault` if it cannot be read or is too large for its kind."""
    try:
        return read_bytes(path, kind)
    except FileNotFoundError:
        raise MissingFileError(f"{path}: no such file; unpack the archive that holds it") from None
    except OSError as error:
        raise fault(f"{path}: {fault_text(error)}; {remedy}") from error


def read_lines(
    path: ReleasePath,
    kind: FileKind,
    fault: type[ReleaseError],
    remedy: str = REMEDY,
    *,
    errors: str = "strict",
) -> list[str]:
    """The lines of a UTF-8 file, without line ends; raises as `read_content` does, and `fault` if it is no text.

    `errors` says what to do with bytes that are not UTF-8, as of `bytes.decode`.
    """
    try:
        return (
            read_content(path, kind, fault, remedy).decode("utf-8-sig", errors=errors).splitlines()
        )
    except UnicodeDecodeError as error:
        raise fault(f"{path}: not a text file ({error.reason}); {remedy}") from error


def real_path(path: ReleasePath) -> Path:
    """A path that other programs can write to; raises NotAvailableError if this has no path of the system."""
    if isinstance(path, Path):
        return path
    raise NotAvailableError(
        f"{path}: lies in an archive or at a URL, and has no path of its own; unpack it first"
    )


@dataclass(frozen=True, slots=True)
class StoreEntry:
    """What lies in a folder of a store, as `os.DirEntry`."""

    name: str
    status: StoreStatus

    def is_dir(self) -> bool:
        """Whether it is a folder."""
        return stat.S_ISDIR(self.status.st_mode)

    def is_file(self) -> bool:
        """Whether it is a file."""
        return not self.is_dir()

    def stat(self) -> StoreStatus:
        """Its size and kind."""
        return self.status


# How a caller names a release: its folder, an archive, a folder of archives, a URL.
Dataroot: TypeAlias = str | os.PathLike[str] | ReleasePath
FolderEntry: TypeAlias = os.DirEntry[str] | StoreEntry


def folder_entries(folder: ReleasePath) -> list[FolderEntry]:
    """What lies in a folder, in no order; raises OSError, FileNotFoundError and NotADirectoryError among them."""
    if isinstance(folder, Path):
        with os.scandir(folder) as entries:
            return list(entries)
    members = folder.store.members
    if not members.has_folder(folder.inside):
        if folder.is_file():
            raise NotADirectoryError(str(folder))
        raise FileNotFoundError(str(folder))
    folders = [
        StoreEntry(name, StoreStatus(stat.S_IFDIR, 0, 0))
        for name in members.folders_in(folder.inside)
    ]
    files = [
        StoreEntry(name, StoreStatus(stat.S_IFREG, member.size, members.number_of(member)))
        for name, member in members.files_in(folder.inside)
    ]
    return [*folders, *files]


def is_folder(entry: FolderEntry, *, loops: bool = False) -> bool:
    """Whether an entry is a folder, or a link whose end cannot be looked at; listing that one tells why.

    Links that lead back (`leads_back`) are none, unless `loops`.
    """
    try:
        return (loops or not leads_back(entry)) and entry.is_dir()
    except OSError:
        return True


def leads_back(entry: FolderEntry) -> bool:
    """Whether an entry is a link that leads nowhere: its end is not there, is itself, or a folder that it lies in."""
    if isinstance(entry, StoreEntry) or not entry.is_symlink():
        return False
    folder = Path(os.path.realpath(os.path.dirname(entry.path)))  # noqa: PTH120 - `Path.resolve` raises for links to themselves
    return not os.path.exists(entry.path) or folder.is_relative_to(os.path.realpath(entry.path))  # noqa: PTH110


def _fetched(paths: Sequence[StorePath]) -> dict[str, bytes] | None:
    if not paths:
        return None
    store = paths[0].store
    try:
        return store.fetch(path.inside for path in paths)
    except FileNotFoundError:  # one after the other they say which one is gone
        return None
    except OSError as error:
        raise DatarootError(
            f"{store.place}: {fault_text(error)}; check the connection and the credentials"
        ) from error


@contextmanager
def fetched(paths: Iterable[ReleasePath]) -> Iterator[None]:
    """Have small files at a URL read together, and from memory in the block and thread; raises DatarootError."""
    remote = [path for path in paths if isinstance(path, StorePath) and path.store.is_remote]
    token = READ_BEFORE.set(_fetched(remote))
    try:
        yield
    finally:
        READ_BEFORE.reset(token)


@contextmanager
def checksums_compared() -> Iterator[None]:
    """Have what is read from archives in the block, in this thread, compared with the archives' checksums."""
    token = COMPARES.set(True)
    try:
        yield
    finally:
        COMPARES.reset(token)
