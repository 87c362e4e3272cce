"""Rows of single samples: for every task, their sums are the result's."""

import math
import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation import DetectedBoxes
from deepaccident_devkit.evaluation.results import Results, ResultsWriter, read_results
from deepaccident_devkit.evaluation.runs import (
    EvaluationRun,
    SampleSelection,
    evaluate_results,
    read_rows,
    sample_rows,
)
from deepaccident_devkit.evaluation.runs.rows import write_rows
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup

Write = Callable[..., Results]


def make_arrow_array(values: list[Any], kind: str) -> Any:
    import pyarrow as pa

    return pa.array(values, pa.type_for_alias(kind))


def repeat_text(value: str, times: int) -> Any:
    import pyarrow as pa

    return pa.DictionaryArray.from_arrays(np.zeros(times, dtype=np.int32), [value])


OVERSIZED_COLUMNS: dict[str, tuple[Callable[[], Any], str]] = {
    "a long text in each of many rows": (
        lambda: repeat_text("x" * 10**6, 10**5),
        "its text takes 100,000,000,000 bytes",
    ),
    "many rows": (
        lambda: make_arrow_array([7] * (5 * 10**6), "int64"),
        "its table takes 160,000,000 bytes",
    ),
    "rows of nothing": (
        lambda: make_arrow_array([None] * (5 * 10**6), "null"),
        "its table takes 160,000,000 bytes",
    ),
    "bytes": (lambda: make_arrow_array([b"a"], "binary"), "column token is of binary"),
    "whole numbers of another size": (
        lambda: make_arrow_array([7], "int32"),
        "column token is of int32",
    ),
}


def column_of(rows: list[dict[str, Any]], name: str) -> list[Any]:
    return [row[name] for row in rows]


def test_rows_describe_their_samples(run: EvaluationRun, da_b: DeepAccident) -> None:
    rows = sample_rows(run)
    assert column_of(rows, "token") == sorted(run.evaluator.tokens)
    assert {row["time_to_impact"] for row in rows} == {0.5, None}

    for row in rows:
        sample = da_b.sample.get(row["token"])
        assert row["scenario"] == sample["scenario_token"]
        assert (row["agent"], row["frame"]) == (sample["agent"], 1)
        assert row["time_to_impact"] == sample["time_to_impact"]
        assert row["accident_visibility"] == run.attributes[row["token"]].accident_visibility


def test_sums_of_accidents(run: EvaluationRun) -> None:
    rows = sample_rows(run)
    assert sum(column_of(rows, "positive")) == run.result.positives == 3
    for distance, within in run.result.within.items():
        sums = [sum(column_of(rows, f"{case}_{distance:g}m")) for case in ("tp", "fp", "fn")]
        assert sums == [within.tp, within.fp, within.fn]

    errors = [error for error in column_of(rows, "position_error") if error is not None]
    assert math.fsum(errors) / len(errors) == pytest.approx(run.result.position_error)
    assert len(errors) == run.result.within[15.0].tp

    truths = {name: count for name, count in run.result.truths.items() if count}
    assert Counter(column_of(rows, "truth")) == truths


def test_sums_of_motion(
    da_b: DeepAccident, selection: SampleSelection, tmp_path: Path, write_motion: Write
) -> None:
    results = write_motion(tmp_path / "motion", selection.tokens(da_b))
    run = evaluate_results(da_b, results, EvaluationSetup(task="motion"), selection, workers=1)
    rows = sample_rows(run)

    for name, part in run.result.ranges.items():
        sums = [sum(column_of(rows, f"{case}_{name}")) for case in ("tp", "fp", "fn")]
        assert sums == [part.true_positive, part.false_positive, part.false_negative]

        cells = [sum(column_of(rows, f"cells_{case}_{name}")) for case in ("tp", "fp", "fn")]
        assert 100 * cells[0] / sum(cells) == pytest.approx(part.iou)

    assert sum(column_of(rows, "paths")) == run.result.paths

    one_cell_m = [0.5] * len(rows)
    assert column_of(rows, "min_ade") == pytest.approx(one_cell_m, abs=0.05)


