"""Three synthetic releases to look for mistakes in."""

from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.synth import SynthConfig, make_release


@pytest.fixture(scope="session", params=[5, 6, 7])
def crossing(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """An accident, of one seed and the next; of the first one also its normal twin."""
    if request.param == 5:
        shared: DeepAccident = request.getfixturevalue("da_motion")
        return shared
    root: Path = tmp_path_factory.mktemp("synthetic") / f"crossing_{request.param}"
    make_release(root, SynthConfig(scenarios=1, frames=30, seed=request.param, sensors=False), workers=1)
    return DeepAccident("v1", root, verbose=False)


@pytest.fixture(scope="session")
def crossing_tokens(crossing: DeepAccident) -> list[str]:
    """All samples of the last 2 s, of both scenarios and all agents."""
    splits = [split for split in ("train", "val", "test") if crossing.split_scenarios(split)]
    return [token for split in splits for token in crossing.samples(split, "evaluate", "paper", scope="all")]


@pytest.fixture(scope="session")
def crossing_labels(crossing: DeepAccident, crossing_tokens: list[str]) -> dict[str, MotionLabels]:
    """Five samples' labels at the present, by token."""
    return {
        token: crossing.motion_labels(token).to_present("bilinear")
        for token in crossing_tokens[:: len(crossing_tokens) // 5]
    }
