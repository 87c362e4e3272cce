"""The index of a release: built once from its small files, then opened in milliseconds.

    <index folder>/<version>/
      manifest.json        states of the files that the index was made from, and broken scenarios
      tables-<digest>/     one Arrow file for each table
      kept/                rows of each scenario, which are joined into tables; see `parallel.Store`

Opening an index compares the states of folders and meta files, the contents of split files and the
sizes of the tables with the manifest, and reads the tables' footers. Updating it compares the times
and sizes of every label and calib file (with `check_files`, the contents of all files), and only
reads the scenarios that changed. Everything is written under a temporary name and then renamed, the
manifest last, so a reader sees either the old index or the new one.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from deepaccident_devkit.errors import (
    BrokenReleaseError,
    DatarootError,
    IndexStoreError,
    VersionError,
    escaped,
)
from deepaccident_devkit.release import ReleaseLayout
from deepaccident_devkit.release.store import Dataroot, index_places, list_files_in, places_of
from deepaccident_devkit.release.store.opening import unwritable_error
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.files import (
    is_writable_folder,
    place_in,
    remove_in,
    replacing_folder,
    temporary_of,
    write_own,
)
from deepaccident_devkit.support.reading import (
    RefusedFileError,
    byte_limit,
    fault_text,
    file_checksum,
    read_bytes,
)
from deepaccident_devkit.support.text import choice, counted
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.tables.arrow_files import table_path
from deepaccident_devkit.tables.records import SCHEMA_VERSION, table_specs
from deepaccident_devkit.tables.scan import content_hashes, folder_digest
from deepaccident_devkit.taxonomy import VERSIONS, OnError

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine, Store
    from deepaccident_devkit.tables.indexing import Outcome, SplitAssignment

logger = logging.getLogger(__name__)

MANIFEST_FILE = "manifest.json"
_TABLES_PREFIX = "tables-"
# Other names that earlier versions used in an index folder.
_EARLIER_NAMES = ("shards", ".unfinished")
# Paths of the files that the devkit writes into an index folder.
_INDEX_FILE = re.compile(
    rf"{re.escape(MANIFEST_FILE)}|\.lock|\.making|\.unfinished"
    r"|(.+/)?(kept|locks|thumbnails)/.+|shards/.+\.arrow"
    rf"|\.?{_TABLES_PREFIX}[^/]+/([^/]+\.arrow|town_map-\w+\.npz)|(.+/)?\.[^/]+\.tmp",
    re.DOTALL,
)
# Maximum number of messages or names that an error lists.
_MAX_LISTED = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem(ShortRepr):
    """A broken scenario.

    Attributes:
        scenario: Token of the scenario.
        messages: A sentence for each fault, with file, line and remedy.
        contents: Hashes of its files when they were read; empty if the files are not the cause.
    """

    scenario: str
    messages: tuple[str, ...]
    contents: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Index(ShortRepr):
    """An index on disk, as its manifest describes it.

    Attributes:
        folder: Folder of the index.
        fingerprint: Digest of the release's folders, meta and split files (`scan.folder_digest`).
        tables: Name of the folder with the tables; empty if no tables could be made.
        table_files: Name → size and checksum of each file in the folder.
        problems: Broken scenarios, which are left out.
        notices: Other parts of the release that were ignored, one sentence each.
    """

    folder: Path
    fingerprint: str
    tables: str
    table_files: Mapping[str, tuple[int, str]] = field(default_factory=dict)
    problems: tuple[Problem, ...] = ()
    notices: tuple[str, ...] = ()

    @property
    def tables_folder(self) -> Path:
        """Folder with one Arrow file for each table; raises OutputFolderError if it is a link."""
        return place_in(self.folder, self.tables, opened=True)

    @classmethod
    def read(cls, folder: Path) -> Index | None:
        """Read a folder's index, even if outdated; None if there is none of this schema version."""
        content = _read_manifest(folder)
        try:
            checksum = content.pop("checksum")
            if checksum != _hash_manifest(content):
                return None
            if content.pop("schema_version") != SCHEMA_VERSION:
                return None
            problems = []
            for problem in content.pop("problems"):
                messages = tuple(problem["messages"])
                problems.append(Problem(**{**problem, "messages": messages}))
            files = {}
            for name, (size, digest) in content.pop("table_files").items():
                files[name] = (int(size), str(digest))
            notices = tuple(content.pop("notices"))
            index = cls(
                folder=folder,
                table_files=files,
                problems=tuple(problems),
                notices=notices,
                **content,
            )
            if index._has_valid_names():
                return index
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
            pass
        return None

    def _has_valid_names(self) -> bool:
        """Return whether the manifest names a folder with one file for each table, or no folder."""
        names: set[str] = set()
        if self.tables:
            names = {table_path(Path(), table).name for table in table_specs()}
        if set(self.table_files) != names:
            return False
        pattern = rf"({_TABLES_PREFIX}\w+)?"
        return re.fullmatch(pattern, self.tables, re.ASCII) is not None

    def write(self) -> None:
        """Write the manifest, which makes its tables the current index."""
        content = {"schema_version": SCHEMA_VERSION, **asdict(self)}
        del content["folder"]
        content["checksum"] = _hash_manifest(content)
        text = json.dumps(content, indent=1)
        write_own(self.folder / MANIFEST_FILE, text.encode())

    def is_current(self, layout: ReleaseLayout, fingerprint: str) -> bool:
        """Return whether the index still describes the release.

        It does if nothing was added or removed, the tables exist, and no broken scenario has
        changed. Broken scenarios are read for this: repairing a file in place does not change its
        folder's time, and a file restored from an archive may have the damaged file's size and
        time.
        """
        if self.fingerprint != fingerprint or not self._has_sizes():
            return False
        contents = {problem.scenario: problem.contents for problem in self.problems}
        for scenario in layout.scenarios:
            broken_contents = contents.get(scenario.token)
            if broken_contents and content_hashes(scenario) != broken_contents:
                return False
        return True

    def is_whole(self) -> bool:
        """Return whether all tables still have the content that was written.

        Sizes are compared first, because a sparse file may have gigabytes to read.
        """
        if not self._has_sizes():
            return False
        return table_files(self.tables_folder) == self.table_files

    def _has_sizes(self) -> bool:
        """Return whether all tables have the sizes that were written."""
        if not self.table_files:
            return True
        sizes = {name: size for name, (size, _) in self.table_files.items()}
        return sizes == _list_sizes(self.tables_folder)