@pytest.mark.parametrize("protocol", ["released", "opencood"])
def test_sums_of_detection(
    da_b: DeepAccident, selection: SampleSelection, tmp_path: Path, protocol: str
) -> None:
    path = tmp_path / "boxes.json"
    with ResultsWriter(path, "detection") as writer:
        for token in selection.tokens(da_b):
            boxes = da_b.boxes(token)
            writer.add(token, DetectedBoxes(boxes=boxes, scores=np.ones(len(boxes))))

    setup = EvaluationSetup(task="detection", protocol=protocol)
    run = evaluate_results(da_b, read_results(path), setup, selection, workers=1)
    rows = sample_rows(run)

    assert sum(column_of(rows, "truths")) == run.result.truths.sum()
    assert sum(column_of(rows, "detections")) == run.result.detections.sum()
    for threshold in run.setup.rules.thresholds:
        assert 0 < sum(column_of(rows, f"tp_{threshold:g}")) <= run.result.truths.sum()


def test_alarms_of_warnings(
    da_b: DeepAccident, results: Results, selection: SampleSelection
) -> None:
    setup = EvaluationSetup(task="warning", protocol="clean")
    rows = sample_rows(evaluate_results(da_b, results, setup, selection, workers=1))

    tokens = sorted(selection.tokens(da_b))
    assert column_of(rows, "alarms_count") == [len(results.prediction(token)) for token in tokens]
    assert len(rows) == 6


def test_columns_of_several_kinds_and_of_nothing(tmp_path: Path) -> None:
    rows = [{"a": 1, "b": None, "c": True, "d": 1}, {"a": None, "b": None, "c": None, "d": 0.5}]
    write_rows(tmp_path / "rows.parquet", rows, {"partial": None})
    assert read_rows(tmp_path / "rows.parquet") == (rows, {"partial": None})


@pytest.mark.parametrize("content", [b"", b"PAR1 and no more"])
def test_a_file_that_is_no_table_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "rows.parquet").write_bytes(content)
    assert_raises(
        (
            lambda: read_rows(tmp_path / "rows.parquet"),
            ResultsError,
            r"rows.parquet: is not a table of samples",
        ),
    )


def test_a_foreign_table_is_refused(tmp_path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    parquet.write_table(pa.table({"token": ["a"]}), tmp_path / "rows.parquet")
    assert_raises(
        (
            lambda: read_rows(tmp_path / "rows.parquet"),
            ResultsError,
            r"rows.parquet: is not a table of samples \(b'deepaccident'\)",
        ),
    )


@pytest.mark.parametrize("kind", OVERSIZED_COLUMNS)
def test_columns_that_would_not_fit_into_memory_are_refused(tmp_path: Path, kind: str) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    make_column, reason = OVERSIZED_COLUMNS[kind]
    path = tmp_path / "rows.parquet"
    table = pa.table({"token": make_column()}).replace_schema_metadata({"deepaccident": "{}"})
    parquet.write_table(table, path, compression="zstd", store_schema=False)
    del table
    pool = pa.default_memory_pool()
    allocated_bytes = pool.bytes_allocated()

    with pytest.raises(ResultsError, match=rf"rows.parquet: is not a table of samples \({reason}"):
        read_rows(path)
    assert pool.bytes_allocated() - allocated_bytes < 100 << 20


def test_a_text_that_is_no_unicode_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    write_rows(path, [{"token": "é" * 20}], {})
    path.write_bytes(path.read_bytes().replace("é".encode(), b"\xff\xff"))

    assert_raises(
        (lambda: read_rows(path), ResultsError, "is not a table of samples"),
    )


def test_a_pipe_and_a_giant_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")

    assert_raises(
        (
            lambda: read_rows(tmp_path / "pipe"),
            ResultsError,
            r"not a regular file \(a named pipe\)",
        ),
    )

    with (tmp_path / "giant").open("wb") as file:
        file.truncate(3 << 30)

    assert_raises(
        (lambda: read_rows(tmp_path / "giant"), ResultsError, "has 3,221,225,472 bytes"),
    )
