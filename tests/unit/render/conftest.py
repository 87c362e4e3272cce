"""Samples, moments and actors that several tests of pictures look at."""

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.statistics import DatasetStatistics, dataset_statistics


@pytest.fixture(scope="session")
def approach(da: DeepAccident) -> str:
    """The ego's third sample in a scenario that ends in a collision."""
    scenario = next(one for one in da.scenario if one["collision"] is not None)
    return f"{scenario['token']}/ego_vehicle/003"


@pytest.fixture(scope="session")
def behind(da: DeepAccident) -> str:
    """The sample of the agent right behind a collider, at the impact."""
    scenario = next(one for one in da.scenario if one["collision"] is not None)
    return f"{scenario['token']}/ego_vehicle_behind/006"


@pytest.fixture(scope="session")
def frame(da: DeepAccident) -> str:
    """A moment of a scenario that ends in a collision."""
    scenario = next(one for one in da.scenario if one["collision"] is not None)
    return f"{scenario['token']}/004"


@pytest.fixture(scope="session")
def other(da: DeepAccident) -> str:
    """The other vehicle, which the ego collides with."""
    scenario = next(one for one in da.scenario if one["collision"] is not None)
    actor = da.get("agent", f"{scenario['token']}/other_vehicle")["actor_id"]
    return f"{scenario['token']}/actor/{actor}"


@pytest.fixture(scope="session")
def sample(da_motion: DeepAccident) -> str:
    """A sample of the ego, 1 s before the impact."""
    accident = next(scenario for scenario in da_motion.scenario if scenario["collision"])
    return da_motion.get_sample(accident, "ego_vehicle", accident["num_frames"] - 10)["token"]


@pytest.fixture(scope="session")
def labels(da_motion: DeepAccident, sample: str) -> MotionLabels:
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
