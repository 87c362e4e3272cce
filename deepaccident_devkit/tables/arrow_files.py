"""Tables on disk: one Arrow file a table with one uncompressed batch, written by streaming, read memory-mapped.

How each kind of column is stored in Arrow, and how it is read back without copying, is at the end.
The rows of some tables that are kept together, such as a scenario's, are compressed Arrow streams one after the other.
They are few, and so neither written nor read by Arrow's threads.
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import cache, cached_property
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np

from deepaccident_devkit.errors import IndexStoreError, shortened
from deepaccident_devkit.support.arrays import AnyArray, BitView
from deepaccident_devkit.support.files import replacing
from deepaccident_devkit.support.reading import mapped_file
from deepaccident_devkit.tables.columns import (
    NULL_INTEGER,
    Choice,
    Column,
    ColumnKind,
    Derived,
    Items,
    Key,
    Number,
    Struct,
    Subset,
    TableSpec,
    Vector,
    Word,
)
from deepaccident_devkit.tables.records import record_columns

ColumnArrays = Mapping[str, Any]
"""Stored column name → array (or list, for words) of one table's rows."""
HASHES = "hashes"
"""A word of kept rows, and of the table of scenarios: the hashes of the files that these were made from, as JSON."""
DAMAGED_INDEX_REMEDY = "mend it with: deepaccident check index DATAROOT"
"""What to do with a damaged table."""


