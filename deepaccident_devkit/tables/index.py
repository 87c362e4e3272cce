"""The index of a release: made once from its small files, then opened in milliseconds.

    <index folder>/<version>/
      manifest.json        states of the files that the index was made from, and broken scenarios
      tables-<digest>/     one Arrow file a table
      kept/                rows of each scenario, which are joined into tables; see `parallel.Store`

Opening compares the states of folders and meta files, the contents of split files and the sizes of
the tables with the manifest, and reads the tables' footers. Making it compares the times and sizes
of every label and calib file, and with `check_files` the contents of all files, and only reads the
scenarios that changed. Everything is written under a temporary name and renamed, the manifest at
the end, so that a reader sees either the old index or the new one.
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
from typing import TYPE_CHECKING, Any, get_args

from deepaccident_devkit.errors import (
    BrokenReleaseError,
    DatarootError,
    IndexStoreError,
    VersionError,
    escaped,
)
from deepaccident_devkit.release import ReleaseLayout
from deepaccident_devkit.release.store import Dataroot, index_places, list_files_in, places_of
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
from deepaccident_devkit.support.text import choice
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
# Names that earlier versions put beside these.
_EARLIER_NAMES = ("shards", ".unfinished")
# Paths of files that a devkit puts into an index folder.
_INDEX_FILE = re.compile(
    rf"{re.escape(MANIFEST_FILE)}|\.lock|\.making|\.unfinished"
    r"|(.+/)?(kept|locks|thumbnails)/.+|shards/.+\.arrow"
    rf"|\.?{_TABLES_PREFIX}[^/]+/([^/]+\.arrow|town_map-\w+\.npz)|(.+/)?\.[^/]+\.tmp",
    re.DOTALL,
)
# Messages or names that an error message lists.
_MAX_LISTED = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem(ShortRepr):
    """A broken scenario.

    Attributes:
        scenario: Token of the scenario.
        messages: A sentence for each fault, with file, line and remedy.
        contents: Hashes of its files at the time; empty if they are not the cause.
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
        tables: Name of the folder with the tables; empty if none could be made.
        table_files: Size and checksum of each file in it, by name.
        problems: Broken scenarios, which are left out.
        notices: Other parts of the release that were left aside, a sentence each.
    """

    folder: Path
    fingerprint: str
    tables: str
    table_files: Mapping[str, tuple[int, str]] = field(default_factory=dict)
    problems: tuple[Problem, ...] = ()
    notices: tuple[str, ...] = ()

    @property
    def tables_folder(self) -> Path:
        """The folder with one Arrow file a table; raises OutputFolderError if it is a link."""
        return place_in(self.folder, self.tables, opened=True)

    @classmethod
    def read(cls, folder: Path) -> Index | None:
        """Return the index in a folder, current or not; None without one of this schema version."""
        content = _read_manifest(folder)
        try:
            if content.pop("checksum") != _checksum(content):
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
            return index if index._has_valid_names() else None
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
            return None

    def _has_valid_names(self) -> bool:
        """Return whether the manifest names a folder of tables, with one file a table, or none."""
        names: set[str] = set()
        if self.tables:
            names = {table_path(Path(), table).name for table in table_specs()}
        pattern = rf"({_TABLES_PREFIX}\w+)?"
        return set(self.table_files) == names and bool(re.fullmatch(pattern, self.tables, re.ASCII))

    def write(self) -> None:
        """Write the manifest: from then on its tables are the index."""
        content = {"schema_version": SCHEMA_VERSION, **asdict(self)}
        del content["folder"]
        text = json.dumps({**content, "checksum": _checksum(content)}, indent=1)
        write_own(self.folder / MANIFEST_FILE, text.encode())

    def is_current(self, layout: ReleaseLayout, fingerprint: str) -> bool:
        """Return whether the index still describes the release.

        Nothing was added or removed, the tables exist, and no broken scenario has changed. Broken
        scenarios are read: a file mended in place leaves its folder's time as it is, and one that
        is restored from an archive may have the damaged file's size and time.
        """
        if self.fingerprint != fingerprint or not self._has_sizes():
            return False
        broken = {
            problem.scenario: problem.contents for problem in self.problems if problem.contents
        }
        for scenario in layout.scenarios:
            token = scenario.token
            if token in broken and content_hashes(scenario) != broken[token]:
                return False
        return True

    def is_whole(self) -> bool:
        """Return whether the content of all tables is what was written.

        Sizes are compared first, since a file with a hole may have gigabytes to read.
        """
        return self._has_sizes() and table_files(self.tables_folder) == self.table_files

    def _has_sizes(self) -> bool:
        sizes = {name: size for name, (size, _) in self.table_files.items()}
        return not sizes or sizes == _sizes(self.tables_folder)


def open_index(
    layout: ReleaseLayout,
    *,
    index_dir: Path | None = None,
    on_error: OnError = "raise",
    check_times: bool = False,
    check_files: bool = False,
    **engine: Unpack[Engine],
) -> Index:
    """Return the index of a release, which is made or updated before if necessary.

    Several processes that open the same release, also on several hosts, share the work.

    Args:
        layout: The release.
        index_dir: Folder of indexes; by default in the dataroot, or in the user's cache if that is
            read-only.
        on_error: `raise` lists every broken scenario and raises; `skip` leaves them out and logs
            them.
        check_times: Whether to compare the time and size of every label, calib and meta file, and
            the content of every table. Otherwise an index is opened if all folders are unchanged
            (schema/README.md).
        check_files: Whether to compare the content of every label, calib and meta file, too.
        **engine: `workers`, `executor` and `progress` (`parallel.Engine`).

    Raises:
        BrokenReleaseError: A scenario is broken and `on_error` is `raise`, or all of them are.
        DatarootError: No scenario has any file.
        IndexStoreError: The index cannot be written, or is a newer devkit's; or the limits of
            files' sizes in the environment cannot be understood.
        OutputFolderError: A link leads out of the index's folder.
        SplitFileError: A split file cannot be read.
        SomeFailedError: The connection to a URL broke.
    """
    on_error = choice("on_error", on_error, get_args(OnError))
    _refuse_wrong_limits()
    index = None if check_times or check_files else current_index(layout, index_dir)
    while index is None:
        folder = _writable_folder(layout, index_dir)
        index = _update_index(layout, folder, check_files=check_files, **engine)
        if index is None:
            index = current_index(layout, index_dir)
    _report_problems(layout, index, on_error)
    return index


def index_folders(root: Dataroot, version: str, index_dir: Path | None = None) -> Iterator[Path]:
    """Return the possible folders of a release's index, in order of preference."""
    return (folder / version for folder in index_places(root, index_dir))