def open_index(
    layout: ReleaseLayout,
    *,
    index_dir: Path | None = None,
    on_error: OnError = "raise",
    check_times: bool = False,
    check_files: bool = False,
    **engine: Unpack[Engine],
) -> Index:
    """Open a release's index; build or update it first if necessary.

    Several processes, even on different hosts, share the work if they open the same release.

    Args:
        layout: The release.
        index_dir: Folder for indexes; by default in the dataroot, or in the user's cache if the
            dataroot is read-only.
        on_error: What to do about broken scenarios: `raise` an error that lists all of them, or
            `skip` and log them.
        check_times: Whether to compare the time and size of every label, calib and meta file, and
            the content of every table. Otherwise an index is opened if all folders are unchanged
            (schema/README.md).
        check_files: Whether to compare the content of every label, calib and meta file, too.
        **engine: `workers`, `executor` and `progress` (`parallel.Engine`).

    Raises:
        BrokenReleaseError: If a scenario is broken and `on_error` is `raise`, or if all are broken.
        DatarootError: If no scenario has any file.
        IndexStoreError: If the index cannot be written, or was written by a newer devkit; or if the
            environment variable with file size limits is invalid.
        OutputFolderError: If a link leads out of the index's folder.
        SplitFileError: If a split file cannot be read.
        SomeFailedError: If the connection to a URL failed.
    """
    on_error = choice("on_error", on_error, get_args(OnError))
    _refuse_wrong_limits()
    index = None if check_times or check_files else current_index(layout, index_dir)
    while index is None:
        folders = list(index_folders(layout.root, layout.version, index_dir))
        folder = next(filter(is_writable_folder, folders), None)
        if folder is None:
            raise unwritable_error(folders)
        index = _update_index(layout, folder, check_files=check_files, **engine)
        if index is None:
            index = current_index(layout, index_dir)
    _report_problems(layout, index, on_error)
    return index


