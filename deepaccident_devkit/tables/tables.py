"""The opened tables: rows as fresh dict records, as Arrow tables, and as views for computations on columns."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, NoReturn, TypeVar, cast, overload

import numpy as np

from deepaccident_devkit.errors import FieldError, IndexStoreError, TableError, TokenError
from deepaccident_devkit.support.nuscenes_names import field_remedy
from deepaccident_devkit.support.text import meant_text, spelled
from deepaccident_devkit.tables.columns import NULL_INTEGER, Choice, Column, Key, Number, Subset, Vector
from deepaccident_devkit.tables.records import table_spec, table_specs
from deepaccident_devkit.tables.resolve import Resolver
from deepaccident_devkit.tables.store import REMEDY, StoredTable, damaged_value

Record = TypeVar("Record")
_Getter = Callable[[int], Any]


class Tables:
    """All tables of an index, memory-mapped: they stay readable when another process remakes the index."""

    def __init__(self, folder: Path) -> None:
        """Open the tables in `folder`; raises IndexStoreError if they cannot be read."""
        self.folder = folder
        self._stored = {name: StoredTable(folder, spec) for name, spec in table_specs().items()}
        self._tables: dict[str, Table[Any]] = {}
        self.views = {name: stored.views for name, stored in self._stored.items()}
        try:
            self.resolver = Resolver(self.views)
        except (IndexError, TypeError, ValueError) as error:
            raise IndexStoreError(f"{folder}: its scenarios and agents do not fit together; {REMEDY}") from error

    def __repr__(self) -> str:
        return f"Tables({str(self.folder)!r})"

    def table(self, name: str) -> "Table[Any]":
        """One table's records; raises TableError."""
        try:
            return self._tables[name]
        except KeyError:
            known = table_spec(name).name  # in its own spelling
            if known not in self._tables:
                self._tables[known] = Table(self._stored[known], self.resolver)
            return self._tables[known]


class RecordDict(dict[str, Any]):
    """A record: a dict that names what was probably meant by a field that it does not have. Its copies are plain."""

    __slots__ = ()

    def __missing__(self, field: object) -> NoReturn:
        remedy = field_remedy(field) or f"; it has {', '.join(self)}{meant_text(field, self)}"
        raise FieldError(f"the record has no field {field!r}{remedy}")

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self),)


