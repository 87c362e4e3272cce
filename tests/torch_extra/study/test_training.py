"""Studies with models: trained weights, control inputs, killed runs, and refused recipes."""

import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
import torch
from support.study_recipes import BASELINE_RECIPE, kill_study, write_recipe
from torch_extra.compared import are_identical

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.plugins.baselines import detected_accidents
from deepaccident_devkit.plugins.model import PredictConfig, load_model, predictions, read_weights
from deepaccident_devkit.plugins.model.presets import tiny
from deepaccident_devkit.plugins.study import read_recipe, run_study
from deepaccident_devkit.plugins.study.predict import (
    blanked,
    predictions_of,
    strangers_of,
    with_strangers,
)
from deepaccident_devkit.plugins.study.recipe import StudyRow
from deepaccident_devkit.plugins.study.summary import ALL
from deepaccident_devkit.training.torch import V2XDataset

SMALL_RELEASE = {
    "scenarios": 2,
    "frames": 8,
    "image_size": [64, 36],
    "sensors": "cameras",
    "view": "hidden",
    "designs": [1],
}
TRAINING_PLAN = {"release": "training", "save_every": 1, "egos": 1}
RECIPE: dict[str, Any] = {
    **BASELINE_RECIPE,
    "releases": {
        "training": {"seed": 201, **SMALL_RELEASE},
        "test": {"seed": 203, **SMALL_RELEASE, "scenarios": 4},
    },
    "seeds": [1, 2],
    "weights": {
        "trunk": {**TRAINING_PLAN, "steps": 3},
        "max": {
            **TRAINING_PLAN,
            "from": "trunk",
            "fusion": "max",
            "steps": 2,
            "freeze": ["img_backbone."],
        },
        "given": {"file": "tiny"},
        "near": {**TRAINING_PLAN, "horizon": 0.5, "steps": 1},
    },
    "test": {"release": "test", "labels": "clean", "horizon": 0.5},
    "headline": {"row": "all", "less": "single", "number": "iou_100"},
    "rows": [
        {"name": "{agents}", "weights": "trunk", "agents": ["single", "all"]},
        {"name": "black", "weights": "trunk", "control": "blank"},
        {"name": "strangers", "weights": "trunk", "control": "strangers"},
        {"name": "max", "weights": "max"},
        {"name": "given", "weights": "given"},
        {"name": "near", "weights": "near"},
        {"name": "sees all", "baseline": "constant_velocity"},
    ],
    "groups": {},
    "compare": [["all", "sees all"]],
}
MODEL_PACKAGE = "deepaccident_devkit.plugins.model"


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models")
    run_recipe(folder, RECIPE, folder / "out")
    return folder / "out"


def run_recipe(folder: Path, recipe: dict[str, Any], out: Path) -> None:
    path = write_recipe(folder, recipe)
    run_study(read_recipe(str(path)), out, device="cpu", workers=1)


@pytest.fixture
def summary(out: Path) -> dict[str, Any]:
    text = (out / "mine" / "study.json").read_text(encoding="utf-8")
    document: dict[str, Any] = json.loads(text)
    return document


@pytest.mark.slow
def test_each_seed_is_a_model_and_weights_begin_from_their_own(
    out: Path, summary: dict[str, Any]
) -> None:
    cells = [cell for cell in summary["cells"] if cell["kind"] == "weights"]
    folders = {cell["name"]: out / "weights" / cell["key"] for cell in cells}
    assert list(folders) == [
        "trunk, seed 1",
        "trunk, seed 2",
        "max, seed 1",
        "max, seed 2",
        "given",
        "near, seed 1",
        "near, seed 2",
    ]
    for seed in (1, 2):
        notes = read_weights(folders[f"max, seed {seed}"]).meta
        assert notes["from"] == str(folders[f"trunk, seed {seed}"])
        assert (notes["preset"], notes["fusion"]) == ("tiny", "max")
        assert notes["training"]["seed"] == seed
        assert notes["training"]["freeze"] == ["img_backbone."]

    rows, comparison = summary["rows"], summary["comparisons"][1]
    assert list(rows["all"]["groups"][ALL]["apa"]["seeds"]) == ["1", "2"]
    assert rows["given"]["groups"][ALL]["apa"]["seeds"] == {}
    assert list(comparison["groups"][ALL]["iou_100"]["seeds"]) == ["1", "2"]
    assert summary["groups"][ALL] == {"samples": 4, "pairs": 2}


