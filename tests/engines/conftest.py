"""A release, results of a baseline, and what a run on this machine makes of them."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from engines.products import COMMANDS, Cluster, Local, command, contents, done, words

from deepaccident_devkit.plugins.synth import SynthConfig, make_release


@pytest.fixture(scope="session")
def local(tmp_path_factory: pytest.TempPathFactory) -> Local:
    folder = tmp_path_factory.mktemp("engines")
    config = SynthConfig(scenarios=6, frames=24, sensors=False, seed=12, designed=True)
    release = make_release(folder / "release", config, workers=2)
    done(
        command(
            [
                "predict",
                "constant_velocity",
                str(release),
                "--split",
                "train",
                "--out",
                str(folder / "results"),
            ]
        )
    )
    places = {"release": release, "results": folder / "results", "out": folder / "local"}
    printed = {name: done(command(words(name, places))) for name in COMMANDS}
    return Local(places, contents(folder / "local"), printed["validate"])


@pytest.fixture
def cluster() -> Iterator[Cluster]:
    script = Path(__file__).with_name("local_cluster.py")
    with subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        told = json.loads(process.stdout.readline())
        yield Cluster(told["address"], told["workers"])
        process.communicate(timeout=300)