def index_folders(root: Dataroot, version: str, index_dir: Path | None = None) -> Iterator[Path]:
    """Yield the folders that may contain a release's index, in order of preference."""
    return (folder / version for folder in index_places(root, index_dir))


def choose_outside_index_dir(layout: ReleaseLayout) -> Path | None:
    """Return an `index_dir` outside the release; None if the release has a current index.

    Opening the release with it writes nothing into the release's folder.
    """
    if current_index(layout) is not None:
        return None
    *_, cache = index_folders(layout.root, layout.version)
    return cache.parent


def _hash_layout(layout: ReleaseLayout) -> str:
    return folder_digest(layout.scenarios, layout.split_files.values())


def current_index(layout: ReleaseLayout, index_dir: Path | None = None) -> Index | None:
    """Return the index that opening the release would use; None if it would have to be built."""
    fingerprint = _hash_layout(layout)
    for folder in index_folders(layout.root, layout.version, index_dir):
        index = Index.read(folder)
        if index and index.is_current(layout, fingerprint):
            return index
    return None


def _refuse_wrong_limits() -> None:
    """Raise IndexStoreError if the environment's file size limits are invalid.

    Otherwise every file would count as broken, and a good index would be rebuilt without any.
    """
    try:
        byte_limit("index")
    except RefusedFileError as error:
        raise IndexStoreError(fault_text(error)) from None


def _update_index(
    layout: ReleaseLayout, folder: Path, *, check_files: bool, **engine: Unpack[Engine]
) -> Index | None:
    """Bring the index in `folder` up to date, and return it.

    The result is None if another process, which shared the work, finished it. Broken scenarios do
    not stop the work: the manifest lists them. Damaged rows and tables are rebuilt.
    """
    # Opening an existing index needs none of these modules.
    from deepaccident_devkit.support.parallel import Places
    from deepaccident_devkit.tables.indexing import assign_splits, index_scenario

    _refuse_newer(folder)
    fingerprint = _hash_layout(layout)
    splits = assign_splits(layout)
    store = _make_store(folder, f"{SCHEMA_VERSION} {fingerprint} {check_files}")
    candidates = {
        scenario.token: scenario
        for scenario in layout.scenarios
        if scenario.token not in splits.problems
    }
    with store.shared(tidy=partial(_remove_leftovers, folder)) as turn:
        outcomes = store.run(
            partial(index_scenario, store, check_files=check_files),
            candidates,
            label="Indexing scenarios",
            places=Places(reads=places_of(layout.root), writes=(folder,)),
            **engine,
        )
        if not turn.alone():
            return None
        indexed = [outcome for outcome in outcomes.values() if outcome.indexed]
        tables, files = _write_tables(store, indexed, splits)
        notices = list(splits.notices)
        for outcome in outcomes.values():
            notices += outcome.notices
        index = Index(
            folder=folder,
            fingerprint=fingerprint,
            tables=tables,
            table_files=files,
            problems=_collect_problems(outcomes, splits),
            notices=tuple(notices),
        )
        index.write()
        current = {f"kept/{outcome.scenario.token}" for outcome in indexed}
        present = {path.relative_to(folder).as_posix() for path in folder.glob("kept/*/*")}
        _remove_leftovers(folder, present - current)
        store.remove(keep=True)
    return index


def _collect_problems(
    outcomes: Mapping[str, Outcome], splits: SplitAssignment
) -> tuple[Problem, ...]:
    """Return the broken and the misplaced scenarios, sorted by token."""
    problems = []
    for token, outcome in outcomes.items():
        if outcome.messages:
            problems.append(
                Problem(scenario=token, messages=outcome.messages, contents=outcome.contents)
            )
    for token, messages in splits.problems.items():
        problems.append(Problem(scenario=token, messages=messages))
    return tuple(sorted(problems, key=lambda problem: problem.scenario))


def _make_store(folder: Path, command: str) -> Store:
    from deepaccident_devkit.support.parallel import Store

    return Store(folder, folder, "is making an index", IndexStoreError, command)


def _refuse_newer(folder: Path) -> None:
    version = _read_schema_version(folder)
    if version is not None and version > SCHEMA_VERSION:
        raise IndexStoreError(
            f"{folder / MANIFEST_FILE}: a newer devkit's index (schema version {version}, this "
            f"devkit's is {SCHEMA_VERSION}); update the devkit, give another index_dir=, or remove "
            "the index with: deepaccident index DATAROOT --clear"
        )