def place_outside(layout: ReleaseLayout) -> Path | None:
    """Return the `index_dir` with which opening a release writes nothing into its folder.

    None is returned if the release has a current index.
    """
    if current_index(layout) is not None:
        return None
    *_, cache = index_folders(layout.root, layout.version)
    return cache.parent


def _fingerprint(layout: ReleaseLayout) -> str:
    return folder_digest(layout.scenarios, layout.split_files.values())


def current_index(layout: ReleaseLayout, index_dir: Path | None = None) -> Index | None:
    """Return the index that would be opened without any change; None if it had to be made."""
    fingerprint = _fingerprint(layout)
    for folder in index_folders(layout.root, layout.version, index_dir):
        index = Index.read(folder)
        if index and index.is_current(layout, fingerprint):
            return index
    return None


def _refuse_wrong_limits() -> None:
    """Raise IndexStoreError before wrong limits make every file count as broken.

    A good index would then be made again without these files.
    """
    try:
        byte_limit("index")
    except RefusedFileError as error:
        raise IndexStoreError(fault_text(error)) from None


def _writable_folder(layout: ReleaseLayout, index_dir: Path | None) -> Path:
    folders = list(index_folders(layout.root, layout.version, index_dir))
    folder = next(filter(is_writable_folder, folders), None)
    if folder is None:
        names = " or ".join(map(str, folders))
        raise IndexStoreError(
            f"{names}: no place to write the index; give a writable folder with index_dir="
        )
    return folder


