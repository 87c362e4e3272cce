"""The released infos against those that the released converter made of the same release, key by
key.

Made by the converter itself, unpatched (tests/data/golden/exports/README.md); the keys are
docs/exports.md, The released code.
"""

import json
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.released_infos import ReleasedInfos


@pytest.fixture(scope="module")
def golden(request: pytest.FixtureRequest) -> Path:
    folder: Path = request.config.getoption("--golden") / "exports"
    assert (folder / "released_infos.json").is_file(), f"{folder}: no golden infos"
    return folder


def test_every_info_is_equal(golden: Path, tmp_path: Path) -> None:
    shutil.copytree(golden / "release", tmp_path / "release")
    dataset = DeepAccident("v1", tmp_path / "release", index_dir=tmp_path / "index", verbose=False)
    export_release(dataset, tmp_path / "out", ReleasedInfos())
    found = pickle.loads((tmp_path / "out/carla_infos_train.pkl").read_bytes())
    expected = json.loads((golden / "released_infos.json").read_text())
    assert expected
    assert [plain(info) for info in found["infos"]] == expected
    assert found["metadata"] == {"version": "v1.0-trainval"}


def plain(value: Any) -> Any:
    """A value as the golden file has it."""
    if isinstance(value, np.ndarray):
        return {"dtype": str(value.dtype), "shape": list(value.shape), "data": value.tolist()}
    return {name: plain(each) for name, each in value.items()} if isinstance(value, dict) else value
