"""The index of a release: made once from its small files, opened in milliseconds afterwards.

    <index folder>/<version>/
      manifest.json        what the index was made from, and what is broken
      tables-<digest>/     one Arrow file a table
      kept/                the rows of each scenario, from which the tables are joined; see `parallel.Store`

Opening compares the states of folders and meta files, the contents of split files and the sizes of the tables with the
manifest, and reads the tables' footers. Making it compares the times and sizes of every label and calib file, and with
`check_files` the contents of all files, and reads only the scenarios that changed. Everything is written under a
temporary name and renamed, the manifest last, so that a reader sees the old index or the new one.
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
_TABLES = "tables-"
# What earlier versions put beside these.
_EARLIER = ("shards", ".unfinished")
# Paths of files that a devkit puts into an index folder.
_FILE = re.compile(
    rf"{re.escape(MANIFEST_FILE)}|\.lock|\.making|\.unfinished|(.+/)?(kept|locks|thumbnails)/.+|shards/.+\.arrow"
    rf"|\.?{_TABLES}[^/]+/([^/]+\.arrow|town_map-\w+\.npz)|(.+/)?\.[^/]+\.tmp",
    re.DOTALL,
)
_NAMED = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem(ShortRepr):
    """What is wrong with one scenario.

    Attributes:
        scenario: its token.
        messages: a sentence each, naming file, line and remedy.
        contents: hashes of its files as they were when this was found; empty if they are not the cause.
    """

    scenario: str
    messages: tuple[str, ...]
    contents: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Index(ShortRepr):
    """An index on disk, as its manifest describes it.

    Attributes:
        folder: where it lies.
        fingerprint: digest of the release's folders, meta and split files (`scan.folder_digest`).
        tables: name of the folder that holds the tables; empty if none could be made.
        table_files: the size and checksum of each file in it, by name.
        problems: the scenarios left out.
        notices: what else was left aside, a sentence each.
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
        """The index in a folder, up to date or not; None if there is none that today's code can use."""
        content = _manifest(folder)
        try:
            if (
                content.pop("checksum") != _checksum(content)
                or content.pop("schema_version") != SCHEMA_VERSION
            ):
                return None
            problems = [
                Problem(**{**each, "messages": tuple(each["messages"])})
                for each in content.pop("problems")
            ]
            files = {
                name: (int(size), str(digest))
                for name, (size, digest) in content.pop("table_files").items()
            }
            notices = tuple(content.pop("notices"))
            index = cls(
                folder=folder,
                table_files=files,
                problems=tuple(problems),
                notices=notices,
                **content,
            )
            names = (
                {table_path(Path(), table).name for table in table_specs()}
                if index.tables
                else set()
            )
            whole = set(files) == names and re.fullmatch(
                rf"({_TABLES}\w+)?", index.tables, re.ASCII
            )
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
            return None
        return index if whole else None

    def write(self) -> None:
        """Write the manifest: from then on the tables that it names are the index."""
        content = {"schema_version": SCHEMA_VERSION, **asdict(self)}
        del content["folder"]
        text = json.dumps({**content, "checksum": _checksum(content)}, indent=1)
        write_own(self.folder / MANIFEST_FILE, text.encode())

    def is_current(self, layout: ReleaseLayout, fingerprint: str) -> bool:
        """Whether nothing was added or removed, the tables are there, and no broken scenario was changed.

        Broken scenarios are read: a file mended in place leaves its folder's time alone, and one that is restored from
        an archive may have the damaged one's size and time.
        """
        if self.fingerprint != fingerprint or not self._has_sizes():
            return False
        broken = {
            problem.scenario: problem.contents for problem in self.problems if problem.contents
        }
        return all(
            content_hashes(each) == broken[each.token]
            for each in layout.scenarios
            if each.token in broken
        )

    def is_whole(self) -> bool:
        """Whether the content of all tables is what was written; by size first, for a hole has gigabytes to read."""
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
    **how: Unpack[Engine],
) -> Index:
    """The index of a release, made or brought up to date first where needed.

    Several processes, also on several hosts, that open the same release share the work.

    Args:
        layout: the release.
        index_dir: where indexes are kept; by default in the dataroot, or in the user's cache if that is read-only.
        on_error: `raise` lists every broken scenario and raises; `skip` leaves them out and logs them.
        check_times: compare the time and size of every label, calib and meta file, and the content of every table. If
            not set, an index is opened where all folders are as they were (schema/README.md).
        check_files: compare the content of every label, calib and meta file too.
        **how: of `parallel.Engine`: `workers`, `executor`, `progress`.

    Raises:
        BrokenReleaseError: some scenarios are broken and `on_error` is `raise`, or all of them are.
        DatarootError: no scenario has any file.
        IndexStoreError: the index cannot be written, or is a newer devkit's; or the limits of files' sizes that the
            environment gives cannot be understood.
        OutputFolderError: a link leads out of the index's folder.
        SplitFileError: a split file cannot be read.
        SomeFailedError: the connection to a URL broke.
    """
    on_error = choice("on_error", on_error, get_args(OnError))
    _refuse_wrong_limits()
    index = None if check_times or check_files else current_index(layout, index_dir)
    while index is None:
        folder = _writable_folder(layout, index_dir)
        index = _made(layout, folder, check_files=check_files, **how) or current_index(
            layout, index_dir
        )
    _accept(layout, index, on_error)
    return index


