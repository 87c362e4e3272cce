"""Studies with models: what is trained, what spoilt inputs are, and that a killed run ends as one
that was not.
"""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from studies import BASELINES, killed, written

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

SMALL = {
    "scenarios": 2,
    "frames": 8,
    "image_size": [64, 36],
    "sensors": "cameras",
    "view": "hidden",
    "designs": [1],
}
TRAINED = {"release": "training", "save_every": 1, "egos": 1}
MODELS: dict[str, Any] = {
    **BASELINES,
    "releases": {
        "training": {"seed": 201, **SMALL},
        "test": {"seed": 203, **SMALL, "scenarios": 4},
    },
    "seeds": [1, 2],
    "weights": {
        "trunk": {**TRAINED, "steps": 3},
        "max": {
            **TRAINED,
            "from": "trunk",
            "fusion": "max",
            "steps": 2,
            "freeze": ["img_backbone."],
        },
        "given": {"file": "tiny"},
        "near": {**TRAINED, "horizon": 0.5, "steps": 1},
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
MODULE = "deepaccident_devkit.plugins.model.training_loop"


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the study of models has run."""
    folder = tmp_path_factory.mktemp("models")
    run_study(read_recipe(str(written(folder, MODELS))), folder / "out", device="cpu", workers=1)
    return folder / "out"


@pytest.fixture
def summary(out: Path) -> dict[str, Any]:
    told: dict[str, Any] = json.loads((out / "mine" / "study.json").read_text(encoding="utf-8"))
    return told


@pytest.mark.slow
def test_each_seed_is_a_model_and_weights_begin_from_their_own(
    out: Path, summary: dict[str, Any]
) -> None:
    cells = {each["name"]: each for each in summary["cells"] if each["kind"] == "weights"}
    folders = {name: out / "weights" / each["key"] for name, each in cells.items()}
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
        noted = read_weights(folders[f"max, seed {seed}"]).meta
        assert noted["from"] == str(folders[f"trunk, seed {seed}"])
        assert (noted["preset"], noted["fusion"], noted["training"]["seed"]) == (
            "tiny",
            "max",
            seed,
        )
        assert noted["training"]["freeze"] == ["img_backbone."]
    assert [*summary["rows"]["all"]["groups"][ALL]["apa"]["seeds"]] == ["1", "2"]
    assert summary["rows"]["given"]["groups"][ALL]["apa"]["seeds"] == {}
    assert [*summary["comparisons"][1]["groups"][ALL]["iou_100"]["seeds"]] == ["1", "2"]
    assert summary["groups"][ALL] == {"samples": 4, "pairs": 2}


@pytest.mark.slow
def test_a_run_that_was_killed_ends_as_one_that_was_not(out: Path, tmp_path: Path) -> None:
    """Amid the second training, then amid the first row, then amid a later one."""
    path, again = written(tmp_path, MODELS), tmp_path / "out"
    killed(path, again, MODULE, "add_to_log", 4)
    steps = sorted(
        len((each / "log.jsonl").read_text().splitlines()) for each in (again / "weights").iterdir()
    )
    assert steps == [1, 3]  # of two seeds; those that begin from nothing come first
    killed(path, again, "deepaccident_devkit.plugins.model.results", "prediction_of", 2)
    killed(path, again, "deepaccident_devkit.plugins.study.predict", "blanked", 1)
    run_study(read_recipe(str(path)), again, device="cpu", workers=2)
    for name in ("counts.json.gz", "tables/rows.csv", "tables/comparisons.csv"):
        assert (again / "mine" / name).read_bytes() == (out / "mine" / name).read_bytes()


@pytest.mark.slow
def test_other_steps_make_those_weights_and_their_rows_alone(out: Path, tmp_path: Path) -> None:
    before = {
        path: path.stat().st_mtime_ns
        for path in (out / "cells" / "kept").rglob("*")
        if path.is_file()
    }
    changed = {
        **MODELS,
        "weights": {**MODELS["weights"], "max": {**MODELS["weights"]["max"], "steps": 1}},
    }
    run_study(read_recipe(str(written(tmp_path, changed))), out, device="cpu", workers=1)
    after = {
        path: path.stat().st_mtime_ns
        for path in (out / "cells" / "kept").rglob("*")
        if path.is_file()
    }
    assert before.items() < after.items()
    assert (
        sorted(path.parent.name for path in after.keys() - before.keys())
        == ["row"] * 2 + ["weights"] * 2
    )


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"preset": "tiny_"}, "mine: weights.trunk: .*'tiny_'"),
        ({"stepps": 3}, "mine: weights.trunk: key: expected one of .*did you mean 'steps'"),
        ({"seed": 3}, "mine: weights.trunk: key: expected one of .*found 'seed'"),
        ({"steps": 0}, "mine: weights.trunk: steps: expected a whole number from 1, found 0"),
        ({"steps": "many"}, r"mine: weights.trunk: expected `int`, got `str` - at `\$.steps`"),
        ({"horizon": 0.7}, "mine: weights.trunk: horizon: 0.7 s is no number of steps"),
    ],
)
def test_weights_that_cannot_be_are_told_before_anything_is_trained(
    changes: dict[str, Any], told: str, da: DeepAccident, tmp_path: Path
) -> None:
    plans = {"trunk": {"release": "test", **changes}}
    rows = [{"name": "one", "weights": "trunk"}]
    test = {**MODELS["test"], "includes_training": True}
    given = {
        "releases": {"test": {"dataroot": str(da.dataroot)}},
        "test": test,
        "weights": plans,
        "rows": rows,
    }
    recipe = {
        **BASELINES,
        **given,
        "compare": [],
        "headline": {"row": "one", "less": "one"},
        "groups": {},
    }
    with pytest.raises(ConfigError, match=told):
        run_study(
            read_recipe(str(written(tmp_path, recipe))), tmp_path / "out", device="cpu", workers=1
        )


def renumbered(root: Path, copy: Path) -> str:
    """A copy of a release whose scenarios have other numbers."""
    shutil.copytree(
        root, copy, ignore=shutil.ignore_patterns(".deepaccident", "Camera_*", "lidar01")
    )
    for path in sorted(copy.rglob("*scenario0*"), key=lambda path: -len(path.parts)):
        path.rename(path.with_name(path.name.replace("scenario0", "scenario7")))
    for listed in copy.glob("*.txt"):
        listed.write_text(listed.read_text().replace("scenario0", "scenario7"))
    return str(copy)


@pytest.mark.parametrize(
    ("plan", "named"),
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
    plan: dict[str, Any], named: str, da: DeepAccident, da_b: DeepAccident, tmp_path: Path
) -> None:
    """Before anything is trained, and unless the recipe says so; a split that the test does not
    have is no fault.
    """
    roots = {
        "here": str(da.dataroot),
        "other": str(da_b.dataroot),
        "copy": renumbered(da.dataroot, tmp_path / "copy"),
    }
    recipe = {
        **MODELS,
        "releases": {name: {"dataroot": root} for name, root in roots.items()},
        "weights": {
            "one": {"release": "other", "preset": "tiny_"},
            "two": {"preset": "tiny", **plan},
        },
        "rows": [{"name": "all", "weights": "two"}],
        "test": {"release": "here", "split": "train", "labels": "clean", "horizon": 0.5},
        "headline": None,
        "compare": [],
    }
    with pytest.raises(
        ConfigError, match=f"mine: weights.two: {named}: shows .* scenarios of the test"
    ) as raised:
        run_study(
            read_recipe(str(written(tmp_path, recipe))), tmp_path / "out", device="cpu", workers=1
        )
    assert "also_split" in str(raised.value)
    assert "includes_training: true" in str(raised.value)
    assert not (tmp_path / "out" / "weights").exists()
    allowed = {**recipe, "test": {**recipe["test"], "includes_training": True}}
    with pytest.raises(ConfigError, match=r"mine: weights.one: .*'tiny_'"):  # which comes next
        run_study(
            read_recipe(str(written(tmp_path, allowed))), tmp_path / "out", device="cpu", workers=1
        )


@pytest.fixture(scope="module")
def items(da: DeepAccident) -> Iterator[list[Any]]:
    """A sample of each of two pairs, with pictures and points."""
    tokens = [f"{scenario['token']}/ego_vehicle/004" for scenario in da.scenario]
    given = tiny().inputs("all", points=True)
    return [V2XDataset(da, own, given)[0] for own in (tokens[:1], strangers_of(tokens)[:1])]


def test_blank_inputs_have_no_picture_and_no_point(items: list[Any]) -> None:
    found = blanked(items[0])
    assert not found["images"].any()
    assert found["images"].shape == items[0]["images"].shape
    assert {tuple(cloud.shape) for of_agent in found["points"] for cloud in of_agent} == {(0, 4)}
    assert all(
        torch.equal(found[name], items[0][name])
        for name in ("intrinsics", "ego_from_agent", "agent_valid")
    )


def test_strangers_bring_sensors_and_poses_and_ego_keeps_its_own(items: list[Any]) -> None:
    own, stranger = items
    found = with_strangers(own, stranger)
    for name in (
        "images",
        "intrinsics",
        "ego_from_camera",
        "image_from_ego",
        "agent_from_past",
        "ego_from_agent",
    ):
        assert torch.equal(found[name][0], own[name][0])
        assert torch.equal(found[name][1:], stranger[name][1:])
    assert all(
        torch.equal(a, b) for a, b in zip(found["points"][1], stranger["points"][1], strict=True)
    )
    assert all(torch.equal(a, b) for a, b in zip(found["points"][0], own["points"][0], strict=True))
    assert not torch.equal(own["images"][1:], stranger["images"][1:])


def test_a_row_predicts_as_the_model_does(da: DeepAccident) -> None:
    torch.set_num_threads(1)  # as rows are predicted; with other threads sums round otherwise
    tokens = [f"{da.scenario[0]['token']}/ego_vehicle/004"]
    shipped = read_weights("tiny").path
    [(token, (motion, accidents, boxes))] = predictions_of(
        StudyRow(name="all", weights="a"), shipped, "cpu", da, tokens, tiny().labels
    )
    [expected] = predictions(load_model("tiny"), da, tokens, PredictConfig())
    assert token == expected.token
    assert [(each.time, each.score) for each in accidents] == [
        (each.time, each.score) for each in expected.accidents
    ]
    assert (boxes.scores == expected.boxes.scores).all()
    assert motion.heads is not None
    assert expected.motion.heads is not None
    assert (motion.heads[-1].centerness == expected.motion.heads[-1].centerness).all()
    with pytest.raises(
        ConfigError, match="was trained with the labels clean; give `labels: clean` in"
    ):
        [
            *predictions_of(
                StudyRow(name="all", weights="a"), shipped, "cpu", da, tokens, MotionLabelConfig()
            )
        ]


def test_a_row_of_weights_and_a_baseline_has_alarms_from_the_boxes(
    da: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.set_num_threads(1)
    likely = "deepaccident_devkit.plugins.baselines.predict._MIN_BOX_SCORE"
    monkeypatch.setattr(likely, 0.0)  # the weights are sure of little here
    tokens, shipped = (
        [f"{each['token']}/ego_vehicle/004" for each in da.scenario],
        read_weights("tiny_lidar").path,
    )
    row = StudyRow(name="boxes", weights="a", baseline="constant_velocity")
    found = dict(predictions_of(row, shipped, "cpu", da, tokens, tiny().labels))
    for token, (_, accidents, boxes) in found.items():
        expected = detected_accidents(da, token, boxes)
        assert [(each.time, each.score) for each in accidents] == [
            (each.time, each.score) for each in expected
        ]
    assert any(accidents for _, accidents, _ in found.values())
