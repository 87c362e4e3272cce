"""What holds whether torch is installed or not."""

import subprocess
import sys

import pytest

from deepaccident_devkit.errors import MissingExtraError


def test_without_torch_the_adapter_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("deepaccident_devkit.export.torch")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingExtraError, match=r"pip install '\.\[torch\]'"):
        from deepaccident_devkit.export.torch import V2XDataset  # noqa: F401


def test_the_devkit_itself_does_not_import_torch() -> None:
    code = "import sys, deepaccident_devkit, deepaccident_devkit.cli; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
