"""Tables on disk: one Arrow file a table with one uncompressed batch, streamed and memory-mapped.

The end of the module defines how each kind of column is stored in Arrow, and how it is read back
without copying. Rows of several tables that belong together, such as a scenario's, are compressed
Arrow streams one after the other. They are few, and so neither written nor read by Arrow's threads.
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
"""Metadata key of scenario rows and of the table of scenarios: hashes of source files, as JSON."""
DAMAGED_INDEX_REMEDY = "mend it with: deepaccident check index DATAROOT"
"""Remedy for a damaged table."""


def damaged_value(table: str) -> IndexStoreError:
    """Return the error for a row key, a count or a code out of range.

    Only damage to a file makes such a value.
    """
    return IndexStoreError(
        f"the index is damaged: table '{table}' holds a value out of its range; "
        f"{DAMAGED_INDEX_REMEDY}"
    )


def table_path(folder: Path, table: str) -> Path:
    """Return the file of a table."""
    return folder / f"{table}.arrow"


class TableWriter(ExitStack):
    """Collects a table's rows piece by piece and writes them as one batch.

    Rows of fixed width go to a scratch file a column, without a name; the batch is then written
    from these, memory-mapped, so that a table of any size needs little memory. A context manager:
    leaving it removes these files.
    """

    def __init__(self, folder: Path, spec: TableSpec) -> None:
        """Start writing the table to `folder`, which must exist."""
        super().__init__()
        self._folder = folder
        self._spec = spec
        self.num_rows = 0
        self._columns: dict[str | None, Any] = {}
        for column in spec.stored_columns:
            self._columns[column.stored] = []
            if is_streamable(spec):
                scratch_file = self.enter_context(TemporaryFile(dir=folder))  # noqa: SIM115
                self._columns[column.stored] = scratch_file

    def append(self, columns: ColumnArrays) -> None:
        """Add rows, with arrays of one length for all stored columns."""
        for column in self._spec.stored_columns:
            values = columns[column.stored or ""]
            collected = self._columns[column.stored]
            if isinstance(collected, list):
                collected.extend(values)
            else:
                np.ascontiguousarray(values, dtype=numpy_dtype(column.kind)).tofile(collected)
        self.num_rows += len(columns[self._spec.stored_columns[0].stored or ""])

    def finish(self, metadata: Mapping[str, str]) -> None:
        """Write the table's file, with metadata of the table."""
        import pyarrow as pa

        columns = {
            column.stored or "": self._collected(column) for column in self._spec.stored_columns
        }
        schema = arrow_schema(self._spec).with_metadata(dict(metadata))
        with (
            replacing(table_path(self._folder, self._spec.name)) as temporary,
            pa.OSFile(str(temporary), "wb") as sink,
            pa.ipc.new_file(sink, schema) as writer,
        ):
            writer.write_batch(record_batch(self._spec, columns))

    def _collected(self, column: Column) -> Any:
        collected = self._columns[column.stored]
        dtype = numpy_dtype(column.kind)
        if isinstance(collected, list):
            return collected
        shape = (self.num_rows, width(column.kind)) if width(column.kind) > 1 else (self.num_rows,)
        if not self.num_rows:
            return np.zeros(shape, dtype=dtype)
        collected.flush()
        try:
            return np.memmap(collected, dtype=dtype, mode="r", shape=shape)
        except OSError:  # The file system cannot map files.
            collected.seek(0)
            return np.fromfile(collected, dtype=dtype).reshape(shape)


def write_table(folder: Path, spec: TableSpec, columns: ColumnArrays) -> None:
    """Write a complete table at once."""
    with TableWriter(folder, spec) as writer:
        writer.append(columns)
        writer.finish({})


class StoredTable:
    """A table's file, memory-mapped.

    Attributes:
        spec: Columns of the table.
        views: Stored column name → view of it (numpy arrays are read-only).
        num_rows: Number of rows.
        words: Metadata of the table, as in `TableWriter.finish`.
    """

    def __init__(self, folder: Path, spec: TableSpec) -> None:
        """Map the file; raises IndexStoreError if it cannot be read."""
        import pyarrow as pa

        path = table_path(folder, spec.name)
        try:
            batch = pa.ipc.open_file(mapped_file(path)).get_batch(0)
            fault = _batch_fault(spec, batch)
            if fault:
                raise OSError(fault)
            self.views = views(spec, batch)
            self.words = _decode_metadata(batch.schema)
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
        """The `pyarrow.Table` over the mapped memory.

        Raises IndexStoreError if Arrow could not read a value.
        """
        import pyarrow as pa

        table = pa.Table.from_batches([self._batch])
        fault = value_fault_of(self.spec, table)
        if fault:
            raise IndexStoreError(
                f"{self._path}: damaged ({shortened(fault)}); {DAMAGED_INDEX_REMEDY}"
            )
        return table


def streams(
    tables: Sequence[tuple[TableSpec, ColumnArrays]], metadata: Mapping[str, str] | None = None
) -> bytes:
    """Return the rows of each table as compressed Arrow streams one after the other."""
    import pyarrow as pa

    options = pa.ipc.IpcWriteOptions(compression="zstd", use_threads=False)
    sink = pa.BufferOutputStream()
    for spec, columns in tables:
        schema = arrow_schema(spec).with_metadata(dict(metadata or {}))
        with pa.ipc.new_stream(sink, schema, options=options) as writer:
            writer.write_batch(record_batch(spec, columns))
    content: bytes = sink.getvalue().to_pybytes()
    return content


