"""The commands of docs/clusters.md, as far as one machine can run them."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from engines.products import Local, contents
from engines.test_mpi import AS_ROOT, CROWDED, HERE

pytestmark = pytest.mark.slow

PAGE = (Path(__file__).parents[2] / "docs" / "clusters.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(bash|python)\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
PROGRAMS = {
    "ssh": '#!/bin/bash\nshift\nexec bash -c "$*"\n',
    "sbatch": """#!/bin/bash
[[ $1 == --wait && $(cat "$2") =~ --array=1-([0-9]+) ]] || exit 1
for each in $(seq "${BASH_REMATCH[1]}"); do bash -e "$2" >&2 & done
for job in $(jobs -p); do wait "$job" || exit; done
""",
}
"""Programs of a cluster that stand for themselves here: one host, all tasks at once."""


@pytest.fixture
def place(local: Local, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with `deepaccident_demo/release`, where those programs are found."""
    (tmp_path / "bin").mkdir()
    for name, script in PROGRAMS.items():
        (tmp_path / "bin" / name).write_text(script)
        (tmp_path / "bin" / name).chmod(0o755)
    (tmp_path / "work" / "deepaccident_demo").mkdir(parents=True)
    (tmp_path / "work" / "deepaccident_demo" / "release").symlink_to(local.places["release"])
    own = Path(sys.executable).parent
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{own}:{os.environ['PATH']}")
    for name, value in {**AS_ROOT, **CROWDED}.items():
        monkeypatch.setenv(name, value)
    return tmp_path / "work"


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_the_page(local: Local, place: Path, number: int) -> None:
    language, code = BLOCKS[number]
    if "mpiexec" in code and not HERE and not os.environ.get("DEEPACCIDENT_REQUIRE_MPI"):
        pytest.skip("no mpiexec, or no mpi4py")
    # the demo's release has point clouds, and the one here none
    code = code.replace("export opencood ", "export opencood --without-clouds ").replace(
        "OpenCood()", "OpenCood(without_clouds=True)"
    )
    (place / "script").write_text(code)
    run = ["bash", "-eu", "script"] if language == "bash" else [sys.executable, "script"]
    ended = subprocess.run(run, cwd=place, capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 0, ended.stderr
    exported = {
        path: content for path, content in local.files.items() if path.startswith("opencood/")
    }
    for folder in (place / "out").glob("[!l]*"):
        assert {
            f"opencood/{path}": content for path, content in contents(folder).items()
        } == exported