def index_folders(root: Dataroot, version: str, index_dir: Path | None = None) -> Iterator[Path]:
    """Where a release's index may lie, the first choice first."""
    return (place / version for place in index_places(root, index_dir))


def place_outside(layout: ReleaseLayout) -> Path | None:
    """The `index_dir` with which opening a release writes nothing into its folder: None where a good index is there."""
    if current_index(layout) is not None:
        return None
    *_, cache = index_folders(layout.root, layout.version)
    return cache.parent


def _fingerprint(layout: ReleaseLayout) -> str:
    return folder_digest(layout.scenarios, layout.split_files.values())


def current_index(layout: ReleaseLayout, index_dir: Path | None = None) -> Index | None:
    """Return the index that opening a release would use as it is; None if one would be made or updated."""
    fingerprint = _fingerprint(layout)
    found = map(Index.read, index_folders(layout.root, layout.version, index_dir))
    return next((index for index in found if index and index.is_current(layout, fingerprint)), None)


def _refuse_wrong_limits() -> None:
    """Raise IndexStoreError before every file counts as broken, and a good index is made again of what is left."""
    try:
        byte_limit("index")
    except RefusedFileError as error:
        raise IndexStoreError(fault_text(error)) from None


def _writable_folder(layout: ReleaseLayout, index_dir: Path | None) -> Path:
    folders = list(index_folders(layout.root, layout.version, index_dir))
    folder = next(filter(is_writable_folder, folders), None)
    if folder is None:
        places = " or ".join(map(str, folders))
        raise IndexStoreError(
            f"{places}: no place to write the index; give a writable folder with index_dir="
        )
    return folder


def _made(
    layout: ReleaseLayout, folder: Path, *, check_files: bool, **how: Unpack[Engine]
) -> Index | None:
    """Bring the index in `folder` up to date; None if another process, with which it shared the work, has done that.

    Broken scenarios do not stop it: they are listed in the manifest. Damaged rows and tables are made again.
    """
    from deepaccident_devkit.support.parallel import (
        Places,  # here, as below: opening an index that is there needs none of it
    )
    from deepaccident_devkit.tables.indexing import assign_splits, index_scenario

    _refuse_newer(folder)
    fingerprint, splits = _fingerprint(layout), assign_splits(layout)
    store = _store(folder, f"{SCHEMA_VERSION} {fingerprint} {check_files}")
    candidates = {
        each.token: each for each in layout.scenarios if each.token not in splits.problems
    }
    with store.shared(tidy=partial(_tidy, folder)) as turn:
        outcomes = store.run(
            partial(index_scenario, store, check_files=check_files),
            candidates,
            label="indexing scenarios",
            places=Places(reads=places_of(layout.root), writes=(folder,)),
            **how,
        )
        if not turn.alone():
            return None
        tables, files = _written_tables(
            store, [outcome for outcome in outcomes.values() if outcome.indexed], splits
        )
        broken = [
            Problem(scenario=token, messages=outcome.messages, contents=outcome.contents)
            for token, outcome in outcomes.items()
            if outcome.messages
        ]
        misplaced = [
            Problem(scenario=token, messages=messages)
            for token, messages in splits.problems.items()
        ]
        index = Index(
            folder=folder,
            fingerprint=fingerprint,
            tables=tables,
            table_files=files,
            problems=tuple(sorted(broken + misplaced, key=lambda problem: problem.scenario)),
            notices=(
                *splits.notices,
                *(notice for each in outcomes.values() for notice in each.notices),
            ),
        )
        index.write()
        kept = {f"kept/{token}" for token, outcome in outcomes.items() if outcome.indexed}
        there = {path.relative_to(folder).as_posix() for path in folder.glob("kept/*/*")}
        _tidy(folder, there - kept)
        store.remove(keep=True)
    return index


