"""Indexing: the rows of each scenario, kept with what they were made from, and how they are joined into tables."""

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

# Tables that are the same for every scenario and are not kept with any.
_SHARED_TABLES = ("sensor", "category")
# Table → column that is not kept, since it follows from others: a twentieth of the index.
_FROM_OTHERS: Mapping[str, Mapping[str, Callable[[ColumnArrays], AnyArray]]] = {
    "annotation": {"rotation": lambda rows: quaternions.from_yaw(rows["yaw"])}
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitAssignment:
    """The splits of a release's scenarios.

    Attributes:
        split_of: scenario token → split; absent where it is unknown.
        problems: scenario token → why it has no single place, a sentence each.
        unlisted: scenarios that no split file lists, though there is one of every split.
        contradictions: scenario token → how files and folders contradict each other; the files win.
        notices: what is odd but harmless, a sentence each.
    """

    split_of: Mapping[str, str]
    problems: Mapping[str, tuple[str, ...]]
    unlisted: tuple[str, ...]
    contradictions: Mapping[str, tuple[str, ...]]
    notices: tuple[str, ...]


def assign_splits(layout: ReleaseLayout) -> SplitAssignment:
    """Read the split files and compare them with the folders; raises SplitFileError for any other file."""
    listed = {split: set(read_split_file(path)) for split, path in layout.split_files.items()}
    tokens = {scenario.token for scenario in layout.scenarios}
    problems: dict[str, list[str]] = {}
    for group in (SPLITS, MINI_SPLITS):
        for first, second in combinations([split for split in group if split in listed], 2):
            for token in sorted(listed[first] & listed[second] & tokens):
                files = f"{layout.split_files[first]} and {layout.split_files[second]}"
                problems.setdefault(token, []).append(
                    f"stands in two splits: {files}; remove it from one"
                )
    for token, folders in _folders_of(layout).items():
        if len(folders) > 1:
            places = " and ".join(str(layout.root / folder) for folder in folders)
            problems.setdefault(token, []).append(f"stands in two folders: {places}; remove one")
    in_folder = {
        scenario.token: scenario.folder
        for scenario in layout.scenarios
        if scenario.folder in SPLITS
    }
    in_files = {token: split for split in SPLITS for token in listed.get(split, ())}
    missing = {split: len(set(listed.get(split, ())) - tokens) for split in SPLITS}
    return SplitAssignment(
        split_of={
            token: split for token, split in {**in_folder, **in_files}.items() if token in tokens
        },
        problems={token: tuple(messages) for token, messages in problems.items()},
        unlisted=tuple(sorted(tokens - set(in_files))) if set(SPLITS) <= set(listed) else (),
        contradictions=_contradictions(listed, in_folder),
        notices=tuple(
            f"{layout.split_files[split]}: lists {counted(count, 'scenario')} not in this release"
            for split, count in missing.items()
            if count
        ),
    )


def _contradictions(
    listed: Mapping[str, set[str]], in_folder: Mapping[str, str]
) -> dict[str, tuple[str, ...]]:
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
    return {token: tuple(found) for token, found in messages.items()}


def _folders_of(layout: ReleaseLayout) -> dict[str, list[str]]:
    folders: dict[str, list[str]] = {}
    for scenario in layout.scenarios:
        folders.setdefault(scenario.token, []).append(scenario.folder)
    return folders


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """The outcome of indexing one scenario.

    Attributes:
        scenario: which one.
        contents: `content_hashes` of its files; empty if it has none.
        messages: what is wrong with it, a sentence each.
        notices: what was left aside.
    """

    scenario: ScenarioFolder
    contents: str = ""
    messages: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()

    @property
    def indexed(self) -> bool:
        """Whether its rows are kept."""
        return bool(self.contents) and not self.messages


def index_scenario(store: Store, scenario: ScenarioFolder, *, check_files: bool = False) -> Outcome:
    """Keep the rows of one scenario, unless they are kept and its files have the same times, or contents."""
    key = f"{SCHEMA_VERSION}:{times_digest(scenario)}"  # before anything is read: a later edit is noticed
    token, scan = scenario.token, scan_scenario(scenario)
    if not scan.agents and not scan.problems:
        return Outcome(
            scenario=scenario,
            notices=(*scan.notices, f"{token}: its calib folders hold no files; left out"),
        )
    faults: Sequence[Finding] = scan.problems
    content = None if faults else store.kept(token, key, "index")
    contents = None if content is None else streams_metadata(content).get(HASHES)
    if contents is None or (check_files and contents != content_hashes(scenario)):
        files, faults = (None, faults) if faults else read_scenario(scenario, scan)
        contents = content_hashes(scenario) if files is None else files.hashes
        if files is not None:
            store.keep(token, key, rows_to_keep(scenario_rows(files), contents))
    notices = scan.notices if faults else (*scan.notices, *_end_notices(scenario, scan))
    return Outcome(
        scenario=scenario, contents=contents, messages=tuple(map(str, faults)), notices=notices
    )


def _end_notices(scenario: ScenarioFolder, scan: ScenarioScan) -> Iterator[str]:
    """What is odd about the end of an accident: by meta (validation's `meta-frames`) it is at another frame."""
    meta = read_meta(scenario.meta_path) if scan.has_meta else None
    if meta and meta.collision and meta.recorded_frames != scan.num_frames:
        yield (
            f"{scenario.meta_path}: the recording does not end with the accident: times to the impact are wrong; see: "
            "deepaccident validate"
        )


def rows_to_keep(tables: Mapping[str, ColumnArrays], contents: str) -> bytes:
    """The rows of one scenario as they are kept, with the hashes of the files that they were made from."""
    return streams([(spec, tables[spec.name]) for spec in _kept_specs()], {HASHES: contents})


def join_tables(
    folder: Path, scenarios: Sequence[Path], splits: Sequence[str | None], hashes: str = "{}"
) -> None:
    """Write every table to a folder: row keys count on, scenario after scenario, whose kept rows and splits are given.

    The table of scenarios carries the hashes of their files, by token, as JSON. Raises OSError, and IndexStoreError if
    a file holds no rows of a scenario.
    """
    specs = table_specs()
    with ExitStack() as stack:
        writers = {
            spec.name: stack.enter_context(TableWriter(folder, specs[spec.name]))
            for spec in _kept_specs()
        }
        for path, split in zip(scenarios, splits, strict=True):
            tables = _kept_rows(path)
            tables["scenario"]["split"] = [NULL_INTEGER if split is None else SPLITS.index(split)]
            first_rows = {name: writer.num_rows for name, writer in writers.items()}
            first_rows["ego_pose"] = first_rows["sample"]
            for name, writer in writers.items():
                writer.append(_counted_on(specs[name], tables[name], first_rows))
        for name, writer in writers.items():
            writer.finish({HASHES: hashes} if name == "scenario" else {})
    codes = np.arange(len(CATEGORIES))
    write_table(folder, specs["sensor"], sensor_rows())
    write_table(folder, specs["category"], {"name": codes, "index": codes})


def _kept_specs() -> list[TableSpec]:
    """The tables of which a scenario has rows, with the columns that are kept."""
    return [
        replace(
            spec,
            columns=tuple(
                column for column in spec.columns if column.stored not in _FROM_OTHERS.get(name, ())
            ),
        )
        for name, spec in table_specs().items()
        if name not in _SHARED_TABLES
    ]


def _kept_rows(path: Path) -> dict[str, dict[str, Any]]:
    """Table → stored column → its values, as `rows_to_keep` took them."""
    import pyarrow as pa

    specs = _kept_specs()
    with pa.OSFile(str(path), "rb") as source:
        tables = read_streams(source, specs)
    if tables is None:
        raise IndexStoreError(
            f"{path}: no rows of a scenario; remove the index with: deepaccident index DATAROOT --clear"
        )
    return {
        spec.name: rows | {name: of(rows) for name, of in _FROM_OTHERS.get(spec.name, {}).items()}
        for spec, rows in zip(specs, tables, strict=True)
    }


def _counted_on(
    spec: TableSpec, rows: Mapping[str, Any], first_rows: Mapping[str, int]
) -> dict[str, Any]:
    """The same rows with keys that count from the joined tables' start; nulls and shared tables' keys stay."""
    result = dict(rows)
    for column in spec.stored_columns:
        if (
            isinstance(column.kind, Key)
            and column.stored
            and column.kind.table not in _SHARED_TABLES
        ):
            local = np.asarray(rows[column.stored], dtype=np.int64)
            result[column.stored] = np.where(
                local == NULL_INTEGER, local, local + first_rows[column.kind.table]
            )
    return result
