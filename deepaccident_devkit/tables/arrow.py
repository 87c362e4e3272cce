"""Columns between numpy and Arrow: how each kind is stored, and how it is read back without copying."""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from deepaccident_devkit.support.arrays import AnyArray, BoolArray, ByteArray
from deepaccident_devkit.tables.columns import (
    NULL_INTEGER,
    Choice,
    Column,
    Derived,
    Items,
    Key,
    Kind,
    Number,
    Struct,
    Subset,
    TableSpec,
    Vector,
    Word,
)
from deepaccident_devkit.tables.records import record_columns

Columns = Mapping[str, Any]
"""Stored column name → array (or list, for words) of one table's rows."""


class BitView(Sequence[bool]):
    """A bool column as Arrow packs it, eight rows a byte; rows are unpacked when asked for."""

    def __init__(self, packed: ByteArray, length: int) -> None:
        """View `length` bits, lowest first."""
        self._packed = packed
        self._length = length

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[bool]:
        return iter(self[:].tolist())

    def __getitem__(self, rows: Any) -> Any:
        """One row as bool, or a slice with step 1 as a new bool array."""
        if isinstance(rows, slice):
            start, stop, _ = rows.indices(self._length)
            return self._unpacked(start, max(start, stop))
        return bool(self._packed.item(rows >> 3) >> (rows & 7) & 1)

    def _unpacked(self, start: int, stop: int) -> BoolArray:
        window = self._packed[start >> 3 : (stop + 7) >> 3]
        first = start & 7
        return np.unpackbits(window, bitorder="little")[first : first + stop - start].view(np.bool_)


def is_streamable(spec: TableSpec) -> bool:
    """Whether every column has a fixed width, so that rows can be appended to raw files."""
    return not any(isinstance(column.kind, Word | Struct) for column in spec.stored_columns)


def numpy_dtype(kind: Kind) -> np.dtype[Any]:
    """The element type of a fixed-width column (bool one byte a row, as long as it is not packed)."""
    if isinstance(kind, Key):
        return np.dtype(np.int32)
    if isinstance(kind, Choice):
        return np.dtype(np.int8)
    if isinstance(kind, Subset):
        return np.dtype(np.uint8)
    return np.dtype(kind.dtype if isinstance(kind, Number) else np.float64)


def width(kind: Kind) -> int:
    """Elements a row of a fixed-width column."""
    return kind.length if isinstance(kind, Vector) else 1


@cache
def arrow_type(kind: Kind) -> Any:
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
            pa.field(column.stored, arrow_type(column.kind), column.nullable, {"doc": column.kind.doc})
            for column in spec.stored_columns
        ]
    )


def record_batch(spec: TableSpec, columns: Columns) -> Any:
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


def fault_of(spec: TableSpec, batch: Any) -> str | None:
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
    """What Arrow itself could not read of a table that is whole by `fault_of`; None if there is nothing.

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

    def field_type(kind: Kind) -> Any:
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


def _view(kind: Kind, array: Any) -> Any:
    if isinstance(kind, Word | Struct | Derived):
        return array
    if isinstance(kind, Choice):
        array = array.indices
    length = len(array)
    if isinstance(kind, Vector):
        return _buffer(array.values.buffers()[1], np.dtype(np.float64), length * kind.length).reshape(
            length, kind.length
        )
    content = array.buffers()[1]
    if isinstance(kind, Number) and kind.dtype == "bool":
        return BitView(_buffer(content, np.dtype(np.uint8), (length + 7) // 8), length)
    return _buffer(content, numpy_dtype(kind), length)


def _buffer(content: Any, dtype: np.dtype[Any], count: int) -> AnyArray:
    if not count:
        return np.zeros(0, dtype=dtype)
    return np.frombuffer(content, dtype=dtype, count=count)
