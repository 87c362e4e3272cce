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
CHAINED = [name for name, field, _ in KEYS if field == "next"]


@pytest.mark.parametrize(("table", "field", "target"), KEYS)
def test_every_foreign_key_names_a_row(both_layouts: DeepAccident, table: str, field: str, target: str) -> None:
    tokens = {record[field] for record in getattr(both_layouts, table)} - {None}
    assert tokens, "a column of nothing but nulls tests nothing"
    for token in tokens:
        assert both_layouts.get(target, token)["token"] == token


@pytest.mark.parametrize("table", list(table_specs()))
def test_tokens_are_unique_and_lead_back_to_their_rows(both_layouts: DeepAccident, table: str) -> None:
    records = getattr(both_layouts, table)
    tokens = [record["token"] for record in records]
    assert len(set(tokens)) == len(tokens) > 0
    assert [both_layouts.getind(table, token) for token in tokens] == list(range(len(records)))


@pytest.mark.parametrize("table", CHAINED)
def test_chains_reach_every_row_once_and_run_both_ways(both_layouts: DeepAccident, table: str) -> None:
    records = {record["token"]: record for record in getattr(both_layouts, table)}
    walked = []
    for record in [record for record in records.values() if record["prev"] is None]:
        before, token = None, record["token"]
        while token is not None:
            assert records[token]["prev"] == before
            walked.append(token)
            before, token = token, records[token]["next"]
    assert sorted(walked) == sorted(records)


def test_annotation_chains_stay_with_one_agent_and_actor(both_layouts: DeepAccident) -> None:
    def who(token: str) -> tuple[object, ...]:
        record = both_layouts.get("annotation", token)
        return record["actor_id"], both_layouts.get("sample", record["sample_token"])["agent_token"]

    for record in both_layouts.annotation:
        assert record["next"] is None or who(record["next"]) == who(record["token"])


def test_an_instances_first_and_last_annotation_are_by_frame_then_agent(both_layouts: DeepAccident) -> None:
    order = {}
    for row, record in enumerate(both_layouts.annotation):
        if record["instance_token"]:
            sample = both_layouts.get("sample", record["sample_token"])
            agent = both_layouts.getind("agent", sample["agent_token"])
            entry = (sample["timestamp"], agent, row, record["token"])
            order.setdefault(record["instance_token"], []).append(entry)
    found = {
        each["token"]: (each["num_annotations"], each["first_annotation_token"], each["last_annotation_token"])
        for each in both_layouts.instance
    }
    assert found == {token: (len(rows), min(rows)[-1], max(rows)[-1]) for token, rows in order.items()}


STREAMED = """
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
"""


def test_streams_are_written_and_read_without_threads() -> None:
    ran = subprocess.run([sys.executable, "-c", STREAMED], check=False, capture_output=True, text=True)
    assert (ran.stdout, ran.stderr) == ("0\n", "")
