"""A study on releases in nuScenes' format, with models of two sources and no accidents."""

import json
from pathlib import Path
from typing import Any

import pytest
from support.study_recipes import write_recipe

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.plugins.study import read_recipe, run_study
from deepaccident_devkit.plugins.study.overlap import known_scenarios

SMALL = {"scenarios": 4, "frames": 16, "image_size": [64, 36], "sensor_step": 5}
ROAD = {**SMALL, "rig": "road", "nuscenes": True}
LEARNED = {"preset": "tiny", "labels": "fiery", "horizon": 0.5, "steps": 2, "save_every": 1}
RECIPE = {
    "title": "A stand-in",
    "question": "Does it run?",
    "releases": {
        "simulation": {**SMALL, "seed": 1},
        "road": {**ROAD, "seed": 2},
        "test": {**ROAD, "seed": 3},
    },
    "weights": {
        "simulation": {"release": "simulation", "agents": "single", **LEARNED},
        "then": {"release": "road", "from": "simulation", "agents": "available", "steps": 1},
        "mixed": {
            "release": "simulation",
            "also": "road",
            "mix": 0.5,
            "agents": "single",
            **LEARNED,
        },
    },
    "test": {"release": "test", "samples": "all", "labels": "fiery", "horizon": 0.5},
    "rows": [
        {"name": "then", "weights": "then", "agents": "single"},
        {"name": "mixed", "weights": "mixed", "agents": "single"},
        {"name": "everything", "trivial": "everything", "agents": "single"},
    ],
    "headline": {"row": "mixed", "less": "then", "number": "iou_100"},
}


def test_a_study_on_the_road_has_no_accident_metrics(tmp_path: Path) -> None:
    recipe = read_recipe(str(write_recipe(tmp_path, RECIPE)))
    out = tmp_path / "out"
    report = run_study(recipe, out, device="cpu", workers=1)
    metrics = report.summary["rows"]["everything"]["groups"]["all samples"]

    assert metrics["iou_100"]["value"] > 0
    assert "apa" not in metrics
    assert report.summary["groups"]["all samples"]["samples"] == 4 * 4

    cells = report.summary["cells"]
    weights = {cell["name"]: cell["key"] for cell in cells if cell["kind"] == "weights"}
    notes = json.loads((out / "weights" / weights["mixed, seed 1"] / "run.json").read_text())
    assert notes["also"]["mix"] == 0.5
    assert "APA" not in report.to_text()


def test_an_export_to_nuscenes_is_known_by_its_actors(pair: Any) -> None:
    """The export numbers its instances anew and gives its scenes other names."""
    our_tokens = [record["token"] for record in pair.release.scenario]
    road_tokens = [record["token"] for record in pair.road.scenario]
    ours = (pair.release, our_tokens)
    road = (pair.road, road_tokens)

    assert known_scenarios(ours, road) == road_tokens
    assert known_scenarios(road, ours) == our_tokens
    assert known_scenarios((pair.road, road_tokens[:1]), ours)
    assert set(map(cluster_of, road_tokens)) == set(map(cluster_of, our_tokens))


def test_a_training_on_the_release_of_a_tested_export_is_refused(tmp_path: Path) -> None:
    """The release has more frames, other sensors and the other format, but the same seed."""
    releases = {**RECIPE["releases"], "simulation": {**SMALL, "seed": 3, "frames": 20}}
    path = write_recipe(tmp_path, {**RECIPE, "releases": releases})
    with pytest.raises(
        ConfigError,
        match=r"weights.simulation: simulation, all: contains \d+ scenarios of the test",
    ):
        run_study(read_recipe(str(path)), tmp_path / "out", device="cpu", workers=1)
