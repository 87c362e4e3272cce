"""Every bulk command on two ranks of MPI."""

import importlib.util
import os
import shutil
import sys
from pathlib import Path

import pytest
from engines.products import COMMANDS, Local, contents, done, words

pytestmark = pytest.mark.slow

HERE = shutil.which("mpiexec") is not None and importlib.util.find_spec("mpi4py") is not None
AS_ROOT = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
CROWDED = {"OMPI_MCA_rmaps_base_oversubscribe": "1"}
"""More ranks than cores."""


@pytest.fixture(autouse=True)
def _needs_mpi() -> None:
    if not HERE and not os.environ.get("DEEPACCIDENT_REQUIRE_MPI"):
        pytest.skip("no mpiexec, or no mpi4py")


def test_all_is_the_same(local: Local, tmp_path: Path) -> None:
    for name in COMMANDS:
        line = [sys.executable, "-m", "mpi4py.futures", "-m", "deepaccident_devkit.cli"]
        line += [*words(name, {**local.places, "out": tmp_path}), "--scheduler", "mpi"]
        printed = done(["mpiexec", "-n", "2", *line], **AS_ROOT, **CROWDED)
        if name == "validate":
            assert printed == local.printed
    assert contents(tmp_path) == local.files
