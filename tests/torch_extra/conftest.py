"""Tests of the extra `torch`: not collected where it is not installed, unless
DEEPACCIDENT_REQUIRE_TORCH is set.

(The folder cannot be called `torch`: the tests' folder is on the path, so that it would be found in
torch's place.)
"""

import importlib.util
import os
from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident

HAS_TORCH = importlib.util.find_spec("torch") is not None

if not HAS_TORCH:
    if os.environ.get("DEEPACCIDENT_REQUIRE_TORCH"):
        raise pytest.UsageError("DEEPACCIDENT_REQUIRE_TORCH is set, but torch is not installed")
    collect_ignore = [
        path.name for path in Path(__file__).parent.glob("*.py") if path.name != "test_installed.py"
    ]
    collect_ignore += ["model", "study"]


@pytest.fixture(scope="session")
def sample(da: DeepAccident) -> str:
    """The vehicle with a few frames before and after it, in an accident scenario."""
    return f"{da.scenario[0]['token']}/ego_vehicle/004"


@pytest.fixture(scope="session")
def tokens(da: DeepAccident) -> list[str]:
    """Samples of every agent and scenario."""
    return [record["token"] for record in da.sample if record["token"].endswith("/004")]
