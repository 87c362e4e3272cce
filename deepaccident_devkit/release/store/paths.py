"""`StorePath`: a path of a release in archives or at a URL, with the methods of Path in use."""

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
from deepaccident_devkit.support.text import PathType

REMEDY: Final = "restore the file from its archive"


@dataclass(frozen=True, slots=True)
class StoreStatus:
    """Status of a file in a store, with the names of `os.stat_result`."""

    st_mode: int
    st_size: int
    st_mtime_ns: int
    """Number that changes with the file, and with its archive."""


@total_ordering
@dataclass(frozen=True, slots=True, repr=False, eq=False)
class StorePath:
    """A path in a store; paths with the same text are equal.

    Attributes:
        store: Store of the path.
        inside: Path in the release, with `/` between names; empty for the release's folder.
    """

    store: ReleaseStore
    inside: str = ""

    def __truediv__(self, relative: str | PurePath) -> StorePath:
        """Return a path below this one."""
        text = relative if isinstance(relative, str) else relative.as_posix()
        inside = self.inside
        if text:
            inside = f"{inside}/{text}".strip("/")
        return StorePath(self.store, inside)

    def __str__(self) -> str:
        """Return the store's location and the path in it."""
        if self.inside:
            return f"{self.store.place}/{self.inside}"
        return self.store.place

    def __repr__(self) -> str:
        return f"StorePath({str(self)!r})"

    def __eq__(self, other: object) -> bool:
        if isinstance(other, StorePath):
            return str(self) == str(other)
        return False

    def __lt__(self, other: StorePath) -> bool:
        return str(self) < str(other)

    def __hash__(self) -> int:
        return hash(str(self))

    @property
    def name(self) -> str:
        """Last name; for the release's folder, the name of the archive or the end of the URL."""
        return PurePosixPath(str(self)).name

    @property
    def stem(self) -> str:
        """Last name without its ending."""
        return PurePosixPath(self.name).stem

    @property
    def parent(self) -> StorePath:
        """Parent folder; the release's folder is its own."""
        return StorePath(self.store, self.inside.rpartition("/")[0])

    def resolve(self) -> StorePath:
        """Return the path itself: there are no links."""
        return self

    def exists(self) -> bool:
        """Return whether there is such a file or folder."""
        return self.is_file() or self.is_dir()

    def is_file(self) -> bool:
        """Return whether there is such a file."""
        return self.store.members.find(self.inside) is not None

    def is_dir(self) -> bool:
        """Return whether there is such a folder."""
        return self.store.members.has_folder(self.inside)

    def stat(self) -> StoreStatus:
        """Return the size and the kind of the file or folder; raises FileNotFoundError."""
        members = self.store.members
        member = members.find(self.inside)
        if member is not None:
            return StoreStatus(stat.S_IFREG, member.size, members.number_of(member))
        if self.is_dir():
            return StoreStatus(stat.S_IFDIR, 0, 0)
        raise FileNotFoundError(str(self))

    def local_path(self) -> Path:
        """Return a real path of the file's content; raises as `ReleaseStore.local_path` does."""
        return self.store.local_path(self.inside)

    def content(self, kind: FileKind) -> bytes:
        """Return the file's bytes like `support.reading.read_bytes`; raises OSError."""
        return self.store.read(self.inside, kind)


# A path of a release: a real path, or a path in a store.
ReleasePath: TypeAlias = Path | StorePath
# A caller's name for a release: its folder, an archive, a folder of archives, a URL.
Dataroot: TypeAlias = PathType | ReleasePath


def places_of(root: ReleasePath) -> tuple[Path, ...]:
    """Return the real paths that a worker must be able to read to use a release."""
    if isinstance(root, Path):
        return (root,)
    return root.store.places


def read_content(
    path: ReleasePath, kind: FileKind, fault: type[ReleaseError], remedy: str = REMEDY
) -> bytes:
    """Read a file's bytes.

    Raises MissingFileError, and `fault` if the file cannot be read or is too large for its kind.
    """
    try:
        return read_bytes(path, kind)
    except FileNotFoundError:
        raise MissingFileError(
            f"{path}: no such file; unpack the archive that contains it"
        ) from None
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
    """Read the lines of a UTF-8 file, without line ends.

    Args:
        path: The file.
        kind: Kind of the file, which limits its size.
        fault: Error for a file that cannot be read or is not text.
        remedy: Remedy in the error.
        errors: What to do with bytes that are not UTF-8, as in `bytes.decode`.

    Raises:
        ReleaseError: As in `read_content`, and `fault` if the file is not text.
    """
    content = read_content(path, kind, fault, remedy)
    try:
        return content.decode("utf-8-sig", errors=errors).splitlines()
    except UnicodeDecodeError as error:
        raise fault(f"{path}: not a text file ({error.reason}); {remedy}") from error


