"""Benchmarks: a release made anywhere equals the published one, and every difference is named."""

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


def add_points(path: Path) -> None:
    """Write a 1 before each number of points in a label file."""
    text = path.read_text()
    path.write_text(re.sub(r"(\d+) (True|False)$", r"1\1 \2", text, flags=re.MULTILINE))


RECORDING_SCRIPT = """
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
scenarios = find_release(root).scenarios
print(json.dumps({scenario.token: described(scenario) for scenario in scenarios}))
"""
"""Records some scenarios of the benchmark, and prints what is compared of them."""


def foreign_environment() -> dict[str, str]:
    """Make the environment of another machine: another locale, hash seed and number of threads, and
    an older processor for numpy.
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


def record_scenarios(root: Path, sensors: str, numbers: list[int]) -> dict[str, object]:
    arguments = [str(root), sensors, *map(str, numbers)]
    run = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", RECORDING_SCRIPT, *arguments],
        env=foreign_environment(),
        check=True,
        capture_output=True,
        text=True,
    )
    return dict(json.loads(run.stdout))


def test_what_is_published_is_what_is_planned() -> None:
    plans = plan_scenarios(BENCHMARKS["v1"])
    scenarios = published("v1")["scenarios"]
    assert sorted(scenarios) == sorted(plan.token for plan in plans)
    assert Counter(plan.accident for plan in plans) == {True: 120, False: 120}
    assert {plan.design for plan in plans} == set(range(1, 13))

    lengths = {
        kind: {len(scenario[kind]) for scenario in scenarios.values()} for kind in TOLERANCES
    }
    assert lengths == {
        "num_lidar_pts": {1},
        "images": {5 * 6 * 8},
        "clouds": {5 * 8},
        "BEV pictures": {5 * 8},
    }
    with pytest.raises(ChoiceError, match="benchmark: expected one of v1, found 'v2'"):
        published("v2")


def test_the_page_shows_the_stored_numbers_of_each_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOP))
    rows = importlib.import_module("benchmarks.pages.benchmark")
    page = (TOP / "docs" / "benchmark.md").read_text(encoding="utf-8")

    for name in rows.ROWS:
        numbers = [rows.text(name, column) for column in rows.NUMBERS]
        assert f"| `{name}` | {' | '.join(numbers)} |" in page
        for task in rows.TASKS:
            bundle = read_bundle(rows.ROWS_FOLDER / name / task)
            assert checksums_of(bundle.folder) == bundle.checksums()
            assert bundle.setup.protocol == "paper"
            assert (bundle.selection.split, bundle.selection.samples) == ("test", "evaluate")


def test_nothing_shipped_was_tuned_with_its_seed() -> None:
    recipes = [read_recipe(path) for path in sorted(SHIPPED_RECIPES.glob("*.yaml"))]
    configs = [synth_config_of(source) for recipe in recipes for source in recipe.releases.values()]
    seeds = {config.seed for config in configs if config is not None}

    assert len(seeds) > 5
    # 12: the baselines' page; 208: the scores of the shipped weights
    assert BENCHMARKS["v1"].seed not in seeds | {12, 208}


@pytest.mark.slow
@pytest.mark.parametrize(("sensors", "numbers"), [("none", [0, 1, 67, 118, 239]), ("all", [102])])
def test_another_machine_makes_the_same(tmp_path: Path, sensors: str, numbers: list[int]) -> None:
    """Labels, meta and calib are compared byte for byte."""
    scenarios = record_scenarios(tmp_path / "there", sensors, numbers)
    assert len(scenarios) == len(numbers)

    stored = published("v1")["scenarios"]
    expected = {token: stored[token] for token in scenarios}
    assert not differences(
        {"splits": None, "scenarios": scenarios},
        {"splits": None, "scenarios": expected},
    )


def edit_file(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    if path.suffix == ".jpg":
        write_image(path, change(read_image(path)))
    else:
        cloud = read_lidar(path)
        write_lidar(path, change(cloud.xyz), cloud.intensity)


def edit_each(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Sequence[Path]], object]:
    return lambda paths: [edit_file(path, change) for path in paths]


def delay_by_one_frame(paths: Sequence[Path]) -> None:
    for folder in {path.parent for path in paths}:
        frames = sorted(path for path in paths if path.parent == folder)
        contents = [path.read_bytes() for path in frames[:-1]]
        for path, content in zip(frames[1:], contents, strict=True):
            path.write_bytes(content)


def lose_first_point(points: np.ndarray) -> np.ndarray:
    return np.concatenate(
        [
            np.full((1, 3), np.nan),
            points[1:],
        ]
    )


IMAGES, CLOUDS = "*/*/Camera_Front/*/*.jpg", "*/*/lidar01/*/*.npz"


@pytest.fixture(scope="module")
def description(release_root: Path) -> dict[str, object]:
    return described_release(release_root, workers=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("files", "change", "kind"),
    [
        (
            "*/*/label/*/*_002.txt",
            lambda paths: [path.write_bytes(b"9" + path.read_bytes()) for path in paths],
            "boxes",
        ),
        ("*/*/label/*/*.txt", lambda paths: [add_points(path) for path in paths], "num_lidar_pts"),
        ("*/*/calib/*/*_002.pkl", lambda paths: [path.unlink() for path in paths], "calib"),
        ("*/meta/*.txt", lambda paths: [path.unlink() for path in paths], "meta"),
        ("*/*/Camera_Back/*/*_003.jpg", lambda paths: [path.unlink() for path in paths], "images"),
        (IMAGES, edit_each(lambda pixels: cv2.flip(pixels, 1)), "images"),
        (IMAGES, edit_each(lambda pixels: cv2.add(pixels, 8.0)), "images"),
        (
            IMAGES,
            edit_each(lambda pixels: np.full_like(pixels, pixels.mean(axis=(0, 1)))),
            "images",
        ),
        (IMAGES, delay_by_one_frame, "images"),
        ("*/ego_vehicle/BEV_instance_camera/*/*.npz", delay_by_one_frame, "BEV pictures"),
        (CLOUDS, edit_each(lambda points: np.add(points, (0, 0, 0.2))), "clouds"),
        (CLOUDS, edit_each(lambda points: points * (1, -1, 1)), "clouds"),
        (CLOUDS, edit_each(lose_first_point), "clouds"),
        (CLOUDS, delay_by_one_frame, "clouds"),
        ("train.txt", lambda paths: paths[0].write_text("Scenario\n"), "split files"),
    ],
)
def test_what_differs_is_named(
    release_root: Path,
    description: dict[str, object],
    tmp_path: Path,
    files: str,
    change: Callable[..., object],
    kind: str,
) -> None:
    root = tmp_path / "copy"
    shutil.copytree(release_root, root, ignore=shutil.ignore_patterns(".deepaccident"))
    change(sorted(root.glob(files)))

    messages = differences(described_release(root, workers=1), description)
    assert messages
    assert all(re.search(rf"\b{kind} differ", message) for message in messages)


def test_missing_and_new_scenarios_are_named_and_missing_sensors_are_not() -> None:
    bare = {
        "boxes": "1",
        "meta": "2",
        "calib": "3",
        "num_lidar_pts": {"all agents": (0,) * 8},
        "images": {},
        "clouds": {},
        "BEV pictures": {},
    }
    full = {**bare, "images": {"front": (1,) * 8}, "clouds": {"lidar": (2,) * 8}}
    expected = {"splits": "4", "scenarios": {"a": full, "b": full}}

    other = {"splits": "4", "scenarios": {"a": bare, "c": bare}}
    assert differences(other, expected) == ["b: is missing", "c: is not part of the benchmark"]
    assert compared_kinds(other) == ["num_lidar_pts"]

    without_clouds = {**full, "clouds": {}}
    (message,) = differences(
        {"splits": "4", "scenarios": {"a": without_clouds, "b": full}}, expected
    )
    assert message.startswith("a: clouds differ ")
