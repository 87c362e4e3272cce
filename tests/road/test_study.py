"""A study on a stand-in for the road: releases in nuScenes' format, models of two sources, and no accidents."""

import json
from pathlib import Path

import pytest
from studies import written

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.study import read_recipe, run_study

SMALL = {"scenarios": 4, "frames": 16, "image_size": [64, 36], "sensor_step": 5}
ROAD = {**SMALL, "rig": "road", "nuscenes": True}
LEARNED = {"preset": "tiny", "labels": "fiery", "horizon": 0.5, "steps": 2, "save_every": 1}
RECIPE = {
    "title": "A stand-in",
    "question": "Does it run?",
    "releases": {"simulation": {**SMALL, "seed": 1}, "road": {**ROAD, "seed": 2}, "test": {**ROAD, "seed": 3}},
    "weights": {
        "simulation": {"release": "simulation", "agents": "single", **LEARNED},
        "then": {"release": "road", "from": "simulation", "agents": "available", "steps": 1},
        "mixed": {"release": "simulation", "also": "road", "mix": 0.5, "agents": "single", **LEARNED},
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
    report = run_study(read_recipe(str(written(tmp_path, RECIPE))), tmp_path / "out", device="cpu", workers=1)
    rows = report.summary["rows"]
    numbers = rows["everything"]["groups"]["all samples"]
    assert numbers["iou_100"]["value"] > 0
    assert "apa" not in numbers
    assert report.summary["groups"]["all samples"]["samples"] == 4 * 4
    trained = {each["name"]: each["key"] for each in report.summary["cells"] if each["kind"] == "weights"}
    notes = json.loads((tmp_path / "out" / "weights" / trained["mixed, seed 1"] / "run.json").read_text())
    assert notes["also"]["mix"] == 0.5
    assert "APA" not in report.to_text()


@pytest.mark.parametrize(
    ("place", "changes", "words"),
    [
        ("releases", {"test": {**ROAD, "nuscenes": "yes"}}, r"nuscenes: expected True or False"),
        ("weights", {"mixed": {**RECIPE["weights"]["mixed"], "also": "nowhere"}}, r"also: expected one of"),
        ("weights", {"mixed": {**RECIPE["weights"]["mixed"], "mix": 1.5}}, r"mix: expected a share"),
    ],
)
def test_what_cannot_be(tmp_path: Path, place: str, changes: dict, words: str) -> None:
    wrong = {**RECIPE, place: {**RECIPE[place], **changes}}
    path = written(tmp_path, wrong)
    with pytest.raises(ConfigError, match=words):
        read_recipe(str(path))
