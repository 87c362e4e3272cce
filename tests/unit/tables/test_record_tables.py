"""Whole columns of what records show."""

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import IndexStoreError, TableError, TokenError
from deepaccident_devkit.tables.record_tables import RecordTables
from deepaccident_devkit.tables.tables import table_names


@pytest.mark.parametrize("table", table_names())
def test_rows_in_any_order_are_the_records(both_layouts: DeepAccident, table: str) -> None:
    records = getattr(both_layouts, table)
    rows = np.random.default_rng(0).permutation(len(records))[:300]
    found = RecordTables(both_layouts).table(table, rows).to_pylist()
    assert list(map(repr, found)) == [
        repr(dict(records[row])) for row in rows
    ]  # in which NaN equals NaN


def test_the_rows_of_scenarios_and_agents(both_layouts: DeepAccident) -> None:
    scenarios = [record["token"] for record in both_layouts.scenario[1:3]]
    maker = RecordTables(both_layouts)
    found = maker.rows(scenarios, ("other_vehicle",))
    for table, rows in found.items():
        tokens = [record["token"] for record in getattr(both_layouts, table)]
        wanted = [token for token in tokens if "/".join(token.split("/")[:2]) in scenarios]
        if table not in ("scenario", "frame", "instance", "track"):
            wanted = [token for token in wanted if token.split("/")[2] == "other_vehicle"]
        assert maker.tokens(table, rows).to_pylist() == wanted


def test_unknown_names_and_a_row_that_only_a_damaged_index_holds(da: DeepAccident) -> None:
    made, beyond = RecordTables(da), np.array([len(da.annotation)])
    assert_refused(
        (lambda: made.table("box", np.arange(1)), TableError, "no table 'box'"),
        (lambda: made.rows(["nowhere"]), TokenError, "has no token 'nowhere'"),
        (
            lambda: made.table("annotation", beyond),
            IndexStoreError,
            "table 'annotation' holds a value out of its range",
        ),
    )
