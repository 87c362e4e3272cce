"""Run the commands of docs/clusters.md, as far as one machine can."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from engines.products import Local, opencood_files, read_files
from engines.test_mpi import AS_ROOT, HAS_MPI, OVERSUBSCRIBED

pytestmark = pytest.mark.slow

PAGE = (Path(__file__).parents[2] / "docs" / "clusters.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(bash|python)\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
PROGRAMS = {
    "sbatch": """#!/bin/bash
[[ $1 == --wait && $(cat "$2") =~ --array=1-([0-9]+) ]] || exit 1
for task in $(seq "${BASH_REMATCH[1]}"); do bash -e "$2" >&2 & done
for job in $(jobs -p); do wait "$job" || exit; done
""",
}
"""Scripts that replace a cluster's programs: all tasks run at once, on this host."""


@pytest.fixture
def workspace(local: Local, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with `deepaccident_demo/release`, and with `PROGRAMS` on the path."""
    programs = tmp_path / "bin"
    programs.mkdir()
    for name, script in PROGRAMS.items():
        (programs / name).write_text(script)
        (programs / name).chmod(0o755)
    folder = tmp_path / "work"
    (folder / "deepaccident_demo").mkdir(parents=True)
    (folder / "deepaccident_demo" / "release").symlink_to(local.paths["release"])

    python_folder = Path(sys.executable).parent
    monkeypatch.setenv("PATH", f"{programs}:{python_folder}:{os.environ['PATH']}")
    for name, value in {**AS_ROOT, **OVERSUBSCRIBED}.items():
        monkeypatch.setenv(name, value)
    return folder


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_the_page(local: Local, workspace: Path, number: int) -> None:
    language, code = BLOCKS[number]
    if "mpiexec" in code and not HAS_MPI and not os.environ.get("DEEPACCIDENT_REQUIRE_MPI"):
        pytest.skip("no mpiexec, or no mpi4py")
    # the demo's release has point clouds, but this one has none
    code = code.replace("export opencood ", "export opencood --without-clouds ")
    code = code.replace("OpenCood()", "OpenCood(without_clouds=True)")
    (workspace / "script").write_text(code)
    interpreter = ["bash", "-eu"] if language == "bash" else [sys.executable]
    result = subprocess.run(
        [*interpreter, "script"],
        cwd=workspace,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )

    assert result.returncode == 0, result.stderr
    for folder in (workspace / "out").glob("[!l]*"):
        assert read_files(folder, prefix="opencood/") == opencood_files(local)
