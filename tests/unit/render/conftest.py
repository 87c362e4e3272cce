"""Samples, frames and actors that several tests of pictures draw."""

import pytest
from support.replay_page import accident_scenario

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.statistics import DatasetStatistics, dataset_statistics


@pytest.fixture(scope="session")
def approach_sample(da: DeepAccident) -> str:
    """The ego's third sample in a scenario that ends in a collision."""
    return f"{accident_scenario(da)}/ego_vehicle/003"


@pytest.fixture(scope="session")
def follower_sample(da: DeepAccident) -> str:
    """The sample, at the impact, of the agent right behind a collider."""
    return f"{accident_scenario(da)}/ego_vehicle_behind/006"


@pytest.fixture(scope="session")
def frame(da: DeepAccident) -> str:
    """The token of a frame in a scenario that ends in a collision."""
    return f"{accident_scenario(da)}/004"


@pytest.fixture(scope="session")
def other_vehicle(da: DeepAccident) -> str:
    """The instance token of the other vehicle, which the ego collides with."""
    scenario = accident_scenario(da)
    actor_id = da.get("agent", f"{scenario}/other_vehicle")["actor_id"]
    return f"{scenario}/actor/{actor_id}"


@pytest.fixture(scope="session")
def sample(da_motion: DeepAccident) -> str:
    """The token of an ego sample 1 s before the impact."""
    scenario = accident_scenario(da_motion)
    num_frames = da_motion.get("scenario", scenario)["num_frames"]
    return da_motion.get_sample(scenario, "ego_vehicle", num_frames - 10)["token"]


@pytest.fixture(scope="session")
def labels(da_motion: DeepAccident, sample: str) -> MotionLabels:
    """The motion labels of `sample`, from the present on."""
    return da_motion.motion_labels(sample).to_present()


@pytest.fixture(scope="session")
def da_designs(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """An accident of each of the twelve designs and its normal twin, labels only."""
    root = tmp_path_factory.mktemp("synthetic") / "designs"
    config = SynthConfig(
        scenarios=24,
        frames=6,
        seed=7,
        sensors=False,
        unplanned=0,
        designs=tuple(range(1, 13)),
        designed=True,
    )
    return DeepAccident("v1", make_release(root, config, workers=1), verbose=False)


@pytest.fixture(scope="session")
def statistics(da: DeepAccident) -> DatasetStatistics:
    return dataset_statistics(da)
