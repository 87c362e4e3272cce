"""The columns of all tables in Markdown, for schema/README.md, derived from the declared records."""

from collections.abc import Iterator, Mapping

from deepaccident_devkit.tables.arrow import arrow_type
from deepaccident_devkit.tables.columns import Choice, Column, Items, Key, Kind, Struct, Subset, TableSpec, Vector
from deepaccident_devkit.tables.records import record_columns, table_specs
from deepaccident_devkit.tables.tokens import FORMS


def columns_markdown(derived: Mapping[str, TableSpec]) -> str:
    """A Markdown section a table: what a row is, its token, and its columns; derived tables last, without tokens."""
    return "\n\n".join(map(_table_markdown, {**table_specs(), **derived}.values())) + "\n"


def _table_markdown(spec: TableSpec) -> str:
    lines = [
        f"### `{spec.name}`",
        "",
        f"{spec.doc} Token: `{FORMS[spec.name]}`." if spec.name in FORMS else spec.doc,
        "",
        "| field | stored as | meaning |",
        "|---|---|---|",
    ]
    return "\n".join([*lines, *(line for column in spec.columns for line in _column_markdown(column))])


def _column_markdown(column: Column, inside: str = "") -> Iterator[str]:
    """A column's line, and those of the fields of its struct."""
    kind = column.kind
    meaning = f"→ `{kind.table}`. {kind.doc}" if isinstance(kind, Key) else kind.doc
    unit = getattr(kind, "unit", "")
    stored = f"`{inside}{column.stored}`: {_type_text(kind)}" if column.stored else "made from the rows' order"
    null = ", nullable" if column.nullable else ""
    yield f"| `{inside}{column.field}` | {stored}{null} | {meaning}{f' [{unit}]' if unit else ''} |"
    for field in record_columns(kind.record) if isinstance(kind, Struct) else ():
        yield from _column_markdown(field, f"{inside}{column.field}.")


def _type_text(kind: Kind) -> str:
    match kind:
        case Vector():
            return f"float64 × {kind.length}"
        case Items():
            return f"{kind.type} × 2"
        case Choice():
            return "dictionary"
        case Subset():
            return "uint8 bit mask"
        case Struct():
            return "struct"
        case _:
            return str(arrow_type(kind))