def _write_tables(
    store: Store, outcomes: Sequence[Outcome], splits: SplitAssignment
) -> tuple[str, dict[str, tuple[int, str]]]:
    """Join scenarios into a new folder of tables whose name is a digest of their contents.

    Complete tables of that name are left as they are.

    Returns:
        Name of the folder, empty if there is nothing to join, and the states of its files.
    """
    from deepaccident_devkit.tables.indexing import join_tables

    if not outcomes:
        return "", {}
    tokens = [outcome.scenario.token for outcome in outcomes]
    folders = [outcome.scenario.folder for outcome in outcomes]
    assigned_splits = [splits.split_of.get(token) for token in tokens]
    contents = [json.loads(outcome.contents) for outcome in outcomes]
    hashes = json.dumps(dict(zip(tokens, contents, strict=True)))
    sources = repr((SCHEMA_VERSION, hashes, folders, assigned_splits))
    digest = hashlib.blake2b(sources.encode(), digest_size=8).hexdigest()
    name = f"{_TABLES_PREFIX}{digest}"
    folder = place_in(store.folder, name, opened=True)
    earlier_index = Index.read(store.folder)
    if earlier_index and earlier_index.tables == name and earlier_index.is_whole():
        return name, dict(earlier_index.table_files)
    # An existing folder of this name is damaged, or its writer was stopped before the manifest.
    remove_in(store.folder, name)
    paths = [store.path(token) for token in tokens]
    with replacing_folder(folder) as temporary:
        join_tables(temporary, paths, assigned_splits, hashes)
        files = table_files(temporary)
    return name, files


def table_files(folder: Path) -> dict[str, tuple[int, str]]:
    """Return name → size and checksum of each file in a folder of tables.

    The result is empty if the folder does not exist.
    """
    sizes = _list_sizes(folder)
    return {name: (size, file_checksum(folder / name)) for name, size in sizes.items()}


def _list_sizes(folder: Path) -> dict[str, int]:
    """Return name → size of each file in a folder of tables, bytes."""
    paths = filter(Path.is_file, folder.glob("*.arrow"))
    return {path.name: path.stat().st_size for path in paths}


def _remove_leftovers(folder: Path, stale: Iterable[str] = ()) -> None:
    """Remove leftovers of stopped processes, tables without a manifest, and stale paths.

    Paths that cannot be removed stay until the next call. No other process may use the folder.
    """
    index = Index.read(folder)
    current_tables = index.tables if index else ""
    for name in (*_find_unnamed(folder, current_tables), *stale):
        with suppress(OSError):
            remove_in(folder, name)


def _find_unnamed(folder: Path, tables: str = "") -> list[str]:
    """Return the names of tables and manifests in an index folder, except the current ones."""
    prefixes = (_TABLES_PREFIX, f".{_TABLES_PREFIX}")
    unnamed = []
    for path in folder.iterdir():
        is_temporary = temporary_of(path.name) == MANIFEST_FILE
        if path.name != tables and (path.name.startswith(prefixes) or is_temporary):
            unnamed.append(path.name)
    return unnamed


def _read_manifest(folder: Path) -> NamedValues:
    """Read the JSON object of a folder's manifest; empty without a manifest."""
    try:
        # `json.loads` keeps lone surrogates, which file names may contain.
        content = json.loads(read_bytes(folder / MANIFEST_FILE, "index"))
    except (OSError, ValueError, RecursionError, MemoryError):
        return {}
    return content if isinstance(content, dict) else {}


