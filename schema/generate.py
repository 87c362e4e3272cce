"""Write the JSON Schemas (also those of results/) and the column tables of README.md.

Run `python schema/generate.py`. Both are derived from the declared records.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from deepaccident_devkit.evaluation.results import RESULT_SCHEMAS
from deepaccident_devkit.interactions.table import interaction_specs
from deepaccident_devkit.tables.arrow_files import arrow_type
from deepaccident_devkit.tables.columns import (
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
from deepaccident_devkit.tables.records import record_columns, table_specs
from deepaccident_devkit.tables.tokens import FORMS

FOLDER = Path(__file__).parent
_DIALECT = "https://json-schema.org/draft/2020-12/schema"
MARK = "<!-- generated below: python schema/generate.py -->"


def generated_files() -> dict[str, str]:
    """File name → what it should contain."""
    files = {
        f"{name}.json": json.dumps(schema, indent=2, ensure_ascii=False) + "\n"
        for name, schema in json_schemas(interaction_specs()).items()
    }
    prose = (FOLDER / "README.md").read_text(encoding="utf-8").partition(MARK)[0]
    return {**files, "README.md": f"{prose}{MARK}\n\n{columns_markdown(interaction_specs())}"}


def generated_results_files() -> dict[str, str]:
    """File name in results/ → what it should contain."""
    return {
        f"{task}.json": json.dumps(schema, indent=2, ensure_ascii=False) + "\n"
        for task, schema in RESULT_SCHEMAS.items()
    }


def json_schemas(derived: Mapping[str, TableSpec] | None = None) -> dict[str, dict[str, Any]]:
    """Return the JSON Schema (draft 2020-12) of a record of each table, by the table's name.

    The tables are those of the index and the derived ones.
    """
    return {
        name: _record_schema(spec) for name, spec in {**table_specs(), **(derived or {})}.items()
    }


def columns_markdown(derived: Mapping[str, TableSpec] | None = None) -> str:
    """Return a Markdown section for each table: the meaning of a row, its token and its columns.

    Derived tables, which have no tokens, come last.
    """
    return (
        "\n\n".join(_table_markdown(spec) for spec in {**table_specs(), **(derived or {})}.values())
        + "\n"
    )


def _record_schema(spec: TableSpec) -> dict[str, Any]:
    return {
        "$schema": _DIALECT,
        "title": spec.name,
        "description": spec.doc,
        **_object_schema(spec.columns),
    }


def _object_schema(columns: tuple[Column, ...]) -> dict[str, Any]:
    return {
        "type": "object",
        "additionalProperties": False,
        "required": [column.field for column in columns],
        "properties": {column.field: _field_schema(column) for column in columns},
    }


def _field_schema(column: Column) -> dict[str, Any]:
    schema = _kind_schema(column.kind)
    if column.nullable:
        schema = {"anyOf": [schema, {"type": "null"}]}
    described = {"description": column.kind.doc, **schema}
    unit = getattr(column.kind, "unit", "")
    return {**described, "x-unit": unit} if unit else described


def _kind_schema(kind: ColumnKind) -> dict[str, Any]:  # noqa: PLR0911 - one a kind
    match kind:
        case Derived() | Word():
            return {"type": "string"}
        case Items(type=item, nullable=nullable):
            items = {"type": [item, "null"] if nullable else item}
            return {"type": "array", "items": items, "minItems": 2, "maxItems": 2}
        case Key(table=table):
            return {"type": "string", "x-table": table}
        case Number(dtype=dtype):
            return {"type": {"b": "boolean", "i": "integer", "f": "number"}[dtype[0]]}
        case Vector():
            return _nested_array(kind.shape)
        case Choice(values=values):
            return {"type": "string", "enum": list(values)}
        case Subset(values=values):
            return {
                "type": "array",
                "items": {"type": "string", "enum": list(values)},
                "uniqueItems": True,
            }
        case Struct(record=record):
            return _object_schema(record_columns(record))


def _nested_array(shape: tuple[int, ...]) -> dict[str, Any]:
    if not shape:
        return {"type": "number"}
    return {
        "type": "array",
        "items": _nested_array(shape[1:]),
        "minItems": shape[0],
        "maxItems": shape[0],
    }


def _table_markdown(spec: TableSpec) -> str:
    lines = [
        f"### `{spec.name}`",
        "",
        f"{spec.doc} Token: `{FORMS[spec.name]}`." if spec.name in FORMS else spec.doc,
        "",
        "| field | stored as | meaning |",
        "|---|---|---|",
    ]
    return "\n".join([*lines, *(_column_markdown(column) for column in spec.columns)])


def _column_markdown(column: Column) -> str:
    kind = column.kind
    meaning = f"→ `{kind.table}`. {kind.doc}" if isinstance(kind, Key) else kind.doc
    unit = getattr(kind, "unit", "")
    stored = (
        f"`{column.stored}`: {_type_text(kind)}" if column.stored else "made from the rows' order"
    )
    null = ", nullable" if column.nullable else ""
    return f"| `{column.field}` | {stored}{null} | {meaning}{f' [{unit}]' if unit else ''} |"


def _type_text(kind: ColumnKind) -> str:
    match kind:
        case Vector():
            return f"float64 × {kind.length}"
        case Choice():
            return "dictionary"
        case Subset():
            return "uint8 bit mask"
        case Struct():
            return "struct"
        case _:
            return str(arrow_type(kind))


if __name__ == "__main__":
    for name, content in generated_files().items():
        (FOLDER / name).write_text(content, encoding="utf-8")
    for name, content in generated_results_files().items():
        (FOLDER / "results" / name).write_text(content, encoding="utf-8")
