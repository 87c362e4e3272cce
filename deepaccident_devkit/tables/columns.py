"""Columns of tables: how they are stored in Arrow, how records show them, and what they mean.

A record's fields are declared once, in `records.py`, as annotated types. Everything else (the Arrow
schema, the JSON Schemas, the records themselves) is derived from there through the classes of this
module.

Null is stored twice: as Arrow's null, for other readers of the table, and as −1 or NaN in the data,
which the devkit reads through plain numpy views without a bitmap.
"""

from dataclasses import dataclass

import numpy as np

NULL_INTEGER = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class _Documented:
    """Base of all kinds of columns; `doc` is the meaning of the values."""

    doc: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Derived(_Documented):
    """A field that is computed with its record, and not stored."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Key(_Documented):
    """A row of another table: stored as its number, shown as its token."""

    table: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Number(_Documented):
    """One number (or bool) of a numpy type."""

    dtype: str
    unit: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Vector(_Documented):
    """Several float64 numbers; `shape` (3,) is a list in a record, (3, 3) a list of lists."""

    shape: tuple[int, ...]
    unit: str = ""

    @property
    def length(self) -> int:
        """Number of values that are stored for each row."""
        return int(np.prod(self.shape))


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice(_Documented):
    """One of some known words, stored as its position."""

    values: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Subset(_Documented):
    """A subset of at most eight known words, stored as a bit mask: bit k stands for `values[k]`."""

    values: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Word(_Documented):
    """Any text; for small tables only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Items(_Documented):
    """Two values of a JSON type (`integer`, `string`); within structs only."""

    type: str
    nullable: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Struct(_Documented):
    """A record within the record, declared by a TypedDict; for small tables only."""

    record: type


ColumnKind = Derived | Key | Number | Vector | Choice | Subset | Word | Items | Struct


@dataclass(frozen=True, slots=True)
class Column:
    """One field of a table's records.

    Attributes:
        field: Name in records.
        stored: Name in the Arrow table; None if the column is not stored.
        kind: How the column is stored and shown.
        nullable: Whether the value in a record may be None.
    """

    field: str
    stored: str | None
    kind: ColumnKind
    nullable: bool


@dataclass(frozen=True, slots=True)
class TableSpec:
    """A table's name, the meaning of a row, and its columns in order."""

    name: str
    doc: str
    columns: tuple[Column, ...]

    @property
    def stored_columns(self) -> tuple[Column, ...]:
        """The columns of the Arrow table."""
        return tuple(column for column in self.columns if column.stored)

    def column(self, field: str) -> Column | None:
        """Return the column of a field; None if the records have no such field."""
        for column in self.columns:
            if column.field == field:
                return column
        return None
