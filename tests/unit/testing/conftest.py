"""A foreign project, to test what the plugin does there."""

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
    """A folder of tests; the devkit is installed with the entry points of pyproject.toml."""

    folder: Path
    site: Path

    def pytest(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        python_path = os.pathsep.join([str(self.site), str(ROOT), os.environ.get("PYTHONPATH", "")])
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments]
        environment = {**os.environ, "PYTHONPATH": python_path}
        return subprocess.run(
            command, cwd=self.folder, env=environment, capture_output=True, text=True, check=False
        )


@pytest.fixture
def foreign(tmp_path: Path) -> Foreign:
    entry_points = ENTRY_POINTS.search((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert entry_points
    metadata_folder = tmp_path / "site" / "deepaccident_kit-0.dist-info"
    metadata_folder.mkdir(parents=True)
    (metadata_folder / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: deepaccident_kit\nVersion: 0\n"
    )
    lines = entry_points[1].replace('"', "")  # INI instead of TOML
    (metadata_folder / "entry_points.txt").write_text(f"[pytest11]\n{lines}\n")
    folder = tmp_path / "project"
    folder.mkdir()
    (folder / "pytest.ini").write_text(INI)
    return Foreign(folder, metadata_folder.parent)
