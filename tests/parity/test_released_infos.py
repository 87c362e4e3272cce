"""The exported infos against the ones that the released converter wrote, key by key.

The unpatched converter made the golden infos from the same release
(tests/data/golden/exports/README.md); docs/exports.md, The released code, describes the keys.
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
from deepaccident_devkit.export.release import ReleasePart
from deepaccident_devkit.export.released_infos import ReleasedInfos


@pytest.fixture(scope="module")
def golden(request: pytest.FixtureRequest) -> Path:
    folder: Path = request.config.getoption("--golden") / "exports"
    assert (folder / "released_infos.json").is_file(), f"{folder}: no golden infos"
    return folder


@pytest.mark.parametrize("of_part", [False, True])
def test_every_info_is_equal(golden: Path, tmp_path: Path, of_part: bool) -> None:
    shutil.copytree(golden / "release", tmp_path / "release")
    dataset = DeepAccident("v1", tmp_path / "release", index_dir=tmp_path / "index", verbose=False)
    if of_part:
        export_release(dataset, tmp_path / "part", ReleasePart(split="train"), workers=1)
        dataset = DeepAccident("v1", tmp_path / "part", verbose=False)
    export_release(dataset, tmp_path / "out", ReleasedInfos())

    content = pickle.loads((tmp_path / "out/carla_infos_train.pkl").read_bytes())
    expected = json.loads((golden / "released_infos.json").read_text())
    assert expected
    assert [to_plain(info) for info in content["infos"]] == expected
    assert content["metadata"] == {"version": "v1.0-trainval"}


def to_plain(value: Any) -> Any:
    """Convert a value to the types of the golden file."""
    if isinstance(value, np.ndarray):
        return {"dtype": str(value.dtype), "shape": list(value.shape), "data": value.tolist()}
    if isinstance(value, dict):
        return {name: to_plain(item) for name, item in value.items()}
    return value
