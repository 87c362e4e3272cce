"""Open the exports of make_tables.py with datasets, Polars, DuckDB and pandas, without the devkit.

It also runs the code of docs/exports.md that is marked with one of these names.
"""

import io
import json
import math
import os
import re
import sys
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from itertools import product
from pathlib import Path
from typing import Any

_CACHE = tempfile.TemporaryDirectory()
os.environ.update(HF_HOME=_CACHE.name, HF_HUB_OFFLINE="1", HF_DATASETS_DISABLE_PROGRESS_BARS="1")

import datasets  # noqa: E402 - which reads the variables once
import duckdb  # noqa: E402
import pandas as pd  # noqa: E402
import polars as pl  # noqa: E402

PAGE = Path(__file__).parents[2] / "docs" / "exports.md"
CLIENTS = ("datasets", "duckdb", "polars")
Rows = tuple[int, Callable[[int], dict[str, Any]]]
"""Number of rows, and a function that returns the row at a position."""


def list_files(table: str, split: str) -> list[str]:
    prefix = "all" if table in ("sensor", "category") else split
    return sorted(map(str, Path("out/tables", table).glob(f"{prefix}-*.parquet")))


def open_with_datasets(table: str, split: str) -> Rows:
    rows = datasets.load_dataset("out/tables", table, split=split)
    return len(rows), lambda position: rows[position]


def open_with_polars(table: str, split: str) -> Rows:
    rows = pl.read_parquet(list_files(table, split))
    return len(rows), lambda position: rows.row(position, named=True)


def open_with_duckdb(table: str, split: str) -> Rows:
    rows = duckdb.read_parquet(list_files(table, split))

    def read_row(position: int) -> dict[str, Any]:
        (row,) = rows.limit(1, position).fetchall()
        return dict(zip(rows.columns, row, strict=True))

    return len(rows), read_row


def open_with_pandas(table: str, split: str) -> Rows:
    parts = [pd.read_parquet(path) for path in list_files(table, split)]
    rows = pd.concat(parts, ignore_index=True)
    return len(rows), lambda position: rows.iloc[position].to_dict()


def equals(value: Any, expected: Any) -> bool:
    """Compare a value with JSON, in which null may stand for NaN."""
    if isinstance(expected, dict):
        return all(equals(value[name], entry) for name, entry in expected.items())
    if isinstance(expected, list):
        return len(value) == len(expected) and all(map(equals, value, expected))
    if expected is None:
        return value is None or math.isnan(value)
    return bool(value == expected)


def check_tables(tables: dict[str, Any]) -> int:
    num_compared = 0
    openers = (open_with_datasets, open_with_polars, open_with_duckdb, open_with_pandas)
    for table, splits in tables.items():
        for (split, expected), opener in product(splits.items(), openers):
            count, read_row = opener(table, split)
            assert count == expected["rows"], (opener, table, split, count)
            for position, record in expected["some"].items():
                row = read_row(int(position))
                assert equals(row, record), (opener, table, split, row, record)
                num_compared += 1
    return num_compared


def find_hidden_actors() -> set[tuple[str, str]]:
    """Return the frame and instance of actors that the pole's LiDAR hits, but not the ego's."""
    columns = ["sample_token", "instance_token", "num_lidar_pts"]
    annotations = pd.read_parquet("out/tables/annotation", columns=columns)
    hit = annotations.query("num_lidar_pts > 0").dropna()
    samples = pd.read_parquet("out/tables/sample", columns=["token", "frame_token", "agent"])
    hit = hit.merge(samples, left_on="sample_token", right_on="token")
    seen = {}
    for agent, rows in hit.groupby("agent"):
        seen[agent] = set(zip(rows.frame_token, rows.instance_token, strict=True))
    return seen["infrastructure"] - seen["ego_vehicle"]


def check_queries(expected: dict[str, Any]) -> int:
    """Run a query with pandas, and the page's code, which assigns its results to `boxes` and
    `impacts`.
    """
    blocks = re.findall(
        rf"^```python ({'|'.join(CLIENTS)})\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE
    )
    assert {client for client, _ in blocks} == set(CLIENTS)

    names: dict[str, Any] = {}
    for client, code in blocks:
        with redirect_stdout(io.StringIO()):
            exec(compile(code, f"{PAGE.name}: {client}", "exec"), names)  # noqa: S102

    assert [list(row) for row in names["boxes"].fetchall()] == expected["boxes"]
    assert sorted(names["impacts"]["token"]) == expected["impacts"]
    assert sorted(map(list, find_hidden_actors())) == expected["hidden"]

    return len(blocks) + 1


def main(folder: Path) -> None:
    os.chdir(folder)
    expected = json.loads(Path("expected.json").read_text())
    print(
        f"tables: {check_tables(expected['tables'])} rows and "
        f"{check_queries(expected['queries'])} blocks of code good"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
