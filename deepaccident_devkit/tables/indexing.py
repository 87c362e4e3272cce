"""Indexing: store each scenario's rows with hashes of their sources, and join them into tables."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TypeAlias

import numpy as np

from deepaccident_devkit.errors import IndexStoreError
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.release import ReleaseLayout, ScenarioFolder, read_meta, read_split_file
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.parallel import Store
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
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

_Sentences: TypeAlias = tuple[str, ...]
# Tables that are the same for all scenarios, and are not stored with each.
_SHARED_TABLES = ("sensor", "category")
# Table → column that is computed from others instead of stored with a scenario; it would take a
# twentieth of the index.
_COMPUTED_COLUMNS: Mapping[str, Mapping[str, Callable[[ColumnArrays], AnyArray]]] = {
    "annotation": {"rotation": lambda rows: quaternions.from_yaw(rows["yaw"])}
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitAssignment:
    """The splits of a release's scenarios.

    Attributes:
        split_of: Scenario token → split; scenarios whose split is unknown are left out.
        problems: Scenario token → reasons why its folder or split is not unique, one sentence each.
        unlisted: Scenarios that no split file lists, although every split has a file.
        contradictions: Scenario token → contradictions between split files and folders; the files
            take precedence.
        notices: Oddities without effect, one sentence each.
    """

    split_of: Mapping[str, str]
    problems: Mapping[str, _Sentences]
    unlisted: tuple[str, ...]
    contradictions: Mapping[str, _Sentences]
    notices: _Sentences


def assign_splits(layout: ReleaseLayout) -> SplitAssignment:
    """Read split files and compare them with the folders; raise SplitFileError if unreadable."""
    listed_tokens = {
        split: set(read_split_file(path)) for split, path in layout.split_files.items()
    }
    tokens = {scenario.token for scenario in layout.scenarios}
    in_split_folders = [scenario for scenario in layout.scenarios if scenario.folder in SPLITS]
    split_by_folder = {scenario.token: scenario.folder for scenario in in_split_folders}
    split_by_file: dict[str, str] = {}
    for split in SPLITS:
        split_by_file |= dict.fromkeys(listed_tokens.get(split, ()), split)
    all_splits = split_by_folder | split_by_file
    split_of = {token: split for token, split in all_splits.items() if token in tokens}
    unlisted: list[str] = []
    if set(SPLITS) <= set(listed_tokens):
        unlisted = sorted(tokens - set(split_by_file))
    notices = []
    for split in SPLITS:
        missing = len(listed_tokens.get(split, set()) - tokens)
        if missing:
            scenarios = counted(missing, "scenario")
            notices.append(f"{layout.split_files[split]}: lists {scenarios} not in this release")
    return SplitAssignment(
        split_of=split_of,
        problems=_find_misplaced(layout, listed_tokens),
        unlisted=tuple(unlisted),
        contradictions=_find_contradictions(listed_tokens, split_by_folder),
        notices=tuple(notices),
    )


def _find_misplaced(
    layout: ReleaseLayout, listed_tokens: Mapping[str, set[str]]
) -> dict[str, _Sentences]:
    """Return scenario token → a sentence for each reason why its split or folder is not unique."""
    folders_by_token: dict[str, list[str]] = {}
    for scenario in layout.scenarios:
        folders_by_token.setdefault(scenario.token, []).append(scenario.folder)
    messages: dict[str, list[str]] = {}
    for all_splits in (SPLITS, MINI_SPLITS):
        splits = [split for split in all_splits if split in listed_tokens]
        for first_split, second_split in combinations(splits, 2):
            files = f"{layout.split_files[first_split]} and {layout.split_files[second_split]}"
            message = f"is in two splits: {files}; remove it from one"
            common_tokens = (
                listed_tokens[first_split] & listed_tokens[second_split] & folders_by_token.keys()
            )
            for token in sorted(common_tokens):
                messages.setdefault(token, []).append(message)
    for token, folders in folders_by_token.items():
        if len(folders) > 1:
            paths = " and ".join(str(layout.root / folder) for folder in folders)
            messages.setdefault(token, []).append(f"is in two folders: {paths}; remove one")
    return {token: tuple(sentences) for token, sentences in messages.items()}


def _find_contradictions(
    listed_tokens: Mapping[str, set[str]], split_by_folder: Mapping[str, str]
) -> dict[str, _Sentences]:
    """Return scenario token → one sentence for each contradiction of split files and folders."""
    messages: dict[str, list[str]] = {}
    for token, folder in split_by_folder.items():
        for split in SPLITS:
            if split != folder and token in listed_tokens.get(split, ()):
                message = f"is in the folder {folder}/, but {split}.txt lists it"
                messages.setdefault(token, []).append(message)
    for mini_split in MINI_SPLITS:
        split = mini_split.removesuffix("_mini")
        if split in listed_tokens:
            message = f"{mini_split}.txt lists it, but {split}.txt does not"
            for token in sorted(listed_tokens.get(mini_split, set()) - listed_tokens[split]):
                messages.setdefault(token, []).append(message)
    return {token: tuple(sentences) for token, sentences in messages.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """The outcome of indexing one scenario.

    Attributes:
        scenario: The scenario.
        contents: `content_hashes` of its files; empty if it has no files.
        messages: A sentence for each of its faults.
        notices: A sentence for each part that was ignored.
    """

    scenario: ScenarioFolder
    contents: str = ""
    messages: _Sentences = ()
    notices: _Sentences = ()

    @property
    def indexed(self) -> bool:
        """Whether its rows are stored."""
        return bool(self.contents) and not self.messages


def index_scenario(store: Store, scenario: ScenarioFolder, *, check_files: bool = False) -> Outcome:
    """Store the rows of one scenario, unless they are already stored and its files are unchanged.

    Files are compared by their times, and with `check_files` also by their contents.
    """
    # The key is computed before any file is read, so a later edit changes it.
    key = f"{SCHEMA_VERSION}:{times_digest(scenario)}"
    token = scenario.token
    scan = scan_scenario(scenario)
    if not scan.agents and not scan.problems:
        notice = f"{token}: its calib folders contain no files; the scenario is excluded"
        return Outcome(scenario=scenario, notices=(*scan.notices, notice))
    faults: Sequence[Finding] = scan.problems
    stored_rows = None if faults else store.read_result(token, key, "index")
    hashes = None if stored_rows is None else streams_metadata(stored_rows).get(HASHES)
    if hashes is None or (check_files and hashes != content_hashes(scenario)):
        files = None
        if not faults:
            files, faults = read_scenario(scenario, scan)
        hashes = content_hashes(scenario) if files is None else files.hashes
        if files is not None:
            store.write_result(token, key, rows_to_keep(scenario_rows(files), hashes))
    notices = scan.notices if faults else (*scan.notices, *_find_end_notices(scenario, scan))
    return Outcome(
        scenario=scenario, contents=hashes, messages=tuple(map(str, faults)), notices=notices
    )


def _find_end_notices(scenario: ScenarioFolder, scan: ScenarioScan) -> Iterator[str]:
    """Yield a notice if meta's last frame differs from the recording's (`meta-frames`)."""
    if not scan.has_meta:
        return
    meta = read_meta(scenario.meta_path)
    if meta.collision and meta.recorded_frames != scan.num_frames:
        yield (
            f"{scenario.meta_path}: the recording does not end with the accident, so times to the "
            "impact are wrong; for details, run deepaccident validate"
        )


def rows_to_keep(tables: Mapping[str, ColumnArrays], contents: str) -> bytes:
    """Encode one scenario's rows and the hashes of their source files for storage."""
    rows = [(spec, tables[spec.name]) for spec in _list_stored_specs()]
    return streams(rows, {HASHES: contents})


