"""Make a release, results of a baseline, and the outputs of all commands on this machine."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from engines.products import COMMANDS, Cluster, Local, command_line, python_command, read_files, run

from deepaccident_devkit.plugins.synth import SynthConfig, make_release


@pytest.fixture(scope="session")
def local(tmp_path_factory: pytest.TempPathFactory) -> Local:
    folder = tmp_path_factory.mktemp("engines")
    release = make_release(
        folder / "release",
        SynthConfig(scenarios=6, frames=24, sensors=False, seed=12, designed=True),
        workers=2,
    )
    results = folder / "results"
    options = ["--split", "train", "--out", str(results)]
    run(python_command(["predict", "constant_velocity", str(release), *options]))

    paths = {"release": release, "results": results, "out": folder / "local"}
    outputs = {name: run(python_command(command_line(name, paths))) for name in COMMANDS}
    return Local(paths, read_files(folder / "local"), outputs["validate"])


@pytest.fixture
def cluster() -> Iterator[Cluster]:
    script = Path(__file__).with_name("local_cluster.py")
    with subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        facts = json.loads(process.stdout.readline())
        yield Cluster(facts["address"], facts["workers"])
        process.communicate(timeout=300)
