"""Making an index: read the scenarios that changed, join all of them, put the result in place."""

import hashlib
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from deepaccident_devkit.errors import DeepAccidentError, IndexStoreError
from deepaccident_devkit.files import file_checksum, replacing_folder
from deepaccident_devkit.parallel import run_batch
from deepaccident_devkit.release import ReleaseLayout, ScenarioFolder, read_meta
from deepaccident_devkit.tables.build import read_scenario, scenario_rows
from deepaccident_devkit.tables.findings import Finding
from deepaccident_devkit.tables.manifest import (
    SCHEMA_VERSION,
    Manifest,
    Problem,
    read_manifest,
    stored_tables,
    write_manifest,
)
from deepaccident_devkit.tables.scan import ScenarioScan, scan_scenario, scenario_digest
from deepaccident_devkit.tables.shards import join_tables, shard_digest, shard_path, write_shard
from deepaccident_devkit.tables.split_assignment import SplitAssignment, assign_splits

SHARDS_FOLDER = "shards"
TABLES_PREFIX = "tables-"
MARK_FILE = ".unfinished"
"""There while an index is made; if no process makes it, one was stopped."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """The outcome of indexing one scenario.

    Attributes:
        token: the scenario's.
        digest: of its files.
        indexed: whether its shard is there.
        messages: what is wrong with it, a sentence each; then it has no shard.
        notices: what was left aside.
    """

    token: str
    digest: str
    indexed: bool
    messages: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()


def make_index(
    layout: ReleaseLayout, folder: Path, fingerprint: str, *, workers: int | None = None, progress: bool = False
) -> Manifest:
    """Bring the index in `folder` up to date with the release and return its manifest.

    Broken scenarios do not stop it: they are listed in the manifest. Damaged shards and tables are made again. The
    caller holds the folder's lock.

    Raises:
        IndexStoreError: something cannot be written; the index that was there stays as it was.
        SplitFileError: a split file cannot be read.
        WorkerError: a worker was killed.
    """
    splits = assign_splits(layout)
    candidates = [scenario for scenario in layout.scenarios if scenario.token not in splits.problems]
    with _store_errors(folder), _marked_unfinished(folder):
        outcomes = run_batch(
            partial(index_scenario, folder / SHARDS_FOLDER),
            candidates,
            workers=workers,
            label="indexing scenarios",
            progress=progress,
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


def is_unfinished(folder: Path) -> bool:
    """Whether an index is being made in this folder, or the process that made one was stopped."""
    return (folder / MARK_FILE).exists()


def index_scenario(shards: Path, scenario: ScenarioFolder) -> Outcome:
    """Write the shard of one scenario, unless it is there and its files are as they were."""
    digest = scenario_state(scenario)
    path = shard_path(shards, scenario.token)
    scan = scan_scenario(scenario)
    if scan.problems:
        return _broken(scenario, digest, scan, scan.problems)
    if not scan.agents:
        notice = f"{scenario.token}: its calib folders hold no files; left out"
        return Outcome(token=scenario.token, digest=digest, indexed=False, notices=(*scan.notices, notice))
    if shard_digest(path) != digest:
        files, faults = read_scenario(scenario, scan)
        if files is None:
            return _broken(scenario, digest, scan, faults)
        write_shard(path, scenario_rows(files), digest)
    notices = (*scan.notices, *_end_notices(scenario, scan))
    return Outcome(token=scenario.token, digest=digest, indexed=True, notices=notices)


def _end_notices(scenario: ScenarioFolder, scan: ScenarioScan) -> Iterator[str]:
    """What is odd about the end of an accident: by meta (validation's `meta-frames`) it is at another frame."""
    meta = read_meta(scenario.meta_path) if scan.has_meta else None
    if meta and meta.collision and meta.recorded_frames != scan.num_frames:
        yield (
            f"{scenario.meta_path}: the recording does not end with the accident: times to the impact are wrong; see: "
            "deepaccident validate"
        )


def _broken(scenario: ScenarioFolder, digest: str, scan: ScenarioScan, faults: Sequence[Finding]) -> Outcome:
    messages = tuple(str(fault) for fault in faults)
    return Outcome(token=scenario.token, digest=digest, indexed=False, messages=messages, notices=scan.notices)


def scenario_state(scenario: ScenarioFolder) -> str:
    """The digest that an `Outcome` of this scenario would have now."""
    return f"{SCHEMA_VERSION}:{scenario_digest(scenario)}"


def edited_scenarios(layout: ReleaseLayout, folder: Path, manifest: Manifest) -> tuple[list[str], bool]:
    """Compare every label, calib and meta file with the index in `folder`; changes nothing.

    Returns:
        The tokens of the scenarios whose files are not those the index was made from, or whose shard is damaged; and
        whether the tables are made from what the other scenarios' shards hold.

    Raises:
        SplitFileError: a split file cannot be read.
    """
    splits = assign_splits(layout)
    broken = {problem.scenario: problem.digest for problem in manifest.problems}
    same, edited = [], []
    for scenario in layout.scenarios:
        token = scenario.token
        if token in splits.problems:
            continue
        state = scenario_state(scenario)
        kept = broken[token] if token in broken else shard_digest(shard_path(folder / SHARDS_FOLDER, token))
        if kept == state:
            same.append(Outcome(token=token, digest=state, indexed=token not in broken))
        elif kept is not None or scan_scenario(scenario).agents:  # without agents it has no shard
            edited.append(token)
    name = _tables_name([outcome for outcome in same if outcome.indexed], splits)
    return edited, bool(edited) or name == manifest.tables


def _problems(outcomes: Sequence[Outcome], splits: SplitAssignment) -> tuple[Problem, ...]:
    broken = [
        Problem(scenario=outcome.token, messages=outcome.messages, digest=outcome.digest)
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
    if before and before.tables == name and table_file_states(folder / name) == before.table_files:
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
    made_from = [(outcome.token, outcome.digest, splits.split_of.get(outcome.token)) for outcome in outcomes]
    return TABLES_PREFIX + hashlib.blake2b(repr(made_from).encode(), digest_size=8).hexdigest() if made_from else ""


def table_file_states(folder: Path) -> dict[str, tuple[int, str]]:
    """Size and checksum of each file of a folder of tables, by name; nothing if there is no such folder."""
    paths = sorted(path for path in folder.glob("*.arrow") if path.is_file())
    return {path.name: (path.stat().st_size, file_checksum(path)) for path in paths}


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
