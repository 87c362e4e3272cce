from collections.abc import Sequence
from pathlib import Path

import pytest

from fault_injection.run import Outcome, list_jobs, make_healthy, run


@pytest.fixture(scope="session")
def healthy_release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Release of an accident and its normal twin with all sensors; tests must not change it."""
    return make_healthy(tmp_path_factory.mktemp("fault_injection"))


@pytest.fixture(scope="session")
def release_copy(healthy_release: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Copy of the healthy release made of hard links: replace its files, never write into them."""
    import os
    import shutil

    root = tmp_path_factory.mktemp("fault_injection") / "copy"
    shutil.copytree(healthy_release, root, copy_function=os.link)
    return root


@pytest.fixture(scope="session")
def outcomes(healthy_release: Path) -> Sequence[Outcome]:
    """What `validate` found after each of the mutations."""
    return run(healthy_release, list_jobs())
