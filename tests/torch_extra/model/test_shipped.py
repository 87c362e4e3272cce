"""The weights that come with the devkit: their size, notes, scores and uses."""

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
def test_shipped_weights_are_small_float16_files_with_their_provenance(name: str) -> None:
    weights = read_weights(name)
    assert weights.path == SHIPPED_FILES[name]
    assert {tensor.dtype for tensor in weights.tensors.values()} == {torch.float16}
    assert weights.path.stat().st_size < 1.3e6

    provenance = weights.meta["made"]
    assert (weights.meta["preset"], provenance["seed"]) == (name, 1)
    assert len(provenance["release"]) > 10


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED_FILES)
def test_shipped_weights_score_what_their_notes_say(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The release is generated again from its seed; another machine may round differently."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[3]))
    from benchmarks.shipping import scores

    notes = read_weights(name).meta["scored"]
    assert scores(SHIPPED_FILES[name], notes) == pytest.approx(notes["scores"], abs=0.01)
    assert notes["scores"]["iou"] > 0.1


def test_a_folder_of_the_same_name_comes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert read_weights("tiny").path == SHIPPED_FILES["tiny"]
    Path("tiny").mkdir()
    write_weights(Path("tiny/best.safetensors"), {"a": torch.ones(2)}, {})
    assert list(read_weights("tiny").tensors) == ["a"]


@pytest.mark.parametrize("name", SHIPPED_FILES)
def test_predict_takes_shipped_weights_by_name(
    name: str, release_root: Path, tmp_path: Path
) -> None:
    out = tmp_path / "results"
    command = ("predict", name, str(release_root), "--split", "train_mini", "--out", str(out))

    result = CliRunner().invoke(deepaccident, command, catch_exceptions=False)

    assert (out / "accident.json").is_file()
    line = result.stdout.splitlines()[-1]
    assert line.startswith("motion, labels clean: IoU ")
    scores = read_weights(name).meta["scored"]["scores"]
    noted = f"IoU {scores['iou']:.1%}, VPQ {scores['vpq']:.1%} on 2 synthetic scenarios"
    assert f"on these samples; {noted}" in line


def test_the_demo_shows_the_prediction_of_shipped_weights(
    da: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, "_SECONDS_BEFORE", 0.1)  # the release is short
    write_beside = Mock(side_effect=demo.write_beside)
    monkeypatch.setattr(demo, "write_beside", write_beside)
    picture = tmp_path / demo.MODEL_PICTURE

    assert demo.draw_model(da, tmp_path)
    titles = sorted(call.args[1] for call in write_beside.call_args_list)
    assert titles == ["ego"] * 4 + ["other"] * 4  # in four panels
    assert picture.stat().st_size > 20_000

    monkeypatch.setattr(
        "deepaccident_devkit.plugins.model.load_model",
        Mock(side_effect=MissingExtraError("no torch")),
    )
    assert not demo.draw_model(da, tmp_path)
    assert not picture.exists()