class Table(Sequence[Record], Generic[Record]):
    """The rows of a table; each access makes a fresh dict, which is the caller's."""

    def __init__(self, stored: StoredTable, resolver: Resolver) -> None:
        """Show the rows of a stored table."""
        self._stored = stored
        self._resolver = resolver
        self._getters = [(column.field, self._getter(column)) for column in stored.spec.columns]

    @property
    def name(self) -> str:
        """The table's name."""
        return self._stored.spec.name

    @property
    def arrow(self) -> Any:
        """The table as a `pyarrow.Table` over the mapped memory, with row keys instead of tokens.

        Raises IndexStoreError where the file is so damaged that Arrow would read beyond its memory.
        """
        return self._stored.table

    def __len__(self) -> int:
        return self._stored.num_rows

    @overload
    def __getitem__(self, row: int) -> Record: ...
    @overload
    def __getitem__(self, row: slice) -> list[Record]: ...
    def __getitem__(self, row: int | slice) -> Record | list[Record]:
        """The record of a row, or the records of a slice."""
        if isinstance(row, slice):
            return [self._record(position) for position in range(*row.indices(len(self)))]
        if not isinstance(row, int | np.integer):
            raise TableError(f"table '{self.name}' counts its rows: expected a number, found {row!r}; use get(token)")
        position = row + len(self) if row < 0 else row
        if not 0 <= position < len(self):
            raise IndexError(f"table '{self.name}' has {len(self)} rows, asked for row {row}")
        return self._record(position)

    def __iter__(self) -> Iterator[Record]:
        return (self._record(row) for row in range(len(self)))

    def __repr__(self) -> str:
        fields = ", ".join(field for field, _ in self._getters)
        return f"<table '{self.name}': {len(self):,} rows of {fields}>"

    def get(self, token: str) -> Record:
        """The record of a token; raises TokenError."""
        return self._record(self.row(token))

    def row(self, token: str) -> int:
        """The row of a token; raises TokenError."""
        return self._resolver.row(self.name, token)

    def tokens_where(self, field: str, value: Any) -> list[str]:
        """The tokens of the rows whose field equals `value`, in order; raises FieldError."""
        try:
            return [self._resolver.token(self.name, int(row)) for row in self._rows_where(field, value)]
        except IndexError as error:
            raise damaged_value(self.name) from error

    def _record(self, row: int) -> Record:
        try:
            return cast(Record, RecordDict({field: getter(row) for field, getter in self._getters}))
        except IndexError as error:
            raise damaged_value(self.name) from error

    def _rows_where(self, field: str, value: Any) -> Sequence[int]:
        column = self._stored.spec.column(field)
        if column is None:
            fields = [name for name, _ in self._getters]
            meant = meant_text(field, fields)
            raise FieldError(f"table '{self.name}' has no field '{field}'; it has {', '.join(fields)}{meant}")
        stored_value = self._stored_value(column, value)
        view = self._stored.views.get(column.stored or "")
        if stored_value is not None and isinstance(view, np.ndarray):
            return np.flatnonzero(view == stored_value).tolist()
        getter = dict(self._getters)[field]
        return [row for row in range(len(self)) if getter(row) == value]

    def _stored_value(self, column: Column, value: Any) -> Any:
        """What stands in the column where its field equals `value`; None where rows must be compared one by one."""
        kind = column.kind
        if isinstance(kind, Key) and isinstance(value, str):
            try:
                return self._resolver.row(kind.table, value)
            except TokenError:
                return NULL_INTEGER - 1
        if isinstance(kind, Choice) and isinstance(value, str):
            known = spelled(value, kind.values)
            return kind.values.index(known) if known in kind.values else NULL_INTEGER - 1
        plain_number = isinstance(value, int | float) and not isinstance(value, bool)
        if isinstance(kind, Number) and plain_number and not (column.nullable and value == NULL_INTEGER):
            return value
        return None

    def _getter(self, column: Column) -> _Getter:  # noqa: PLR0911 - one a kind
        if column.stored is None:
            return self._resolver.filename if column.field == "filename" else self._resolver.token_makers[self.name]
        view: Any = self._stored.views[column.stored]
        match column.kind:
            case Key(table=table):
                return _key_getter(view, self._resolver.token_makers[table], nullable=column.nullable)
            case Choice(values=values):
                return _choice_getter(view, values)
            case Subset(values=values):
                return lambda row: [value for bit, value in enumerate(values) if view.item(row) >> bit & 1]
            case Vector(shape=shape):
                return _vector_getter(view, shape, nullable=column.nullable)
            case Number(dtype=dtype):
                return _number_getter(view, dtype, nullable=column.nullable)
            case _:
                return lambda row: view[row].as_py()


def table_names() -> list[str]:
    """The names of all tables."""
    return list(table_specs())


def _key_getter(view: Any, token_of: Callable[[int], str], *, nullable: bool) -> _Getter:
    item = view.item
    if not nullable:
        return lambda row: token_of(item(row))

    def get(row: int) -> str | None:
        target = item(row)
        return None if target == NULL_INTEGER else token_of(target)

    return get


def _choice_getter(view: Any, values: Sequence[str]) -> _Getter:
    words, item = (*values, None), view.item  # code −1 is the last: None
    return lambda row: words[item(row)]


def _vector_getter(view: Any, shape: tuple[int, ...], *, nullable: bool) -> _Getter:
    def get(row: int) -> Any:
        values = view[row]
        if nullable and np.isnan(values[0]):
            return None
        return values.tolist() if len(shape) == 1 else values.reshape(shape).tolist()

    return get


def _number_getter(view: Any, dtype: str, *, nullable: bool) -> _Getter:
    if dtype == "bool":
        return cast(_Getter, view.__getitem__)
    item = view.item
    if not nullable:
        return cast(_Getter, item)

    def get(row: int) -> Any:
        value = item(row)
        return None if value == NULL_INTEGER or value != value else value  # noqa: PLR0124 - NaN

    return get
