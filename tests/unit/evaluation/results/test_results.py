"""Every default and constant of results, against what is written out here."""

from pathlib import Path

from support.default_values import package_values
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.results import ResultsWriter, read_results
from deepaccident_devkit.evaluation.results.records import json_meta

EXPECTED_VALUES = {
    "motion.MEMBER": "'{}/{}.npy'",
    "motion.HEADS": "{'segmentation': 2, 'centerness': 1, 'offset': 2, 'flow': 2}",
    "motion.NOT_READ": "('trajectory_id', 'trajectory')",
    "motion.MotionForm": "step=0.5, labels=None",
    "reader.EntryContents": "form=None",
    "reader.contents_of": "fingerprint=''",
    "records.FORMAT": "'DeepAccident results'",
    "records.FORMAT_VERSION": "1",
    "records.RESULTS_NAMES": (
        "mappingproxy({'motion': 'motion', 'accident': 'accident.json', "
        "'detection': 'detection.json', "
        "'planning': 'planning.json', 'forecasting': 'forecasting.json'})"
    ),
    "records.RESULTS_FILE": "'results.json'",
    "records.WORDS": "'^[^/\\\\\\\\]+(/[^/\\\\\\\\]+)*$'",
    "records.MAX_MEASURE": "1000000.0",
    "records.LENGTH_FIRST": "[1, 0, 2]",
    "records.parsed_json": "levels=64",
    "records.entry_place": "number=None",
    "writer.MAX_SHARD_BYTES": "33554432",
    "writer.ResultsWriter": "meta=None, grid=None, step=0.5, labels='released', store='instances'",
}


def test_every_default_and_constant_written_out(tmp_path: Path) -> None:
    assert package_values("deepaccident_devkit.evaluation.results") == EXPECTED_VALUES
    assert json_meta({}) == {}
    path = tmp_path / "x"
    assert repr(ResultsWriter(path, "motion")) == f"ResultsWriter(motion to {path}: 0 samples)"
    assert_raises((lambda: read_results(path), ResultsError, ("x: no such file",)))
