"""The notebooks run from top to bottom on the session's release, and are stored without outputs."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

TUTORIALS = Path(__file__).parents[1] / "tutorials"
NOTEBOOKS = sorted(TUTORIALS.glob("*.ipynb"))


def test_there_are_notebooks() -> None:
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
@pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_client|zmq|nbclient|asyncio")
def test_notebook_runs(path: Path, release_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook = nbformat.read(path, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "store notebooks without outputs"
    monkeypatch.setenv("DEEPACCIDENT", str(release_root))
    NotebookClient(
        notebook, timeout=120, kernel_name="python3", resources={"metadata": {"path": str(TUTORIALS)}}
    ).execute()
    last = next(cell for cell in reversed(notebook.cells) if cell.cell_type == "code")
    assert "gap one frame before" in last.outputs[0].text
