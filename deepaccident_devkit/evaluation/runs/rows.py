"""`sample_rows`: the counts of a run's samples as flat rows, and such rows as a Parquet file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.errors import MOST_TOLD, ResultsError, shortened
from deepaccident_devkit.evaluation.runs.evaluation_run import EvaluationRun
from deepaccident_devkit.evaluation.task import plain
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import check_size, fault_text, read_bytes

Row = dict[str, Any]
# Key of the file's metadata; its value is one JSON object.
STAMP_KEY: Final = b"deepaccident"
# Memory that Python needs for a number.
_VALUE_BYTES: Final = 32


def sample_rows(run: EvaluationRun) -> list[Row]:
    """Return one row a sample, ordered by token, all with the same columns.

    Values are texts, numbers, or None where there is none. The first columns identify the sample:
    token, scenario, agent, frame (from 1), time_to_impact (seconds to the recorded impact),
    accident_visibility. The others are the evaluator's `sample_row`:

    - motion: by range IoU and PQ (percent) and instances over all frames, cells of IoU, paths and
      their errors (m);
    - accident: `positive` (an accident comes), the actors that the truth names, tp, fp and fn by
      tolerance in metres, and the errors (m, s) of what is foreseen within the largest distance;
    - detection: true boxes and detections that count, and true positives by threshold, over all
      classes and ranges;
    - warning: the plain values of the sample's counts, and the lengths of its lists;
    - planning, forecasting: the headlines of the sample.
    """
    rows = []
    for token in sorted(run.evaluator.tokens):
        rows.append(_identity(run, token) | run.evaluator.sample_row(token))
    # rows of tables of means have only the means that the sample counts in
    columns = dict.fromkeys(name for row in rows for name in row)
    return [{name: plain(row.get(name)) for name in columns} for row in rows]


def _identity(run: EvaluationRun, token: str) -> Row:
    """Return the columns that identify a sample."""
    attributes = run.attributes[token]
    return {
        "token": token,
        "scenario": attributes.scenario,
        "agent": attributes.agent,
        "frame": int(token.rsplit("/", 1)[1]),
        "time_to_impact": run.times_to_impact[token],
        "accident_visibility": attributes.accident_visibility,
    }


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]], stamp: Mapping[str, Any]) -> None:
    """Write rows as a Parquet file, with a stamp in its metadata."""
    from pyarrow import parquet

    parquet.write_table(
        rows_table(rows).replace_schema_metadata({STAMP_KEY: json.dumps(dict(stamp))}), path
    )


def rows_table(rows: Sequence[Mapping[str, Any]]) -> Any:
    """Return the Arrow table of rows with the same columns.

    Values are texts, numbers, booleans or None, of one kind in a column.
    """
    import pyarrow as pa

    names = rows[0] if rows else ()
    return pa.table({name: _column([row[name] for row in rows]) for name in names})


def read_rows(path: Path) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the rows and the stamp that `write_rows` wrote; raises ResultsError."""
    import pyarrow as pa

    try:
        table = _read_table(read_bytes(path, "bundle"))
        stamp: dict[str, Any] = parsed_json((table.schema.metadata or {})[STAMP_KEY])
        rows: list[dict[str, Any]] = table.to_pylist()
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError, MemoryError) as error:
        fault = shortened(fault_text(error), MOST_TOLD)
        raise ResultsError(f"{path}: is no table of samples ({fault}); evaluate again") from error
    return rows, stamp


def _read_table(content: bytes) -> Any:
    """Return the Arrow table in a Parquet file, within the memory that such a file may take.

    Texts stay in dictionaries until their lengths in all rows are known: a few bytes can stand for
    a long text in millions of rows. Raises OSError (it would take more memory), ValueError (a
    column has a type that `write_rows` does not write) or ArrowException (it is damaged).
    """
    import pyarrow as pa
    import pyarrow.compute as pc
    from pyarrow import parquet

    limits = {"thrift_string_size_limit": len(content), "thrift_container_size_limit": len(content)}
    schema = parquet.ParquetFile(pa.BufferReader(content), **limits).schema_arrow
    types = (pa.string(), pa.int64(), pa.float64(), pa.bool_(), pa.null())
    for field in schema:
        if field.type not in types:
            raise ValueError(f"column {shortened(field.name)} is of {shortened(str(field.type))}")
    text_columns = [field.name for field in schema if field.type == pa.string()]
    file = parquet.ParquetFile(pa.BufferReader(content), read_dictionary=text_columns, **limits)
    check_size(file.metadata.num_rows * len(schema) * _VALUE_BYTES, "bundle", "its table")
    table = file.read(use_threads=False)
    text_bytes = 0
    for name in text_columns:
        for chunk in table.column(name).chunks:
            lengths = pc.take(pc.binary_length(chunk.dictionary), chunk.indices)
            text_bytes += pc.sum(lengths).as_py() or 0
    check_size(text_bytes, "bundle", "its text")
    return table


def _column(values: Sequence[Any]) -> Any:
    """Return an Arrow array of the values' type.

    It is an array of floats for mixed whole numbers and fractions, and if all values are None.
    """
    import pyarrow as pa

    types = {type(value) for value in values if value is not None}
    if types <= {float, int} and types != {int}:
        floats = [None if value is None else float(value) for value in values]
        return pa.array(floats, pa.float64())
    return pa.array(values)
