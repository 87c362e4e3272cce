import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.synth import SynthConfig, make_release


@pytest.fixture(scope="session")
def da_hidden(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """An accident of 4 s, labels only, whose colliders a house hides from each other."""
    root = tmp_path_factory.mktemp("synthetic") / "hidden"
    make_release(root, SynthConfig(scenarios=1, frames=40, sensors=False, view="hidden"), workers=1)
    return DeepAccident("v1", root, verbose=False)
