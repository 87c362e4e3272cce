"""A scenario's rows on disk, kept for resuming and refreshing, and how all scenarios' rows are joined into tables.

A shard is a compressed Arrow stream a table, one after the other, and at its end a checksum of all of it.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.errors import IndexStoreError
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.reading import read_bytes
from deepaccident_devkit.tables.arrow import Columns, arrow_schema, fault_of, record_batch, unpacked, views
from deepaccident_devkit.tables.columns import NULL_INTEGER, Key, TableSpec
from deepaccident_devkit.tables.sensor_rows import sensor_rows
from deepaccident_devkit.tables.specs import table_specs
from deepaccident_devkit.tables.store import TableWriter, write_table
from deepaccident_devkit.taxonomy import CATEGORIES, SPLITS

SHARED_TABLES = ("sensor", "category")
"""Tables that are the same for every scenario and stand in no shard."""
_FROM_OTHERS: Mapping[str, Mapping[str, Callable[[Columns], AnyArray]]] = {
    "annotation": {"rotation": lambda rows: quaternions.from_yaw(rows["yaw"])}
}
"""Table → column that a shard does without, since it follows from others: a twentieth of the index."""
_CHECKSUM_SIZE = 16


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
    import pyarrow as pa

    options = pa.ipc.IpcWriteOptions(compression="zstd")
    sink = pa.BufferOutputStream()
    for spec in shard_specs():
        schema = arrow_schema(spec).with_metadata(asdict(state))
        with pa.ipc.new_stream(sink, schema, options=options) as writer:
            writer.write_batch(record_batch(spec, tables[spec.name]))
    content = sink.getvalue().to_pybytes()
    write_bytes(path, content + _checksum(content))


def read_shard(path: Path) -> dict[str, dict[str, Any]]:
    """Table → stored column → its values, as `write_shard` took them.

    Raises IndexStoreError if the streams, whose checksum is right, are not those of a shard.
    """
    import pyarrow as pa

    tables = {}
    with pa.OSFile(str(path), "rb") as source:
        for spec in shard_specs():
            batches = list(pa.ipc.open_stream(source))  # to the stream's end, where the next one starts
            if len(batches) != 1 or fault_of(spec, batches[0]):
                raise IndexStoreError(f"{path}: not a shard; remove the index with: deepaccident index clear DATAROOT")
            batch = batches[0]
            rows = {name: unpacked(view) for name, view in views(spec, batch).items()}
            tables[spec.name] = rows | {name: of(rows) for name, of in _FROM_OTHERS.get(spec.name, {}).items()}
    return tables


def shard_state(path: Path) -> ShardState | None:
    """What a shard was made from, None if there is no whole shard."""
    import pyarrow as pa

    try:
        content = read_bytes(path, "index")
        if content[-_CHECKSUM_SIZE:] != _checksum(content[:-_CHECKSUM_SIZE]):
            return None
        metadata = pa.ipc.open_stream(content).schema.metadata or {}
        return ShardState(**{name.decode(): value.decode() for name, value in metadata.items()})
    except (OSError, pa.ArrowException, TypeError, ValueError):  # an older devkit's
        return None


def _checksum(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=_CHECKSUM_SIZE).digest()


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
