"""schema/ is what the code says, and records are what schema/ says."""

import hashlib
import json
from pathlib import Path
from types import ModuleType

import jsonschema
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.tables.arrow_files import arrow_schema
from deepaccident_devkit.tables.index import SCHEMA_VERSION
from deepaccident_devkit.tables.records import table_specs

SCHEMA = Path(__file__).parents[1] / "schema"


def test_the_files_are_not_stale(schema_generator: ModuleType) -> None:
    for name, content in schema_generator.generated_files().items():
        assert (SCHEMA / name).read_text(encoding="utf-8") == content, (
            f"run python schema/generate.py: {name}"
        )


def test_no_file_is_left_over(schema_generator: ModuleType) -> None:
    by_hand = {
        "generate.py",
        "motion_labels.md",
    }  # tests/unit/motion/test_label_files.py runs what the page says
    assert {path.name for path in SCHEMA.iterdir() if path.is_file()} == {
        *schema_generator.generated_files(),
        *by_hand,
    }


@pytest.mark.parametrize("table", list(table_specs()))
def test_records_are_as_their_schema_says(both_layouts: DeepAccident, table: str) -> None:
    schema = json.loads((SCHEMA / f"{table}.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    validator, records = jsonschema.Draft202012Validator(schema), getattr(both_layouts, table)
    for record in records[:: max(1, len(records) // 40)]:
        validator.validate(record)
        assert list(record) == list(schema["properties"]) == schema["required"]


def test_the_page_explains_every_table_and_stored_column() -> None:
    page = (SCHEMA / "README.md").read_text(encoding="utf-8")
    prose = page.partition("<!-- generated below")[0]
    for name, spec in table_specs().items():
        assert name in prose, f"the prose says nothing of {name}"
        for column in spec.stored_columns:
            assert f"`{column.stored}`" in page


def test_stored_columns_do_not_change_without_a_new_schema_version() -> None:
    """An index of other columns must not be read: count SCHEMA_VERSION up and write the new digest
    here.
    """
    stored = [
        (name, field.name, str(field.type), field.nullable)
        for name, spec in table_specs().items()
        for field in arrow_schema(spec)
    ]
    digest = hashlib.blake2b(repr(stored).encode(), digest_size=8).hexdigest()
    assert (SCHEMA_VERSION, digest) == (4, "a56005d98bcb9522")
