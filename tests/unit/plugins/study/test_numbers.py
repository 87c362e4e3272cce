"""Hidden actors, intervals, verdicts and controls, on data with known answers."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError, NotAvailableError
from deepaccident_devkit.evaluation import DetectedBoxes, MotionOutput
from deepaccident_devkit.geometry import BevGrid, Boxes
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabelConfig, motion_labels
from deepaccident_devkit.plugins.study.numbers import (
    HIDDEN,
    HiddenActors,
    evaluators_of,
    numbers_of_rows,
    verdict,
)
from deepaccident_devkit.plugins.study.predict import predictions_of, strangers_of, with_strangers
from deepaccident_devkit.plugins.study.recipe import StudyRow
from deepaccident_devkit.v2x import visible_instances
from deepaccident_devkit.v2x.cooperation import seen_actors

LABELS = MotionLabelConfig(
    grid=BevGrid(x=(-50.0, 50.0, 1.0), y=(-50.0, 50.0, 1.0)), protocol="clean"
)


SAMPLE_TEMPLATE = "type1_subtype1_accident/Town03_{}/ego_vehicle/010"


def make_boxes(*positions: tuple[float, float], frame: str = "ego") -> DetectedBoxes:
    """Make boxes of 1 m at positions on the ground, all with score 1."""
    count = len(positions)
    center = np.zeros((count, 3))
    center[:, :2] = np.reshape(positions, (count, 2))
    boxes = Boxes.from_arrays(center, np.ones((count, 3)), np.zeros(count), frame=frame)
    return DetectedBoxes(boxes=boxes, scores=np.ones(count))


def make_motion(foreground: np.ndarray) -> MotionOutput:
    instances = np.repeat(foreground[None, None], 5, axis=1).astype(np.int32)
    return MotionOutput(grid=LABELS.grid, instances=instances)


def test_hidden_actors_are_the_ones_that_only_a_partner_sees(da: DeepAccident) -> None:
    """The prediction has boxes of actors that the ego sees and a map of all actors: hidden actors
    are on the map, but not detected.
    """
    evaluator = HiddenActors()
    num_hidden, num_seen = 0, 0
    for scenario in da.scenario:
        token = f"{scenario['token']}/ego_vehicle/004"
        instances = visible_instances(da, token, agents="single")
        visible_ids = {int(instance.rsplit("/", 1)[1]) for instance in instances}
        boxes = seen_actors(da, token, agents="all", frame="ego").boxes
        foreground = motion_labels(da, token, LABELS).segmentation[0] > 0
        cells, is_inside = LABELS.grid.index_of(boxes.center[:, :2])
        is_known = (boxes.actor_id >= 0) & is_inside
        detected = [(49.0, -49.0), (80.0, 0.0)]
        for index in np.flatnonzero(is_known):
            row, column = cells[index]
            if not foreground[row, column]:
                continue
            if boxes.actor_id[index] in visible_ids:
                num_seen += 1
                detected.append(tuple(boxes.center[index, :2]))
            else:
                num_hidden += 1
        evaluator.update(token, da, LABELS, make_motion(foreground), make_boxes(*detected))

    counts = evaluator.counts.values()
    assert sum(sample["hidden"] for sample in counts) == num_hidden
    assert sum(sample["seen"] for sample in counts) == num_seen
    assert evaluator.compute() == {
        "false_foreground": 0.0,
        "hidden_foreground": 1.0,
        "seen_foreground": 1.0,
        "hidden_detected": 0.0,
        "seen_detected": 1.0,
        "false_boxes": 1.0,  # the box beyond the grid does not count
    }
    zeros = np.zeros((5, 2, 100, 100), dtype=np.float32)
    heads = MotionOutput.from_arrays(zeros, zeros[:, :1], zeros, zeros, grid=LABELS.grid)
    with pytest.raises(EvaluationError, match="expected instance maps, found heads"):
        evaluator.update("other", da, LABELS, heads, make_boxes())


def make_hidden_seeds(*shares: float) -> dict[str, dict[str, Any]]:
    """Make a seed for each share, with ten pairs of ten hidden actors; about this share of them is
    found.
    """
    seeds = {}
    for seed, share in enumerate(shares, 1):
        evaluator = evaluators_of("clean")[HIDDEN]
        for pair in range(10):
            counts = {
                "hidden": 10,
                "hidden_foreground": round(10 * share) + (pair + seed) % 2,
                "hidden_detected": 0,
                "seen": 0,
                "seen_foreground": 0,
                "seen_detected": 0,
                "cells": 0,
                "false_cells": 0,
                "false_boxes": 0,
            }
            evaluator.add(SAMPLE_TEMPLATE.format(pair), counts)
        seeds[str(seed)] = {HIDDEN: evaluator}
    return seeds


def make_detection_seeds(*models: tuple[float, float]) -> dict[str, dict[str, Any]]:
    """Make a seed for each model's scores of true and of false boxes, with ten pairs."""
    seeds = {}
    truth = make_boxes((10.0, 0.0), frame="lidar").boxes
    for seed, scores in enumerate(models, 1):
        evaluator = evaluators_of("clean")["detection"]
        for pair in range(10):
            y = 0.0 if (pair + seed) % 4 else 5.0
            boxes = make_boxes((10.0, y), (30.0, 20.0), frame="lidar").boxes
            detections = DetectedBoxes(boxes=boxes, scores=np.array(scores))
            evaluator.update(SAMPLE_TEMPLATE.format(pair), detections, truth)
        seeds[str(seed)] = {"detection": evaluator}
    return seeds