@pytest.mark.slow
def test_a_killed_study_ends_as_an_undisturbed_one(out: Path, tmp_path: Path) -> None:
    path = write_recipe(tmp_path, RECIPE)
    killed_out = tmp_path / "out"

    # in the second training; the trunks of both seeds are trained first
    kill_study(path, killed_out, f"{MODEL_PACKAGE}.training_loop", "add_to_log", 4)
    logs = [folder / "log.jsonl" for folder in (killed_out / "weights").iterdir()]
    assert sorted(len(log.read_text().splitlines()) for log in logs) == [1, 3]
    # in the first row, and in a later one
    kill_study(path, killed_out, f"{MODEL_PACKAGE}.results", "prediction_of", 2)
    kill_study(path, killed_out, "deepaccident_devkit.plugins.study.predict", "blanked", 1)
    run_study(read_recipe(str(path)), killed_out, device="cpu", workers=2)

    for name in ("counts.json.gz", "tables/rows.csv", "tables/comparisons.csv"):
        assert (killed_out / "mine" / name).read_bytes() == (out / "mine" / name).read_bytes()


def read_cell_times(out: Path) -> dict[Path, int]:
    paths = [path for path in (out / "cells" / "kept").rglob("*") if path.is_file()]
    return {path: path.stat().st_mtime_ns for path in paths}


@pytest.mark.slow
def test_changed_steps_remake_only_their_weights_and_rows(out: Path, tmp_path: Path) -> None:
    before = read_cell_times(out)
    weights = {
        **RECIPE["weights"],
        "max": {**RECIPE["weights"]["max"], "steps": 1},
    }

    run_recipe(tmp_path, {**RECIPE, "weights": weights}, out)

    after = read_cell_times(out)
    assert before.items() < after.items()
    new_paths = after.keys() - before.keys()
    assert sorted(path.parent.name for path in new_paths) == ["row"] * 2 + ["weights"] * 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"preset": "tiny_"}, "mine: weights.trunk: .*'tiny_'"),
        ({"stepps": 3}, "mine: weights.trunk: key: expected one of .*did you mean 'steps'"),
        ({"seed": 3}, "mine: weights.trunk: key: expected one of .*found 'seed'"),
        ({"steps": 0}, "mine: weights.trunk: steps: expected a whole number from 1, found 0"),
        ({"steps": "many"}, r"mine: weights.trunk: expected `int`, got `str` - at `\$.steps`"),
        ({"horizon": 0.7}, "mine: weights.trunk: horizon: 0.7 s is not a multiple"),
    ],
)
def test_impossible_weights_are_refused_before_anything_is_trained(
    changes: dict[str, Any], message: str, da: DeepAccident, tmp_path: Path
) -> None:
    recipe = {
        **BASELINE_RECIPE,
        "releases": {"test": {"dataroot": str(da.dataroot)}},
        "test": {**RECIPE["test"], "includes_training": True},
        "weights": {"trunk": {"release": "test", **changes}},
        "rows": [{"name": "one", "weights": "trunk"}],
        "compare": [],
        "headline": {"row": "one", "less": "one"},
        "groups": {},
    }
    with pytest.raises(ConfigError, match=message):
        run_recipe(tmp_path, recipe, tmp_path / "out")


def copy_with_other_numbers(root: Path, copy: Path) -> str:
    """Copy a release without sensors, and give its scenarios other numbers."""
    shutil.copytree(
        root,
        copy,
        ignore=shutil.ignore_patterns(".deepaccident", "Camera_*", "lidar01"),
    )
    for path in sorted(copy.rglob("*scenario0*"), key=lambda path: -len(path.parts)):
        path.rename(path.with_name(path.name.replace("scenario0", "scenario7")))
    for split in copy.glob("*.txt"):
        split.write_text(split.read_text().replace("scenario0", "scenario7"))
    return str(copy)


@pytest.mark.parametrize(
    ("plan", "source"),
    [
        ({"release": "here"}, "here, all"),
        ({"release": "here", "split": "train"}, "here, train"),
        ({"release": "other", "also": "here"}, "here, all"),
        ({"release": "other", "also": "here", "also_split": "train"}, "here, train"),
        ({"release": "here", "split": "test", "validation": "train"}, "here, train"),
        ({"release": "copy", "split": "train"}, "copy, train"),
        ({"release": "other", "also": "copy"}, "copy, all"),
    ],
)
def test_a_training_that_shows_the_test_is_refused(
    plan: dict[str, Any], source: str, da: DeepAccident, da_b: DeepAccident, tmp_path: Path
) -> None:
    """The refusal comes before anything is trained, and the recipe can allow the training."""
    copy = copy_with_other_numbers(da.dataroot, tmp_path / "copy")
    recipe = {
        **RECIPE,
        "releases": {
            "here": {"dataroot": str(da.dataroot)},
            "other": {"dataroot": str(da_b.dataroot)},
            "copy": {"dataroot": copy},
        },
        "weights": {
            "one": {"release": "other", "preset": "tiny_"},
            "two": {"preset": "tiny", **plan},
        },
        "rows": [{"name": "all", "weights": "two"}],
        "test": {"release": "here", "split": "train", "labels": "clean", "horizon": 0.5},
        "headline": None,
        "compare": [],
    }
    out = tmp_path / "out"
    with pytest.raises(
        ConfigError, match=f"mine: weights.two: {source}: contains .* scenarios of the test"
    ) as raised:
        run_recipe(tmp_path, recipe, out)
    assert "also_split" in str(raised.value)
    assert "includes_training: true" in str(raised.value)
    assert not (out / "weights").exists()

    allowed_recipe = {**recipe, "test": {**recipe["test"], "includes_training": True}}
    with pytest.raises(ConfigError, match=r"mine: weights.one: .*'tiny_'"):  # the next fault
        run_recipe(tmp_path, allowed_recipe, out)


