"""A release with BEV cameras that a test may remove, and the generator's roads beneath it."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.maps import TownMap, town_map
from deepaccident_devkit.plugins.synth import SynthConfig
from deepaccident_devkit.plugins.synth.plan import plan_scenarios
from deepaccident_devkit.plugins.synth.scenario import build_scenario
from deepaccident_devkit.plugins.synth.world import World
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.taxonomy import CAMERAS, LIDAR


def copy_release(release_root: Path, root: Path) -> Path:
    """Copy the labels, calib, meta and BEV cameras of the release."""
    shutil.copytree(
        release_root,
        root,
        copy_function=os.link,
        ignore=shutil.ignore_patterns(".deepaccident", *CAMERAS, LIDAR),
    )
    return root


@pytest.fixture(scope="session")
def bev_release(release_root: Path, tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """The session's release with its BEV cameras and its own index, beside which maps are kept."""
    root = copy_release(release_root, tmp_path_factory.mktemp("maps") / "release")
    return DeepAccident("v1", root, verbose=False)


@pytest.fixture
def own_bev_release(release_root: Path, tmp_path: Path) -> DeepAccident:
    """The same, with files that a test may remove; to write them would change the session's."""
    return DeepAccident("v1", copy_release(release_root, tmp_path / "release"), verbose=False)


@pytest.fixture(scope="session")
def town(bev_release: DeepAccident) -> str:
    """The town of the first accident and its twin, which no other scenario shares."""
    first = bev_release.scenario[0]
    tokens = bev_release.field2token("scenario", "town", first["town"])
    names = [bev_release.get("scenario", token)["name"] for token in tokens]
    assert names == [first["name"]] * 2
    return str(first["town"])


@pytest.fixture(scope="session")
def mapped_town(bev_release: DeepAccident, town: str) -> TownMap:
    """The map of that town."""
    return town_map(bev_release, town, workers=1)


@pytest.fixture(scope="session")
def world(bev_release: DeepAccident) -> World:
    """The generator's world of that town."""
    config = SynthConfig(
        scenarios=4, frames=6, image_size=(64, 36), seed=3, unplanned=0, exact=True, designed=True
    )
    plan = plan_scenarios(config)[0]
    assert plan.token == bev_release.scenario[0]["token"]
    return build_scenario(config, plan).world


@pytest.fixture(scope="session")
def true_codes(world: World) -> Callable[[FloatArray], FloatArray]:
    """A function that returns the codes of the generator's ground at points (N, 2) in world."""
    rotation = world.world_from_ground.matrix[:2, :2]

    def codes_at(xy: FloatArray) -> FloatArray:
        offsets = xy - world.world_from_ground.translation[:2]
        return world.ground.at(offsets @ np.linalg.inv(rotation).T)

    return codes_at
