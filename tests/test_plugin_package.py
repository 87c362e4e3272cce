"""The plug-in package of docs/plugins.md works when it is installed in its own environment."""

import json
import os
import re
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.runs import read_bundle
from deepaccident_devkit.plugins.baselines import predict_results
from deepaccident_devkit.selection.samples import samples

PAGE = Path(__file__).parents[1] / "docs" / "plugins.md"


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of a new environment that has this one's packages and the page's package."""
    folder = tmp_path_factory.mktemp("plugin")
    text = PAGE.read_text(encoding="utf-8")
    package = folder / "deepaccident-extras"
    package.mkdir()
    for name, language in (("pyproject.toml", "toml"), ("deepaccident_extras.py", "python")):
        (block,) = re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
        (package / name).write_text(block, encoding="utf-8")
    venv.create(folder / "environment")
    interpreter = folder / "environment" / "bin" / "python"
    (site_packages,) = folder.glob("environment/lib/python*/site-packages")
    shared_folders = "\n".join(filter(os.path.isdir, sys.path))
    (site_packages / "shared.pth").write_text(shared_folders, encoding="utf-8")
    options = ("--quiet", "--no-deps", "--no-index", "--no-build-isolation")
    pip = [sys.executable, "-m", "pip", "--python", interpreter]
    subprocess.run([*pip, "install", *options, package], check=True, timeout=300)
    return interpreter


def run(python: Path, *words: object, status: int = 0, **environment: str) -> str:
    """Run a command of the devkit in the environment, and return its output."""
    command = [python, "-m", "deepaccident_devkit", *map(str, words)]
    process = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=300,
        check=False,
        env={**os.environ, **environment},
    )
    assert process.returncode == status, process.stdout
    return process.stdout


@pytest.mark.slow
def test_its_verb_and_its_format(python: Path, da_b: DeepAccident, tmp_path: Path) -> None:
    assert "top-speed" in run(python, "--help")
    assert "top-speed" not in run(python, "--help", DEEPACCIDENT_PLUGINS="off")
    lines = run(python, "top-speed", da_b.dataroot).splitlines()
    tokens = [scenario["token"] for scenario in da_b.scenario]
    assert [line.partition(":")[0] for line in lines] == tokens
    assert min(float(line.split()[-2]) for line in lines) > 0

    out = tmp_path / "counts"
    run(python, "export", "box-counts", da_b.dataroot, "--out", out, "--agents", "ego_vehicle")
    counts = {}
    for path in out.glob("type*.json"):
        counts.update(json.loads(path.read_text()))
    assert counts == {
        sample["token"]: len(da_b.boxes(sample["token"]))
        for sample in da_b.sample
        if sample["agent"] == "ego_vehicle"
    }


@pytest.mark.slow
def test_its_task(python: Path, da_motion: DeepAccident, tmp_path: Path) -> None:
    tokens = samples(da_motion, "train", "evaluate")
    results = predict_results(da_motion, "detection", tokens, tmp_path / "detection.json")
    out = tmp_path / "bundle"
    options = ("--split", "train", "--workers", 2, "--protocol", "about", "--out", out)
    words = ("evaluate", "counting", da_motion.dataroot, "--results", results, *options)
    assert "right" in run(python, *words)

    bundle = read_bundle(out)  # in this process the plug-in is not installed
    assert bundle.summary["task"] == "counting"
    assert 0 <= bundle.summary["metrics"]["means"]["boxes"]["all"]["right"] <= 1
    message = r"'counting'.*; if a plug-in adds this task, install it\."
    with pytest.raises(ResultsError, match=message):
        _ = bundle.setup

    picture = tmp_path / "counting.png"
    options = ("--results", results, "--task", "counting", "--out", picture)
    run(python, "render", "evaluation", da_motion.dataroot, tokens[0], *options)
    assert picture.stat().st_size > 10_000

    sources = ("--results", results, "--dataroot", da_motion.dataroot)
    assert "identical: " in run(python, "check", "bundle", out, *sources)
    output = run(python, "evaluate", "counting", status=2, DEEPACCIDENT_PLUGINS="off")
    assert "No such command 'counting'" in output
