"""Opening a dataroot by the caller's name for it: a real folder, archives, or a URL."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final, TypeAlias
from urllib.parse import unquote, urlsplit

import numpy as np

from deepaccident_devkit.errors import DatarootError, DeepAccidentError, IndexStoreError, escaped
from deepaccident_devkit.release.store.members import (
    FORM,
    MINI_FOLDER,
    SCENARIO_TYPE,
    SPLIT_FILE_FOLDER,
    SPLIT_FILES,
    SPLIT_FOLDERS,
    FileState,
    Listing,
    Members,
    is_release_file,
    release_folder,
    write_members,
)
from deepaccident_devkit.release.store.paths import (
    Dataroot,
    ReleasePath,
    StorePath,
    folder_entries,
    is_folder,
)
from deepaccident_devkit.release.store.sources import UrlSource, call_library, list_zip
from deepaccident_devkit.release.store.store import opened_store
from deepaccident_devkit.support.files import is_writable_folder
from deepaccident_devkit.support.reading import fault_text, open_file, reason_text
from deepaccident_devkit.support.text import PathType, counted, path_text
from deepaccident_devkit.taxonomy import OnError

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine, Failure

# File → its state.
_States: TypeAlias = Mapping[str, FileState]
INDEX_FOLDER: Final = ".deepaccident"
_ARCHIVE_ENDING = ".zip"
# Archives may lie in folders of this depth below a dataroot.
_MAX_DEPTH = 3
# Begin of the name of a list of a store's files.
_LIST_PREFIX = "files-"
_SKIP_REMEDY = (
    "\nThe other archives can be read: move the broken ones out of the folder, "
    "or pass on_error='skip' (--on-error skip)."
)
_logger = logging.getLogger(__name__)


def open_dataroot(
    dataroot: Dataroot,
    index_dir: Path | None = None,
    *,
    refresh: bool = False,
    outside: bool = False,
    on_error: OnError = "raise",
    **engine: Unpack[Engine],
) -> ReleasePath:
    """Return the path at which the files of a release are read.

    A folder that holds a release is read directly. The files of a zip, a folder of zips or a URL
    are listed once, beside the index. Archives are listed again when they change or are replaced,
    and a URL's files when `refresh` is set.

    Args:
        dataroot: A folder, a zip, a folder with zips (each of any part of a release), or a URL that
            fsspec can list.
        index_dir: Folder for lists and indexes; by default in the dataroot, or in the user's cache.
        refresh: Whether to list the files of a URL again.
        outside: Whether to store a new list in the user's cache instead of beside the archives.
        on_error: What to do if archives cannot be listed: `raise` names all of them, `skip` leaves
            them out and logs them, even if there is no other archive.
        **engine: `workers`, `executor` and `progress` for the lists of archives, see
            `parallel.Engine`.

    Returns:
        The folder's absolute path, which need not exist; or the release's folder in a store.

    Raises:
        DatarootError: If archives cannot be read, if two hold the same file, or if the URL cannot
            be listed.
        IndexStoreError: If the list cannot be written or read.
        MissingExtraError: If the URL needs fsspec, or one of its file systems.
    """
    if isinstance(dataroot, StorePath):
        if not (refresh and dataroot.store.is_remote):
            return dataroot
        dataroot = dataroot.store.place
    location = _resolve_location(dataroot)
    folders = list(index_places(location, index_dir))
    if outside:
        folders.reverse()
    if isinstance(location, str):
        return _open_url(UrlSource(location), folders, on_error, refresh=refresh)
    archives = _find_archives(location)
    if not archives:
        return location
    return _open_archives(location, archives, folders, on_error, **engine)


def refused_archives(root: ReleasePath) -> list[str]:
    """Return a sentence for each archive that a store lacks, with its name, fault and remedy."""
    if isinstance(root, Path):
        return []
    results = _list_archives(root.store.base, root.store.members.lacking)
    return [result.message for result in results if not isinstance(result, Listing)]


def index_places(dataroot: Dataroot, index_dir: Path | None = None) -> Iterator[Path]:
    """Yield the folders that may hold a dataroot's index, the preferred one first."""
    if index_dir is not None:
        yield index_dir
        return
    location = _resolve_location(
        dataroot.store.place if isinstance(dataroot, StorePath) else dataroot
    )
    identity = os.fsencode(location)
    if isinstance(location, Path):
        if location.is_file():
            yield location.parent / INDEX_FOLDER / location.name
        else:
            yield location / INDEX_FOLDER
        identity = os.fsencode(os.path.realpath(location))  # `resolve` raises for a link to itself
    from platformdirs import user_cache_path

    digest = hashlib.blake2b(identity, digest_size=8).hexdigest()
    yield user_cache_path("deepaccident_devkit") / digest


