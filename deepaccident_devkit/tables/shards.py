"""A scenario's rows on disk, kept for resuming and refreshing, and how all scenarios' rows are joined into tables.

A shard is a compressed Arrow stream a table, one after the other, and at its end a checksum of all of it.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.errors import IndexStoreError
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.tables.arrow import Columns
from deepaccident_devkit.tables.columns import NULL_INTEGER, Key, TableSpec
from deepaccident_devkit.tables.sensor_rows import sensor_rows
from deepaccident_devkit.tables.specs import table_specs
from deepaccident_devkit.tables.store import TableWriter, write_table
from deepaccident_devkit.tables.streams import read_streams, streams_metadata, whole_streams, write_streams
from deepaccident_devkit.taxonomy import CATEGORIES, SPLITS

SHARED_TABLES = ("sensor", "category")
"""Tables that are the same for every scenario and stand in no shard."""
_FROM_OTHERS: Mapping[str, Mapping[str, Callable[[Columns], AnyArray]]] = {
    "annotation": {"rotation": lambda rows: quaternions.from_yaw(rows["yaw"])}
}
"""Table → column that a shard does without, since it follows from others: a twentieth of the index."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ShardState:
    """What a shard was made from.

    Attributes:
        times: digest of the scenario's files by name, size and time.
        contents: digest of them by name and content.
    """

    times: str
    contents: str


def shard_path(folder: Path, scenario_token: str) -> Path:
    """Where a scenario's shard lies."""
    return folder / f"{scenario_token}.arrow"


def shard_specs() -> list[TableSpec]:
    """The tables of a shard, in its order, with the columns that it stores."""
    return [
        replace(
            spec, columns=tuple(column for column in spec.columns if column.stored not in _FROM_OTHERS.get(name, ()))
        )
        for name, spec in table_specs().items()
        if name not in SHARED_TABLES
    ]


def write_shard(path: Path, tables: Mapping[str, Columns], state: ShardState) -> None:
    """Write the rows of every table as compressed Arrow streams, one after the other."""
    write_streams(path, [(spec, tables[spec.name]) for spec in shard_specs()], asdict(state))


def read_shard(path: Path) -> dict[str, dict[str, Any]]:
    """Table → stored column → its values, as `write_shard` took them.

    Raises IndexStoreError if the streams, whose checksum is right, are not those of a shard.
    """
    import pyarrow as pa

    specs = shard_specs()
    with pa.OSFile(str(path), "rb") as source:
        read = read_streams(source, specs)
    if read is None:
        raise IndexStoreError(f"{path}: not a shard; remove the index with: deepaccident index DATAROOT --clear")
    return {
        spec.name: rows | {name: of(rows) for name, of in _FROM_OTHERS.get(spec.name, {}).items()}
        for spec, rows in zip(specs, read, strict=True)
    }


def shard_state(path: Path) -> ShardState | None:
    """What a shard was made from, None if there is no whole shard."""
    import pyarrow as pa

    content = whole_streams(path)
    try:
        return None if content is None else ShardState(**streams_metadata(content))
    except (pa.ArrowException, TypeError, ValueError):  # an older devkit's
        return None


def join_tables(folder: Path, shards: Sequence[Path], splits: Sequence[str | None]) -> None:
    """Write every table to `folder`, which must exist: row keys count on, scenario after scenario.

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
