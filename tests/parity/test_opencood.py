"""The export to OPV2V's folders against files that OpenCOOD's own datasets read
(golden/exports/opencood).
"""

import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.opencood import OpenCood

PRECISE_KEYS = {"angle", "cords", "pos"}
"""The keys of values that are equal within 1e-9 instead of 1e-6."""


@pytest.fixture(scope="module")
def golden(request: pytest.FixtureRequest) -> Path:
    folder: Path = request.config.getoption("--golden") / "exports"
    assert list(folder.glob("opencood/*/*/*.yaml")), f"{folder}: no golden files"
    return folder


@pytest.fixture(scope="module")
def exported(golden: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Export the golden release."""
    root = tmp_path_factory.mktemp("golden")
    shutil.copytree(golden / "release", root / "release")
    dataset = DeepAccident("v1", root / "release", index_dir=root / "index", verbose=False)
    return export_release(dataset, root / "out", OpenCood(without_clouds=True)).folder


def test_every_value_is_equal(golden: Path, exported: Path) -> None:
    scenario_folders = {path.name: path for path in exported.glob("*/*")}
    for path in sorted(golden.glob("opencood/*/*/*.yaml")):
        scenario, agent, name = path.parts[-3:]
        expected = yaml.safe_load(path.read_text())
        content = yaml.safe_load((scenario_folders[scenario] / agent / name).read_text())
        for keys, theirs, ours in find_differences(expected, content):
            message = (path, keys, theirs, ours)
            tolerance = 1e-6 if PRECISE_KEYS.isdisjoint(keys) else 1e-9
            assert isinstance(theirs, float), message
            assert math.isclose(theirs, ours, rel_tol=0, abs_tol=tolerance), message


def test_point_clouds_are_the_same_bytes(golden: Path, exported: Path) -> None:
    scenario_folders = {path.name: path for path in exported.glob("*/*")}
    clouds = list(golden.glob("opencood/*/*/*.pcd"))
    assert clouds
    for path in clouds:
        scenario, agent, name = path.parts[-3:]
        exported_path = scenario_folders[scenario] / agent / name
        assert exported_path.read_bytes() == path.read_bytes()


def find_differences(
    expected: Any, content: Any, keys: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any, Any]]:
    """Yield keys, expected value and value wherever two loaded files differ."""
    are_dicts = isinstance(expected, dict) and isinstance(content, dict)
    are_lists = isinstance(expected, list) and isinstance(content, list)
    if are_dicts and expected.keys() == content.keys():
        for name, value in expected.items():
            yield from find_differences(value, content[name], (*keys, str(name)))
    elif are_lists and len(expected) == len(content):
        for number, value in enumerate(expected):
            yield from find_differences(value, content[number], (*keys, str(number)))
    elif expected != content:
        yield keys, expected, content
