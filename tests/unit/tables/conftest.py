"""Fixtures that the tests of the index share."""

from pathlib import Path

import pytest
import tiny
from tiny_index import OTHER


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A release of two scenarios. Its path has a blank in it."""
    tiny.write_tiny_release(tmp_path / "deep accident")
    return tiny.write_tiny_release(tmp_path / "deep accident", name=OTHER)
