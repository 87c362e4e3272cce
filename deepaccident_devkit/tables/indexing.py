"""Making an index: read the scenarios that changed, join all of them, put the result in place."""

import hashlib
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from deepaccident_devkit.errors import IndexStoreError
from deepaccident_devkit.files import file_checksum, replacing_folder
from deepaccident_devkit.parallel import run_batch
from deepaccident_devkit.release import ReleaseLayout, ScenarioFolder
from deepaccident_devkit.tables.build import read_scenario, scenario_rows
from deepaccident_devkit.tables.findings import Finding
from deepaccident_devkit.tables.join import join_tables
from deepaccident_devkit.tables.manifest import SCHEMA_VERSION, Manifest, Problem, read_manifest, write_manifest
from deepaccident_devkit.tables.scan import ScenarioScan, scan_scenario, scenario_digest
from deepaccident_devkit.tables.shards import shard_digest, shard_path, write_shard
from deepaccident_devkit.tables.split_assignment import SplitAssignment, assign_splits

_SHARDS = "shards"
_TABLES = "tables-"


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What became of one scenario.

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
        SplitFileError: a split file is none.
    """
    splits = assign_splits(layout)
    candidates = [scenario for scenario in layout.scenarios if scenario.token not in splits.problems]
    with _store_errors(folder):
        _remove_leftovers(folder)
        outcomes = run_batch(
            partial(index_scenario, folder / _SHARDS),
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
        _remove_stale(folder, manifest, {outcome.token for outcome in outcomes if outcome.indexed})
    return manifest


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
    return Outcome(token=scenario.token, digest=digest, indexed=True, notices=scan.notices)


def _broken(scenario: ScenarioFolder, digest: str, scan: ScenarioScan, faults: Sequence[Finding]) -> Outcome:
    messages = tuple(str(fault) for fault in faults)
    return Outcome(token=scenario.token, digest=digest, indexed=False, messages=messages, notices=scan.notices)


def scenario_state(scenario: ScenarioFolder) -> str:
    """The digest that an `Outcome` of this scenario would have now."""
    return f"{SCHEMA_VERSION}:{scenario_digest(scenario)}"


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
    if not outcomes:
        return "", {}
    assigned = [splits.split_of.get(outcome.token) for outcome in outcomes]
    made_from = repr(
        [(outcome.token, outcome.digest, split) for outcome, split in zip(outcomes, assigned, strict=True)]
    )
    name = _TABLES + hashlib.blake2b(made_from.encode(), digest_size=8).hexdigest()
    before = read_manifest(folder)
    if before and before.tables == name and table_file_states(folder / name) == before.table_files:
        return name, dict(before.table_files)
    shards = [shard_path(folder / _SHARDS, outcome.token) for outcome in outcomes]
    shutil.rmtree(folder / name, ignore_errors=True)  # damaged, or of a process that was stopped before its manifest
    with replacing_folder(folder / name) as temporary:
        join_tables(temporary, shards, assigned)
        states = table_file_states(temporary)
    return name, states


def table_file_states(folder: Path) -> dict[str, tuple[int, str]]:
    """Size and checksum of each file of a folder of tables, by name; nothing if there is no such folder."""
    paths = sorted(path for path in folder.glob("*.arrow") if path.is_file())
    return {path.name: (path.stat().st_size, file_checksum(path)) for path in paths}


def _remove_stale(folder: Path, manifest: Manifest, indexed: set[str]) -> None:
    """Remove the tables and shards that the manifest no longer stands on; what resists is left to the next time."""
    with suppress(OSError):
        for tables in folder.glob(f"{_TABLES}*"):
            if tables.name != manifest.tables:
                shutil.rmtree(tables, ignore_errors=True)
        kept = {shard_path(folder / _SHARDS, token) for token in indexed}
        for shard in (folder / _SHARDS).glob("*/*.arrow"):
            if shard not in kept:
                shard.unlink(missing_ok=True)


def _remove_leftovers(folder: Path) -> None:
    """Remove what a stopped process left under temporary names."""
    with suppress(OSError):
        for tables in folder.glob(f".{_TABLES}*"):
            shutil.rmtree(tables, ignore_errors=True)
        for pattern in (".*.tmp", f"{_SHARDS}/*/.*.tmp"):
            for file in folder.glob(pattern):
                file.unlink(missing_ok=True)


@contextmanager
def _store_errors(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if isinstance(error, IndexStoreError):
            raise
        raise IndexStoreError(f"{folder}: the index cannot be written ({error}); give another index_dir=") from error
