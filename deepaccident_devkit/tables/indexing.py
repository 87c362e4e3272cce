"""Making an index: read the scenarios that changed, join all of them, put the result in place."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from deepaccident_devkit.errors import DeepAccidentError, IndexStoreError
from deepaccident_devkit.files import replacing_folder
from deepaccident_devkit.parallel import Places, run_batch
from deepaccident_devkit.reading import file_checksum, observed
from deepaccident_devkit.release import ReleaseLayout, ScenarioFolder, read_meta
from deepaccident_devkit.release.store import places_of
from deepaccident_devkit.tables.build import ScenarioFiles, read_scenario, scenario_rows
from deepaccident_devkit.tables.findings import Finding
from deepaccident_devkit.tables.manifest import (
    SCHEMA_VERSION,
    TABLES_PREFIX,
    Manifest,
    Problem,
    read_manifest,
    stored_tables,
    write_manifest,
)
from deepaccident_devkit.tables.scan import (
    ScenarioScan,
    content_words,
    contents_digest,
    scan_scenario,
    times_digest,
)
from deepaccident_devkit.tables.shards import ShardState, join_tables, shard_path, shard_state, write_shard
from deepaccident_devkit.tables.split_assignment import SplitAssignment, assign_splits

if TYPE_CHECKING:
    from concurrent.futures import Executor

SHARDS_FOLDER = "shards"
MARK_FILE = ".unfinished"
"""There while an index is made; if no process makes it, one was stopped."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """The outcome of indexing one scenario.

    Attributes:
        token: the scenario's.
        contents: digest of its files.
        indexed: whether its shard is there.
        messages: what is wrong with it, a sentence each; then it has no shard.
        notices: what was left aside.
    """

    token: str
    contents: str
    indexed: bool
    messages: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()


def make_index(
    layout: ReleaseLayout,
    folder: Path,
    fingerprint: str,
    *,
    check_files: bool = False,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> Manifest:
    """Bring the index in `folder` up to date with the release and return its manifest.

    Files of the size and time that they had are taken for the same, unless `check_files` has their contents compared.
    Broken scenarios do not stop it: they are listed in the manifest. Damaged shards and tables are made again. The
    caller holds the folder's lock. Arguments that are not described here are those of `open_index`.

    Raises:
        IndexStoreError: something cannot be written; the index that was there stays as it was. Or shards lie behind
            a link.
        SplitFileError: a split file cannot be read.
        WorkerError: a worker was killed.
    """
    splits = assign_splits(layout)
    _refuse_links(folder / SHARDS_FOLDER)
    with _store_errors(folder), _marked_unfinished(folder):
        outcomes = run_batch(
            partial(index_scenario, folder / SHARDS_FOLDER, check_files=check_files),
            _candidates(layout, splits),
            workers=workers,
            executor=executor,
            label="indexing scenarios",
            progress=progress,
            places=Places(reads=places_of(layout.root), writes=(folder,)),
        )
        tables, table_files = _write_tables(folder, [outcome for outcome in outcomes if outcome.indexed], splits)
        manifest = Manifest(
            schema_version=SCHEMA_VERSION,
            fingerprint=fingerprint,
            tables=tables,
            table_files=table_files,
            problems=_problems(outcomes, splits),
            notices=(*splits.notices, *(notice for outcome in outcomes for notice in outcome.notices)),
        )
        write_manifest(folder, manifest)
        _remove_stale_shards(folder, {outcome.token for outcome in outcomes if outcome.indexed})
    return manifest


def _times_of(scenario: ScenarioFolder) -> str:
    """What a shard of the files as they are now remembers of their times."""
    return f"{SCHEMA_VERSION}:{times_digest(scenario)}"


def _candidates(layout: ReleaseLayout, splits: SplitAssignment) -> list[ScenarioFolder]:
    """The scenarios that the split files agree on."""
    return [scenario for scenario in layout.scenarios if scenario.token not in splits.problems]


def is_unfinished(folder: Path) -> bool:
    """Whether an index is being made in this folder, or the process that made one was stopped."""
    return (folder / MARK_FILE).exists()


def index_scenario(shards: Path, scenario: ScenarioFolder, *, check_files: bool = False) -> Outcome:
    """Write the shard of one scenario, unless it is there and its files are as they were."""
    times = _times_of(scenario)  # before anything is read: a later edit is noticed
    path = shard_path(shards, scenario.token)
    scan = scan_scenario(scenario)
    if scan.problems:
        return _broken(scenario, contents_digest(scenario), scan, scan.problems)
    if not scan.agents:
        notice = f"{scenario.token}: its calib folders hold no files; left out"
        return Outcome(token=scenario.token, contents="", indexed=False, notices=(*scan.notices, notice))
    state = shard_state(path)
    if state is None or state.times != times or (check_files and state.contents != contents_digest(scenario)):
        files, faults, contents = _read(scenario, scan)
        if files is None:
            return _broken(scenario, contents, scan, faults)
        state = ShardState(times=times, contents=contents)
        write_shard(path, scenario_rows(files), state)
    notices = (*scan.notices, *_end_notices(scenario, scan))
    return Outcome(token=scenario.token, contents=state.contents, indexed=True, notices=notices)


def _read(scenario: ScenarioFolder, scan: ScenarioScan) -> tuple[ScenarioFiles | None, list[Finding], str]:
    """What `read_scenario` returns, and the digest of the contents that it was made from."""
    words: dict[str, bytes] = {}

    def note(path: object, content: bytes) -> None:
        words[str(path)] = content_words(content)

    with observed(note):
        files, faults = read_scenario(scenario, scan)
    return files, faults, contents_digest(scenario, words)


def _end_notices(scenario: ScenarioFolder, scan: ScenarioScan) -> Iterator[str]:
    """What is odd about the end of an accident: by meta (validation's `meta-frames`) it is at another frame."""
    meta = read_meta(scenario.meta_path) if scan.has_meta else None
    if meta and meta.collision and meta.recorded_frames != scan.num_frames:
        yield (
            f"{scenario.meta_path}: the recording does not end with the accident: times to the impact are wrong; see: "
            "deepaccident validate"
        )


def _broken(scenario: ScenarioFolder, contents: str, scan: ScenarioScan, faults: Sequence[Finding]) -> Outcome:
    messages = tuple(str(fault) for fault in faults)
    return Outcome(token=scenario.token, contents=contents, indexed=False, messages=messages, notices=scan.notices)


def edited_scenarios(layout: ReleaseLayout, folder: Path, manifest: Manifest) -> tuple[list[str], bool]:
    """Compare the content of every label, calib and meta file with the index in `folder`; changes nothing.

    Returns:
        The tokens of the scenarios whose files are not those the index was made from, or whose shard is damaged; and
        whether the tables are whole, and made from what the other scenarios' shards hold.

    Raises:
        SplitFileError: a split file cannot be read.
    """
    splits = assign_splits(layout)
    broken = {problem.scenario: problem.contents for problem in manifest.problems}
    candidates = _candidates(layout, splits)
    same, edited = [], []
    for scenario, contents in zip(candidates, run_batch(contents_digest, candidates), strict=True):
        token = scenario.token
        state = None if token in broken else shard_state(shard_path(folder / SHARDS_FOLDER, token))
        kept = state.contents if state else broken.get(token)
        if kept == contents:
            same.append(Outcome(token=token, contents=contents, indexed=token not in broken))
        elif kept is not None or scan_scenario(scenario).agents:  # without agents it has no shard
            edited.append(token)
    name = _tables_name([outcome for outcome in same if outcome.indexed], splits)
    made_from_these = bool(edited) or name == manifest.tables
    return edited, made_from_these and _are_whole(folder / manifest.tables, manifest.table_files)


def _problems(outcomes: Sequence[Outcome], splits: SplitAssignment) -> tuple[Problem, ...]:
    broken = [
        Problem(scenario=outcome.token, messages=outcome.messages, contents=outcome.contents)
        for outcome in outcomes
        if outcome.messages
    ]
    misplaced = [Problem(scenario=token, messages=messages) for token, messages in splits.problems.items()]
    return tuple(sorted(broken + misplaced, key=lambda problem: problem.scenario))


def _write_tables(
    folder: Path, outcomes: Sequence[Outcome], splits: SplitAssignment
) -> tuple[str, dict[str, tuple[int, str]]]:
    """Join the shards into a new folder of tables, named by what they were made from; its name and its files' states.

    The name is empty if there is nothing to join. Whole tables of that name are left as they are.
    """
    name = _tables_name(outcomes, splits)
    if not name:
        return "", {}
    before = read_manifest(folder)
    if before and before.tables == name and _are_whole(folder / name, before.table_files):
        return name, dict(before.table_files)
    shards = [shard_path(folder / SHARDS_FOLDER, outcome.token) for outcome in outcomes]
    assigned = [splits.split_of.get(outcome.token) for outcome in outcomes]
    shutil.rmtree(folder / name, ignore_errors=True)  # damaged, or of a process that was stopped before its manifest
    with replacing_folder(folder / name) as temporary:
        join_tables(temporary, shards, assigned)
        states = table_file_states(temporary)
    return name, states


def _tables_name(outcomes: Sequence[Outcome], splits: SplitAssignment) -> str:
    """The name of the folder of tables made from these scenarios; empty if there are none."""
    made_from = [(outcome.token, outcome.contents, splits.split_of.get(outcome.token)) for outcome in outcomes]
    text = repr((SCHEMA_VERSION, made_from))
    return TABLES_PREFIX + hashlib.blake2b(text.encode(), digest_size=8).hexdigest() if made_from else ""


def table_file_states(folder: Path) -> dict[str, tuple[int, str]]:
    """Size and checksum of each file of a folder of tables, by name; nothing if there is no such folder."""
    return {name: (size, file_checksum(folder / name)) for name, size in _sizes(folder).items()}


def _are_whole(folder: Path, states: Mapping[str, tuple[int, str]]) -> bool:
    """Whether the tables in a folder have these sizes and checksums; of another size nothing is read."""
    return _sizes(folder) == {name: size for name, (size, _) in states.items()} and table_file_states(folder) == states


def _sizes(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_size for path in sorted(folder.glob("*.arrow")) if path.is_file()}


def _refuse_links(shards: Path) -> None:
    """Raise IndexStoreError if a link leads out of the index, where files are written and removed."""
    for path in (shards, shards.with_name(MARK_FILE), *shards.glob("*")):
        if path.is_symlink():
            raise IndexStoreError(f"{path}: a symbolic link, which no devkit makes; remove it")


def _remove_stale_shards(folder: Path, indexed: set[str]) -> None:
    """Remove the shards of scenarios that are gone or broken; what cannot be removed is left to the next time."""
    shards = folder / SHARDS_FOLDER
    kept = {shard_path(shards, token) for token in indexed}
    for shard in shards.glob("*/*.arrow"):
        if shard not in kept:
            with suppress(OSError):
                shard.unlink(missing_ok=True)
    for scenario_type in shards.glob("*/"):
        with suppress(OSError):  # not empty
            scenario_type.rmdir()


def _remove_leftovers(folder: Path) -> None:
    """Remove temporary files and the tables that the manifest does not name; failures are left to the next time."""
    with suppress(OSError):
        named = stored_tables(folder)
        stale = [tables for tables in folder.glob(f"{TABLES_PREFIX}*") if tables.name != named]
        for tables in [*folder.glob(f".{TABLES_PREFIX}*"), *stale]:
            shutil.rmtree(tables, ignore_errors=True)
        for pattern in (".*.tmp", f"{SHARDS_FOLDER}/*/.*.tmp"):
            for file in folder.glob(pattern):
                file.unlink(missing_ok=True)


@contextmanager
def _marked_unfinished(folder: Path) -> Iterator[None]:
    """Mark the folder while an index is made in it, so that a process that is stopped leaves the mark behind."""
    folder.mkdir(parents=True, exist_ok=True)
    mark = folder / MARK_FILE
    mark.touch()
    _remove_leftovers(folder)
    try:
        yield
    finally:  # the mark is removed last, so that unfinished tidying is noticed
        _remove_leftovers(folder)
        with suppress(OSError):
            mark.unlink(missing_ok=True)


@contextmanager
def _store_errors(folder: Path) -> Iterator[None]:
    """Turn errors of files into errors that name the folder and the remedy."""
    import pyarrow as pa

    try:
        yield
    except DeepAccidentError:
        raise
    except (OSError, pa.ArrowException) as error:
        remedy = "make room there or give another index_dir="
        raise IndexStoreError(f"{folder}: the index cannot be written ({error}); {remedy}") from error
