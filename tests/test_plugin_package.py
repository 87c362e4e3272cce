"""The package of docs/plugins.md, installed in an environment of its own: its verb, format and task
work.
"""

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
    """The interpreter of a new environment with the package of the page, beside what this one
    has.
    """
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
    (site_packages / "shared.pth").write_text(
        "\n".join(filter(os.path.isdir, sys.path)), encoding="utf-8"
    )
    options = ("--quiet", "--no-deps", "--no-index", "--no-build-isolation")
    pip = [sys.executable, "-m", "pip", "--python", interpreter]
    subprocess.run([*pip, "install", *options, package], check=True, timeout=300)
    return interpreter


def run(python: Path, *words: object, status: int = 0, **environment: str) -> str:
    """Return what a command of the devkit prints in that environment."""
    command = [python, "-m", "deepaccident_devkit", *map(str, words)]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env={**os.environ, **environment},
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.mark.slow
def test_its_verb_and_its_format(python: Path, da_b: DeepAccident, tmp_path: Path) -> None:
    assert "top-speed" in run(python, "--help")
    assert "top-speed" not in run(python, "--help", DEEPACCIDENT_PLUGINS="off")
    speeds = run(python, "top-speed", da_b.dataroot).splitlines()
    assert [line.partition(":")[0] for line in speeds] == [
        record["token"] for record in da_b.scenario
    ]
    assert min(float(line.split()[-2]) for line in speeds) > 0
    run(
        python,
        "export",
        "box-counts",
        da_b.dataroot,
        "--out",
        tmp_path / "counts",
        "--agents",
        "ego_vehicle",
    )
    counts = {
        token: count
        for path in (tmp_path / "counts").glob("type*.json")
        for token, count in json.loads(path.read_text()).items()
    }
    assert counts == {
        record["token"]: len(da_b.boxes(record["token"]))
        for record in da_b.sample
        if record["agent"] == "ego_vehicle"
    }


@pytest.mark.slow
def test_its_task(python: Path, da_motion: DeepAccident, tmp_path: Path) -> None:
    tokens = samples(da_motion, "train", "evaluate")
    results = predict_results(da_motion, "detection", tokens, tmp_path / "detection.json")
    words = (
        "evaluate",
        "counting",
        da_motion.dataroot,
        "--results",
        results,
        "--split",
        "train",
        "--workers",
        2,
    )
    printed = run(python, *words, "--protocol", "about", "--out", tmp_path / "bundle")
    assert "right" in printed
    bundle = read_bundle(tmp_path / "bundle")  # here the plug-in is not installed
    assert bundle.summary["task"] == "counting"
    assert 0 <= bundle.summary["metrics"]["means"]["boxes"]["all"]["right"] <= 1
    with pytest.raises(
        ResultsError, match=r"'counting'.*; if a plug-in has this task, install it\."
    ):
        _ = bundle.setup
    assert "the same; " in run(
        python,
        "check",
        "bundle",
        tmp_path / "bundle",
        *words[3:5],
        "--dataroot",
        da_motion.dataroot,
    )
    assert "No such command 'counting'" in run(
        python, "evaluate", "counting", status=2, DEEPACCIDENT_PLUGINS="off"
    )