def _store(folder: Path, command: str) -> Store:
    from deepaccident_devkit.support.parallel import Store

    return Store(folder, folder, "makes an index", IndexStoreError, command)


def _refuse_newer(folder: Path) -> None:
    version = _schema_version(folder)
    if version is not None and version > SCHEMA_VERSION:
        raise IndexStoreError(
            f"{folder / MANIFEST_FILE}: a newer devkit's index (schema version {version}, this devkit's is "
            f"{SCHEMA_VERSION}); update the devkit, give another index_dir=, or remove the index with: "
            "deepaccident index DATAROOT --clear"
        )


def _written_tables(
    store: Store, outcomes: Sequence[Outcome], splits: SplitAssignment
) -> tuple[str, dict[str, tuple[int, str]]]:
    """Join scenarios into a new folder of tables, named by what they were made from; its name and its files' states.

    The name is empty if there is nothing to join. Whole tables of that name are left as they are.
    """
    from deepaccident_devkit.tables.indexing import join_tables

    if not outcomes:
        return "", {}
    assigned = [splits.split_of.get(outcome.scenario.token) for outcome in outcomes]
    hashes = json.dumps(
        {outcome.scenario.token: json.loads(outcome.contents) for outcome in outcomes}
    )
    made_from = (
        SCHEMA_VERSION,
        hashes,
        [outcome.scenario.folder for outcome in outcomes],
        assigned,
    )
    name = _TABLES + hashlib.blake2b(repr(made_from).encode(), digest_size=8).hexdigest()
    folder, before = place_in(store.folder, name, opened=True), Index.read(store.folder)
    if before is not None and before.tables == name and before.is_whole():
        files = dict(before.table_files)
    else:
        remove_in(
            store.folder, name
        )  # damaged, or of a process that was stopped before its manifest
        with replacing_folder(folder) as temporary:
            join_tables(
                temporary, [store.path(each.scenario.token) for each in outcomes], assigned, hashes
            )
            files = table_files(temporary)
    return name, files


def table_files(folder: Path) -> dict[str, tuple[int, str]]:
    """Size and checksum of each file of a folder of tables, by name; nothing if there is no such folder."""
    return {name: (size, file_checksum(folder / name)) for name, size in _sizes(folder).items()}


def _sizes(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_size for path in folder.glob("*.arrow") if path.is_file()}


def _tidy(folder: Path, stale: Iterable[str] = ()) -> None:
    """Remove what stopped processes left, tables that the manifest does not name, and what is given by its path.

    What cannot be removed is left to the next time. The caller has the folder alone.
    """
    index = Index.read(folder)
    for name in (*_unnamed(folder, index.tables if index else ""), *stale):
        with suppress(OSError):
            remove_in(folder, name)


def _unnamed(folder: Path, tables: str = "") -> list[str]:
    """Tables and manifests in an index folder, but for the manifest and its tables."""
    begin = (_TABLES, f".{_TABLES}")
    names = [path.name for path in folder.iterdir() if path.name != tables]
    return [name for name in names if name.startswith(begin) or temporary_of(name) == MANIFEST_FILE]


def _manifest(folder: Path) -> dict[str, Any]:
    """The manifest's JSON object, empty if there is none."""
    try:
        content = json.loads(
            read_bytes(folder / MANIFEST_FILE, "index")
        )  # names of files may have half characters
    except (OSError, ValueError, RecursionError, MemoryError):
        return {}
    return content if isinstance(content, dict) else {}


