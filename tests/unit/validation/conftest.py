"""A release that is small enough to decode in every test."""

import shutil
from pathlib import Path

import pytest


@pytest.fixture
def small(release_root: Path, tmp_path: Path) -> Path:
    """Copy a release of one agent with two channels."""
    root = tmp_path / "release"
    of_type = next(release_root.glob("*_accident"))
    for kind in ("calib", "label", "Camera_Front", "lidar01"):
        shutil.copytree(of_type / "ego_vehicle" / kind, root / of_type.name / "ego_vehicle" / kind)
    shutil.copytree(of_type / "meta", root / of_type.name / "meta")
    return root
