from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for files that every example of a property overwrites."""
    return tmp_path_factory.mktemp("properties")
