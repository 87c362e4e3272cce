"""Studies that tests run: a small one of baselines, and a process that is killed in the middle of
one.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

BASELINES: dict[str, Any] = {
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
_KILLED = """
import os, signal, sys
from importlib import import_module
from deepaccident_devkit.plugins.study import read_recipe, run_study

module, name, after, path, out = sys.argv[1:]
place, calls = import_module(module), []
there = getattr(place, name)

def counted(*arguments, **options):
    calls.append(name)
    if len(calls) > int(after):
        os.kill(os.getpid(), signal.SIGKILL)
    return there(*arguments, **options)

setattr(place, name, counted)
run_study(read_recipe(path), out, device="cpu", workers=1)
"""


def written(folder: Path, recipe: dict[str, Any], name: str = "mine") -> Path:
    """A recipe's file; JSON is YAML."""
    path = folder / f"{name}.yaml"
    path.write_text(json.dumps(recipe), encoding="utf-8")
    return path


def killed(recipe: Path, out: Path, module: str, name: str, after: int) -> None:
    """Run a study in a process that is killed when a function is called once more than so many
    times.
    """
    words = [sys.executable, "-c", _KILLED, module, name, str(after), str(recipe), str(out)]
    ran = subprocess.run(words, check=False, capture_output=True, text=True, timeout=600)
    assert ran.returncode == -9, ran.stderr