def real_path(path: ReleasePath) -> Path:
    """Return the same path if it is one of the file system, which other programs can use.

    Raises NotAvailableError for a path in a store.
    """
    if isinstance(path, Path):
        return path
    raise NotAvailableError(
        f"{path}: is in an archive or at a URL, and has no local path; unpack it first"
    )


@dataclass(frozen=True, slots=True)
class StoreEntry:
    """An entry of a folder in a store, like `os.DirEntry`."""

    name: str
    status: StoreStatus

    def is_dir(self) -> bool:
        """Return whether the entry is a folder."""
        return stat.S_ISDIR(self.status.st_mode)

    def is_file(self) -> bool:
        """Return whether the entry is a file."""
        return not self.is_dir()

    def stat(self) -> StoreStatus:
        """Return the entry's size and kind."""
        return self.status


FolderEntry: TypeAlias = os.DirEntry[str] | StoreEntry


def folder_entries(folder: ReleasePath) -> list[FolderEntry]:
    """Return the entries of a folder, in any order.

    Raises OSError, which may be a FileNotFoundError or a NotADirectoryError.
    """
    if isinstance(folder, Path):
        with os.scandir(folder) as entries:
            return list(entries)
    members = folder.store.members
    if not members.has_folder(folder.inside):
        if folder.is_file():
            raise NotADirectoryError(str(folder))
        raise FileNotFoundError(str(folder))
    store_entries: list[FolderEntry] = []
    for name in members.folders_in(folder.inside):
        store_entries.append(StoreEntry(name, StoreStatus(stat.S_IFDIR, 0, 0)))
    for name, member in members.files_in(folder.inside):
        status = StoreStatus(stat.S_IFREG, member.size, members.number_of(member))
        store_entries.append(StoreEntry(name, status))
    return store_entries


def is_folder(entry: FolderEntry, *, loops: bool = False) -> bool:
    """Return whether an entry is a folder, or a link with a target that cannot be accessed.

    Listing such a link raises the reason. Links that lead back (`leads_back`) are not folders,
    except with `loops`.
    """
    try:
        if not loops and leads_back(entry):
            return False
        return entry.is_dir()
    except OSError:
        return True


def leads_back(entry: FolderEntry) -> bool:
    """Return whether an entry is a link that leads nowhere or back.

    Its target does not exist, is the link itself, or is a folder that holds the link.
    """
    if isinstance(entry, StoreEntry) or not entry.is_symlink():
        return False
    if not os.path.exists(entry.path):  # noqa: PTH110
        return True
    # `Path.resolve` raises for links to themselves.
    folder = Path(os.path.realpath(os.path.dirname(entry.path)))  # noqa: PTH120
    return folder.is_relative_to(os.path.realpath(entry.path))


def _fetch_contents(paths: Sequence[StorePath]) -> dict[str, bytes] | None:
    """Read small files together; return None if there are none, or if one is missing."""
    if not paths:
        return None
    store = paths[0].store
    try:
        return store.fetch(path.inside for path in paths)
    except FileNotFoundError:  # separate reads raise the error of the missing file
        return None
    except OSError as error:
        raise DatarootError(
            f"{store.place}: {fault_text(error)}; check the connection and the credentials"
        ) from error


@contextmanager
def fetched(paths: Iterable[ReleasePath]) -> Iterator[None]:
    """Read small files at a URL together, and use their bytes within the block.

    This holds for the current thread. Raises DatarootError.
    """
    remote_paths = [path for path in paths if isinstance(path, StorePath) and path.store.is_remote]
    contents = _fetch_contents(remote_paths)
    token = READ_BEFORE.set(contents)
    try:
        yield
    finally:
        READ_BEFORE.reset(token)


@contextmanager
def checksums_compared() -> Iterator[None]:
    """Compare bytes from archives with their checksums within the block, in this thread."""
    token = COMPARES.set(True)
    try:
        yield
    finally:
        COMPARES.reset(token)
