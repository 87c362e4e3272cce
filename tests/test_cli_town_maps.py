"""`deepaccident export town-maps`, as a user meets it."""

import json
import os
import shutil
from functools import partial
from pathlib import Path

import pytest
from refusals import assert_refused
from verbs import called

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.taxonomy import BEV_CAMERA, CAMERAS, LIDAR


@pytest.fixture(scope="module")
def root(release_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The release with its BEV cameras; those of its second pair are missing."""
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


run = partial(called, "export", "town-maps")


def towns(root: Path) -> tuple[str, str]:
    """The town of the first pair, and that of the second."""
    da = DeepAccident("v1", root, verbose=False)
    names = {each["name"][-1]: each["town"] for each in da.scenario}
    return names["1"], names["2"]


def test_a_file_for_each_town_that_has_a_map(root: Path, tmp_path: Path) -> None:
    seen, unseen = towns(root)
    made = run(root, "--out", tmp_path / "maps")
    (path,) = (tmp_path / "maps").iterdir()
    told = (f"{path}: ", "m² of road, from 20 pictures of 2 scenarios (0 missing, 0 damaged)")
    assert (path.name, [each for each in told if each not in made.stdout]) == (
        f"{seen}.geojson",
        [],
    )
    assert f"left out: {unseen}: none of its 2 scenarios has a readable file" in made.stderr
    assert len(json.loads(path.read_text(encoding="utf-8"))["features"]) > 1


def test_one_town_as_json(root: Path, tmp_path: Path) -> None:
    seen, unseen = towns(root)
    told = json.loads(run(root, "--out", tmp_path, "--where", f"town={seen}", "--json").stdout)[
        seen
    ]
    wanted = {
        "path": str(tmp_path / f"{seen}.geojson"),
        "scenarios": 2,
        "looks": 20,
        "missing": 0,
        "damaged": 0,
    }
    assert told.items() >= wanted.items()
    another = (root, "--out", tmp_path, "--where", f"town={unseen}")
    assert_refused((lambda: run(*another), NotAvailableError, ("no town has a map",)))
