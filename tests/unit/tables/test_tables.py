"""Every key points at a row, every chain can be walked, on both layouts; streams of rows."""

import subprocess
import sys

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.tables.columns import Key
from deepaccident_devkit.tables.records import table_specs

KEYS = [
    (name, column.field, column.kind.table)
    for name, spec in table_specs().items()
    for column in spec.columns
    if isinstance(column.kind, Key)
]
CHAINED_TABLES = [name for name, field, _ in KEYS if field == "next"]


@pytest.mark.parametrize(("table", "field", "target"), KEYS)
def test_every_foreign_key_names_a_row(
    both_layouts: DeepAccident, table: str, field: str, target: str
) -> None:
    tokens = {record[field] for record in getattr(both_layouts, table)} - {None}
    assert tokens, "a column of nothing but nulls tests nothing"
    for token in tokens:
        assert both_layouts.get(target, token)["token"] == token


@pytest.mark.parametrize("table", CHAINED_TABLES)
def test_chains_reach_every_row_once_and_run_both_ways(
    both_layouts: DeepAccident, table: str
) -> None:
    records = {record["token"]: record for record in getattr(both_layouts, table)}
    first_records = [record for record in records.values() if record["prev"] is None]
    visited_tokens = []
    for record in first_records:
        previous_token, token = None, record["token"]
        while token is not None:
            assert records[token]["prev"] == previous_token
            visited_tokens.append(token)
            previous_token, token = token, records[token]["next"]
    assert sorted(visited_tokens) == sorted(records)


STREAMING_PROGRAM = """
import os
import numpy as np
import pyarrow
from deepaccident_devkit.tables.arrow_files import is_streamable, numpy_dtype, read_streams, streams, width
from deepaccident_devkit.tables.records import table_specs

def values(kind):
    return np.zeros((500, width(kind)) if width(kind) > 1 else 500, numpy_dtype(kind))

specs = [spec for spec in table_specs().values() if is_streamable(spec)]
tables = [(spec, {column.stored: values(column.kind) for column in spec.stored_columns}) for spec in specs]
before = len(os.listdir("/proc/self/task"))
assert len(read_streams(pyarrow.BufferReader(streams(tables)), specs)) == len(specs) > 2
print(len(os.listdir("/proc/self/task")) - before)
"""  # noqa: E501


def test_streams_are_written_and_read_without_threads() -> None:
    process = subprocess.run(
        [sys.executable, "-c", STREAMING_PROGRAM], check=False, capture_output=True, text=True
    )
    assert (process.stdout, process.stderr) == ("0\n", "")