def join_tables(
    folder: Path, scenarios: Sequence[Path], splits: Sequence[str | None], hashes: str = "{}"
) -> None:
    """Write every table to a folder, from the stored rows and the split of each scenario.

    Row keys continue from one scenario to the next. The metadata of the scenario table has the
    hashes of the scenarios' files, by token, as JSON. OSError is raised if a file cannot be read or
    written, and IndexStoreError if a file does not contain the rows of a scenario.
    """
    specs = table_specs()
    with ExitStack() as stack:
        writers = {
            spec.name: stack.enter_context(TableWriter(folder, specs[spec.name]))
            for spec in _list_stored_specs()
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


def _list_stored_specs() -> list[TableSpec]:
    """Return the tables that are stored with each scenario, with only their stored columns."""
    specs = []
    for name, spec in table_specs().items():
        if name not in _SHARED_TABLES:
            computed = _COMPUTED_COLUMNS.get(name, ())
            columns = [column for column in spec.columns if column.stored not in computed]
            specs.append(replace(spec, columns=tuple(columns)))
    return specs


def _read_rows(path: Path) -> dict[str, NamedValues]:
    """Read table → stored column → values from a file that `rows_to_keep` encoded."""
    import pyarrow as pa

    specs = _list_stored_specs()
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
    spec: TableSpec, rows: ReadOnlyValues, first_rows: Mapping[str, int]
) -> NamedValues:
    """Shift the keys of rows so that they count from the start of the joined tables.

    Nulls, and the keys of shared tables, stay as they are.
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