def _hash_manifest(content: ReadOnlyValues) -> str:
    """Return the checksum of a manifest's content, leaving out the checksum field."""
    text = json.dumps(content, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _read_schema_version(folder: Path) -> int | None:
    """Read the schema version of an index folder's manifest, even if unknown; None without one."""
    version = _read_manifest(folder).get("schema_version")
    if type(version) is int:
        return version
    return None


def _report_problems(layout: ReleaseLayout, index: Index, on_error: OnError) -> None:
    """Raise an error for broken scenarios, or log them, and log all notices."""
    if index.problems and (on_error == "raise" or not index.tables):
        raise BrokenReleaseError(_format_problems(layout, index.problems))
    if not index.tables:
        raise DatarootError(
            f"{layout.root}: its scenarios contain no calib files; unpack the calib archives"
        )
    for problem in index.problems:
        text = f"{problem.scenario}: {' | '.join(problem.messages)}"
        logger.warning("excluded %s", escaped(text))
    scenarios_by_notice: dict[str, list[str]] = {}
    for notice in index.notices:
        scenario, _, text = notice.partition(": ")
        scenarios_by_notice.setdefault(text, []).append(scenario)
    for text, scenarios in scenarios_by_notice.items():
        subject = scenarios[0]
        if len(scenarios) > 1:
            subject = f"{len(scenarios)} scenarios, such as {subject}"
        logger.warning("%s", escaped(f"{subject}: {text}"))


def _format_problems(layout: ReleaseLayout, problems: Sequence[Problem]) -> str:
    total = len({scenario.token for scenario in layout.scenarios})
    lines = [f"{layout.root}: errors in {len(problems)} of {counted(total, 'scenario')}:"]
    for problem in problems:
        lines.append(f"  {problem.scenario}")
        lines += [f"    {message}" for message in problem.messages[:_MAX_LISTED]]
        if len(problem.messages) > _MAX_LISTED:
            lines.append(f"    … and {len(problem.messages) - _MAX_LISTED} more")
    num_others = total - len(problems)
    if num_others:
        lines.append(
            f"Repair them, or open the other {counted(num_others, 'scenario')} with "
            "on_error='skip' (--on-error skip)."
        )
    else:
        lines.append("There is no other scenario to open.")
    return "\n".join(lines)


def clear_index(
    dataroot: Dataroot, *, version: str = "v1", index_dir: Path | None = None
) -> list[Path]:
    """Remove the indexes of a release, in its own folder and in the user's cache.

    Leftovers of stopped processes are removed too. The call waits while another process builds an
    index. The release itself is not needed, and not changed.

    Args:
        dataroot: Dataroot of the release, as for `DeepAccident`; it need not exist.
        version: Version of the release.
        index_dir: The only folder to look for indexes in; None looks in all of them.

    Returns:
        Folders that were removed; empty if there was no index.

    Raises:
        IndexStoreError: If a folder contains a file that is not part of an index (nothing is then
            removed), or if the removal failed.
        VersionError: If the version is unknown.
    """
    version = choice("version", version, VERSIONS, error=VersionError)
    folders = list(filter(_has_index, index_folders(dataroot, version, index_dir)))
    for folder in folders:
        _refuse_foreign(folder)
    for folder in folders:
        store = _make_store(folder, "clear")
        with store.shared(partial(_refuse_foreign, folder)) as turn:
            if turn.alone():
                _remove_index(store)
    for index_folder in index_places(dataroot, index_dir):
        # The folder may be missing, or contain the index of another version.
        with suppress(OSError):
            for listing in list_files_in(index_folder):
                listing.unlink(missing_ok=True)
            if index_dir is None:
                index_folder.rmdir()
    return folders


def _has_index(folder: Path) -> bool:
    """Return whether a folder contains an index, or part of one."""
    if _read_schema_version(folder) is not None:
        return True
    for pattern in (f"{_TABLES_PREFIX}*", "kept", ".lock"):
        if any(folder.glob(pattern)):
            return True
    return False


def _refuse_foreign(folder: Path) -> None:
    """Raise IndexStoreError if a folder contains anything that the devkit does not write there."""
    foreign = []
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() or not (path.is_dir() or _INDEX_FILE.fullmatch(name)):
            foreign.append(name)
    if foreign:
        names = ", ".join(foreign[:_MAX_LISTED])
        raise IndexStoreError(
            f"{folder}: not removed, as it contains files that belong to no index: {names}; check "
            "them"
        )


def _remove_index(store: Store) -> None:
    """Remove an index, manifest first, so that an interrupted removal leaves no index."""
    try:
        for name in (MANIFEST_FILE, *_EARLIER_NAMES, *_find_unnamed(store.folder)):
            remove_in(store.folder, name)
        store.remove()
    except OSError as error:
        raise IndexStoreError(f"{store.folder}: cannot be removed ({error})") from error
