import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.synth import SynthConfig, make_release


@pytest.fixture(scope="session")
def da_hidden(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """Return an accident of 4 s with labels only, in which a house hides the colliders from each
    other.
    """
    root = tmp_path_factory.mktemp("synthetic") / "hidden"
    make_release(root, SynthConfig(scenarios=1, frames=40, sensors=False, view="hidden"), workers=1)
    return DeepAccident("v1", root, verbose=False)