def list_files_in(folder: Path) -> list[Path]:
    """Return the paths of the lists of files in a folder of indexes."""
    return sorted(folder.glob(f"{_LIST_PREFIX}*"))


def _resolve_location(dataroot: PathType) -> Path | str:
    """Return the absolute path of a dataroot, with its symbolic links, or its URL."""
    text = path_text(dataroot, "dataroot: expected a path or a URL", error=DatarootError)
    if "://" in text:
        parts = urlsplit(text)
        if parts.scheme != "file":
            return text
        text = unquote(parts.path)
    return Path(os.path.abspath(Path(text).expanduser()))  # noqa: PTH100


def _find_archives(path: Path) -> list[Path]:
    """Return the archives of a path: itself, or the archives in a folder that holds no release.

    There are none for other paths.
    """
    if path.suffix.lower() == _ARCHIVE_ENDING and path.is_file():
        return [path]
    for name in ("", *SPLIT_FOLDERS, MINI_FOLDER):
        if _has_scenarios(path / name):
            return []
    archives = []
    folders = [(path, 0)]
    while folders:
        folder, depth = folders.pop()
        with suppress(OSError):
            for entry in folder_entries(folder):
                entry_path = folder / entry.name
                is_hidden = entry.name.startswith(".")
                if is_folder(entry) and depth < _MAX_DEPTH and not is_hidden:
                    folders.append((entry_path, depth + 1))
                elif _is_archive(entry.name) and entry_path.is_file() and not is_hidden:
                    archives.append(entry_path)
    return sorted(archives)


def _is_archive(name: str) -> bool:
    """Return whether a file name or a URL names an archive."""
    return name.lower().endswith(_ARCHIVE_ENDING)


def _has_scenarios(folder: Path) -> bool:
    """Return whether a folder holds scenario types."""
    with suppress(OSError):
        for entry in folder_entries(folder):
            if SCENARIO_TYPE.fullmatch(entry.name) and is_folder(entry):
                return True
    return False


def _open_archives(
    path: Path,
    archives: Sequence[Path],
    folders: Sequence[Path],
    on_error: OnError,
    **engine: Unpack[Engine],
) -> StorePath:
    """Open the release in archives at or below a path; `folders` may hold its list of files."""
    base = path.parent if archives == [path] else path
    split_files = []
    for split_folder in (path, path / SPLIT_FILE_FOLDER):
        split_files += [split_folder / name for name in SPLIT_FILES]
    states = _read_states(base, archives)
    split_states = _read_states(base, filter(Path.is_file, split_files))
    all_states = sorted({**states, **split_states}.items())
    name = list_name(all_states)
    for folder in folders:
        list_file = folder / name
        if list_file.is_file():
            with suppress(IndexStoreError):  # a damaged list is made again
                return StorePath(opened_store(str(path), str(base), list_file))
    results = _list_archives(str(base), states, (base,), **engine)
    listings = _add_loose_files(_accept_listings(str(path), results, on_error), split_states)
    list_file = _write_list(folders, all_states, listings, states)
    return StorePath(opened_store(str(path), str(base), list_file))


def _read_states(base: Path, files: Iterable[Path]) -> _States:
    """Return path below a base folder → state of the file."""
    return {file.relative_to(base).as_posix(): state_of(file) for file in files}


