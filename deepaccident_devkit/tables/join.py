"""Joining the scenarios' shards into one table each, row keys counted on, scenario after scenario."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from deepaccident_devkit.tables.columns import NULL_INTEGER, Key, TableSpec
from deepaccident_devkit.tables.sensor_rows import sensor_rows
from deepaccident_devkit.tables.shards import SHARED_TABLES, read_shard
from deepaccident_devkit.tables.specs import table_specs
from deepaccident_devkit.tables.store import TableWriter, write_table
from deepaccident_devkit.taxonomy import CATEGORIES, SPLITS


def join_tables(folder: Path, shards: Sequence[Path], splits: Sequence[str | None]) -> None:
    """Write every table to `folder`, which must exist.

    Args:
        folder: where the tables go.
        shards: the scenarios' shards, in the order that their rows shall have.
        splits: each scenario's split, None if unknown.
    """
    specs = table_specs()
    with ExitStack() as stack:
        writers = {
            name: stack.enter_context(TableWriter(folder, spec))
            for name, spec in specs.items()
            if name not in SHARED_TABLES
        }
        for path, split in zip(shards, splits, strict=True):
            tables = read_shard(path)
            tables["scenario"]["split"] = [NULL_INTEGER if split is None else SPLITS.index(split)]
            first_rows = {name: writer.num_rows for name, writer in writers.items()}
            first_rows["ego_pose"] = first_rows["sample"]
            for name, writer in writers.items():
                writer.append(_counted_on(specs[name], tables[name], first_rows))
        for writer in writers.values():
            writer.finish()
    write_shared_tables(folder)


def write_shared_tables(folder: Path) -> None:
    """Write the tables that are the same for every release."""
    codes = np.arange(len(CATEGORIES))
    write_table(folder, table_specs()["sensor"], sensor_rows())
    write_table(folder, table_specs()["category"], {"name": codes, "index": codes})


def _counted_on(spec: TableSpec, rows: Mapping[str, Any], first_rows: Mapping[str, int]) -> dict[str, Any]:
    """The same rows with keys that count from the joined tables' start; nulls and shared tables' keys stay."""
    result = dict(rows)
    for column in spec.stored_columns:
        if isinstance(column.kind, Key) and column.stored and column.kind.table not in SHARED_TABLES:
            local = np.asarray(rows[column.stored], dtype=np.int64)
            result[column.stored] = np.where(local == NULL_INTEGER, local, local + first_rows[column.kind.table])
    return result
