"""The weights that come with the devkit: their size and notes, what they score, and where they are used."""

import importlib
import json
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from click.testing import CliRunner

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import MissingExtraError
from deepaccident_devkit.model import PredictConfig, load_model, read_weights
from deepaccident_devkit.model.checkpoint import SHIPPED, write_weights
from deepaccident_devkit.model.training_step import validated
from deepaccident_devkit.motion import samples
from deepaccident_devkit.release.layout import write_split_file
from deepaccident_devkit.synth import SynthConfig, make_release

demo: Any = importlib.import_module("deepaccident_devkit.synth.demo")


def test_they_are_small_halves_with_their_provenance() -> None:
    weights = read_weights("tiny")
    assert (weights.path, {each.dtype for each in weights.tensors.values()}) == (SHIPPED["tiny"], {torch.float16})
    assert weights.path.stat().st_size < 1.3e6
    made, study = weights.meta["made"], Path(__file__).parents[3] / "benchmarks" / "cooperation" / "study.json"
    assert (made["seed"], len(made["release"]) > 10) == (made["protocol"]["seeds"][0], True)
    assert json.loads(study.read_text())["weights"]["scores"] == weights.meta["scored"]["scores"]


@pytest.mark.slow
def test_they_score_what_their_notes_say(tmp_path: Path) -> None:
    """On a release that is made again from its seed; another machine may round otherwise, a little."""
    told = read_weights("tiny").meta["scored"]
    synth = {name: tuple(each) if isinstance(each, list) else each for name, each in told["synth"].items()}
    release = DeepAccident("v1", make_release(tmp_path / "release", SynthConfig(**synth)), verbose=False)
    split = tmp_path / "all.txt"
    write_split_file(split, [record["token"] for record in release.scenario])
    found = validated(load_model("tiny"), release, samples(release, split, "all"), PredictConfig(agents=told["agents"]))
    assert found == pytest.approx(told["scores"], abs=0.01)
    assert found["iou"] > 0.02


def test_a_folder_of_that_name_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert read_weights("tiny").path == SHIPPED["tiny"]
    Path("tiny").mkdir()
    write_weights(Path("tiny/best.safetensors"), {"a": torch.ones(2)}, {})
    assert list(read_weights("tiny").tensors) == ["a"]


def test_predict_takes_them_by_their_name(release_root: Path, tmp_path: Path) -> None:
    words = ("predict", "tiny", str(release_root), "--split", "train_mini", "--out", str(tmp_path / "results"))
    result = CliRunner().invoke(deepaccident, words, catch_exceptions=False)
    assert (tmp_path / "results" / "accident.json").is_file()
    told = read_weights("tiny").meta["scored"]["scores"]
    line = result.stdout.splitlines()[-1]
    assert line.startswith("motion, labels clean: IoU ")
    assert f"here; IoU {told['iou']:.1%}, VPQ {told['vpq']:.1%} on 2 synthetic scenarios" in line


def test_the_demo_shows_their_prediction(da: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "_SECONDS_BEFORE", 0.1)  # the release is short
    assert demo.draw_model(da, tmp_path)
    name = demo.MODEL_PICTURE
    assert (tmp_path / name).stat().st_size > 20_000
    page, without = (demo.demo_page([["agents"]], [], model=there) for there in (True, False))
    assert page.index("motion_labels_1s_before.png") < page.index(name)
    assert name not in without
    monkeypatch.setattr("deepaccident_devkit.model.load_model", Mock(side_effect=MissingExtraError("no torch")))
    assert not demo.draw_model(da, tmp_path)
    assert not (tmp_path / name).exists()
