"""Benchmarks: what is published is what is made, wherever it is made, and what differs is told."""

import importlib
import json
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.runs.bundles import checksums_of, read_bundle
from deepaccident_devkit.plugins.study.recipe import SHIPPED_RECIPES, read_recipe, synth_config_of
from deepaccident_devkit.plugins.synth.benchmark import (
    BENCHMARKS,
    TOLERANCES,
    compared_kinds,
    described_release,
    differences,
    published,
)
from deepaccident_devkit.plugins.synth.plan import plan_scenarios
from deepaccident_devkit.release import read_image, read_lidar, write_image, write_lidar

TOP = Path(__file__).parents[4]


def more_points(path: Path) -> None:
    path.write_text(re.sub(r"(\d+) (True|False)$", r"1\1 \2", path.read_text(), flags=re.MULTILINE))


MAKE = """
import json, sys
from dataclasses import replace
from pathlib import Path
from deepaccident_devkit.release import find_release
from deepaccident_devkit.plugins.synth.benchmark import BENCHMARKS, described
from deepaccident_devkit.plugins.synth.plan import plan_scenarios
from deepaccident_devkit.plugins.synth.scenario import RecordingJob, record_scenario
root, sensors, numbers = Path(sys.argv[1]), sys.argv[2], map(int, sys.argv[3:])
config = BENCHMARKS["v1"]
plans = plan_scenarios(config)
for number in numbers:
    record_scenario(RecordingJob(root, replace(config, sensors=sensors), plans[number]))
print(json.dumps({each.token: described(each) for each in find_release(root).scenarios}))
"""
"""Makes some scenarios of the benchmark, and says what is compared of them."""


def elsewhere() -> dict[str, str]:
    """The environment of another machine: its place, its hash seed, its threads, and an older
    processor for numpy.
    """
    from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

    newer = [name for name in __cpu_dispatch__ if __cpu_features__[name]]
    return {
        **os.environ,
        "LC_ALL": "C.UTF-8",
        "LANG": "C.UTF-8",
        "TZ": "Asia/Kathmandu",
        "PYTHONHASHSEED": "4711",
        "OMP_NUM_THREADS": "2",
        "NPY_DISABLE_CPU_FEATURES": " ".join(newer),
    }


def made(
    root: Path, sensors: str, numbers: list[int], environment: dict[str, str]
) -> dict[str, object]:
    words = [sys.executable, "-W", "ignore", "-c", MAKE, str(root), sensors, *map(str, numbers)]
    run = subprocess.run(words, env=environment, check=True, capture_output=True, text=True)
    found: dict[str, object] = json.loads(run.stdout)
    return found


def test_what_is_published_is_what_is_planned() -> None:
    plans = plan_scenarios(BENCHMARKS["v1"])
    told = published("v1")["scenarios"]
    assert sorted(told) == sorted(plan.token for plan in plans)
    assert Counter(plan.accident for plan in plans) == {True: 120, False: 120}
    assert {plan.design for plan in plans} == set(range(1, 13))
    numbers = {kind: {len(scenario[kind]) for scenario in told.values()} for kind in TOLERANCES}
    assert numbers == {
        "num_lidar_pts": {1},
        "images": {5 * 6 * 8},
        "clouds": {5 * 8},
        "BEV pictures": {5 * 8},
    }
    with pytest.raises(ChoiceError, match="benchmark: expected one of v1, found 'v2'"):
        published("v2")


def test_the_page_has_what_is_kept_of_the_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOP))
    rows = importlib.import_module("benchmarks.pages.benchmark")
    page = (TOP / "docs" / "benchmark.md").read_text(encoding="utf-8")
    for name in rows.ROWS:
        assert (
            f"| `{name}` | {' | '.join(rows.text(name, column) for column in rows.NUMBERS)} |"
            in page
        )
        for task in rows.TASKS:
            bundle = read_bundle(rows.KEPT / name / task)
            assert checksums_of(bundle.folder) == bundle.checksums()
            assert (bundle.setup.protocol, bundle.selection.split, bundle.selection.samples) == (
                "paper",
                "test",
                "evaluate",
            )


def test_its_seed_is_of_no_release_that_anything_shipped_was_tuned_with() -> None:
    recipes = [read_recipe(path) for path in sorted(SHIPPED_RECIPES.glob("*.yaml"))]
    configs = [synth_config_of(source) for recipe in recipes for source in recipe.releases.values()]
    seeds = {config.seed for config in configs if config is not None}
    assert len(seeds) > 5
    assert BENCHMARKS["v1"].seed not in seeds | {
        12,
        208,
    }  # of the baselines' page, and of the shipped weights' scores


