from pathlib import Path

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.release import ScenarioFolder, find_release

CONFIG = SynthConfig(scenarios=2, frames=3, image_size=(192, 108), seed=5, designed=True)


@pytest.fixture(scope="session")
def config() -> SynthConfig:
    return CONFIG


@pytest.fixture(scope="session")
def release_root(tmp_path_factory) -> Path:
    """An accident and its twin, three frames, with all sensors."""
    return make_release(tmp_path_factory.mktemp("synth") / "a release", CONFIG, workers=1)


@pytest.fixture(scope="session")
def scenarios(release_root) -> tuple[ScenarioFolder, ...]:
    return find_release(release_root).scenarios


@pytest.fixture(scope="session")
def digests():
    """A function that reads every file below a folder: relative path → content."""

    def read(root: Path) -> dict[str, bytes]:
        return {
            path.relative_to(root).as_posix(): path.read_bytes()
            for path in sorted(root.rglob("*"))
            if path.is_file()
        }

    return read


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