@pytest.mark.parametrize("models", [((0.9, 0.8), (0.3, 0.2)), ((0.9, 0.8), (0.3, 0.4), (0.6, 0.6))])
def test_a_number_over_seeds_is_the_mean_of_each_seeds_number(
    models: tuple[tuple[float, float], ...],
) -> None:
    """A curve over the boxes of all models would rank the first model's false boxes above the
    second model's true boxes.
    """
    seeds = make_detection_seeds(*models)
    numbers = numbers_of_rows(seeds["1"]["detection"].tokens, seeds)["map"]
    expected = [
        evaluators["detection"].compute().mean_average_precision for evaluators in seeds.values()
    ]
    assert [*numbers["seeds"].values()] == expected
    assert numbers["value"] == pytest.approx(np.mean(expected))
    assert numbers["low"] <= numbers["value"] <= numbers["high"]


def test_a_number_that_a_seed_lacks_has_no_mean() -> None:
    seeds = make_hidden_seeds(0.6, 0.7)
    tokens = seeds["1"][HIDDEN].tokens
    second = seeds["2"][HIDDEN]
    for token in tokens:
        second._counts[token] = {**second.counts[token], "hidden": 0}
    numbers = numbers_of_rows(tokens, seeds)["hidden_foreground"]
    assert numbers["value"] is None
    assert numbers["low"] is None
    assert numbers["seeds"] == {"1": pytest.approx(0.65), "2": None}


def test_seeds_count_together_and_are_also_listed_one_by_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        "deepaccident_devkit.plugins.study.numbers.NUMBERS",
        {"hidden_foreground": (HIDDEN, "hidden_foreground", "")},
    )
    many_found, few_found = make_hidden_seeds(0.6, 0.7, 0.8), make_hidden_seeds(0.2, 0.3, 0.4)
    tokens = many_found["1"][HIDDEN].tokens
    numbers = numbers_of_rows(tokens, many_found)["hidden_foreground"]
    assert numbers["seeds"] == {
        "1": pytest.approx(0.65),
        "2": pytest.approx(0.75),
        "3": pytest.approx(0.85),
    }
    assert numbers["low"] < 0.75 < numbers["high"]

    baseline = {"": few_found["1"]}
    differences = numbers_of_rows(tokens, many_found, baseline)["hidden_foreground"]
    assert differences["value"] == pytest.approx(0.5)
    assert differences["seeds"] == {
        "1": pytest.approx(0.4),
        "2": pytest.approx(0.5),
        "3": pytest.approx(0.6),
    }
    assert numbers_of_rows([*tokens][:3], many_found)["hidden_foreground"]["low"] is None
    assert numbers_of_rows(tokens, baseline)["hidden_foreground"]["seeds"] == {}


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.1, 0.3, "wins"),
        (-0.3, -0.1, "loses"),
        (-0.1, 0.3, "not decided"),
        (0.0, 0.3, "not decided"),
        (None, None, "not decided"),
    ],
)
def test_the_verdict_follows_from_the_interval(
    low: float | None, high: float | None, expected: str
) -> None:
    assert verdict({"low": low, "high": high}) == expected


def test_labels_as_predictions_lack_actors_that_come_into_sight_later(da: DeepAccident) -> None:
    config = replace(LABELS, agents="single")
    tokens = [f"{scenario['token']}/ego_vehicle_behind/001" for scenario in da.scenario]
    row = StudyRow(name="labels", trivial="labels", agents="single")
    num_later = 0
    for token, (motion, _, _) in predictions_of(row, None, "cpu", da, tokens, LABELS):
        instances = visible_instances(da, token, agents="single")
        visible_ids = {int(instance.rsplit("/", 1)[1]) for instance in instances}
        label = motion_labels(da, token, config).to_present()
        expected = set()
        for actor_id, number in label.id_map.items():
            if not (label.instance == number).any():
                continue
            if actor_id in visible_ids or actor_id == OWN_BOX_ID:
                expected.add(number)
            else:
                num_later += 1
        assert set(np.unique(motion.instances).tolist()) - {0} == expected
    assert num_later > 0


def test_strangers_come_from_another_pair() -> None:
    tokens = [
        f"type1_subtype1_{kind}/Town03_{name}/ego_vehicle/{frame:03d}"
        for name in "ab"
        for kind in ("accident", "normal")
        for frame in (5, 10)
    ]
    strangers = strangers_of(tokens)
    assert [token.split("/")[1] for token in strangers] == ["Town03_b"] * 4 + ["Town03_a"] * 4
    frames = [token.rsplit("/", 1)[1] for token in tokens]
    assert [token.rsplit("/", 1)[1] for token in strangers] == frames
    with pytest.raises(
        NotAvailableError, match="Town03_a: there is no other pair to take unrelated partners from"
    ):
        strangers_of(tokens[:4])


def test_partners_are_replaced_by_strangers_of_the_same_name() -> None:
    class FakeTensor(list):  # type: ignore[type-arg]
        def clone(self) -> "FakeTensor":
            return FakeTensor(self)

    item = {
        "token": "a",
        "agents": ("ego", "behind", "pole"),
        "images": FakeTensor([0, 1, 2]),
        "points": [[0], [1], [2]],
    }
    other = {
        "token": "b",
        "agents": ("ego", "pole"),
        "images": FakeTensor([10, 12]),
        "points": [[10], [12]],
    }
    mixed = with_strangers(item, other)
    assert (mixed["token"], mixed["agents"]) == ("a", item["agents"])
    assert (mixed["images"], mixed["points"]) == ([0, 1, 12], [[0], [1], [12]])
    assert item["images"] == [0, 1, 2]