def damaged_value(table: str) -> IndexStoreError:
    """The error for a row key, a count or a code beyond what it counts: only damage to a file makes one."""
    return IndexStoreError(
        f"the index is damaged: table '{table}' holds a value out of its range; {DAMAGED_INDEX_REMEDY}"
    )


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
            column.stored: self.enter_context(TemporaryFile(dir=folder))  # noqa: SIM115
            if is_streamable(spec)
            else []
            for column in spec.stored_columns
        }

    def append(self, columns: ColumnArrays) -> None:
        """Add rows; every stored column must be there, all of one length."""
        for column in self._spec.stored_columns:
            values, collected = columns[column.stored or ""], self._columns[column.stored]
            if isinstance(collected, list):
                collected.extend(values)
            else:
                np.ascontiguousarray(values, dtype=numpy_dtype(column.kind)).tofile(collected)
        self.num_rows += len(columns[self._spec.stored_columns[0].stored or ""])

    def finish(self, words: Mapping[str, str]) -> None:
        """Write the table's file, with words about the table as a whole."""
        import pyarrow as pa

        columns = {
            column.stored or "": self._collected(column) for column in self._spec.stored_columns
        }
        with (
            replacing(table_path(self._folder, self._spec.name)) as temporary,
            pa.OSFile(str(temporary), "wb") as sink,
            pa.ipc.new_file(sink, arrow_schema(self._spec).with_metadata(dict(words))) as writer,
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
        try:
            return np.memmap(collected, dtype=dtype, mode="r", shape=shape)
        except OSError:  # its file system cannot map files
            collected.seek(0)
            return np.fromfile(collected, dtype=dtype).reshape(shape)


def write_table(folder: Path, spec: TableSpec, columns: ColumnArrays) -> None:
    """Write a whole table at once."""
    with TableWriter(folder, spec) as writer:
        writer.append(columns)
        writer.finish({})


class StoredTable:
    """A table's file, memory-mapped.

    Attributes:
        spec: its columns.
        views: stored column name → view of it (numpy arrays are read-only).
        num_rows: its length.
        words: about the table as a whole, as `TableWriter.finish` took them.
    """

    def __init__(self, folder: Path, spec: TableSpec) -> None:
        """Map the file; raises IndexStoreError if it cannot be read."""
        import pyarrow as pa

        path = table_path(folder, spec.name)
        try:
            batch = pa.ipc.open_file(mapped_file(path)).get_batch(0)
            if fault := _batch_fault(spec, batch):
                raise OSError(fault)
            self.views = views(spec, batch)
            self.words = _words(batch.schema)
        except FileNotFoundError:
            raise IndexStoreError(
                f"{path}: no such file: the index was made again; open the release again"
            ) from None
        except (OSError, pa.ArrowException, IndexError, ValueError) as error:
            raise IndexStoreError(
                f"{path}: cannot be read ({shortened(str(error))}); {DAMAGED_INDEX_REMEDY}"
            ) from error
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
            raise IndexStoreError(
                f"{self._path}: damaged ({shortened(fault)}); {DAMAGED_INDEX_REMEDY}"
            )
        return table


def streams(
    tables: Sequence[tuple[TableSpec, ColumnArrays]], metadata: Mapping[str, str] | None = None
) -> bytes:
    """The rows of each table, with or without words, as compressed Arrow streams one after the other."""
    import pyarrow as pa

    options = pa.ipc.IpcWriteOptions(compression="zstd", use_threads=False)
    sink = pa.BufferOutputStream()
    for spec, columns in tables:
        with pa.ipc.new_stream(
            sink, arrow_schema(spec).with_metadata(dict(metadata or {})), options=options
        ) as writer:
            writer.write_batch(record_batch(spec, columns))
    content: bytes = sink.getvalue().to_pybytes()
    return content


def streams_metadata(content: bytes) -> dict[str, str]:
    """The words of `streams`."""
    import pyarrow as pa

    return _words(pa.ipc.open_stream(content).schema)


def _words(schema: Any) -> dict[str, str]:
    return {name.decode(): value.decode() for name, value in (schema.metadata or {}).items()}


def read_streams(source: Any, specs: Sequence[TableSpec]) -> list[dict[str, Any]] | None:
    """Of each table stored column → values, as `streams` took them; None if they are not of these tables."""
    import pyarrow as pa

    options = pa.ipc.IpcReadOptions(use_threads=False)
    tables = []
    for spec in specs:
        batches = list(
            pa.ipc.open_stream(source, options=options)
        )  # to the stream's end, where the next one starts
        if len(batches) != 1 or _batch_fault(spec, batches[0]):
            return None
        tables.append({name: unpacked(view) for name, view in views(spec, batches[0]).items()})
    return tables


def is_streamable(spec: TableSpec) -> bool:
    """Whether every column has a fixed width, so that rows can be appended to raw files."""
    return not any(isinstance(column.kind, Word | Struct) for column in spec.stored_columns)


def numpy_dtype(kind: ColumnKind) -> np.dtype[Any]:
    """The element type of a fixed-width column (bool one byte a row, as long as it is not packed)."""
    if isinstance(kind, Key):
        return np.dtype(np.int32)
    if isinstance(kind, Choice):
        return np.dtype(np.int8)
    if isinstance(kind, Subset):
        return np.dtype(np.uint8)
    return np.dtype(kind.dtype if isinstance(kind, Number) else np.float64)


def width(kind: ColumnKind) -> int:
    """Elements a row of a fixed-width column."""
    return kind.length if isinstance(kind, Vector) else 1


@cache
def arrow_type(kind: ColumnKind) -> Any:
    """The Arrow type of a stored column."""
    import pyarrow as pa

    if isinstance(kind, Word):
        return pa.string()
    if isinstance(kind, Choice):
        return pa.dictionary(pa.int8(), pa.string())
    if isinstance(kind, Vector):
        return pa.list_(pa.float64(), kind.length)
    if isinstance(kind, Struct):
        return _struct_type(kind.record)
    return pa.from_numpy_dtype(numpy_dtype(kind))


def arrow_schema(spec: TableSpec) -> Any:
    """The Arrow schema of a table; each field's metadata carries its documentation."""
    import pyarrow as pa

    return pa.schema(
        [
            pa.field(
                column.stored, arrow_type(column.kind), column.nullable, {"doc": column.kind.doc}
            )
            for column in spec.stored_columns
        ]
    )


def record_batch(spec: TableSpec, columns: ColumnArrays) -> Any:
    """One Arrow record batch over columns; numbers are not copied (bools are packed)."""
    import pyarrow as pa

    arrays = [_arrow_array(column, columns[column.stored or ""]) for column in spec.stored_columns]
    return pa.RecordBatch.from_arrays(arrays, schema=arrow_schema(spec))


def views(spec: TableSpec, batch: Any) -> dict[str, Any]:
    """Stored column name → a view of the batch's memory: numpy arrays, `BitView`s, Arrow arrays for words."""
    return {
        column.stored: _view(column.kind, batch.column(position))
        for position, column in enumerate(spec.stored_columns)
        if column.stored
    }


def _batch_fault(spec: TableSpec, batch: Any) -> str | None:
    """Why a batch that was read from a file is not one of the table's, None if its parts fit together.

    Fixed-width columns are not read: only their sizes are checked, at no cost for a table of any length. Words and
    structs are small tables' and read in full, since Arrow would follow a damaged offset out of its memory.
    """
    import pyarrow as pa

    expected = [(column.stored, arrow_type(column.kind)) for column in spec.stored_columns]
    if [(field.name, field.type) for field in batch.schema] != expected:
        return "its columns are not those of the table"
    try:
        batch.validate(full=not is_streamable(spec))
    except (pa.ArrowException, ValueError) as error:
        return str(error)
    return None


def value_fault_of(spec: TableSpec, table: Any) -> str | None:
    """What Arrow itself could not read of a table that is whole by `_batch_fault`; None if there is nothing.

    Reads the codes of all choices, those of 8.6 million rows in 20 ms. The devkit's own views use no dictionary.
    """
    import pyarrow as pa

    try:
        table.validate(full=True)
        for column in spec.stored_columns:
            if isinstance(column.kind, Choice):
                words = table[column.stored].chunk(0).dictionary
                words.validate(full=True)
                if words.to_pylist() != list(column.kind.values):
                    return f"the words of {column.stored} are not those of the table"
    except (pa.ArrowException, ValueError) as error:
        return str(error)
    return None


def unpacked(view: Any) -> Any:
    """A view as what `record_batch` takes: bools as an array, words as a list."""
    if isinstance(view, BitView):
        return view[:]
    return view if isinstance(view, np.ndarray) else view.to_pylist()


def _struct_type(record: type) -> Any:
    import pyarrow as pa

    def field_type(kind: ColumnKind) -> Any:
        if isinstance(kind, Items):
            return pa.list_(pa.int64() if kind.type == "integer" else pa.string(), 2)
        return arrow_type(kind)

    return pa.struct([(column.field, field_type(column.kind)) for column in record_columns(record)])


def _arrow_array(column: Column, values: Any) -> Any:
    import pyarrow as pa

    kind = column.kind
    if isinstance(kind, Word | Struct):
        return pa.array(values, type=arrow_type(kind))
    data = np.ascontiguousarray(values, dtype=numpy_dtype(kind))
    validity = _validity(data, len(values)) if column.nullable else None
    if isinstance(kind, Vector):
        children = [pa.Array.from_buffers(pa.float64(), data.size, [None, pa.py_buffer(data)])]
        return pa.Array.from_buffers(arrow_type(kind), len(values), [validity], children=children)
    content = pa.py_buffer(np.packbits(data, bitorder="little") if data.dtype == np.bool_ else data)
    if isinstance(kind, Choice):
        codes = pa.Array.from_buffers(pa.int8(), len(values), [validity, content])
        return pa.DictionaryArray.from_arrays(codes, pa.array(kind.values), safe=False)
    return pa.Array.from_buffers(arrow_type(kind), len(values), [validity, content])


def _validity(data: AnyArray, length: int) -> Any:
    """Arrow's bitmap of the rows that are not null, from the values that stand beneath nulls."""
    import pyarrow as pa

    if not length:
        return None
    first = data.reshape(length, -1)[:, 0]
    valid = ~np.isnan(first) if data.dtype.kind == "f" else first != NULL_INTEGER
    return None if valid.all() else pa.py_buffer(np.packbits(valid, bitorder="little"))


def _view(kind: ColumnKind, array: Any) -> Any:
    if isinstance(kind, Word | Struct | Derived):
        return array
    if isinstance(kind, Choice):
        array = array.indices
    length = len(array)
    if isinstance(kind, Vector):
        return _buffer(
            array.values.buffers()[1], np.dtype(np.float64), length * kind.length
        ).reshape(length, kind.length)
    content = array.buffers()[1]
    if isinstance(kind, Number) and kind.dtype == "bool":
        return BitView(_buffer(content, np.dtype(np.uint8), (length + 7) // 8), length)
    return _buffer(content, numpy_dtype(kind), length)


def _buffer(content: Any, dtype: np.dtype[Any], count: int) -> AnyArray:
    return np.frombuffer(content, dtype=dtype, count=count) if count else np.zeros(0, dtype=dtype)
