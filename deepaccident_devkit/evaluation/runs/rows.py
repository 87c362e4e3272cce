"""`sample_rows`: the counts of a run's samples as flat rows, and Parquet files of such rows."""

import json
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.errors import MAX_REASON_LENGTH, ResultsError, shortened
from deepaccident_devkit.evaluation.runs.evaluation_run import EvaluationRun
from deepaccident_devkit.evaluation.task import plain
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import check_size, read_bytes, reason_text
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues

Row = dict[str, Any]
# Key in the file's metadata; its value is a JSON object.
STAMP_KEY: Final = b"deepaccident"
# Memory that Python needs for a number, in bytes.
_VALUE_BYTES = 32


def sample_rows(run: EvaluationRun) -> list[Row]:
    """Build one row per sample, ordered by token; all rows have the same columns.

    Values are texts, numbers or None. The first columns identify the sample: token, scenario,
    agent, frame (from 1), time_to_impact (seconds to the recorded impact), accident_visibility. The
    other columns come from the evaluator's `sample_row`:

    - motion: for each range IoU and PQ (percent), instances summed over frames, and cells; paths
      and their errors (m);
    - accident: `positive` (whether an accident comes); the kind of pair that the truth names; tp,
      fp and fn for each allowed distance in metres; and the errors (m, s) of accidents that are
      foreseen within the largest distance;
    - detection: the numbers of true boxes and detections that count, and of true positives at each
      threshold, summed over classes and ranges;
    - warning: the sample's counts, with lists replaced by their lengths;
    - tracking, planning, forecasting: the headlines of the sample.
    """
    rows = []
    for token in sorted(run.evaluator.tokens):
        rows.append(_identify_sample(run, token) | run.evaluator.sample_row(token))
    # for tasks with tables of means, a row only contains means that the sample contributes to
    columns = dict.fromkeys(chain.from_iterable(rows))
    plain_rows = []
    for row in rows:
        plain_rows.append({name: plain(row.get(name)) for name in columns})
    return plain_rows


def _identify_sample(run: EvaluationRun, token: str) -> Row:
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


def write_rows(path: Path, rows: Sequence[ReadOnlyValues], stamp: ReadOnlyValues) -> None:
    """Write rows to a Parquet file, with a stamp in the file's metadata."""
    from pyarrow import parquet

    metadata = {STAMP_KEY: json.dumps(dict(stamp))}
    table = rows_table(rows).replace_schema_metadata(metadata)
    parquet.write_table(table, path)


def rows_table(rows: Sequence[ReadOnlyValues]) -> Any:
    """Convert rows with the same columns to an Arrow table.

    The values of a column must all be texts, all numbers, or all booleans; None is always allowed.
    """
    import pyarrow as pa

    columns = {}
    for name in rows[0] if rows else ():
        columns[name] = _make_column([row[name] for row in rows])
    return pa.table(columns)


def read_rows(path: Path) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Read the rows and the stamp that `write_rows` wrote; raise ResultsError on a fault."""
    import pyarrow as pa

    try:
        table = _read_table(read_bytes(path, "bundle"))
        stamp: NamedValues = parsed_json((table.schema.metadata or {})[STAMP_KEY])
        rows: list[NamedValues] = table.to_pylist()
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError, MemoryError) as error:
        fault = shortened(reason_text(error), MAX_REASON_LENGTH)
        raise ResultsError(
            f"{path}: is not a table of samples ({fault}); evaluate again"
        ) from error
    return rows, stamp


def _read_table(content: bytes) -> Any:
    """Read the Arrow table from a Parquet file, unless it would take too much memory.

    Texts are kept dictionary-encoded until their total length is known, since a few bytes can
    encode a long text in millions of rows. Raise OSError if the table would take more memory than
    such a file may take, ValueError if a column has a type that `write_rows` does not write, and
    ArrowException if the file is damaged.
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


def _make_column(values: Sequence[Any]) -> Any:
    """Convert values to an Arrow array of their type.

    The type is float if integers and floats are mixed, or if all values are None.
    """
    import pyarrow as pa

    types = {type(value) for value in values if value is not None}
    if types <= {float, int} and types != {int}:
        floats = [None if value is None else float(value) for value in values]
        return pa.array(floats, pa.float64())
    return pa.array(values)
