"""The files in schema/ agree with the code, and records agree with the files in schema/."""

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
    # tests/unit/motion/test_label_files.py runs the code on the page of motion labels
    handwritten_files = {"generate.py", "motion_labels.md"}
    names = {path.name for path in SCHEMA.iterdir() if path.is_file()}
    assert names == {*schema_generator.generated_files(), *handwritten_files}


@pytest.mark.parametrize("table", list(table_specs()))
def test_records_agree_with_their_schema(both_layouts: DeepAccident, table: str) -> None:
    schema = json.loads((SCHEMA / f"{table}.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    records = getattr(both_layouts, table)
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
    """An index with other columns must not be read.

    After a change, increase SCHEMA_VERSION and write the new digest here.
    """
    stored_columns = [
        (name, field.name, str(field.type), field.nullable)
        for name, spec in table_specs().items()
        for field in arrow_schema(spec)
    ]
    digest = hashlib.blake2b(repr(stored_columns).encode(), digest_size=8).hexdigest()
    assert (SCHEMA_VERSION, digest) == (4, "a56005d98bcb9522")