def _update_index(
    layout: ReleaseLayout, folder: Path, *, check_files: bool, **engine: Unpack[Engine]
) -> Index | None:
    """Bring the index in `folder` up to date.

    None is returned if another process, with which this one shared the work, has finished it.
    Broken scenarios do not stop it: they are listed in the manifest. Damaged rows and tables are
    made again.
    """
    # Opening an existing index needs none of these modules.
    from deepaccident_devkit.support.parallel import Places
    from deepaccident_devkit.tables.indexing import assign_splits, index_scenario

    _refuse_newer(folder)
    fingerprint = _fingerprint(layout)
    splits = assign_splits(layout)
    store = _store(folder, f"{SCHEMA_VERSION} {fingerprint} {check_files}")
    candidates = {
        scenario.token: scenario
        for scenario in layout.scenarios
        if scenario.token not in splits.problems
    }
    with store.shared(tidy=partial(_tidy, folder)) as turn:
        outcomes = store.run(
            partial(index_scenario, store, check_files=check_files),
            candidates,
            label="indexing scenarios",
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
        _tidy(folder, present - current)
        store.remove(keep=True)
    return index


def _collect_problems(
    outcomes: Mapping[str, Outcome], splits: SplitAssignment
) -> tuple[Problem, ...]:
    """Return the broken and the misplaced scenarios, by token."""
    problems = []
    for token, outcome in outcomes.items():
        if outcome.messages:
            problems.append(
                Problem(scenario=token, messages=outcome.messages, contents=outcome.contents)
            )
    for token, messages in splits.problems.items():
        problems.append(Problem(scenario=token, messages=messages))
    return tuple(sorted(problems, key=lambda problem: problem.scenario))


def _store(folder: Path, command: str) -> Store:
    from deepaccident_devkit.support.parallel import Store

    return Store(folder, folder, "makes an index", IndexStoreError, command)


def _refuse_newer(folder: Path) -> None:
    version = _schema_version(folder)
    if version is not None and version > SCHEMA_VERSION:
        raise IndexStoreError(
            f"{folder / MANIFEST_FILE}: a newer devkit's index (schema version {version}, this "
            f"devkit's is {SCHEMA_VERSION}); update the devkit, give another index_dir=, or remove "
            "the index with: deepaccident index DATAROOT --clear"
        )


def _write_tables(
    store: Store, outcomes: Sequence[Outcome], splits: SplitAssignment
) -> tuple[str, dict[str, tuple[int, str]]]:
    """Join scenarios into a new folder of tables, named after their contents.

    Complete tables of that name are left as they are.

    Returns:
        Name of the folder, empty if there is nothing to join, and the states of its files.
    """
    from deepaccident_devkit.tables.indexing import join_tables

    if not outcomes:
        return "", {}
    tokens = [outcome.scenario.token for outcome in outcomes]
    folders = [outcome.scenario.folder for outcome in outcomes]
    assigned = [splits.split_of.get(token) for token in tokens]
    hashes = json.dumps(
        {outcome.scenario.token: json.loads(outcome.contents) for outcome in outcomes}
    )
    sources = (SCHEMA_VERSION, hashes, folders, assigned)
    name = _TABLES_PREFIX + hashlib.blake2b(repr(sources).encode(), digest_size=8).hexdigest()
    folder = place_in(store.folder, name, opened=True)
    before = Index.read(store.folder)
    if before is not None and before.tables == name and before.is_whole():
        return name, dict(before.table_files)
    # A folder of this name is damaged, or of a process that was stopped before its manifest.
    remove_in(store.folder, name)
    with replacing_folder(folder) as temporary:
        join_tables(temporary, [store.path(token) for token in tokens], assigned, hashes)
        files = table_files(temporary)
    return name, files


def table_files(folder: Path) -> dict[str, tuple[int, str]]:
    """Return size and checksum of each file in a folder of tables, by name.

    They are empty without such a folder.
    """
    states = {}
    for name, size in _sizes(folder).items():
        states[name] = (size, file_checksum(folder / name))
    return states


def _sizes(folder: Path) -> dict[str, int]:
    sizes = {}
    for path in folder.glob("*.arrow"):
        if path.is_file():
            sizes[path.name] = path.stat().st_size
    return sizes


def _tidy(folder: Path, stale: Iterable[str] = ()) -> None:
    """Remove leftovers of stopped processes, tables without a manifest, and stale paths.

    A path that cannot be removed stays until the next time. No other process may use the folder.
    """
    index = Index.read(folder)
    for name in (*_unnamed(folder, index.tables if index else ""), *stale):
        with suppress(OSError):
            remove_in(folder, name)


def _unnamed(folder: Path, tables: str = "") -> list[str]:
    """Return tables and manifests in an index folder, except the manifest and its tables."""
    prefixes = (_TABLES_PREFIX, f".{_TABLES_PREFIX}")
    unnamed = []
    for path in folder.iterdir():
        is_temporary = temporary_of(path.name) == MANIFEST_FILE
        if path.name != tables and (path.name.startswith(prefixes) or is_temporary):
            unnamed.append(path.name)
    return unnamed


def _read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest's JSON object, empty without one."""
    try:
        # `json.loads` keeps lone surrogates, which names of files may have.
        content = json.loads(read_bytes(folder / MANIFEST_FILE, "index"))
    except (OSError, ValueError, RecursionError, MemoryError):
        return {}
    return content if isinstance(content, dict) else {}


def _checksum(content: Mapping[str, Any]) -> str:
    """Return a checksum of a manifest's content without its checksum."""
    text = json.dumps(content, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _schema_version(folder: Path) -> int | None:
    """Return the schema version in an index folder's manifest, known or not; None without any."""
    version = _read_manifest(folder).get("schema_version")
    return version if type(version) is int else None


def _report_problems(layout: ReleaseLayout, index: Index, on_error: OnError) -> None:
    """Raise an error for broken scenarios, or log them; log all notices."""
    if index.problems and (on_error == "raise" or not index.tables):
        raise BrokenReleaseError(_problems_text(layout, index.problems))
    if not index.tables:
        raise DatarootError(
            f"{layout.root}: its scenarios hold no calib files; unpack the calib archives"
        )
    for problem in index.problems:
        text = f"{problem.scenario}: {' | '.join(problem.messages)}"
        logger.warning("left out %s", escaped(text))
    scenarios_by_notice: dict[str, list[str]] = {}
    for notice in index.notices:
        scenario, _, text = notice.partition(": ")
        scenarios_by_notice.setdefault(text, []).append(scenario)
    for text, scenarios in scenarios_by_notice.items():
        head = scenarios[0]
        if len(scenarios) > 1:
            head = f"{len(scenarios)} scenarios, such as {head}"
        logger.warning("%s", escaped(f"{head}: {text}"))


def _problems_text(layout: ReleaseLayout, problems: Sequence[Problem]) -> str:
    total = len({scenario.token for scenario in layout.scenarios})
    lines = [f"{layout.root}: {len(problems)} of {total} scenarios are broken:"]
    for problem in problems:
        lines.append(f"  {problem.scenario}")
        lines += [f"    {message}" for message in problem.messages[:_MAX_LISTED]]
        if len(problem.messages) > _MAX_LISTED:
            lines.append(f"    … and {len(problem.messages) - _MAX_LISTED} more")
    good = total - len(problems)
    advice = "No other is left to open."
    if good:
        advice = f"Mend them, or open the other {good} with on_error='skip' (--on-error skip)."
    return "\n".join([*lines, advice])


def clear_index(
    dataroot: Dataroot, *, version: str = "v1", index_dir: Path | None = None
) -> list[Path]:
    """Remove the indexes of a release, in its own folder and in the user's cache.

    Leftovers of stopped processes are removed, too. The call waits for a process that makes an
    index. The release itself is not needed, nor touched.

    Args:
        dataroot: Dataroot of the release, as for `DeepAccident`; it need not exist.
        version: Version of the release.
        index_dir: The only folder of indexes to look in.

    Returns:
        Folders that were removed; empty if there was no index.

    Raises:
        IndexStoreError: A folder holds a file that is no part of an index, and then nothing is
            removed; or the removal failed.
        VersionError: The version is unknown.
    """
    version = choice("version", version, VERSIONS, error=VersionError)
    folders = list(filter(_holds_index, index_folders(dataroot, version, index_dir)))
    for folder in folders:
        _refuse_foreign(folder)
    for folder in folders:
        store = _store(folder, "clear")
        with store.shared(partial(_refuse_foreign, folder)) as turn:
            if turn.alone():
                _remove(store)
    for index_folder in index_places(dataroot, index_dir):
        # The folder may be absent, or hold the index of another version.
        with suppress(OSError):
            for listing in list_files_in(index_folder):
                listing.unlink(missing_ok=True)
            if index_dir is None:
                index_folder.rmdir()
    return folders


def _holds_index(folder: Path) -> bool:
    """Return whether a folder holds an index, or part of one."""
    if _schema_version(folder) is not None:
        return True
    patterns = (f"{_TABLES_PREFIX}*", "kept", ".lock")
    return any(any(folder.glob(pattern)) for pattern in patterns)


def _refuse_foreign(folder: Path) -> None:
    """Raise IndexStoreError if a folder holds anything that no devkit writes there."""
    foreign = []
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() or not (path.is_dir() or _INDEX_FILE.fullmatch(name)):
            foreign.append(name)
    if foreign:
        names = ", ".join(foreign[:_MAX_LISTED])
        raise IndexStoreError(
            f"{folder}: not removed: it holds what is no part of an index: {names}; look at it"
        )


def _remove(store: Store) -> None:
    """Remove an index, its manifest first, so that a half of it does not count as an index."""
    try:
        for name in (MANIFEST_FILE, *_EARLIER_NAMES, *_unnamed(store.folder)):
            remove_in(store.folder, name)
        store.remove()
    except OSError as error:
        raise IndexStoreError(f"{store.folder}: cannot be removed ({error})") from error
