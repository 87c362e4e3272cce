"""Recipes of small studies that tests run, and a process that is killed during a study."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

BASELINE_RECIPE: dict[str, Any] = {
    "title": "A small <study>",
    "question": "Does it run?",
    "headline": {
        "row": "sees all",
        "less": "sees single",
        "number": "iou_100",
        "where": "accidents",
    },
    "releases": {
        "test": {
            "seed": 203,
            "scenarios": 4,
            "frames": 26,
            "sensors": "none",
            "view": "hidden",
            "designs": [1],
            "image_size": [64, 36],
        }
    },
    "test": {"release": "test"},
    "rows": [
        {"name": "sees {agents}", "baseline": "constant_velocity", "agents": ["single", "all"]},
        {"name": "late {latency} s", "baseline": "constant_velocity", "latency": [0.0, 0.5]},
        {"name": "labels, {agents}", "trivial": "labels", "agents": ["single", "all"]},
        {"name": "nothing", "trivial": "nothing"},
        {"name": "everything", "trivial": "everything"},
    ],
    "groups": {"accidents": ["collision=true"], "long": ["length>=900"]},
    "by": ["impact_step"],
    "compare": [["labels, all", "nothing"]],
}
_KILLED_STUDY_SCRIPT = """
import os, signal, sys
from importlib import import_module
from deepaccident_devkit.plugins.study import read_recipe, run_study

module, name, after, path, out = sys.argv[1:]
owner, calls = import_module(module), []
original = getattr(owner, name)

def count_call(*arguments, **options):
    calls.append(name)
    if len(calls) > int(after):
        os.kill(os.getpid(), signal.SIGKILL)
    return original(*arguments, **options)

setattr(owner, name, count_call)
run_study(read_recipe(path), out, device="cpu", workers=1)
"""


def write_recipe(folder: Path, recipe: dict[str, Any], name: str = "mine") -> Path:
    """Write a recipe as JSON, which is also YAML, and return the file."""
    path = folder / f"{name}.yaml"
    path.write_text(json.dumps(recipe), encoding="utf-8")
    return path


def kill_study(recipe: Path, out: Path, module: str, name: str, after: int) -> None:
    """Run a study in a process that is killed when `module.name` is called for the `after` + 1st
    time.
    """
    arguments = [module, name, str(after), str(recipe), str(out)]
    command = [sys.executable, "-c", _KILLED_STUDY_SCRIPT, *arguments]
    process = subprocess.run(command, check=False, capture_output=True, text=True, timeout=600)
    assert process.returncode == -9, process.stderr
