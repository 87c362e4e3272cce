"""Whole columns of what records show."""

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import IndexStoreError, TableError, TokenError
from deepaccident_devkit.tables.record_tables import RecordTables
from deepaccident_devkit.tables.tables import table_names


@pytest.mark.parametrize("table", table_names())
def test_rows_in_any_order_are_the_records(both_layouts: DeepAccident, table: str) -> None:
    records = getattr(both_layouts, table)
    rows = np.random.default_rng(0).permutation(len(records))[:300]
    column_rows = RecordTables(both_layouts).table(table, rows).to_pylist()
    # NaN equals NaN in repr
    assert list(map(repr, column_rows)) == [repr(dict(records[row])) for row in rows]


def test_the_rows_of_scenarios_and_agents(both_layouts: DeepAccident) -> None:
    scenarios = [record["token"] for record in both_layouts.scenario[1:3]]
    record_tables = RecordTables(both_layouts)
    rows_by_table = record_tables.rows(scenarios, ("other_vehicle",))
    for table, rows in rows_by_table.items():
        tokens = [record["token"] for record in getattr(both_layouts, table)]
        tokens = [token for token in tokens if "/".join(token.split("/")[:2]) in scenarios]
        if table not in ("scenario", "frame", "instance", "track"):
            tokens = [token for token in tokens if token.split("/")[2] == "other_vehicle"]
        assert record_tables.tokens(table, rows).to_pylist() == tokens


def test_unknown_names_and_a_row_that_only_a_damaged_index_holds(da: DeepAccident) -> None:
    record_tables = RecordTables(da)
    row_past_the_end = np.array([len(da.annotation)])
    assert_raises(
        (lambda: record_tables.table("box", np.arange(1)), TableError, "no table 'box'"),
        (lambda: record_tables.rows(["nowhere"]), TokenError, "has no token 'nowhere'"),
        (
            lambda: record_tables.table("annotation", row_past_the_end),
            IndexStoreError,
            "table 'annotation' contains a value out of its range",
        ),
    )
