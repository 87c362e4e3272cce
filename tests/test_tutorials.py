"""The notebooks run from top to bottom on synthetic releases, and are stored without outputs."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from deepaccident_devkit import DeepAccident

pytestmark = pytest.mark.slow

TUTORIALS = Path(__file__).parents[1] / "tutorials"
LAST_WORDS = {
    "01_first_steps": "gap one frame before",
    "02_v2x": "seen by the ego alone",
    "03_motion_labels": "the fastest actor's flow",
    "04_evaluate": "'100x100': (100.0, 100.0)",
    "05_own_scenario": "gap 0.050 m, sides ('right', 'front'), angle 90 degrees",
}
"""What each notebook prints last, where it lets its reader check something."""
NEEDS_SENSORS = ("01_first_steps", "02_v2x")
SECONDS = 300


def read(name: str) -> nbformat.NotebookNode:
    return nbformat.read(TUTORIALS / f"{name}.ipynb", as_version=4)


def test_every_notebook_is_run_and_listed() -> None:
    assert sorted(path.stem for path in TUTORIALS.glob("*.ipynb")) == sorted(LAST_WORDS)
    page = (TUTORIALS / "README.md").read_text(encoding="utf-8")
    assert [name for name in LAST_WORDS if f"({name}.ipynb)" not in page] == []


@pytest.mark.parametrize("name", LAST_WORDS)
def test_notebook_is_stored_without_outputs_and_begins_with_what_installs_the_devkit(
    name: str,
) -> None:
    code = [cell for cell in read(name).cells if cell.cell_type == "code"]
    assert [cell.id for cell in code if cell.outputs or cell.execution_count is not None] == []
    wanted = ("except ModuleNotFoundError:", "\n    %pip install --quiet '..[synth]'")
    assert [each for each in wanted if each not in code[0].source] == []


@pytest.mark.parametrize("name", LAST_WORDS)
@pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_client|zmq|nbclient|asyncio")
def test_notebook_runs(
    name: str,
    release_root: Path,
    da_motion: DeepAccident,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(
        "DEEPACCIDENT", str(release_root if name in NEEDS_SENSORS else da_motion.dataroot)
    )
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    notebook = read(name)
    NotebookClient(
        notebook,
        timeout=SECONDS,
        kernel_name="python3",
        resources={"metadata": {"path": str(TUTORIALS)}},
    ).execute()
    last = next(cell for cell in reversed(notebook.cells) if cell.cell_type == "code")
    assert LAST_WORDS[name] in last.outputs[0].text
