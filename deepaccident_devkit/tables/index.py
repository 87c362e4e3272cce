"""The index of a release: made once from its small files, opened in milliseconds afterwards.

    <index folder>/<version>/
      manifest.json        what the index was made from, and what is broken
      tables-<digest>/     one Arrow file a table
      shards/              one file a scenario, from which the tables are joined
      .lock                held by the process that makes the index
      .unfinished          there while it is made; the next process finishes the work of a stopped one

Opening compares the times of folders, meta and split files and the sizes of the tables with the manifest; making it
compares the times of every label and calib file (with `check_files` their contents), reads only the scenarios that
changed, and compares the checksums of shards and tables. Everything is written under a temporary name and renamed, the
manifest last, so that a reader sees the old index or the new one.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.errors import BrokenReleaseError, DatarootError, IndexStoreError
from deepaccident_devkit.files import is_writable_folder, place_in
from deepaccident_devkit.reading import RefusedFileError, fault_text, limit_of
from deepaccident_devkit.release import ReleaseLayout
from deepaccident_devkit.release.store import Dataroot, index_places
from deepaccident_devkit.tables.indexing import is_unfinished, make_index
from deepaccident_devkit.tables.locking import index_lock
from deepaccident_devkit.tables.manifest import (
    MANIFEST_FILE,
    SCHEMA_VERSION,
    Manifest,
    Problem,
    read_manifest,
    stored_schema_version,
)
from deepaccident_devkit.tables.scan import contents_digest, folder_digest
from deepaccident_devkit.taxonomy import OnError
from deepaccident_devkit.text import choice

if TYPE_CHECKING:
    from concurrent.futures import Executor

logger = logging.getLogger(__name__)

_MESSAGES_A_SCENARIO = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Index(ShortRepr):
    """An index on disk.

    Attributes:
        folder: where it lies.
        manifest: what it was made from.
    """

    folder: Path
    manifest: Manifest

    @property
    def tables_folder(self) -> Path:
        """The folder with one Arrow file a table; raises OutputFolderError if it is a link."""
        return place_in(self.folder, self.manifest.tables, opened=True)


def open_index(
    layout: ReleaseLayout,
    *,
    index_dir: Path | None = None,
    workers: int | None = None,
    executor: Executor | None = None,
    on_error: OnError = "raise",
    progress: bool = False,
    check_files: bool = False,
) -> Index:
    """The index of a release, made or brought up to date first where needed.

    Args:
        layout: the release.
        index_dir: where indexes are kept; by default in the dataroot, or in the user's cache if that is read-only.
        workers: processes to read with; see `parallel.run_batch`.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        on_error: `raise` lists every broken scenario and raises; `skip` leaves them out and logs them.
        progress: whether to show a progress bar.
        check_files: compare the content of every label, calib and meta file, and of every file of the index, with
            the checksums of the indexing; else only times and sizes are compared (schema/README.md).

    Raises:
        BrokenReleaseError: some scenarios are broken and `on_error` is `raise`, or all of them are.
        DatarootError: no scenario has any file.
        IndexStoreError: the index cannot be written, or is a newer devkit's; or the limits of files' sizes that the
            environment gives cannot be understood.
    """
    on_error = choice("on_error", on_error, get_args(OnError))
    _refuse_wrong_limits()
    index = None if check_files else _current_index(layout, index_dir)
    make = partial(
        _found_or_made,
        layout,
        index_dir,
        check_files=check_files,
        workers=workers,
        executor=executor,
        progress=progress,
    )
    if index is None:
        folder = _writable_folder(layout, index_dir)
        with index_lock(folder):
            index = make(folder)
    elif is_unfinished(index.folder):
        index = _finished(index, make)
    _accept(layout, index, on_error)
    return index


def _refuse_wrong_limits() -> None:
    """Raise IndexStoreError before every file counts as broken, and a good index is made again of what is left."""
    try:
        limit_of("index")
    except RefusedFileError as error:
        raise IndexStoreError(fault_text(error)) from None


def find_indexes(layout: ReleaseLayout, index_dir: Path | None = None) -> Iterator[Index]:
    """The release's indexes on disk, up to date or not, the first choice first."""
    for folder in index_folders(layout.root, layout.version, index_dir):
        manifest = read_manifest(folder)
        if manifest:
            yield Index(folder=folder, manifest=manifest)


def index_folders(root: Dataroot, version: str, index_dir: Path | None = None) -> Iterator[Path]:
    """Where a release's index may lie, the first choice first."""
    return (place / version for place in index_places(root, index_dir))


def place_outside(layout: ReleaseLayout) -> Path | None:
    """The `index_dir` with which opening a release writes nothing into its folder: None where a good index is there."""
    index = _current_index(layout, None)
    if index is not None and not is_unfinished(index.folder):
        return None
    *_, cache = index_folders(layout.root, layout.version)
    return cache.parent