@pytest.mark.slow
@pytest.mark.parametrize(("sensors", "numbers"), [("none", [0, 1, 67, 118, 239]), ("all", [102])])
def test_it_is_made_elsewhere_too(tmp_path: Path, sensors: str, numbers: list[int]) -> None:
    """Labels, meta and calib byte for byte."""
    told = published("v1")
    found = made(tmp_path / "there", sensors, numbers, elsewhere())
    wanted = {token: told["scenarios"][token] for token in found}
    assert len(found) == len(numbers)
    assert (
        differences({"splits": None, "scenarios": found}, {"splits": None, "scenarios": wanted})
        == []
    )


def edited(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    if path.suffix == ".jpg":
        write_image(path, change(read_image(path)))
    else:
        cloud = read_lidar(path)
        write_lidar(path, change(cloud.xyz), cloud.intensity)


def each_edited(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Sequence[Path]], object]:
    return lambda paths: [edited(path, change) for path in paths]


def one_frame_late(paths: Sequence[Path]) -> None:
    for folder in {path.parent for path in paths}:
        own = sorted(path for path in paths if path.parent == folder)
        for path, content in zip(own[1:], [path.read_bytes() for path in own[:-1]], strict=True):
            path.write_bytes(content)


def first_point_unknown(points: np.ndarray) -> np.ndarray:
    return np.concatenate([np.full((1, 3), np.nan), points[1:]])


IMAGES, CLOUDS = "*/*/Camera_Front/*/*.jpg", "*/*/lidar01/*/*.npz"


@pytest.fixture(scope="module")
def wanted(release_root: Path) -> dict[str, object]:
    """What is compared of the release."""
    return described_release(release_root, workers=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("files", "change", "told"),
    [
        (
            "*/*/label/*/*_002.txt",
            lambda paths: [path.write_bytes(b"9" + path.read_bytes()) for path in paths],
            "boxes",
        ),
        ("*/*/label/*/*.txt", lambda paths: [more_points(path) for path in paths], "num_lidar_pts"),
        ("*/*/calib/*/*_002.pkl", lambda paths: [path.unlink() for path in paths], "calib"),
        ("*/meta/*.txt", lambda paths: [path.unlink() for path in paths], "meta"),
        ("*/*/Camera_Back/*/*_003.jpg", lambda paths: [path.unlink() for path in paths], "images"),
        (IMAGES, each_edited(lambda pixels: cv2.flip(pixels, 1)), "images"),
        (IMAGES, each_edited(lambda pixels: cv2.add(pixels, 8.0)), "images"),
        (
            IMAGES,
            each_edited(lambda pixels: np.full_like(pixels, pixels.mean(axis=(0, 1)))),
            "images",
        ),
        (IMAGES, one_frame_late, "images"),
        ("*/ego_vehicle/BEV_instance_camera/*/*.npz", one_frame_late, "BEV pictures"),
        (CLOUDS, each_edited(lambda points: np.add(points, (0, 0, 0.2))), "clouds"),
        (CLOUDS, each_edited(lambda points: points * (1, -1, 1)), "clouds"),
        (CLOUDS, each_edited(first_point_unknown), "clouds"),
        (CLOUDS, one_frame_late, "clouds"),
        ("train.txt", lambda paths: paths[0].write_text("Scenario\n"), "split files"),
    ],
)
def test_what_differs_is_told(
    release_root: Path,
    wanted: dict[str, object],
    tmp_path: Path,
    files: str,
    change: Callable[..., object],
    told: str,
) -> None:
    root = tmp_path / "copy"
    shutil.copytree(release_root, root, ignore=shutil.ignore_patterns(".deepaccident"))
    change(sorted(root.glob(files)))
    found = differences(described_release(root, workers=1), wanted)
    assert found
    assert all(re.search(rf"\b{told} differ", line) for line in found)


def test_scenarios_that_are_missing_or_new_are_told_and_missing_sensors_are_not() -> None:
    points = {"num_lidar_pts": {"all agents": (0,) * 8}}
    nothing = {
        "boxes": "1",
        "meta": "2",
        "calib": "3",
        **points,
        "images": {},
        "clouds": {},
        "BEV pictures": {},
    }
    seen = {**nothing, "images": {"front": (1,) * 8}, "clouds": {"lidar": (2,) * 8}}
    wanted = {"splits": "4", "scenarios": {"a": seen, "b": seen}}
    found = {"splits": "4", "scenarios": {"a": nothing, "c": nothing}}
    assert differences(found, wanted) == ["b: is missing", "c: is not of the benchmark"]
    assert compared_kinds(found) == ["num_lidar_pts"]
    partly = {"splits": "4", "scenarios": {"a": {**seen, "clouds": {}}, "b": seen}}
    (told,) = differences(partly, wanted)
    assert told.startswith("a: clouds differ ")
