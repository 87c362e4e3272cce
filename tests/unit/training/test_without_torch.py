"""What holds whether torch is installed or not."""

import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from refusals import assert_refused

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import MissingExtraError


def test_without_torch_the_adapter_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [
        name for name in sys.modules if name.startswith("deepaccident_devkit.training.torch")
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingExtraError, match=r"pip install '\.\[torch\]'"):
        from deepaccident_devkit.training.torch import V2XDataset  # noqa: F401


@pytest.mark.parametrize(
    "words", [["train", "x", "--out", "y"], ["predict", "x", "x", "--out", "y"]]
)
def test_without_torch_the_models_commands_name_the_extra(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, words: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("x").mkdir()
    for name in [
        name for name in sys.modules if name.startswith("deepaccident_devkit.plugins.model")
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    assert_refused(
        (
            lambda: CliRunner().invoke(deepaccident, words, catch_exceptions=False),
            MissingExtraError,
            r"the model needs PyTorch.*pip install '\.\[torch\]'",
        )
    )
    assert CliRunner().invoke(deepaccident, [words[0], "--help"]).exit_code == 0


def test_the_devkit_itself_does_not_import_torch() -> None:
    code = (
        "import sys, deepaccident_devkit, deepaccident_devkit.cli; sys.exit('torch' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
