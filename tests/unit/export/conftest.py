"""Make small releases for exports."""

import shutil
from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.testing import SmallRelease, write_small_release


@pytest.fixture(scope="session")
def small_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An indexed release of three scenarios with three frames and two agents, only to be read."""
    content = SmallRelease(
        splits=("train", "val"), agents=("ego_vehicle", "other_vehicle"), channels=("Camera_Front",)
    )
    root = tmp_path_factory.mktemp("small") / "release"
    write_small_release(root, content)
    DeepAccident(dataroot=root, verbose=False)
    return root


@pytest.fixture(scope="session")
def small_dataset(small_root: Path) -> DeepAccident:
    return DeepAccident(dataroot=small_root, verbose=False)


@pytest.fixture
def unlabelled_dataset(own_release: Path) -> DeepAccident:
    """A release without labels."""
    for path in own_release.rglob("label/*/*.txt"):
        path.unlink()
    return DeepAccident("v1", own_release, verbose=False)


@pytest.fixture
def release_copy(small_root: Path, tmp_path: Path) -> Path:
    """A copy of the small release that a test may change."""
    return shutil.copytree(small_root, tmp_path / "changing")
