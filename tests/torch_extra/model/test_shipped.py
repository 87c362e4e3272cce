"""The weights that come with the devkit: their size and notes, what they score, and where they are
used.
"""

import importlib
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from click.testing import CliRunner

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import MissingExtraError
from deepaccident_devkit.plugins.model import read_weights
from deepaccident_devkit.plugins.model.checkpoint import SHIPPED_FILES, write_weights

demo: Any = importlib.import_module("deepaccident_devkit.plugins.synth.demo")


@pytest.mark.parametrize("name", SHIPPED_FILES)
def test_they_are_small_halves_with_their_provenance(name: str) -> None:
    weights = read_weights(name)
    assert (weights.path, {each.dtype for each in weights.tensors.values()}) == (
        SHIPPED_FILES[name],
        {torch.float16},
    )
    assert weights.path.stat().st_size < 1.3e6
    made = weights.meta["made"]
    assert (weights.meta["preset"], made["seed"], len(made["release"]) > 10) == (name, 1, True)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED_FILES)
def test_they_score_what_their_notes_say(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a release that is made again from its seed; another machine may round otherwise, a
    little.
    """
    monkeypatch.syspath_prepend(str(Path(__file__).parents[3]))
    from benchmarks.shipping import scores

    told = read_weights(name).meta["scored"]
    assert scores(SHIPPED_FILES[name], told) == pytest.approx(told["scores"], abs=0.01)
    assert told["scores"]["iou"] > 0.1


def test_a_folder_of_that_name_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert read_weights("tiny").path == SHIPPED_FILES["tiny"]
    Path("tiny").mkdir()
    write_weights(Path("tiny/best.safetensors"), {"a": torch.ones(2)}, {})
    assert list(read_weights("tiny").tensors) == ["a"]


@pytest.mark.parametrize("name", SHIPPED_FILES)
def test_predict_takes_them_by_their_name(name: str, release_root: Path, tmp_path: Path) -> None:
    words = (
        "predict",
        name,
        str(release_root),
        "--split",
        "train_mini",
        "--out",
        str(tmp_path / "results"),
    )
    result = CliRunner().invoke(deepaccident, words, catch_exceptions=False)
    assert (tmp_path / "results" / "accident.json").is_file()
    told = read_weights(name).meta["scored"]["scores"]
    line = result.stdout.splitlines()[-1]
    assert line.startswith("motion, labels clean: IoU ")
    assert f"here; IoU {told['iou']:.1%}, VPQ {told['vpq']:.1%} on 2 synthetic scenarios" in line


def test_the_demo_shows_their_prediction(
    da: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, "_SECONDS_BEFORE", 0.1)  # the release is short
    written = Mock(side_effect=demo.write_beside)
    monkeypatch.setattr(demo, "write_beside", written)
    assert demo.draw_model(da, tmp_path)
    assert (
        sorted(call.args[1] for call in written.call_args_list) == ["ego"] * 4 + ["other"] * 4
    )  # in four panels
    name = demo.MODEL_PICTURE
    assert (tmp_path / name).stat().st_size > 20_000
    monkeypatch.setattr(
        "deepaccident_devkit.plugins.model.load_model",
        Mock(side_effect=MissingExtraError("no torch")),
    )
    assert not demo.draw_model(da, tmp_path)
    assert not (tmp_path / name).exists()
