"""`sample_rows`: the counts of a run's samples, one flat row each, and such rows as a Parquet file."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.errors import MOST_TOLD, ResultsError, shortened
from deepaccident_devkit.evaluation.accident import AccidentResult
from deepaccident_devkit.evaluation.detection import DetectionProtocol
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.motion import MotionResult
from deepaccident_devkit.evaluation.runs.evaluation_run import EvaluationRun
from deepaccident_devkit.evaluation.task import TaskResult, headlines, plain
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import check_size, fault_text, read_bytes

Row = dict[str, Any]
Cells = Iterator[tuple[str, Any]]


def sample_rows(run: EvaluationRun) -> list[Row]:
    """List one row a sample, by token, all with the same columns: texts, numbers, or None where there is none.

    The first columns say which sample: token, scenario, agent, frame (from 1), time_to_impact (seconds to the recorded
    impact), accident_visibility. The others are what the sample alone has as result:

    - motion: by range IoU and PQ (percent) and instances over all frames, cells of IoU, paths and their errors (m);
    - accident: `positive` (an accident comes), whom the truth names, by metres allowed tp, fp and fn, and the errors
      (m, s) of what is foreseen within the largest distance;
    - detection: true boxes and detections that count, and true positives by threshold, over all classes and ranges;
    - warning: the plain values of the sample's counts, and how many entries its lists have;
    - planning, forecasting: the headline numbers.
    """
    counts, cells = run.evaluator.counts, _CELLS[run.setup.task]
    rows = [
        _which(run, token) | dict(cells(run.evaluator.compute([token]), counts[token], run.setup.rules))
        for token in sorted(run.evaluator.tokens)
    ]
    columns = dict.fromkeys(name for row in rows for name in row)  # a table of means has only what a sample counts in
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


def _motion_cells(result: MotionResult, counts: Counts, _rules: object) -> Cells:
    yield "frames", result.frames
    for (name, part), cells in zip(result.ranges.items(), counts["cells"], strict=True):
        instances = part.true_positive, part.false_positive, part.false_negative
        yield f"iou_{name}", part.iou
        yield f"pq_{name}", part.pq
        yield from zip((f"{each}_{name}" for each in ("tp", "fp", "fn")), instances, strict=True)
        yield from zip((f"cells_{each}_{name}" for each in ("tp", "fp", "fn")), cells, strict=True)
    counts_of_paths = ("paths", "path_true_positive", "path_false_positive", "path_false_negative")
    yield from ((name, getattr(result, name)) for name in (*counts_of_paths, "min_ade", "min_fde", "miss_rate"))


def _accident_cells(result: AccidentResult, _counts: Counts, _rules: object) -> Cells:
    yield "positive", bool(result.positives)
    yield "truth", next((name for name, count in result.truths.items() if count), None)
    for distance, within in result.within.items():
        for case in ("tp", "fp", "fn"):
            yield f"{case}_{distance:g}m", getattr(within, case)
    widest = result.within[max(result.within)]
    for error in ("position_error", "time_error", "id_error"):
        value = getattr(widest, error)
        yield error, None if value is None else float(value)


def _detection_cells(_result: object, counts: Counts, rules: DetectionProtocol) -> Cells:
    levels = len(rules.thresholds)
    found = Counter(cell % levels for cell in counts["tp"][0])
    yield "truths", sum(counts["truths"])
    yield "detections", len(counts["detections"][0])
    for level, threshold in enumerate(rules.thresholds):
        yield f"tp_{threshold:g}", found[level]


def _plain_cells(_result: object, counts: Counts, _rules: object) -> Cells:
    for name, value in counts.items():
        if isinstance(value, list | tuple | Mapping):
            yield f"{name}_count", len(value)
        else:
            yield name, value


def _headline_cells(result: TaskResult, _counts: Counts, _rules: object) -> Cells:
    yield from ((each.name, each.value) for each in headlines(result.task, result))


_CELLS: Final[Mapping[str, Callable[[Any, Counts, Any], Cells]]] = {
    "motion": _motion_cells,
    "accident": _accident_cells,
    "detection": _detection_cells,
    "warning": _plain_cells,
    "planning": _headline_cells,
    "forecasting": _headline_cells,
}
STAMP_KEY: Final = b"deepaccident"
"""Of the metadata: one JSON object."""
_VALUE_BYTES: Final = 32
"""Of a number as Python holds it."""


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]], stamp: Mapping[str, Any]) -> None:
    """Write rows as a Parquet file, with a stamp in its metadata."""
    from pyarrow import parquet

    parquet.write_table(rows_table(rows).replace_schema_metadata({STAMP_KEY: json.dumps(dict(stamp))}), path)


def rows_table(rows: Sequence[Mapping[str, Any]]) -> Any:
    """Make the Arrow table of rows with the same columns: texts, numbers, booleans or None, of one kind in a column."""
    import pyarrow as pa

    return pa.table({name: _column([row[name] for row in rows]) for name in (rows[0] if rows else ())})


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
