"""A project of somebody else, for what the plugin does there."""

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
ENTRY_POINTS = re.compile(r"\[project\.entry-points\.pytest11\]\n(.*?)\n\n", re.DOTALL)
INI = "[pytest]\nfilterwarnings = error\naddopts = --strict-config --strict-markers\n"


@dataclass(frozen=True)
class Foreign:
    """A folder of tests, where the devkit is installed with the entry points that pyproject.toml
    names.
    """

    folder: Path
    site: Path

    def pytest(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        path = os.pathsep.join([str(self.site), str(ROOT), os.environ.get("PYTHONPATH", "")])
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments]
        environment = {**os.environ, "PYTHONPATH": path}
        return subprocess.run(
            command, cwd=self.folder, env=environment, capture_output=True, text=True, check=False
        )


@pytest.fixture
def foreign(tmp_path: Path) -> Foreign:
    found = ENTRY_POINTS.search((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert found
    info = tmp_path / "site" / "deepaccident_kit-0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: deepaccident_kit\nVersion: 0\n")
    lines = found[1].replace('"', "")
    (info / "entry_points.txt").write_text(f"[pytest11]\n{lines}\n")
    folder = tmp_path / "project"
    folder.mkdir()
    (folder / "pytest.ini").write_text(INI)
    return Foreign(folder, info.parent)
