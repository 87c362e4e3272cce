"""Tests of the extra `nuscenes`, with PyTorch: not collected without them, unless
DEEPACCIDENT_REQUIRE_NUSCENES is set.

nuScenes' devkit needs numpy 1.26, so that this folder has an environment of its own (.ci/run).
"""

import importlib.util
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.plugins.nuscenes import NuScenesRelease, open_nuscenes
from deepaccident_devkit.plugins.synth import SynthConfig, make_release

_NEEDED = ("nuscenes", "torch")

if missing := [name for name in _NEEDED if importlib.util.find_spec(name) is None]:
    if os.environ.get("DEEPACCIDENT_REQUIRE_NUSCENES"):
        raise pytest.UsageError(
            f"DEEPACCIDENT_REQUIRE_NUSCENES is set, but {', '.join(missing)} is not installed"
        )
    collect_ignore_glob = ["test_*.py"]


@dataclass(frozen=True)
class Pair:
    """A release, and the same as nuScenes: what `ego_vehicle` recorded.

    Attributes:
        release: ours.
        road: its export, opened.
        ours: sample of `road` → the release's.
        folder: of the export.
    """

    release: DeepAccident
    road: NuScenesRelease
    ours: Mapping[str, str]
    folder: Path


@pytest.fixture(scope="session", params=["ego", "nuscenes"])
def pair(
    request: pytest.FixtureRequest, made: DeepAccident, tmp_path_factory: pytest.TempPathFactory
) -> Pair:
    """The release and its export, with either axes of the LiDAR."""
    folder = tmp_path_factory.mktemp("road") / request.param
    export_release(made, folder, NuScenes(agents=("ego_vehicle",), lidar_axes=request.param))
    road = open_nuscenes(folder)
    ours = {}
    for record in road.sample:
        scene, _, frame = record["token"].removeprefix("nuscenes/").rsplit("/", 2)
        kind, name, _ = scene.split("-")
        ours[record["token"]] = f"{kind}/{name}/ego_vehicle/{frame}"
    return Pair(made, road, ours, folder)


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """Accidents and their twins of 31 frames: each fifth one, from the first to the last, is a
    keyframe.
    """
    config = SynthConfig(
        scenarios=8,
        frames=31,
        image_size=(160, 90),
        seed=8,
        sensor_step=5,
        unplanned=0,
        designed=True,
    )
    return DeepAccident(
        "v1", make_release(tmp_path_factory.mktemp("made") / "release", config), verbose=False
    )