def _checksum(content: Mapping[str, Any]) -> str:
    """A checksum of all else that a manifest says."""
    return hashlib.blake2b(json.dumps(content, sort_keys=True).encode(), digest_size=16).hexdigest()


def _schema_version(folder: Path) -> int | None:
    """The schema version that an index folder's manifest states, known here or not; None if it states none."""
    version = _manifest(folder).get("schema_version")
    return version if type(version) is int else None


def _accept(layout: ReleaseLayout, index: Index, on_error: OnError) -> None:
    if index.problems and (on_error == "raise" or not index.tables):
        raise BrokenReleaseError(_problems_text(layout, index.problems))
    if not index.tables:
        raise DatarootError(
            f"{layout.root}: its scenarios hold no calib files; unpack the calib archives"
        )
    for problem in index.problems:
        logger.warning(
            "left out %s", escaped(f"{problem.scenario}: {' | '.join(problem.messages)}")
        )
    places: dict[str, list[str]] = {}
    for notice in index.notices:
        place, _, words = notice.partition(": ")
        places.setdefault(words, []).append(place)
    for words, (first, *others) in places.items():  # one sentence of all that lack the same
        head = f"{1 + len(others)} scenarios, such as {first}" if others else first
        logger.warning("%s", escaped(f"{head}: {words}"))


def _problems_text(layout: ReleaseLayout, problems: Sequence[Problem]) -> str:
    total = len({scenario.token for scenario in layout.scenarios})
    lines = [f"{layout.root}: {len(problems)} of {total} scenarios are broken:"]
    for problem in problems:
        lines += [f"  {problem.scenario}", *_first_lines(problem.messages)]
    good = total - len(problems)
    others = f"Mend them, or open the other {good} with on_error='skip' (--on-error skip)."
    return "\n".join([*lines, others if good else "No other is left to open."])


def _first_lines(messages: Sequence[str]) -> list[str]:
    more = [f"    … and {len(messages) - _NAMED} more"] if len(messages) > _NAMED else []
    return [*(f"    {message}" for message in messages[:_NAMED]), *more]


def clear_index(
    dataroot: Dataroot, *, version: str = "v1", index_dir: Path | None = None
) -> list[Path]:
    """Remove the indexes of a release, in its own folder and in the user's cache, with what stopped processes left.

    Waits for a process that makes one. The release itself is not needed, nor touched.

    Args:
        dataroot: the release, as of `DeepAccident`; it need not be there.
        version: whose indexes.
        index_dir: the only place to look in, where given.

    Returns:
        The folders that were removed; empty if there was no index.

    Raises:
        IndexStoreError: something there is no part of an index, and then nothing is removed; or the removal failed.
        VersionError: the version is unknown.
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
    for place in index_places(dataroot, index_dir):
        with suppress(OSError):  # not there, or not empty: another version's index
            for listing in list_files_in(place):
                listing.unlink(missing_ok=True)
            if index_dir is None:
                place.rmdir()
    return folders


def _holds_index(folder: Path) -> bool:
    """Whether there is an index, or part of one."""
    parts = folder.glob(f"{_TABLES}*"), folder.glob("kept"), folder.glob(".lock")
    return _schema_version(folder) is not None or any(map(any, parts))


def _refuse_foreign(folder: Path) -> None:
    """Raise IndexStoreError if there is anything in the folder that no devkit puts there."""
    paths = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*"))}
    foreign = [
        name
        for name, path in paths.items()
        if path.is_symlink() or not (path.is_dir() or _FILE.fullmatch(name))
    ]
    if foreign:
        names = ", ".join(foreign[:_NAMED])
        raise IndexStoreError(
            f"{folder}: not removed: it holds what is no part of an index: {names}; look at it"
        )


def _remove(store: Store) -> None:
    """Remove an index: the manifest first, so that half of it is not taken for one."""
    try:
        for name in (MANIFEST_FILE, *_EARLIER, *_unnamed(store.folder)):
            remove_in(store.folder, name)
        store.remove()
    except OSError as error:
        raise IndexStoreError(f"{store.folder}: cannot be removed ({error})") from error