@pytest.fixture(scope="module")
def items(da: DeepAccident) -> list[Any]:
    """The item of a sample, and the item of a stranger from another pair of scenarios."""
    tokens = [f"{scenario['token']}/ego_vehicle/004" for scenario in da.scenario]
    pair = [tokens[0], strangers_of(tokens)[0]]
    config = tiny().inputs("all", points=True)
    return [V2XDataset(da, [token], config)[0] for token in pair]


def test_blank_inputs_have_black_images_and_no_points(items: list[Any]) -> None:
    item = items[0]
    blank = blanked(item)
    assert not blank["images"].any()
    assert blank["images"].shape == item["images"].shape
    clouds = [cloud for agent_clouds in blank["points"] for cloud in agent_clouds]
    assert {tuple(cloud.shape) for cloud in clouds} == {(0, 4)}
    for name in ("intrinsics", "ego_from_agent", "agent_valid"):
        assert torch.equal(blank[name], item[name])


def test_strangers_bring_sensors_and_poses_and_ego_keeps_its_own(items: list[Any]) -> None:
    item, stranger = items
    mixed = with_strangers(item, stranger)
    for name in (
        "images",
        "intrinsics",
        "ego_from_camera",
        "image_from_ego",
        "agent_from_past",
        "ego_from_agent",
    ):
        assert torch.equal(mixed[name][0], item[name][0])
        assert torch.equal(mixed[name][1:], stranger[name][1:])
    for agent, source in enumerate((item, stranger)):
        assert are_identical(mixed["points"][agent], source["points"][agent])
    assert not torch.equal(item["images"][1:], stranger["images"][1:])


def test_a_row_predicts_as_the_model_does(da: DeepAccident) -> None:
    torch.set_num_threads(1)  # as for rows; with more threads, sums are rounded differently
    tokens = [f"{da.scenario[0]['token']}/ego_vehicle/004"]
    row = StudyRow(name="all", weights="a")
    weights = read_weights("tiny").path

    [prediction] = predictions_of(row, weights, "cpu", da, tokens, tiny().labels)
    [expected] = predictions(load_model("tiny"), da, tokens, PredictConfig())

    token, (motion, accidents, boxes) = prediction
    assert token == expected.token
    assert select_alarms(accidents) == select_alarms(expected.accidents)
    assert (boxes.scores == expected.boxes.scores).all()
    assert motion.heads is not None
    assert expected.motion.heads is not None
    assert (motion.heads[-1].centerness == expected.motion.heads[-1].centerness).all()

    with pytest.raises(
        ConfigError,
        match="was trained with the labels clean; set `labels: clean` in",
    ):
        list(predictions_of(row, weights, "cpu", da, tokens, MotionLabelConfig()))


def select_alarms(accidents: Iterable[Any]) -> list[tuple[float, float]]:
    return [(accident.time, accident.score) for accident in accidents]


def test_a_row_of_weights_and_a_baseline_has_alarms_from_the_boxes(
    da: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.set_num_threads(1)
    # the weights give low scores on this release
    monkeypatch.setattr("deepaccident_devkit.plugins.baselines.predict._MIN_BOX_SCORE", 0.0)
    tokens = [f"{scenario['token']}/ego_vehicle/004" for scenario in da.scenario]
    row = StudyRow(name="boxes", weights="a", baseline="constant_velocity")
    weights = read_weights("tiny_lidar").path

    predicted = dict(predictions_of(row, weights, "cpu", da, tokens, tiny().labels))

    for token, (_, accidents, boxes) in predicted.items():
        expected = detected_accidents(da, token, boxes)
        assert select_alarms(accidents) == select_alarms(expected)
    assert any(accidents for _, accidents, _ in predicted.values())
