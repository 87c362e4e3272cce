"""Removing the indexes of a release, and nothing else."""

import re
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from deepaccident_devkit.errors import IndexStoreError, VersionError
from deepaccident_devkit.files import temporary_of
from deepaccident_devkit.release.store import Dataroot, index_places, list_files_in
from deepaccident_devkit.tables.index import index_folders
from deepaccident_devkit.tables.indexing import MARK_FILE, SHARDS_FOLDER
from deepaccident_devkit.tables.locking import LOCK_FILE, index_lock
from deepaccident_devkit.tables.manifest import MANIFEST_FILE, SCHEMA_VERSION, TABLES_PREFIX, stored_schema_version
from deepaccident_devkit.taxonomy import VERSIONS
from deepaccident_devkit.text import choice

_FILE = re.compile(r".*\.arrow|town_map-\w+\.npz|\..*\.(tmp|part)", re.DOTALL)
_NAMED = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Cleared:
    """An index that was removed.

    Attributes:
        folder: where it lay.
        num_files: how many files it had, the lock not counted.
        num_bytes: their size.
    """

    folder: Path
    num_files: int
    num_bytes: int

    def to_text(self) -> str:
        """A line for a terminal."""
        return f"removed {self.folder}: {self.num_files} files, {megabytes(self.num_bytes)}"


def clear_index(dataroot: Dataroot, *, version: str = "v1", index_dir: Path | None = None) -> list[Cleared]:
    """Remove the indexes of a release, in its own folder and in the user's cache, with what stopped processes left.

    Waits for a process that makes one. The release itself is not needed, nor touched.

    Args:
        dataroot: the release, as of `DeepAccident`; it need not be there.
        version: whose indexes.
        index_dir: the only place to look in, where given.

    Returns:
        What was removed; empty if there was no index.

    Raises:
        IndexStoreError: something there is no part of an index, and then nothing is removed; or the removal failed.
        VersionError: the version is unknown.
    """
    version = choice("version", version, VERSIONS, error=VersionError)
    folders = [folder for folder in index_folders(dataroot, version, index_dir) if folder.is_dir()]
    for folder in folders:
        _refuse_foreign(folder)
    cleared = []
    for folder in folders:
        had_index = holds_index(folder)
        with index_lock(folder):
            _refuse_foreign(folder)
            removed = _remove(folder)
        if had_index:
            cleared.append(removed)
    for place in index_places(dataroot, index_dir):
        with suppress(OSError):  # not there, or not empty: another version's index
            for listing in list_files_in(place):
                listing.unlink(missing_ok=True)
            if index_dir is None:
                place.rmdir()
    return cleared


def holds_index(folder: Path) -> bool:
    """Whether there is an index, or part of one."""
    return any(_is_own(path) and path.name != LOCK_FILE for path in _entries(folder))


def sizes_in(folder: Path) -> dict[Path, int]:
    """The size of every file below a folder, by its path from there."""
    sizes = {}
    for path in folder.rglob("*"):
        with suppress(OSError):  # removed meanwhile
            if path.is_file():
                sizes[path.relative_to(folder)] = path.stat().st_size
    return sizes


def megabytes(size: int) -> str:
    """A size in words."""
    return f"{size / 1e6:,.1f} MB"


def _refuse_foreign(folder: Path) -> None:
    """Raise IndexStoreError if there is anything in the folder that no devkit puts there."""
    foreign = [path for path in _entries(folder) if not _is_own(path)]
    stored = stored_schema_version(folder)
    if stored is None or stored <= SCHEMA_VERSION:  # a newer devkit's folders may hold other files
        own_folders = [path for path in _entries(folder) if path not in foreign and path.is_dir()]
        inside = (path for own in own_folders for path in own.rglob("*"))
        foreign += [path for path in inside if path.is_symlink() or not (path.is_dir() or _is_own_file(path))]
        named = {path.name for path in _entries(folder)} - {LOCK_FILE}
        if stored is None and named == {MANIFEST_FILE}:
            foreign.append(folder / MANIFEST_FILE)
    if foreign:
        names = ", ".join(str(path.relative_to(folder)) for path in sorted(foreign)[:_NAMED])
        raise IndexStoreError(f"{folder}: not removed: it holds what is no part of an index: {names}; look at it")


def _is_own_file(path: Path) -> bool:
    """Whether a file in a devkit's folder has the name of one of its files; what a store keeps has any name."""
    return "kept" in path.parts or _FILE.fullmatch(path.name) is not None


def _is_own(path: Path) -> bool:
    """Whether an entry of an index folder has the name and kind of a devkit's."""
    name = path.name
    if path.is_symlink():
        return False
    if path.is_dir():
        return name == SHARDS_FOLDER or name.startswith((TABLES_PREFIX, f".{TABLES_PREFIX}"))
    return name in (MANIFEST_FILE, MARK_FILE, LOCK_FILE) or temporary_of(name) == MANIFEST_FILE


def _remove(folder: Path) -> Cleared:
    """Remove an index folder whose lock is held: the manifest first, so that half an index is not taken for one."""
    sizes = [size for path, size in sizes_in(folder).items() if path.name != LOCK_FILE]
    try:
        (folder / MANIFEST_FILE).unlink(missing_ok=True)
        for path in _entries(folder):
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name != LOCK_FILE:
                path.unlink(missing_ok=True)
        (folder / LOCK_FILE).unlink(missing_ok=True)
    except OSError as error:
        raise IndexStoreError(f"{folder}: cannot be removed ({error})") from error
    with suppress(OSError):  # a symbolic link, or another process has come
        folder.rmdir()
    return Cleared(folder=folder, num_files=len(sizes), num_bytes=sum(sizes))


def _entries(folder: Path) -> list[Path]:
    """What lies in a folder; nothing if it cannot be listed."""
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []
