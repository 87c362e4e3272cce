"""A dataroot, as a caller names it → where its files are read: a real folder, archives, or a URL."""

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
from deepaccident_devkit.release.store.sources import UrlSource, asked, list_zip
from deepaccident_devkit.release.store.store import opened_store
from deepaccident_devkit.support.files import is_writable_folder
from deepaccident_devkit.support.reading import fault_text, open_file
from deepaccident_devkit.support.text import path_text
from deepaccident_devkit.taxonomy import OnError

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine, Failure

# File → its bytes, and a text that changes with it.
_States: TypeAlias = Mapping[str, tuple[int, str]]
INDEX_FOLDER: Final = ".deepaccident"
_ENDING: Final = ".zip"
# Folders below a dataroot in which archives are looked for.
_DEEPEST: Final = 3
# How the name of a list of a store's files begins.
_LIST: Final = "files-"
_WITHOUT_THEM: Final = "\nThe others can be read without them: move them out of the folder, or pass on_error='skip' (--on-error skip)."
_logger = logging.getLogger(__name__)


def open_dataroot(
    dataroot: Dataroot,
    index_dir: Path | None = None,
    *,
    refresh: bool = False,
    outside: bool = False,
    on_error: OnError = "raise",
    **how: Unpack[Engine],
) -> ReleasePath:
    """Where the files of a release are read.

    A folder that holds a release is read as it is. Of a zip, a folder of zips and a URL, the files are listed once,
    beside the index; archives are listed again when they change or are replaced, a URL's files when `refresh` is set.

    Args:
        dataroot: a folder, a zip, a folder with zips (of any part of a release each), or a URL that fsspec can list.
        index_dir: where lists and indexes are kept; by default in the dataroot, or in the user's cache.
        refresh: list the files of a URL again.
        outside: keep a new list in the user's cache, not beside the archives.
        on_error: what to do if archives cannot be listed: `raise` names all of them, `skip` leaves them out and logs
            them, even if no other archive is there.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says; for the lists of archives.

    Returns:
        The folder's absolute path, which need not be there; or the release's folder in a store.

    Raises:
        DatarootError: archives cannot be read, two hold the same file, or the URL cannot be listed.
        IndexStoreError: the list cannot be kept or read.
        MissingExtraError: the URL needs fsspec, or one of its file systems.
    """
    if isinstance(dataroot, StorePath):
        if not (refresh and dataroot.store.is_remote):
            return dataroot
        dataroot = dataroot.store.place
    located = _located(dataroot)
    places = list(index_places(located, index_dir))
    if outside:
        places.reverse()
    if isinstance(located, str):
        return _opened_url(UrlSource(located), places, on_error, refresh=refresh)
    archives = _archives(located)
    return _opened_archives(located, archives, places, on_error, **how) if archives else located


def refused_archives(root: ReleasePath) -> list[str]:
    """Return a sentence for each archive that was left out of a store: which one, what is wrong with it, a remedy."""
    results = (
        [] if isinstance(root, Path) else _listings(root.store.base, root.store.members.lacking)
    )
    return [result.message for result in results if not isinstance(result, Listing)]


def index_places(dataroot: Dataroot, index_dir: Path | None = None) -> Iterator[Path]:
    """The folders in which a dataroot's index may be kept, the first choice first."""
    if index_dir is not None:
        yield index_dir
        return
    located = _located(dataroot.store.place if isinstance(dataroot, StorePath) else dataroot)
    identity = os.fsencode(located)
    if isinstance(located, Path):
        yield (
            located.parent / INDEX_FOLDER / located.name
            if located.is_file()
            else located / INDEX_FOLDER
        )
        identity = os.fsencode(os.path.realpath(located))  # `resolve` raises for a link to itself
    from platformdirs import user_cache_path

    yield (
        user_cache_path("deepaccident_devkit")
        / hashlib.blake2b(identity, digest_size=8).hexdigest()
    )


def list_files_in(place: Path) -> list[Path]:
    """The lists of stores' files in a folder of indexes, with what they were made from."""
    return sorted(place.glob(f"{_LIST}*"))


def _located(dataroot: str | os.PathLike[str]) -> Path | str:
    """The absolute path of what a caller names, symbolic links as they are; or the URL."""
    text = path_text(dataroot, "dataroot: expected a path or a URL", error=DatarootError)
    if "://" in text:
        parts = urlsplit(text)
        if parts.scheme != "file":
            return text
        text = unquote(parts.path)
    return Path(os.path.abspath(Path(text).expanduser()))  # noqa: PTH100


def _archives(path: Path) -> list[Path]:
    """The archives that a path stands for: itself, or those in a folder that holds no release; none for others."""
    if path.suffix.lower() == _ENDING and path.is_file():
        return [path]
    if any(
        _has_scenarios(folder)
        for folder in (path, *(path / name for name in (*SPLIT_FOLDERS, MINI_FOLDER)))
    ):
        return []
    found: list[Path] = []
    folders = [(path, 0)]
    while folders:
        folder, depth = folders.pop()
        with suppress(OSError):
            for entry in folder_entries(folder):
                inside = folder / entry.name
                if is_folder(entry) and depth < _DEEPEST and not entry.name.startswith("."):
                    folders.append((inside, depth + 1))
                elif (
                    entry.name.lower().endswith(_ENDING)
                    and inside.is_file()
                    and not entry.name.startswith(".")
                ):
                    found.append(inside)
    return sorted(found)


def _has_scenarios(folder: Path) -> bool:
    with suppress(OSError):
        return any(
            SCENARIO_TYPE.fullmatch(entry.name) and is_folder(entry)
            for entry in folder_entries(folder)
        )
    return False


def _opened_archives(
    path: Path,
    archives: Sequence[Path],
    places: Sequence[Path],
    on_error: OnError,
    **how: Unpack[Engine],
) -> StorePath:
    base = path.parent if archives == [path] else path
    split_files = (path / below / name for below in ("", SPLIT_FILE_FOLDER) for name in SPLIT_FILES)
    states, beside = _states(base, archives), _states(base, filter(Path.is_file, split_files))
    found = sorted({**states, **beside}.items())
    name = list_name(found)
    for known in (place / name for place in places if (place / name).is_file()):
        with suppress(IndexStoreError):  # a damaged list is made again
            return StorePath(opened_store(str(path), str(base), known))
    listings = _accepted(str(path), _listings(str(base), states, (base,), **how), on_error)
    written = _written(places, found, _with_loose(listings, beside), states)
    return StorePath(opened_store(str(path), str(base), written))


def _states(base: Path, files: Iterable[Path]) -> _States:
    return {file.relative_to(base).as_posix(): state_of(file) for file in files}


def state_of(file: Path) -> tuple[int, str]:
    """A file's bytes, and a text that changes with it, also if its time is put back."""
    status = file.stat()
    return status.st_size, f"{status.st_mtime_ns} {status.st_ctime_ns}"


def _opened_url(
    source: UrlSource, places: Sequence[Path], on_error: OnError, *, refresh: bool
) -> StorePath:
    url = source.url
    base = UrlSource(url.rpartition("/")[0]) if url.lower().endswith(_ENDING) else source
    with _told(url):
        known = None if refresh else _known_list(base, places)
        if known is None:
            archives, others = _files_at(base, url)
            listings = _accepted(url, _listings(base.url, archives, workers=1), on_error)
            listings = _with_loose(listings, others)
            if on_error == "raise" and not any(listing.names for listing in listings):
                raise DatarootError(
                    f"{url}: no file of a release found; give the URL that the release lies below"
                )
            known = _written(places, [*archives.items(), *others.items()], listings, archives)
    return StorePath(opened_store(url, base.url, known))


def _listings(
    base: str, archives: Iterable[str], places: tuple[Path, ...] = (), **how: Unpack[Engine]
) -> list[Listing | Failure]:
    """List archives by their paths from the base, a folder or a URL; a Failure says why one cannot be listed."""
    from deepaccident_devkit.support.parallel import (
        Places,
        Tried,
        run_batch,
    )  # here: few dataroots are archives

    work = Tried(partial(_listing_of, base))
    return run_batch(
        work, list(archives), label="listing archives", places=Places(reads=places), **how
    )


def _listing_of(base: str, name: str) -> Listing:
    shown = f"{base}/{name}"

    def listing() -> Listing:
        with UrlSource(base).opened(name) if "://" in base else open_file(Path(shown)) as file:
            return list_zip(file, name, shown)

    try:
        return asked(listing)
    except OSError as error:
        if isinstance(error, DatarootError):
            raise
        raise DatarootError(
            f"{shown}: {fault_text(error)}; make it readable, or fetch it again"
        ) from error


def _accepted(place: str, results: Sequence[Listing | Failure], on_error: OnError) -> list[Listing]:
    """Return the listings of archives; those that cannot be listed are logged, or DatarootError names all of them."""
    refused = [result.message for result in results if not isinstance(result, Listing)]
    text = "\n  ".join(
        [f"{place}: {len(refused)} of {len(results)} archives cannot be read:", *refused]
    )
    if refused and on_error == "raise":
        raise DatarootError(text + _WITHOUT_THEM * (len(refused) < len(results)))
    if refused:
        _logger.warning("left out: %s", escaped(text))
    return [result for result in results if isinstance(result, Listing)]


def _known_list(base: UrlSource, places: Sequence[Path]) -> Path | None:
    """The list of all of a URL's files, if its archives have not changed since; others are not asked."""
    for path in (path for place in places for path in list_files_in(place)):
        with suppress(IndexStoreError):
            members = Members(path)
            if not members.lacking and all(
                base.state_of(name) == state for name, state in members.states.items()
            ):
                return path
    return None


def _files_at(base: UrlSource, url: str) -> tuple[_States, _States]:
    """The archives at a URL, and the other files that are read: split files beside archives, all where there are none.

    Path from the base → bytes, and a text that changes with the file.
    """
    if base.url != url:
        name = PurePosixPath(url).name
        return {name: base.state_of(name)}, {}
    files = dict(sorted(base.list_files().items()))
    archives = {name: state for name, state in files.items() if name.lower().endswith(_ENDING)}
    if not archives or any(
        release_folder(folder.split("/")) for folder in {each.rpartition("/")[0] for each in files}
    ):
        return {}, files
    return archives, {name: state for name, state in files.items() if _is_split(name)}


def _is_split(path: str) -> bool:
    """Whether a file beside archives is a split file, by its path from the place."""
    folder, _, name = path.rpartition("/")
    return name in SPLIT_FILES and folder in ("", SPLIT_FILE_FOLDER)


def _with_loose(listings: Sequence[Listing], files: _States) -> list[Listing]:
    """The listings of archives, and of files beside them; a split file that an archive holds counts more than those."""
    packed = {name for listing in listings for name in listing.names if name in SPLIT_FILES}
    return [
        *listings,
        *_loose({path: files[path] for path in files if path.rpartition("/")[2] not in packed}),
    ]


def _loose(files: _States) -> list[Listing]:
    """Files that are in no archive, a listing for each folder; for the place itself also if it has none."""
    folders: dict[str, list[str]] = {"": []}
    for path in files:
        folders.setdefault(path.rpartition("/")[0], []).append(path)
    listings = []
    for folder, paths in folders.items():
        found = release_folder(folder.split("/"))
        if found is None:
            continue
        paths = [path for path in paths if is_release_file(found, path.rpartition("/")[2])]  # noqa: PLW2901
        sizes = np.array([files[path][0] for path in paths], np.int64)
        numbers = {
            "offset": np.full(len(paths), -1),
            "stored": sizes,
            "size": sizes,
            "version": np.array([zlib.crc32(files[path][1].encode()) for path in paths], np.uint32),
            "deflated": np.zeros(len(paths), np.uint8),
        }
        names = [path.rpartition("/")[2] for path in paths]
        zeros = np.zeros(len(paths), int)
        listings.append(
            Listing(archive=folder, folders=[found], folder=zeros, names=names, numbers=numbers)
        )
    return listings


def list_name(states: Sequence[Any]) -> str:
    """The name of the list of what is made from files of these states."""
    digest = hashlib.blake2b(json.dumps([FORM, states]).encode(), digest_size=8).hexdigest()
    return f"{_LIST}{digest}.arrow"


def _written(
    places: Sequence[Path],
    found: Sequence[Any],
    listings: Sequence[Listing],
    states: _States,
) -> Path:
    """Write the list of a store's files into the first place that can be written, and remove older ones there.

    Its name is that of what was found, unless archives could not be listed: these are looked at each time.
    """
    name = list_name([*found, *sorted(states.keys() - {listing.archive for listing in listings})])
    place = next((place for place in places if is_writable_folder(place)), None)
    if place is None:
        told = " or ".join(map(str, places))
        raise IndexStoreError(
            f"{told}: no place to write the index; give a writable folder with index_dir="
        )
    try:
        write_members(place / name, listings, states)
        for path in list_files_in(place):
            if path.name != name:
                path.unlink(missing_ok=True)
    except OSError as error:
        if isinstance(error, DeepAccidentError):
            raise
        raise IndexStoreError(
            f"{place / name}: cannot be written ({fault_text(error)}); make room there"
        ) from error
    return place / name


@contextmanager
def _told(url: str) -> Iterator[None]:
    """Turn what a URL's files raise into DatarootError."""
    try:
        yield
    except OSError as error:
        if isinstance(error, DeepAccidentError):
            raise
        what = (
            "does not exist, or may not be listed"
            if isinstance(error, FileNotFoundError)
            else fault_text(error)
        )
        raise DatarootError(
            f"{url}: {what}; check the URL, and the credentials in the environment"
        ) from None
