"""Tables on disk: one Arrow file per table, with one uncompressed batch that is memory-mapped.

The end of the module defines how each kind of column is stored in Arrow, and how it is read back
without copying. Rows of several tables that belong together, such as a scenario's, are stored as
consecutive compressed Arrow streams. They are few, so Arrow's threads are not used for them.
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
from deepaccident_devkit.support.values import NamedValues
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
"""Metadata key of a scenario's rows and of the scenario table: hashes of source files, as JSON."""
DAMAGED_INDEX_REMEDY = "repair it with: deepaccident check index DATAROOT"
"""Remedy for a damaged table."""


def damaged_value(table: str) -> IndexStoreError:
    """Return the error for a row key, count or code out of range, as in a damaged file."""
    return IndexStoreError(
        f"the index is damaged: table '{table}' contains a value out of its range; "
        f"{DAMAGED_INDEX_REMEDY}"
    )


def table_path(folder: Path, table: str) -> Path:
    """Return the path of a table's file."""
    return folder / f"{table}.arrow"


class TableWriter(ExitStack):
    """A context manager that collects a table's rows in pieces and writes them as one batch.

    Rows of fixed width go to an unnamed scratch file per column. The batch is then written from
    these memory-mapped files, so a table of any size needs little memory. Leaving the context
    removes the files.
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
        """Add rows: an array for each stored column, all of the same length."""
        num_rows = 0
        for column in self._spec.stored_columns:
            values = columns[column.stored or ""]
            num_rows = len(values)
            collected = self._columns[column.stored]
            if isinstance(collected, list):
                collected.extend(values)
            else:
                array = np.ascontiguousarray(values, dtype=numpy_dtype(column.kind))
                array.tofile(collected)
        self.num_rows += num_rows

    def finish(self, metadata: Mapping[str, str]) -> None:
        """Write the table's file, with this metadata."""
        import pyarrow as pa

        columns = {
            column.stored or "": self._read_collected(column)
            for column in self._spec.stored_columns
        }
        schema = arrow_schema(self._spec).with_metadata(dict(metadata))
        with (
            replacing(table_path(self._folder, self._spec.name)) as temporary,
            pa.OSFile(str(temporary), "wb") as sink,
            pa.ipc.new_file(sink, schema) as writer,
        ):
            writer.write_batch(record_batch(self._spec, columns))

    def _read_collected(self, column: Column) -> Any:
        collected = self._columns[column.stored]
        dtype = numpy_dtype(column.kind)
        if isinstance(collected, list):
            return collected
        num_elements = width(column.kind)
        shape = (self.num_rows, num_elements) if num_elements > 1 else (self.num_rows,)
        if not self.num_rows:
            return np.zeros(shape, dtype=dtype)
        collected.flush()
        try:
            return np.memmap(collected, dtype=dtype, mode="r", shape=shape)
        except OSError:  # the file system cannot map files
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
        """Map the table's file; raise IndexStoreError if it cannot be read."""
        import pyarrow as pa

        path = table_path(folder, spec.name)
        try:
            batch = pa.ipc.open_file(mapped_file(path)).get_batch(0)
            fault = _find_batch_fault(spec, batch)
            if fault:
                raise OSError(fault)
            self.views = views(spec, batch)
            self.words = _decode_metadata(batch.schema)
        except FileNotFoundError:
            raise IndexStoreError(
                f"{path}: no such file, as the index was made again; open the release again"
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
        """`pyarrow.Table` over the mapped memory; raises IndexStoreError if a value is damaged."""
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
    """Return the rows of several tables as consecutive compressed Arrow streams."""
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
    """Return the metadata that `streams` stored."""
    import pyarrow as pa

    return _decode_metadata(pa.ipc.open_stream(content).schema)


def _decode_metadata(schema: Any) -> dict[str, str]:
    metadata = schema.metadata or {}
    return {name.decode(): value.decode() for name, value in metadata.items()}


def read_streams(source: Any, specs: Sequence[TableSpec]) -> list[NamedValues] | None:
    """Read each table's stored column → values, as `streams` wrote them; None for other tables."""
    import pyarrow as pa

    options = pa.ipc.IpcReadOptions(use_threads=False)
    tables = []
    for spec in specs:
        # Reading to the stream's end leaves the source where the next stream starts.
        batches = list(pa.ipc.open_stream(source, options=options))
        if len(batches) != 1 or _find_batch_fault(spec, batches[0]):
            return None
        columns = views(spec, batches[0])
        tables.append({name: unpacked(view) for name, view in columns.items()})
    return tables


def is_streamable(spec: TableSpec) -> bool:
    """Return whether every column has a fixed width, so rows can be appended to raw files."""
    return not any(isinstance(column.kind, Word | Struct) for column in spec.stored_columns)


def numpy_dtype(kind: ColumnKind) -> np.dtype[Any]:
    """Return the element type of a fixed-width column; a bool takes one byte until it is packed."""
    if isinstance(kind, Key):
        return np.dtype(np.int32)
    if isinstance(kind, Choice):
        return np.dtype(np.int8)
    if isinstance(kind, Subset):
        return np.dtype(np.uint8)
    return np.dtype(kind.dtype if isinstance(kind, Number) else np.float64)


def width(kind: ColumnKind) -> int:
    """Return the number of elements in each row of a fixed-width column."""
    if isinstance(kind, Vector):
        return kind.length
    return 1


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
        return _make_struct_type(kind.record)
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
    """Make an Arrow record batch from columns; numbers are not copied, and bools are packed."""
    import pyarrow as pa

    arrays = [
        _make_arrow_array(column, columns[column.stored or ""]) for column in spec.stored_columns
    ]
    return pa.RecordBatch.from_arrays(arrays, schema=arrow_schema(spec))


def views(spec: TableSpec, batch: Any) -> NamedValues:
    """Return stored column name → a view of the batch's memory.

    Views are numpy arrays, `BitView`s, or Arrow arrays for words.
    """
    columns = {}
    for index, column in enumerate(spec.stored_columns):
        if column.stored:
            columns[column.stored] = _make_view(column.kind, batch.column(index))
    return columns


def _find_batch_fault(spec: TableSpec, batch: Any) -> str | None:
    """Return why a batch from a file does not match the table's columns; None if it does.

    Fixed-width columns are not read: only their sizes are checked, at no cost for a table of any
    length. Words and structs occur in small tables and are read in full, since Arrow would follow a
    damaged offset out of its memory.
    """
    import pyarrow as pa

    expected = [(column.stored, arrow_type(column.kind)) for column in spec.stored_columns]
    if [(field.name, field.type) for field in batch.schema] != expected:
        return "its columns differ from those of the table"
    try:
        batch.validate(full=not is_streamable(spec))
    except (pa.ArrowException, ValueError) as error:
        return str(error)
    return None


def value_fault_of(spec: TableSpec, table: Any) -> str | None:
    """Return a fault in a table's values that `_find_batch_fault` does not look for, or None.

    The codes of all choices are read, which takes 20 ms for 8.6 million rows. The devkit's own
    views use no dictionary.
    """
    import pyarrow as pa

    try:
        table.validate(full=True)
        for column in spec.stored_columns:
            if isinstance(column.kind, Choice):
                words = table[column.stored].chunk(0).dictionary
                words.validate(full=True)
                if words.to_pylist() != list(column.kind.values):
                    return f"the words of {column.stored} differ from those of the table"
    except (pa.ArrowException, ValueError) as error:
        return str(error)
    return None


def unpacked(view: Any) -> Any:
    """Convert a view for `record_batch`: bools to an array, words to a list."""
    if isinstance(view, BitView):
        return view[:]
    if isinstance(view, np.ndarray):
        return view
    return view.to_pylist()


def _make_struct_type(record: type) -> Any:
    import pyarrow as pa

    fields = []
    for column in record_columns(record):
        if isinstance(column.kind, Items):
            item_type = pa.int64() if column.kind.type == "integer" else pa.string()
            field_type = pa.list_(item_type, 2)
        else:
            field_type = arrow_type(column.kind)
        fields.append((column.field, field_type))
    return pa.struct(fields)


def _make_arrow_array(column: Column, values: Any) -> Any:
    import pyarrow as pa

    kind = column.kind
    if isinstance(kind, Word | Struct):
        return pa.array(values, type=arrow_type(kind))
    data = np.ascontiguousarray(values, dtype=numpy_dtype(kind))
    validity = _make_validity(data, len(values)) if column.nullable else None
    if isinstance(kind, Vector):
        elements = pa.Array.from_buffers(pa.float64(), data.size, [None, pa.py_buffer(data)])
        return pa.Array.from_buffers(arrow_type(kind), len(values), [validity], children=[elements])
    if data.dtype == np.bool_:
        data = np.packbits(data, bitorder="little")
    content = pa.py_buffer(data)
    if isinstance(kind, Choice):
        codes = pa.Array.from_buffers(pa.int8(), len(values), [validity, content])
        return pa.DictionaryArray.from_arrays(codes, pa.array(kind.values), safe=False)
    return pa.Array.from_buffers(arrow_type(kind), len(values), [validity, content])


def _make_validity(data: AnyArray, length: int) -> Any:
    """Return Arrow's bitmap of non-null rows; −1 and NaN mark nulls."""
    import pyarrow as pa

    if not length:
        return None
    first_elements = data.reshape(length, -1)[:, 0]
    if data.dtype.kind == "f":
        is_valid = ~np.isnan(first_elements)
    else:
        is_valid = first_elements != NULL_INTEGER
    if is_valid.all():
        return None
    return pa.py_buffer(np.packbits(is_valid, bitorder="little"))


def _make_view(kind: ColumnKind, array: Any) -> Any:
    if isinstance(kind, Word | Struct | Derived):
        return array
    if isinstance(kind, Choice):
        array = array.indices
    length = len(array)
    if isinstance(kind, Vector):
        content = array.values.buffers()[1]
        elements = _view_buffer(content, np.dtype(np.float64), length * kind.length)
        return elements.reshape(length, kind.length)
    content = array.buffers()[1]
    if isinstance(kind, Number) and kind.dtype == "bool":
        packed_bits = _view_buffer(content, np.dtype(np.uint8), (length + 7) // 8)
        return BitView(packed_bits, length)
    return _view_buffer(content, numpy_dtype(kind), length)


def _view_buffer(content: Any, dtype: np.dtype[Any], count: int) -> AnyArray:
    if not count:
        return np.zeros(0, dtype=dtype)
    return np.frombuffer(content, dtype=dtype, count=count)
