"""The real scenario of `pytest --real DIR`; no part of it is in this repository."""

import shutil
from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident

TOKEN = "type1_subtype1_normal/Town01_type001_subtype0001_scenario00003"  # noqa: S105 - a name


@pytest.fixture(scope="session")
def real_root(request: pytest.FixtureRequest) -> Path:
    """The folder of the real scenario; it is never written to."""
    root: Path | None = request.config.getoption("--real")
    if root is None:
        pytest.skip("no real scenario: pass --real DIR, or set DEEPACCIDENT_REAL")
    if not (root / TOKEN.partition("/")[0] / "meta").is_dir():
        pytest.fail(f"--real {root}: expected {TOKEN} in it")
    return root


@pytest.fixture(scope="session")
def real(real_root: Path, tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """The opened real scenario, with its index in another folder."""
    return DeepAccident(
        "v1", real_root, index_dir=tmp_path_factory.mktemp("real index"), verbose=False
    )


@pytest.fixture(scope="session")
def real_copy(real_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(real_root, tmp_path_factory.mktemp("real") / "release"))
