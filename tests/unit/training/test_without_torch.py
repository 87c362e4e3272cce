"""What holds whether torch is installed or not."""

import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from support.expected_errors import assert_raises

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import MissingExtraError


def hide_torch(monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    """Make torch impossible to import, and forget the modules of a package that imported it."""
    module_names = [name for name in sys.modules if name.startswith(package)]
    for name in module_names:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)


def test_without_torch_the_adapter_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    hide_torch(monkeypatch, "deepaccident_devkit.training.torch")
    with pytest.raises(MissingExtraError, match=r"pip install '\.\[torch\]'"):
        from deepaccident_devkit.training.torch import V2XDataset  # noqa: F401


@pytest.mark.parametrize(
    "arguments", [["train", "x", "--out", "y"], ["predict", "x", "x", "--out", "y"]]
)
def test_without_torch_the_models_commands_name_the_extra(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, arguments: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("x").mkdir()
    hide_torch(monkeypatch, "deepaccident_devkit.plugins.model")
    assert_raises(
        (
            lambda: CliRunner().invoke(deepaccident, arguments, catch_exceptions=False),
            MissingExtraError,
            r"the model needs PyTorch.*pip install '\.\[torch\]'",
        )
    )
    assert CliRunner().invoke(deepaccident, [arguments[0], "--help"]).exit_code == 0


def test_the_devkit_itself_does_not_import_torch() -> None:
    code = (
        "import sys, deepaccident_devkit, deepaccident_devkit.cli; sys.exit('torch' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