def _current_index(layout: ReleaseLayout, index_dir: Path | None) -> Index | None:
    fingerprint = folder_digest(layout.scenarios, layout.split_files.values())
    found = (index for index in find_indexes(layout, index_dir) if is_current(layout, index, fingerprint))
    return next(found, None)


def _found_or_made(
    layout: ReleaseLayout,
    index_dir: Path | None,
    folder: Path,
    **how: Any,
) -> Index:
    """The index, made in `folder`, whose lock is held, unless another process has made it meanwhile."""
    index = None if how["check_files"] else _current_index(layout, index_dir)
    if index is not None and not (index.folder == folder and is_unfinished(folder)):
        return index
    _refuse_newer(folder)
    fingerprint = folder_digest(layout.scenarios, layout.split_files.values())
    manifest = make_index(layout, folder, fingerprint, **how)
    return Index(folder=folder, manifest=manifest)


def _finished(index: Index, make: Callable[[Path], Index]) -> Index:
    """Finish what a stopped process left; if that cannot be done, a good index is used as it is."""
    if not is_writable_folder(index.folder):
        return index
    try:
        with index_lock(index.folder, wait=False) as held:
            return make(index.folder) if held else index
    except IndexStoreError as error:
        logger.warning("%s", error)
        return index


def _refuse_newer(folder: Path) -> None:
    version = stored_schema_version(folder)
    if version is not None and version > SCHEMA_VERSION:
        raise IndexStoreError(
            f"{folder / MANIFEST_FILE}: a newer devkit's index (schema version {version}, this devkit's is "
            f"{SCHEMA_VERSION}); update the devkit, give another index_dir=, or remove the index with: "
            "deepaccident index DATAROOT --clear"
        )


def _writable_folder(layout: ReleaseLayout, index_dir: Path | None) -> Path:
    folders = list(index_folders(layout.root, layout.version, index_dir))
    for folder in folders:
        if is_writable_folder(folder):
            return folder
    places = " or ".join(map(str, folders))
    raise IndexStoreError(f"{places}: no place to write the index; give a writable folder with index_dir=")


def is_current(layout: ReleaseLayout, index: Index, fingerprint: str) -> bool:
    """Whether nothing was added or removed, and no broken scenario was changed.

    Broken scenarios are read: a file mended in place leaves its folder's time alone, and one that is restored from an
    archive may have the damaged one's size and time.
    """
    if index.manifest.fingerprint != fingerprint or not _is_whole(index):
        return False
    broken = {problem.scenario: problem.contents for problem in index.manifest.problems if problem.contents}
    return all(
        contents_digest(scenario) == broken[scenario.token] for scenario in layout.scenarios if scenario.token in broken
    )


def _is_whole(index: Index) -> bool:
    """Whether every table's file is there in its size."""
    files = {index.tables_folder / name: size for name, (size, _) in index.manifest.table_files.items()}
    try:
        return all(path.stat().st_size == size for path, size in files.items())
    except OSError:
        return False


def _accept(layout: ReleaseLayout, index: Index, on_error: OnError) -> None:
    problems = index.manifest.problems
    if problems and (on_error == "raise" or not index.manifest.tables):
        raise BrokenReleaseError(_report(layout, problems))
    if not index.manifest.tables:
        raise DatarootError(f"{layout.root}: its scenarios hold no calib files; unpack the calib archives")
    for problem in problems:
        logger.warning("left out %s: %s", problem.scenario, " | ".join(problem.messages))
    for notice in summed_notices(index.manifest.notices):
        logger.warning("%s", notice)


def summed_notices(notices: Sequence[str]) -> list[str]:
    """Notices, with one sentence in place of several that say the same of different files."""
    places: dict[str, list[str]] = {}
    for notice in notices:
        place, _, words = notice.partition(": ")
        places.setdefault(words, []).append(place)
    return [
        f"{found[0]}: {words}" if len(found) == 1 else f"{len(found)} scenarios, such as {found[0]}: {words}"
        for words, found in places.items()
    ]


def _report(layout: ReleaseLayout, problems: Sequence[Problem]) -> str:
    total = len({scenario.token for scenario in layout.scenarios})
    lines = [f"{layout.root}: {len(problems)} of {total} scenarios are broken:"]
    for problem in problems:
        shown = problem.messages[:_MESSAGES_A_SCENARIO]
        lines += [f"  {problem.scenario}", *(f"    {message}" for message in shown)]
        if len(problem.messages) > len(shown):
            lines.append(f"    … and {len(problem.messages) - len(shown)} more")
    good = total - len(problems)
    lines.append(
        f"Mend them, or open the other {good} with on_error='skip' (--on-error skip)." if good else "Mend them first."
    )
    return "\n".join(lines)
