"""The table that av2 0.3.6 writes for a window, and the rates that nuscenes-devkit 1.2.0 returns on
our export (tests/data/golden/windows).
"""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support.packed_release import unpack_release

from deepaccident_devkit import DeepAccident

PANDAS_TYPES = {
    "bool": pa.bool_(),
    "str": pa.string(),
    "int64": pa.int64(),
    "float64": pa.float64(),
}


@pytest.fixture(scope="module")
def folder(pytestconfig: pytest.Config) -> Path:
    return Path(pytestconfig.getoption("golden")) / "windows"


@pytest.fixture(scope="module")
def dataset(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    root = unpack_release(folder / "release.npz", tmp_path_factory.mktemp("windows"))
    return DeepAccident("v1", root, verbose=False, workers=1)


def test_the_file_is_the_one_that_av2_writes(
    folder: Path, dataset: DeepAccident, tmp_path: Path
) -> None:
    description = json.loads((folder / "av2_table.json").read_text())
    with np.load(folder / "av2_table.npz") as archive:
        expected = dict(archive)
    sample = expected["scenario_id"][0].item()
    window = dataset.window(sample, past=4.9, future=6.0, frame="world")

    path = window.write_av2(tmp_path / "scenario.parquet", focal=expected["focal_track_id"][0])
    table = pq.read_table(path)

    types = {name: PANDAS_TYPES[kind] for name, kind in description["columns"].items()}
    assert dict(zip(table.column_names, table.schema.types, strict=True)) == types
    assert len(table) == description["rows"]
    for name, values in expected.items():
        written = table[name].to_numpy()
        if values.dtype.kind == "f":
            assert_allclose(written, values, atol=1e-4)
        else:
            assert_array_equal(written.astype(values.dtype), values)


def test_rates_are_those_of_the_prediction_helper(folder: Path, dataset: DeepAccident) -> None:
    # Differences of a window, as docs/reading.md says, where no step is missing before the present.
    num_rates = 0
    samples = json.loads((folder / "predict_helper.json").read_text())
    for sample, records_by_actor in samples.items():
        window = dataset.window(sample, 2, 3, step=0.5, agents="single", frame="world")
        at = window.present
        velocities = np.diff(window.center[..., :2], axis=1) / 0.5
        speeds = np.linalg.norm(velocities, axis=-1)
        turns = np.angle(np.exp(1j * np.diff(window.yaw, axis=1))) / 0.5
        for row, actor in enumerate(window.actor_id.tolist()):
            if actor == window.own_actor_id or not window.valid[row, at - 2 : at].all():
                continue
            theirs = records_by_actor[str(actor)]
            acceleration = (speeds[row, at - 1] - speeds[row, at - 2]) / 0.5
            assert speeds[row, at - 1] == pytest.approx(theirs["velocity"], abs=1e-5)
            assert turns[row, at - 1] == pytest.approx(theirs["heading_change_rate"], abs=1e-5)
            assert acceleration == pytest.approx(theirs["acceleration"], abs=1e-4)
            num_rates += 1
    assert num_rates > 100