def state_of(file: Path) -> FileState:
    """Return a file's size in bytes, and a text that changes with it.

    The text also changes if the file's time is reset.
    """
    status = file.stat()
    return status.st_size, f"{status.st_mtime_ns} {status.st_ctime_ns}"


def _open_url(
    source: UrlSource, folders: Sequence[Path], on_error: OnError, *, refresh: bool
) -> StorePath:
    """Open the release at a URL; `folders` may hold its list of files."""
    url = source.url
    base = UrlSource(url.rpartition("/")[0]) if _is_archive(url) else source
    with _dataroot_errors(url):
        list_file = None if refresh else _find_known_list(base, folders)
        if list_file is None:
            archives, loose_files = _list_url_files(base, url)
            results = _list_archives(base.url, archives, workers=1)
            listings = _add_loose_files(_accept_listings(url, results, on_error), loose_files)
            if on_error == "raise" and not any(listing.names for listing in listings):
                raise DatarootError(
                    f"{url}: no file of a release found; give the URL of the folder that "
                    "contains the release"
                )
            states = [*archives.items(), *loose_files.items()]
            list_file = _write_list(folders, states, listings, archives)
    return StorePath(opened_store(url, base.url, list_file))


def _list_archives(
    base: str, archives: Iterable[str], read_paths: tuple[Path, ...] = (), **engine: Unpack[Engine]
) -> list[Listing | Failure]:
    """List archives, which are paths from the base, a folder or a URL.

    A Failure has the reason why an archive cannot be listed.
    """
    # Imported late, since few dataroots are archives.
    from deepaccident_devkit.support.parallel import Places, Tried, run_batch

    work = Tried(partial(_list_archive, base))
    places = Places(reads=read_paths)
    return run_batch(work, list(archives), label="Listing archives", places=places, **engine)


def _list_archive(base: str, name: str) -> Listing:
    """List the release's files in an archive, or raise DatarootError."""
    path = f"{base}/{name}"

    def read_listing() -> Listing:
        with UrlSource(base).open_archive(name) if "://" in base else open_file(Path(path)) as file:
            return list_zip(file, name, path)

    try:
        return call_library(read_listing)
    except DatarootError:
        raise
    except OSError as error:
        raise DatarootError(
            f"{path}: {fault_text(error)}; make it readable, or download it again"
        ) from error


def _accept_listings(
    location: str, results: Sequence[Listing | Failure], on_error: OnError
) -> list[Listing]:
    """Return the listings of the archives that can be listed.

    The others are logged, or DatarootError names all of them.
    """
    listings = [result for result in results if isinstance(result, Listing)]
    refused = [result.message for result in results if not isinstance(result, Listing)]
    archives = counted(len(results), "archive")
    title = f"{location}: {len(refused)} of {archives} cannot be read:"
    text = "\n  ".join([title, *refused])
    if refused and on_error == "raise":
        if listings:
            text += _SKIP_REMEDY
        raise DatarootError(text)
    if refused:
        _logger.warning("excluded archives: %s", escaped(text))
    return listings


def _find_known_list(base: UrlSource, folders: Sequence[Path]) -> Path | None:
    """Return the path of a list of all of a URL's files, if its archives have not changed since.

    The states of other files are not requested.
    """
    for folder in folders:
        for path in list_files_in(folder):
            with suppress(IndexStoreError):
                members = Members(path)
                if not members.lacking and _has_states(base, members.states):
                    return path
    return None


def _has_states(base: UrlSource, states: _States) -> bool:
    """Return whether files at a URL still have these states."""
    for name, state in states.items():
        if base.state_of(name) != state:
            return False
    return True


def _list_url_files(base: UrlSource, url: str) -> tuple[_States, _States]:
    """Return the states of the archives at a URL, and of the other files that are read.

    The other files are split files beside archives, or all files if there are no archives. The keys
    are the paths from the base.
    """
    if base.url != url:
        name = PurePosixPath(url).name
        return {name: base.state_of(name)}, {}
    files = dict(sorted(base.list_files().items()))
    archives = {name: state for name, state in files.items() if _is_archive(name)}
    folders = {path.rpartition("/")[0] for path in files}
    if not archives or any(release_folder(folder.split("/")) for folder in folders):
        return {}, files
    split_files = {name: state for name, state in files.items() if _is_split_file(name)}
    return archives, split_files


