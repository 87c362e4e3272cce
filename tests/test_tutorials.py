"""The notebooks run from top to bottom on synthetic releases, and are stored without outputs."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from deepaccident_devkit import DeepAccident

pytestmark = pytest.mark.slow

TUTORIALS = Path(__file__).parents[1] / "tutorials"
LAST_OUTPUT = {
    "01_first_steps": "gap one frame before",
    "02_v2x": "seen by the ego alone",
    "03_motion_labels": "the fastest actor's flow",
    "04_evaluate": "'100x100': (100.0, 100.0)",
    "05_own_scenario": "gap 0.050 m, sides ('right', 'front'), angle 90 degrees",
}
"""Notebook → a part of its last output, which lets its reader check something."""
NEEDS_SENSORS = ("01_first_steps", "02_v2x")
TIMEOUT_S = 300


def read_notebook(name: str) -> nbformat.NotebookNode:
    return nbformat.read(TUTORIALS / f"{name}.ipynb", as_version=4)


def test_every_notebook_is_run_and_listed() -> None:
    assert sorted(path.stem for path in TUTORIALS.glob("*.ipynb")) == sorted(LAST_OUTPUT)
    page = (TUTORIALS / "README.md").read_text(encoding="utf-8")
    assert [name for name in LAST_OUTPUT if f"({name}.ipynb)" not in page] == []


@pytest.mark.parametrize("name", LAST_OUTPUT)
def test_notebook_is_stored_without_outputs_and_begins_by_installing_the_devkit(
    name: str,
) -> None:
    cells = [cell for cell in read_notebook(name).cells if cell.cell_type == "code"]
    executed_cells = [cell for cell in cells if cell.outputs or cell.execution_count is not None]
    assert executed_cells == []
    assert "except ModuleNotFoundError:" in cells[0].source
    assert "\n    %pip install --quiet '..[synth]'" in cells[0].source


@pytest.mark.parametrize("name", LAST_OUTPUT)
@pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_client|zmq|nbclient|asyncio")
def test_notebook_runs(
    name: str,
    release_root: Path,
    da_motion: DeepAccident,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    root = release_root if name in NEEDS_SENSORS else da_motion.dataroot
    monkeypatch.setenv("DEEPACCIDENT", str(root))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    notebook = read_notebook(name)
    client = NotebookClient(
        notebook,
        timeout=TIMEOUT_S,
        kernel_name="python3",
        resources={"metadata": {"path": str(TUTORIALS)}},
    )

    client.execute()

    last_cell = next(cell for cell in reversed(notebook.cells) if cell.cell_type == "code")
    assert LAST_OUTPUT[name] in last_cell.outputs[0].text
