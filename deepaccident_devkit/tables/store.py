"""Tables on disk: one Arrow file a table with one uncompressed batch, written by streaming, read memory-mapped.

The rows of some tables that are kept together, such as a scenario's, are compressed Arrow streams one after the other.
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np

from deepaccident_devkit.errors import IndexStoreError, shortened
from deepaccident_devkit.support.files import replacing
from deepaccident_devkit.support.reading import irregular_text
from deepaccident_devkit.tables.arrow import (
    Columns,
    arrow_schema,
    fault_of,
    is_streamable,
    numpy_dtype,
    record_batch,
    unpacked,
    value_fault_of,
    views,
    width,
)
from deepaccident_devkit.tables.columns import Column, TableSpec

REMEDY = "mend it with: deepaccident index DATAROOT --check"
"""What to do with a damaged table."""


def damaged_value(table: str) -> IndexStoreError:
    """The error for a row key, a count or a code beyond what it counts: only damage to a file makes one."""
    return IndexStoreError(f"the index is damaged: table '{table}' holds a value out of its range; {REMEDY}")


def table_path(folder: Path, table: str) -> Path:
    """The file of one table."""
    return folder / f"{table}.arrow"


class TableWriter(ExitStack):
    """Collects a table's rows piece by piece and writes them as one batch.

    Rows of fixed width go to a scratch file a column, without a name; the batch is then written from these,
    memory-mapped, so that a table of any size needs little memory. A context manager: leaving it removes these files.
    """

    def __init__(self, folder: Path, spec: TableSpec) -> None:
        """Start writing the table to `folder`, which must exist."""
        super().__init__()
        self._folder, self._spec, self.num_rows = folder, spec, 0
        self._columns: dict[str | None, Any] = {
            column.stored: self.enter_context(TemporaryFile(dir=folder)) if is_streamable(spec) else []  # noqa: SIM115
            for column in spec.stored_columns
        }

    def append(self, columns: Columns) -> None:
        """Add rows; every stored column must be there, all of one length."""
        for column in self._spec.stored_columns:
            values, collected = columns[column.stored or ""], self._columns[column.stored]
            if isinstance(collected, list):
                collected.extend(values)
            else:
                np.ascontiguousarray(values, dtype=numpy_dtype(column.kind)).tofile(collected)
        self.num_rows += len(columns[self._spec.stored_columns[0].stored or ""])

    def finish(self) -> None:
        """Write the table's file."""
        import pyarrow as pa

        columns = {column.stored or "": self._collected(column) for column in self._spec.stored_columns}
        with (
            replacing(table_path(self._folder, self._spec.name)) as temporary,
            pa.OSFile(str(temporary), "wb") as sink,
            pa.ipc.new_file(sink, arrow_schema(self._spec)) as writer,
        ):
            writer.write_batch(record_batch(self._spec, columns))

    def _collected(self, column: Column) -> Any:
        collected, dtype = self._columns[column.stored], numpy_dtype(column.kind)
        if isinstance(collected, list):
            return collected
        shape = (self.num_rows, width(column.kind)) if width(column.kind) > 1 else (self.num_rows,)
        if not self.num_rows:
            return np.zeros(shape, dtype=dtype)
        collected.flush()
        return np.memmap(collected, dtype=dtype, mode="r", shape=shape)


def write_table(folder: Path, spec: TableSpec, columns: Columns) -> None:
    """Write a whole table at once."""
    with TableWriter(folder, spec) as writer:
        writer.append(columns)
        writer.finish()


class StoredTable:
    """A table's file, memory-mapped.

    Attributes:
        spec: its columns.
        views: stored column name → view of it (numpy arrays are read-only).
        num_rows: its length.
    """

    def __init__(self, folder: Path, spec: TableSpec) -> None:
        """Map the file; raises IndexStoreError if it cannot be read."""
        import pyarrow as pa

        path = table_path(folder, spec.name)
        try:
            if fault := irregular_text(path.stat().st_mode):
                raise OSError(fault)
            batch = pa.ipc.open_file(pa.memory_map(str(path))).get_batch(0)
            if fault := fault_of(spec, batch):
                raise OSError(fault)
            self.views = views(spec, batch)
        except FileNotFoundError:
            raise IndexStoreError(f"{path}: no such file: the index was made again; open the release again") from None
        except (OSError, pa.ArrowException, IndexError, ValueError) as error:
            raise IndexStoreError(f"{path}: cannot be read ({shortened(str(error))}); {REMEDY}") from error
        self.spec = spec
        self._path = path
        self._batch = batch
        self.num_rows = int(batch.num_rows)

    @cached_property
    def table(self) -> Any:
        """The `pyarrow.Table` over the mapped memory; raises IndexStoreError if Arrow could not read a value."""
        import pyarrow as pa

        table = pa.Table.from_batches([self._batch])
        if fault := value_fault_of(self.spec, table):
            raise IndexStoreError(f"{self._path}: damaged ({shortened(fault)}); {REMEDY}")
        return table


def streams(tables: Sequence[tuple[TableSpec, Columns]], metadata: Mapping[str, str] | None = None) -> bytes:
    """The rows of each table, with or without words, as compressed Arrow streams one after the other."""
    import pyarrow as pa

    options = pa.ipc.IpcWriteOptions(compression="zstd")
    sink = pa.BufferOutputStream()
    for spec, columns in tables:
        with pa.ipc.new_stream(sink, arrow_schema(spec).with_metadata(dict(metadata or {})), options=options) as writer:
            writer.write_batch(record_batch(spec, columns))
    content: bytes = sink.getvalue().to_pybytes()
    return content


def streams_metadata(content: bytes) -> dict[str, str]:
    """The words of `streams`."""
    import pyarrow as pa

    metadata = pa.ipc.open_stream(content).schema.metadata or {}
    return {name.decode(): value.decode() for name, value in metadata.items()}


def read_streams(source: Any, specs: Sequence[TableSpec]) -> list[dict[str, Any]] | None:
    """Of each table stored column → its values, as `streams` took them; None if they are not of these tables.

    Args:
        source: an Arrow file or bytes in an Arrow reader, at the first stream.
        specs: the tables, in their order.
    """
    import pyarrow as pa

    tables = []
    for spec in specs:
        batches = list(pa.ipc.open_stream(source))  # to the stream's end, where the next one starts
        if len(batches) != 1 or fault_of(spec, batches[0]):
            return None
        tables.append({name: unpacked(view) for name, view in views(spec, batches[0]).items()})
    return tables