def _is_split_file(path: str) -> bool:
    """Return whether a file beside archives is a split file, by its path from the base."""
    folder, _, name = path.rpartition("/")
    return name in SPLIT_FILES and folder in ("", SPLIT_FILE_FOLDER)


def _add_loose_files(listings: Sequence[Listing], files: _States) -> list[Listing]:
    """Return the listings of archives and of the files beside them.

    A split file in an archive takes precedence over one beside the archives.
    """
    archived_files: set[str] = set()
    for listing in listings:
        archived_files.update(name for name in listing.names if name in SPLIT_FILES)
    loose_paths = [path for path in files if path.rpartition("/")[2] not in archived_files]
    return [*listings, *_list_loose_files({path: files[path] for path in loose_paths})]


def _list_loose_files(files: _States) -> list[Listing]:
    """Return a listing for each folder of files that are in no archive.

    There is one for the base folder even if it has no files.
    """
    folders: dict[str, list[str]] = {"": []}
    for path in files:
        folders.setdefault(path.rpartition("/")[0], []).append(path)
    listings = []
    for folder, paths in folders.items():
        release_name = release_folder(folder.split("/"))
        if release_name is None:
            continue
        names = []
        states = []
        for path in paths:
            name = path.rpartition("/")[2]
            if is_release_file(release_name, name):
                names.append(name)
                states.append(files[path])
        sizes = np.array([size for size, _ in states], np.int64)
        versions = [zlib.crc32(text.encode()) for _, text in states]
        numbers = {
            "offset": np.full(len(names), -1),
            "stored": sizes,
            "size": sizes,
            "version": np.array(versions, np.uint32),
            "deflated": np.zeros(len(names), np.uint8),
        }
        listing = Listing(
            archive=folder,
            folders=[release_name],
            folder=np.zeros(len(names), int),
            names=names,
            numbers=numbers,
        )
        listings.append(listing)
    return listings


def unwritable_error(folders: Sequence[Path]) -> IndexStoreError:
    """Return the error for an index if none of its possible folders can be written to."""
    names = " or ".join(map(str, folders))
    return IndexStoreError(
        f"{names}: no place to write the index; give a writable folder with index_dir="
    )


def list_name(states: Sequence[Any]) -> str:
    """Return the file name of the list of a store, which follows from the states of its files."""
    content = json.dumps([FORM, states]).encode()
    digest = hashlib.blake2b(content, digest_size=8).hexdigest()
    return f"{_LIST_PREFIX}{digest}.arrow"


def _write_list(
    folders: Sequence[Path],
    all_states: Sequence[Any],
    listings: Sequence[Listing],
    states: _States,
) -> Path:
    """Write the list of a store's files into the first writable folder, and remove older lists.

    The name follows from the states of all files. If archives could not be listed it also has
    theirs, so that they are tried again each time.
    """
    refused = states.keys() - {listing.archive for listing in listings}
    name = list_name([*all_states, *sorted(refused)])
    folder = next(filter(is_writable_folder, folders), None)
    if folder is None:
        raise unwritable_error(folders)
    list_file = folder / name
    try:
        write_members(list_file, listings, states)
        for path in list_files_in(folder):
            if path.name != name:
                path.unlink(missing_ok=True)
    except DeepAccidentError:
        raise
    except OSError as error:
        raise IndexStoreError(
            f"{list_file}: cannot be written ({reason_text(error)}); free space there"
        ) from error
    return list_file


@contextmanager
def _dataroot_errors(url: str) -> Iterator[None]:
    """Turn errors of a URL's files, raised within the block, into DatarootError."""
    try:
        yield
    except DeepAccidentError:
        raise
    except OSError as error:
        if isinstance(error, FileNotFoundError):
            fault = "does not exist, or may not be listed"
        else:
            fault = fault_text(error)
        raise DatarootError(
            f"{url}: {fault}; check the URL, and the credentials in the environment"
        ) from None
