"""Flat rows as a Parquet file, with what all of them have in common in the file's own metadata."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.errors import ResultsError

STAMP_KEY: Final = b"deepaccident"
"""Of the metadata: one JSON object."""


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]], stamp: Mapping[str, Any]) -> None:
    """Write rows; columns are those of any row, in the order met, null where a row has none.

    Args:
        path: of the file.
        rows: names → texts, numbers, booleans or None; of one kind in a column.
        stamp: for the metadata.
    """
    import pyarrow as pa
    from pyarrow import parquet

    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: [row.get(name) for row in rows] for name in names}
    arrays = [_column(values) for values in columns.values()]
    table = pa.Table.from_arrays(arrays, names=names).replace_schema_metadata({STAMP_KEY: json.dumps(dict(stamp))})
    parquet.write_table(table, path)


def read_rows(path: Path) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rows and stamp that `write_rows` wrote; raises ResultsError."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        table = parquet.read_table(path)
        stamp = json.loads((table.schema.metadata or {})[STAMP_KEY])
    except (OSError, pa.ArrowException, KeyError, ValueError) as error:
        raise ResultsError(f"{path}: is no table of samples ({error}); evaluate again") from error
    rows: list[dict[str, Any]] = table.to_pylist()
    return rows, stamp


def _column(values: Sequence[Any]) -> Any:
    """An Arrow array of the values' kind; of whole numbers and fractions, and of nothing at all, fractions."""
    import pyarrow as pa

    kinds = {type(value) for value in values if value is not None}
    if kinds <= {float, int} and kinds != {int}:
        return pa.array([None if value is None else float(value) for value in values], pa.float64())
    return pa.array(values)
