"""Fixtures that the tests of the index share."""

from pathlib import Path

import pytest
from support import tiny_release
from support.tiny_release_index import OTHER_SCENARIO


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A release of two scenarios. Its path has a blank in it."""
    tiny_release.write_tiny_release(tmp_path / "deep accident")
    return tiny_release.write_tiny_release(tmp_path / "deep accident", name=OTHER_SCENARIO)
