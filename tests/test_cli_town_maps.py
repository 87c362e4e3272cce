"""`deepaccident export town-maps`: one map for each town with BEV pictures."""

import json
import os
import shutil
from functools import partial
from pathlib import Path

import pytest
from support.command_calls import invoke_command
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.taxonomy import BEV_CAMERA, CAMERAS, LIDAR


@pytest.fixture(scope="module")
def root(release_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The release with only BEV cameras; its second pair of scenarios lacks them."""
    root = tmp_path_factory.mktemp("towns") / "release"
    shutil.copytree(
        release_root,
        root,
        copy_function=os.link,
        ignore=shutil.ignore_patterns(".deepaccident", *CAMERAS, LIDAR),
    )
    for folder in root.glob(f"*/*/{BEV_CAMERA}/*scenario00002"):
        shutil.rmtree(folder)
    return root


run = partial(invoke_command, "export", "town-maps")


def read_towns(root: Path) -> tuple[str, str]:
    """Return the town of the first pair of scenarios, which has a map, and that of the second."""
    da = DeepAccident("v1", root, verbose=False)
    towns = {scenario["name"][-1]: scenario["town"] for scenario in da.scenario}
    return towns["1"], towns["2"]


def test_a_file_for_each_town_that_has_a_map(root: Path, tmp_path: Path) -> None:
    town, town_without_map = read_towns(root)
    result = run(root, "--out", tmp_path / "maps")
    (path,) = (tmp_path / "maps").iterdir()
    assert path.name == f"{town}.geojson"
    assert f"wrote {path} (" in result.stdout
    road = "m² of road, from 20 pictures of 2 scenarios)"
    assert road in result.stdout
    message = f"warning: {town_without_map}: none of its 2 scenarios has a readable file"
    assert message in result.stderr
    assert len(json.loads(path.read_text(encoding="utf-8"))["features"]) > 1


def test_missing_pictures_are_counted(root: Path, tmp_path: Path) -> None:
    partial_root = tmp_path / "release"
    no_index = shutil.ignore_patterns(".deepaccident")
    shutil.copytree(root, partial_root, copy_function=os.link, ignore=no_index)
    first_picture = next(partial_root.glob(f"*/*/{BEV_CAMERA}/*scenario00001/*_001.*"))
    first_picture.unlink()
    output = run(partial_root, "--out", tmp_path / "maps").stdout
    assert "from 19 pictures of 2 scenarios; 1 missing, 0 damaged)" in output


def test_one_town_as_json(root: Path, tmp_path: Path) -> None:
    town, town_without_map = read_towns(root)
    words = (root, "--out", tmp_path, "--where")
    result = run(*words, f"town={town}", "--json")
    expected = {
        "path": str(tmp_path / f"{town}.geojson"),
        "scenarios": 2,
        "looks": 20,
        "missing": 0,
        "damaged": 0,
    }
    assert json.loads(result.stdout)[town].items() >= expected.items()
    assert_raises(
        (
            lambda: run(*words, f"town={town_without_map}"),
            NotAvailableError,
            ("no town has a map",),
        )
    )
