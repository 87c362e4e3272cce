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


@pytest.fixture(scope="module")
def golden(request: pytest.FixtureRequest) -> Path:
    folder: Path = request.config.getoption("--golden") / "exports"
    assert list(folder.glob("opencood/*/*/*.yaml")), f"{folder}: no golden files"
    return folder


@pytest.fixture(scope="module")
def made(golden: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The export of the golden release."""
    root = tmp_path_factory.mktemp("golden")
    shutil.copytree(golden / "release", root / "release")
    dataset = DeepAccident("v1", root / "release", index_dir=root / "index", verbose=False)
    return export_release(dataset, root / "out", OpenCood(without_clouds=True)).folder


def test_every_value_is_equal(golden: Path, made: Path) -> None:
    ours = {path.name: path for path in made.glob("*/*")}
    for path in sorted(golden.glob("opencood/*/*/*.yaml")):
        scenario, agent, name = path.parts[-3:]
        expected, found = (
            yaml.safe_load(each.read_text()) for each in (path, ours[scenario] / agent / name)
        )
        for where, theirs, mine in differences(expected, found):
            tolerance = 1e-9 if "angle" in where or "cords" in where or "pos" in where else 1e-6
            assert isinstance(theirs, float), (path, where, theirs, mine)
            assert math.isclose(theirs, mine, rel_tol=0, abs_tol=tolerance), (
                path,
                where,
                theirs,
                mine,
            )


def test_point_clouds_are_the_same_bytes(golden: Path, made: Path) -> None:
    ours = {path.name: path for path in made.glob("*/*")}
    clouds = list(golden.glob("opencood/*/*/*.pcd"))
    assert clouds
    for path in clouds:
        scenario, agent, name = path.parts[-3:]
        assert (ours[scenario] / agent / name).read_bytes() == path.read_bytes()


def differences(
    expected: Any, found: Any, where: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any, Any]]:
    """Where two loaded files differ, and by what."""
    if isinstance(expected, dict) and isinstance(found, dict) and expected.keys() == found.keys():
        for name, value in expected.items():
            yield from differences(value, found[name], (*where, str(name)))
    elif isinstance(expected, list) and isinstance(found, list) and len(expected) == len(found):
        for number, value in enumerate(expected):
            yield from differences(value, found[number], (*where, str(number)))
    elif expected != found:
        yield where, expected, found
