"""Every default and constant of results, against what is written out here."""

from pathlib import Path

from support.default_values import package_values
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.results import ResultsWriter, read_results
from deepaccident_devkit.evaluation.results.records import json_meta

EXPECTED_VALUES = {
    "motion.HEADS": "{'segmentation': 2, 'centerness': 1, 'offset': 2, 'flow': 2}",
    "motion.MotionForm": "step=0.5, labels=None",
    "shards.NOT_READ": "('trajectory_id', 'trajectory')",
    "reader.EntryContents": "form=None",
    "reader.contents_of": "fingerprint=''",
    "reader.detection_columns": "kind='detection'",
    "records.FORMAT": "'DeepAccident results'",
    "records.FORMAT_VERSION": "1",
    "records.FOLDER_TASKS": "('motion', 'segmentation')",
    "records.MEMBER": "'{}/{}.npy'",
    "records.MAX_CELLS": "67108864",
    "records.RESULTS_FILE": "'results.json'",
    "records.WORDS": "'^[^/\\\\\\\\]+(/[^/\\\\\\\\]+)*$'",
    "records.MAX_MEASURE": "1000000.0",
    "records.LENGTH_FIRST": "[1, 0, 2]",
    "records.parsed_json": "levels=64",
    "records.entry_place": "number=None",
    "writer.detection_entries": "kind='detection'",
    "writer.MAX_SHARD_BYTES": "33554432",
    "writer.ResultsWriter": (
        "meta=None, grid=None, step=0.5, labels='released', store='instances', classes=None"
    ),
}


def test_every_default_and_constant_written_out(tmp_path: Path) -> None:
    assert package_values("deepaccident_devkit.evaluation.results") == EXPECTED_VALUES
    assert json_meta({}) == {}
    path = tmp_path / "x"
    assert repr(ResultsWriter(path, "motion")) == f"ResultsWriter(motion to {path}: 0 samples)"
    assert_raises((lambda: read_results(path), ResultsError, ("x: no such file",)))
