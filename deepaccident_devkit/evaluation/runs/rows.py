"""`sample_rows`: the counts of a run's samples, one flat row each, and such rows as a Parquet file."""

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


def sample_rows(run: EvaluationRun) -> list[Row]:
    """List one row a sample, by token, all with the same columns: texts, numbers, or None where there is none.

    The first columns say which sample: token, scenario, agent, frame (from 1), time_to_impact (seconds to the recorded
    impact), accident_visibility. The others are the evaluator's `sample_row`:

    - motion: by range IoU and PQ (percent) and instances over all frames, cells of IoU, paths and their errors (m);
    - accident: `positive` (an accident comes), whom the truth names, by metres allowed tp, fp and fn, and the errors
      (m, s) of what is foreseen within the largest distance;
    - detection: true boxes and detections that count, and true positives by threshold, over all classes and ranges;
    - warning: the plain values of the sample's counts, and how many entries its lists have;
    - planning, forecasting: the headlines of the sample.
    """
    rows = [
        _which(run, token) | run.evaluator.sample_row(token)
        for token in sorted(run.evaluator.tokens)
    ]
    columns = dict.fromkeys(
        name for row in rows for name in row
    )  # a table of means has only what a sample counts in
    return [{name: plain(row.get(name)) for name in columns} for row in rows]


def _which(run: EvaluationRun, token: str) -> Row:
    attributes = run.attributes[token]
    return {
        "token": token,
        "scenario": attributes.scenario,
        "agent": attributes.agent,
        "frame": int(token.rsplit("/", 1)[1]),
        "time_to_impact": run.times_to_impact[token],
        "accident_visibility": attributes.accident_visibility,
    }


# Of the metadata: one JSON object.
STAMP_KEY: Final = b"deepaccident"
# Of a number as Python holds it.
_VALUE_BYTES: Final = 32


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]], stamp: Mapping[str, Any]) -> None:
    """Write rows as a Parquet file, with a stamp in its metadata."""
    from pyarrow import parquet

    parquet.write_table(
        rows_table(rows).replace_schema_metadata({STAMP_KEY: json.dumps(dict(stamp))}), path
    )


def rows_table(rows: Sequence[Mapping[str, Any]]) -> Any:
    """Make the Arrow table of rows with the same columns: texts, numbers, booleans or None, of one kind in a column."""
    import pyarrow as pa

    return pa.table(
        {name: _column([row[name] for row in rows]) for name in (rows[0] if rows else ())}
    )


def read_rows(path: Path) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rows and stamp that `write_rows` wrote; raises ResultsError."""
    import pyarrow as pa

    try:
        table = _table(read_bytes(path, "bundle"))
        stamp: dict[str, Any] = parsed_json((table.schema.metadata or {})[STAMP_KEY])
        rows: list[dict[str, Any]] = table.to_pylist()
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError, MemoryError) as error:
        told = shortened(fault_text(error), MOST_TOLD)
        raise ResultsError(f"{path}: is no table of samples ({told}); evaluate again") from error
    return rows, stamp


def _table(content: bytes) -> Any:
    """The Arrow table in a Parquet file, whose values take no more memory than such a file may.

    Texts stay in dictionaries until their lengths in all rows are known: a few bytes can stand for a long text in
    millions of rows. Raises OSError (it would take more), ValueError (a column is of another kind than `write_rows`
    writes) or ArrowException (it is damaged).
    """
    import pyarrow as pa
    import pyarrow.compute as pc
    from pyarrow import parquet

    limits = {"thrift_string_size_limit": len(content), "thrift_container_size_limit": len(content)}
    schema = parquet.ParquetFile(pa.BufferReader(content), **limits).schema_arrow
    kinds = (pa.string(), pa.int64(), pa.float64(), pa.bool_(), pa.null())
    for field in schema:
        if field.type not in kinds:
            raise ValueError(f"column {shortened(field.name)} is of {shortened(str(field.type))}")
    texts = [field.name for field in schema if field.type == pa.string()]
    file = parquet.ParquetFile(pa.BufferReader(content), read_dictionary=texts, **limits)
    check_size(file.metadata.num_rows * len(schema) * _VALUE_BYTES, "bundle", "its table")
    table = file.read(use_threads=False)
    lengths = 0
    for name in texts:
        for chunk in table.column(name).chunks:
            each = pc.take(pc.binary_length(chunk.dictionary), chunk.indices)
            lengths += pc.sum(each).as_py() or 0
    check_size(lengths, "bundle", "its text")
    return table


def _column(values: Sequence[Any]) -> Any:
    """An Arrow array of the values' kind; of whole numbers and fractions, and of nothing at all, fractions."""
    import pyarrow as pa

    kinds = {type(value) for value in values if value is not None}
    if kinds <= {float, int} and kinds != {int}:
        return pa.array([None if value is None else float(value) for value in values], pa.float64())
    return pa.array(values)
