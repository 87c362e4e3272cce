"""schema/ is what the code says, and records are what schema/ says."""

import hashlib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.tables.arrow import arrow_schema
from deepaccident_devkit.tables.columns import Choice, Column, Items, Number, Struct, Subset, Vector
from deepaccident_devkit.tables.index import SCHEMA_VERSION
from deepaccident_devkit.tables.records import record_columns, table_specs

SCHEMA = Path(__file__).parents[1] / "schema"


def test_the_page_is_not_stale(schema_generator: ModuleType) -> None:
    found = (SCHEMA / "README.md").read_text(encoding="utf-8")
    assert found == schema_generator.generated_page(), "run python schema/generate.py"


def fits(value: Any, column: Column) -> bool:
    """Whether a record may hold a value."""
    kind = column.kind
    if value is None:
        return column.nullable
    if isinstance(kind, Choice | Subset):
        return set([value] if isinstance(kind, Choice) else value) <= set(kind.values)
    if isinstance(kind, Vector):
        return np.shape(value) == kind.shape
    if isinstance(kind, Number):
        return np.dtype(type(value)).kind == np.dtype(kind.dtype).kind
    if isinstance(kind, Struct):
        return all(fits(value[field.field], field) for field in record_columns(kind.record))
    return len(value) == 2 if isinstance(kind, Items) else isinstance(value, str)


@pytest.mark.parametrize("table", list(table_specs()))
def test_records_are_as_they_are_declared(both_layouts: DeepAccident, table: str) -> None:
    records, columns = getattr(both_layouts, table), table_specs()[table].columns
    for record in records[:: max(1, len(records) // 40)]:
        assert list(record) == [column.field for column in columns]
        assert not [column.field for column in columns if not fits(record[column.field], column)]


def test_the_page_explains_every_table_and_stored_column() -> None:
    page = (SCHEMA / "README.md").read_text(encoding="utf-8")
    prose = page.partition("<!-- generated below")[0]
    for name, spec in table_specs().items():
        assert name in prose, f"the prose says nothing of {name}"
        for column in spec.stored_columns:
            assert f"`{column.stored}`" in page


def test_stored_columns_do_not_change_without_a_new_schema_version() -> None:
    """An index of other columns must not be read: count SCHEMA_VERSION up and write the new digest here."""
    stored = [
        (name, field.name, str(field.type), field.nullable)
        for name, spec in table_specs().items()
        for field in arrow_schema(spec)
    ]
    digest = hashlib.blake2b(repr(stored).encode(), digest_size=8).hexdigest()
    assert (SCHEMA_VERSION, digest) == (4, "a56005d98bcb9522")
