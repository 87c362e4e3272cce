"""The tables' specifications, derived from the records' annotated types."""

from collections.abc import Mapping
from functools import cache
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from deepaccident_devkit.errors import TableError
from deepaccident_devkit.nuscenes_names import table_remedy
from deepaccident_devkit.tables.columns import Column, Derived, Key, Kind, TableSpec
from deepaccident_devkit.tables.records import RECORDS
from deepaccident_devkit.text import meant_text, spelled


@cache
def table_specs() -> Mapping[str, TableSpec]:
    """Every table, in the order in which the tables build on each other."""
    return {name: spec_of(name, record) for name, record in RECORDS.items()}


def table_spec(name: str) -> TableSpec:
    """One table's specification; raises TableError."""
    specs = table_specs()
    known = spelled(name, specs)
    if known not in specs:
        remedy = table_remedy(name) or meant_text(name, specs)
        raise TableError(f"no table {name!r}; there are {', '.join(specs)}{remedy}")
    return specs[known]


def record_columns(record: type) -> tuple[Column, ...]:
    """The columns that a TypedDict of annotated fields declares."""
    return tuple(_column(field, hint) for field, hint in get_type_hints(record, include_extras=True).items())


def spec_of(name: str, record: type) -> TableSpec:
    """The specification of a table whose records a TypedDict of annotated fields declares."""
    return TableSpec(name=name, doc=" ".join((record.__doc__ or "").split()), columns=record_columns(record))


def _column(field: str, hint: Any) -> Column:
    plain, kind = get_args(hint)
    nullable = get_origin(plain) in (Union, UnionType) and type(None) in get_args(plain)
    return Column(field, _stored_name(field, kind), kind, nullable)


def _stored_name(field: str, kind: Kind) -> str | None:
    if isinstance(kind, Derived):
        return None
    if isinstance(kind, Key):
        return f"{field.removesuffix('_token')}_row"
    return field
