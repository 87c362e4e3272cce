"""Test the extra `nuscenes` together with PyTorch.

Nothing here is collected without them, unless DEEPACCIDENT_REQUIRE_NUSCENES is set. The nuScenes
devkit needs numpy 1.26, which is why this folder has its own environment (.ci/run).
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

_REQUIRED_PACKAGES = ("nuscenes", "torch")

if missing := [name for name in _REQUIRED_PACKAGES if importlib.util.find_spec(name) is None]:
    if os.environ.get("DEEPACCIDENT_REQUIRE_NUSCENES"):
        raise pytest.UsageError(
            f"DEEPACCIDENT_REQUIRE_NUSCENES is set, but {', '.join(missing)} is not installed"
        )
    collect_ignore_glob = ["test_*.py"]


@dataclass(frozen=True)
class Pair:
    """A release and the export of `ego_vehicle`'s recordings to nuScenes' format.

    Attributes:
        release: Original release.
        road: Export, opened as a release.
        ours: Token of the original sample by sample of `road`.
        folder: Root folder of the export.
    """

    release: DeepAccident
    road: NuScenesRelease
    ours: Mapping[str, str]
    folder: Path


@pytest.fixture(scope="session", params=["ego", "nuscenes"])
def pair(
    request: pytest.FixtureRequest, release: DeepAccident, tmp_path_factory: pytest.TempPathFactory
) -> Pair:
    """The release and its export, once for each convention of the LiDAR's axes."""
    folder = tmp_path_factory.mktemp("road") / request.param
    export_release(
        release,
        folder,
        NuScenes(agents=("ego_vehicle",), lidar_axes=request.param),
    )
    road = open_nuscenes(folder)
    ours = {}
    for record in road.sample:
        scene, _, frame = record["token"].removeprefix("nuscenes/").rsplit("/", 2)
        kind, name, _ = scene.split("-")
        ours[record["token"]] = f"{kind}/{name}/ego_vehicle/{frame}"
    return Pair(release, road, ours, folder)


@pytest.fixture(scope="session")
def release(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """Accidents and their twins of 31 frames; every fifth frame is a keyframe, including the first
    and the last.
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
    root = make_release(tmp_path_factory.mktemp("made") / "release", config)
    return DeepAccident("v1", root, verbose=False)
