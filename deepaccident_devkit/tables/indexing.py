"""Indexing: the stored rows of each scenario with their sources, and joining them into tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from deepaccident_devkit.errors import IndexStoreError
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.release import ReleaseLayout, ScenarioFolder, read_meta, read_split_file
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.parallel import Store
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.tables.arrow_files import (
    HASHES,
    ColumnArrays,
    TableWriter,
    read_streams,
    streams,
    streams_metadata,
    write_table,
)
from deepaccident_devkit.tables.build import scenario_rows, sensor_rows
from deepaccident_devkit.tables.columns import NULL_INTEGER, Key, TableSpec
from deepaccident_devkit.tables.records import SCHEMA_VERSION, table_specs
from deepaccident_devkit.tables.scan import (
    Finding,
    ScenarioScan,
    content_hashes,
    read_scenario,
    scan_scenario,
    times_digest,
)
from deepaccident_devkit.taxonomy import CATEGORIES, MINI_SPLITS, SPLITS

# Tables that are the same for every scenario and are not stored with any.
_SHARED_TABLES = ("sensor", "category")
# Table → column that is not stored with a scenario, and its computation from others; it would be a
# twentieth of the index.
_COMPUTED_COLUMNS: Mapping[str, Mapping[str, Callable[[ColumnArrays], AnyArray]]] = {
    "annotation": {"rotation": lambda rows: quaternions.from_yaw(rows["yaw"])}
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitAssignment:
    """The splits of a release's scenarios.

    Attributes:
        split_of: Scenario token → split, without scenarios of unknown split.
        problems: Scenario token → reasons why it has no single folder or split, a sentence each.
        unlisted: Scenarios that no split file lists, though every split has a file.
        contradictions: Scenario token → contradictions of files and folders; the files win.
        notices: Oddities without effect, a sentence each.
    """

    split_of: Mapping[str, str]
    problems: Mapping[str, tuple[str, ...]]
    unlisted: tuple[str, ...]
    contradictions: Mapping[str, tuple[str, ...]]
    notices: tuple[str, ...]


def assign_splits(layout: ReleaseLayout) -> SplitAssignment:
    """Read the split files and compare them with the folders; raises SplitFileError."""
    listed = {split: set(read_split_file(path)) for split, path in layout.split_files.items()}
    tokens = {scenario.token for scenario in layout.scenarios}
    in_folder = {
        scenario.token: scenario.folder
        for scenario in layout.scenarios
        if scenario.folder in SPLITS
    }
    in_files = {token: split for split in SPLITS for token in listed.get(split, ())}
    split_of = {
        token: split for token, split in {**in_folder, **in_files}.items() if token in tokens
    }
    unlisted: list[str] = []
    if set(SPLITS) <= set(listed):
        unlisted = sorted(tokens - set(in_files))
    notices = []
    for split in SPLITS:
        missing = len(listed.get(split, set()) - tokens)
        if missing:
            scenarios = counted(missing, "scenario")
            notices.append(f"{layout.split_files[split]}: lists {scenarios} not in this release")
    return SplitAssignment(
        split_of=split_of,
        problems=_find_misplaced(layout, listed),
        unlisted=tuple(unlisted),
        contradictions=_find_contradictions(listed, in_folder),
        notices=tuple(notices),
    )


def _find_misplaced(
    layout: ReleaseLayout, listed: Mapping[str, set[str]]
) -> dict[str, tuple[str, ...]]:
    """Return scenario token → why it is in several splits or folders, a sentence each."""
    folders_of: dict[str, list[str]] = {}
    for scenario in layout.scenarios:
        folders_of.setdefault(scenario.token, []).append(scenario.folder)
    messages: dict[str, list[str]] = {}
    for group in (SPLITS, MINI_SPLITS):
        for split, other in combinations([split for split in group if split in listed], 2):
            files = f"{layout.split_files[split]} and {layout.split_files[other]}"
            message = f"stands in two splits: {files}; remove it from one"
            for token in sorted(listed[split] & listed[other] & folders_of.keys()):
                messages.setdefault(token, []).append(message)
    for token, folders in folders_of.items():
        if len(folders) > 1:
            paths = " and ".join(str(layout.root / folder) for folder in folders)
            messages.setdefault(token, []).append(f"stands in two folders: {paths}; remove one")
    return {token: tuple(sentences) for token, sentences in messages.items()}


def _find_contradictions(
    listed: Mapping[str, set[str]], in_folder: Mapping[str, str]
) -> dict[str, tuple[str, ...]]:
    """Return scenario token → contradictions of split files and folders, a sentence each."""
    messages: dict[str, list[str]] = {}
    for token, folder in in_folder.items():
        for split in SPLITS:
            if split != folder and token in listed.get(split, ()):
                messages.setdefault(token, []).append(f"lies in {folder}/, {split}.txt lists it")
    for mini in MINI_SPLITS:
        split = mini.removesuffix("_mini")
        if split in listed:
            for token in sorted(listed.get(mini, set()) - listed[split]):
                messages.setdefault(token, []).append(f"{mini}.txt lists it, {split}.txt does not")
    return {token: tuple(sentences) for token, sentences in messages.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """The outcome of indexing one scenario.

    Attributes:
        scenario: The scenario.
        contents: `content_hashes` of its files; empty if it has none.
        messages: Its faults, a sentence each.
        notices: Parts that were left aside, a sentence each.
    """

    scenario: ScenarioFolder
    contents: str = ""
    messages: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()

    @property
    def indexed(self) -> bool:
        """Whether its rows are stored."""
        return bool(self.contents) and not self.messages


def index_scenario(store: Store, scenario: ScenarioFolder, *, check_files: bool = False) -> Outcome:
    """Store the rows of one scenario, unless they are stored and its files are unchanged.

    Files are compared by their times, and with `check_files` by their contents.
    """
    # The key is made before any file is read, so that a later edit changes it.
    key = f"{SCHEMA_VERSION}:{times_digest(scenario)}"
    token = scenario.token
    scan = scan_scenario(scenario)
    if not scan.agents and not scan.problems:
        notice = f"{token}: its calib folders hold no files; left out"
        return Outcome(scenario=scenario, notices=(*scan.notices, notice))
    faults: Sequence[Finding] = scan.problems
    content = None if faults else store.kept(token, key, "index")
    contents = None if content is None else streams_metadata(content).get(HASHES)
    if contents is None or (check_files and contents != content_hashes(scenario)):
        files = None
        if not faults:
            files, faults = read_scenario(scenario, scan)
        contents = content_hashes(scenario) if files is None else files.hashes
        if files is not None:
            store.keep(token, key, rows_to_keep(scenario_rows(files), contents))
    notices = scan.notices if faults else (*scan.notices, *_end_notices(scenario, scan))
    return Outcome(
        scenario=scenario, contents=contents, messages=tuple(map(str, faults)), notices=notices
    )


def _end_notices(scenario: ScenarioFolder, scan: ScenarioScan) -> Iterator[str]:
    """Yield a notice if an accident ends at another frame by meta (validation's `meta-frames`)."""
    meta = read_meta(scenario.meta_path) if scan.has_meta else None
    if meta and meta.collision and meta.recorded_frames != scan.num_frames:
        yield (
            f"{scenario.meta_path}: the recording does not end with the accident: times to the "
            "impact are wrong; see: deepaccident validate"
        )


def rows_to_keep(tables: Mapping[str, ColumnArrays], contents: str) -> bytes:
    """Return the stored form of one scenario's rows, with the hashes of their source files."""
    rows = [(spec, tables[spec.name]) for spec in _stored_specs()]
    return streams(rows, {HASHES: contents})


def join_tables(
    folder: Path, scenarios: Sequence[Path], splits: Sequence[str | None], hashes: str = "{}"
) -> None:
    """Write every table to a folder, from the stored rows and the split of each scenario.

    Row keys count on, scenario after scenario. The table of scenarios carries the hashes of their
    files, by token, as JSON. Raises OSError, and IndexStoreError if a file holds no rows of a
    scenario.
    """
    specs = table_specs()
    with ExitStack() as stack:
        writers = {
            spec.name: stack.enter_context(TableWriter(folder, specs[spec.name]))
            for spec in _stored_specs()
        }
        for path, split in zip(scenarios, splits, strict=True):
            tables = _read_rows(path)
            tables["scenario"]["split"] = [NULL_INTEGER if split is None else SPLITS.index(split)]
            first_rows = {name: writer.num_rows for name, writer in writers.items()}
            first_rows["ego_pose"] = first_rows["sample"]
            for name, writer in writers.items():
                writer.append(_shift_keys(specs[name], tables[name], first_rows))
        for name, writer in writers.items():
            writer.finish({HASHES: hashes} if name == "scenario" else {})
    codes = np.arange(len(CATEGORIES))
    write_table(folder, specs["sensor"], sensor_rows())
    write_table(folder, specs["category"], {"name": codes, "index": codes})


def _stored_specs() -> list[TableSpec]:
    """Return the tables with rows of single scenarios, with their stored columns only."""
    specs = []
    for name, spec in table_specs().items():
        if name not in _SHARED_TABLES:
            computed = _COMPUTED_COLUMNS.get(name, ())
            columns = [column for column in spec.columns if column.stored not in computed]
            specs.append(replace(spec, columns=tuple(columns)))
    return specs


def _read_rows(path: Path) -> dict[str, dict[str, Any]]:
    """Return table → stored column → values from a file with the content of `rows_to_keep`."""
    import pyarrow as pa

    specs = _stored_specs()
    with pa.OSFile(str(path), "rb") as source:
        tables = read_streams(source, specs)
    if tables is None:
        raise IndexStoreError(
            f"{path}: no rows of a scenario; remove the index with: "
            "deepaccident index DATAROOT --clear"
        )
    rows_by_table = {}
    for spec, rows in zip(specs, tables, strict=True):
        computed = _COMPUTED_COLUMNS.get(spec.name, {})
        columns = {name: compute(rows) for name, compute in computed.items()}
        rows_by_table[spec.name] = rows | columns
    return rows_by_table


def _shift_keys(
    spec: TableSpec, rows: Mapping[str, Any], first_rows: Mapping[str, int]
) -> dict[str, Any]:
    """Return the rows with keys that count from the joined tables' start.

    Nulls and shared tables' keys stay.
    """
    shifted = dict(rows)
    for column in spec.stored_columns:
        if not isinstance(column.kind, Key) or not column.stored:
            continue
        if column.kind.table not in _SHARED_TABLES:
            keys = np.asarray(rows[column.stored], dtype=np.int64)
            first_row = first_rows[column.kind.table]
            shifted[column.stored] = np.where(keys == NULL_INTEGER, keys, keys + first_row)
    return shifted
