"""Tests of the extra `torch`, which are left out where torch is not installed.

With DEEPACCIDENT_REQUIRE_TORCH set, a missing torch is an error. The folder cannot be called
`torch`: the tests' folder is on the path, so Python would import it instead of the library.
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
    """The ego vehicle's sample in an accident scenario, with frames before and after it."""
    return f"{da.scenario[0]['token']}/ego_vehicle/004"


@pytest.fixture(scope="session")
def tokens(da: DeepAccident) -> list[str]:
    """The samples of frame 4 of every agent and scenario."""
    all_tokens = [record["token"] for record in da.sample]
    return [token for token in all_tokens if token.endswith("/004")]