def streams_metadata(content: bytes) -> dict[str, str]:
    """Return the metadata of `streams`."""
    import pyarrow as pa

    return _decode_metadata(pa.ipc.open_stream(content).schema)


def _decode_metadata(schema: Any) -> dict[str, str]:
    metadata = schema.metadata or {}
    return {name.decode(): value.decode() for name, value in metadata.items()}


def read_streams(source: Any, specs: Sequence[TableSpec]) -> list[dict[str, Any]] | None:
    """Return stored column → values of each table in `streams`; None if they are other tables."""
    import pyarrow as pa

    options = pa.ipc.IpcReadOptions(use_threads=False)
    tables = []
    for spec in specs:
        # Reading to the stream's end leaves the source where the next stream starts.
        batches = list(pa.ipc.open_stream(source, options=options))
        if len(batches) != 1 or _batch_fault(spec, batches[0]):
            return None
        columns = views(spec, batches[0])
        tables.append({name: unpacked(view) for name, view in columns.items()})
    return tables


def is_streamable(spec: TableSpec) -> bool:
    """Return whether every column has a fixed width, so that rows can be appended to raw files."""
    for column in spec.stored_columns:
        if isinstance(column.kind, Word | Struct):
            return False
    return True


def numpy_dtype(kind: ColumnKind) -> np.dtype[Any]:
    """Return the element type of a fixed-width column (bool: one byte a row until it is packed)."""
    if isinstance(kind, Key):
        return np.dtype(np.int32)
    if isinstance(kind, Choice):
        return np.dtype(np.int8)
    if isinstance(kind, Subset):
        return np.dtype(np.uint8)
    return np.dtype(kind.dtype if isinstance(kind, Number) else np.float64)


def width(kind: ColumnKind) -> int:
    """Return the number of elements a row of a fixed-width column."""
    return kind.length if isinstance(kind, Vector) else 1


@cache
def arrow_type(kind: ColumnKind) -> Any:
    """Return the Arrow type of a stored column."""
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
    """Return the Arrow schema of a table, with documentation in each field's metadata."""
    import pyarrow as pa

    fields = []
    for column in spec.stored_columns:
        metadata = {"doc": column.kind.doc}
        field = pa.field(column.stored, arrow_type(column.kind), column.nullable, metadata)
        fields.append(field)
    return pa.schema(fields)


def record_batch(spec: TableSpec, columns: ColumnArrays) -> Any:
    """Return one Arrow record batch over columns; numbers are not copied (bools are packed)."""
    import pyarrow as pa

    arrays = [_arrow_array(column, columns[column.stored or ""]) for column in spec.stored_columns]
    return pa.RecordBatch.from_arrays(arrays, schema=arrow_schema(spec))


def views(spec: TableSpec, batch: Any) -> dict[str, Any]:
    """Return stored column name → a view of the batch's memory.

    Views are numpy arrays, `BitView`s, or Arrow arrays for words.
    """
    columns = {}
    for index, column in enumerate(spec.stored_columns):
        if column.stored:
            columns[column.stored] = _view(column.kind, batch.column(index))
    return columns


def _batch_fault(spec: TableSpec, batch: Any) -> str | None:
    """Return why a batch from a file is not one of the table's; None if its parts fit together.

    Fixed-width columns are not read: only their sizes are checked, at no cost for a table of any
    length. Words and structs occur in small tables and are read in full, since Arrow would follow a
    damaged offset out of its memory.
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
    """Return what Arrow itself could not read of a table without `_batch_fault`; None if nothing.

    The codes of all choices are read, for 8.6 million rows in 20 ms. The devkit's own views use no
    dictionary.
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
    """Return a view in the form for `record_batch`: bools as an array, words as a list."""
    if isinstance(view, BitView):
        return view[:]
    return view if isinstance(view, np.ndarray) else view.to_pylist()


def _struct_type(record: type) -> Any:
    import pyarrow as pa

    def field_type(kind: ColumnKind) -> Any:
        if not isinstance(kind, Items):
            return arrow_type(kind)
        item_type = pa.int64() if kind.type == "integer" else pa.string()
        return pa.list_(item_type, 2)

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
    """Return Arrow's bitmap of rows that are not null, from the values stored under nulls."""
    import pyarrow as pa

    if not length:
        return None
    marker = data.reshape(length, -1)[:, 0]
    valid = ~np.isnan(marker) if data.dtype.kind == "f" else marker != NULL_INTEGER
    if valid.all():
        return None
    return pa.py_buffer(np.packbits(valid, bitorder="little"))


def _view(kind: ColumnKind, array: Any) -> Any:
    if isinstance(kind, Word | Struct | Derived):
        return array
    if isinstance(kind, Choice):
        array = array.indices
    length = len(array)
    if isinstance(kind, Vector):
        content = array.values.buffers()[1]
        size = length * kind.length
        return _buffer(content, np.dtype(np.float64), size).reshape(length, kind.length)
    content = array.buffers()[1]
    if isinstance(kind, Number) and kind.dtype == "bool":
        return BitView(_buffer(content, np.dtype(np.uint8), (length + 7) // 8), length)
    return _buffer(content, numpy_dtype(kind), length)


def _buffer(content: Any, dtype: np.dtype[Any], count: int) -> AnyArray:
    if not count:
        return np.zeros(0, dtype=dtype)
    return np.frombuffer(content, dtype=dtype, count=count)
