"""A study on a stand-in for the road: releases in nuScenes' format, models of two sources, and no
accidents.
"""

import json
from pathlib import Path
from typing import Any

import pytest
from studies import written

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


def test_it_runs_and_has_no_numbers_of_accidents(tmp_path: Path) -> None:
    report = run_study(
        read_recipe(str(written(tmp_path, RECIPE))), tmp_path / "out", device="cpu", workers=1
    )
    rows = report.summary["rows"]
    numbers = rows["everything"]["groups"]["all samples"]
    assert numbers["iou_100"]["value"] > 0
    assert "apa" not in numbers
    assert report.summary["groups"]["all samples"]["samples"] == 4 * 4
    trained = {
        each["name"]: each["key"] for each in report.summary["cells"] if each["kind"] == "weights"
    }
    notes = json.loads(
        (tmp_path / "out" / "weights" / trained["mixed, seed 1"] / "run.json").read_text()
    )
    assert notes["also"]["mix"] == 0.5
    assert "APA" not in report.to_text()


def test_an_export_to_nuscenes_is_known_by_its_actors(pair: Any) -> None:
    """Its instances have other numbers, and its scenes other names."""
    ours, theirs = (
        (each, [record["token"] for record in each.scenario]) for each in (pair.release, pair.road)
    )
    assert known_scenarios(ours, theirs) == theirs[1]
    assert known_scenarios(theirs, ours) == ours[1]
    assert known_scenarios((pair.road, theirs[1][:1]), ours)
    assert {cluster_of(token) for token in theirs[1]} == {cluster_of(token) for token in ours[1]}


def test_a_training_on_the_release_of_a_tested_export_is_refused(tmp_path: Path) -> None:
    """It has more frames, other sensors, and the other format, but the same seed."""
    releases = {**RECIPE["releases"], "simulation": {**SMALL, "seed": 3, "frames": 20}}
    path = written(tmp_path, {**RECIPE, "releases": releases})
    with pytest.raises(
        ConfigError, match=r"weights.simulation: simulation, all: shows \d+ scenarios of the test"
    ):
        run_study(read_recipe(str(path)), tmp_path / "out", device="cpu", workers=1)
