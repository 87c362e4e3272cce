"""Every bulk command on two ranks of MPI."""

import importlib.util
import os
import shutil
import sys
from pathlib import Path

import pytest
from engines.products import COMMANDS, Local, command_line, read_files, run

pytestmark = pytest.mark.slow

HAS_MPI = shutil.which("mpiexec") is not None and importlib.util.find_spec("mpi4py") is not None
AS_ROOT = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
OVERSUBSCRIBED = {"OMPI_MCA_rmaps_base_oversubscribe": "1"}
"""Allows more ranks than cores."""


@pytest.fixture(autouse=True)
def _needs_mpi() -> None:
    if not HAS_MPI and not os.environ.get("DEEPACCIDENT_REQUIRE_MPI"):
        pytest.skip("no mpiexec, or no mpi4py")


def test_every_command_writes_the_same(local: Local, tmp_path: Path) -> None:
    for name in COMMANDS:
        command = ["mpiexec", "-n", "2", sys.executable]
        command += ["-m", "mpi4py.futures", "-m", "deepaccident_devkit.cli"]
        command += command_line(name, {**local.paths, "out": tmp_path})
        printed = run([*command, "--scheduler", "mpi"], **AS_ROOT, **OVERSUBSCRIBED)
        if name == "validate":
            assert printed == local.printed

    assert read_files(tmp_path) == local.files
