"""Hidden actors, intervals, verdicts, controls: on data whose answers are known."""

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


SAMPLE = "type1_subtype1_accident/Town03_{}/ego_vehicle/010"


def boxes_at(*places: tuple[float, float], frame: str = "ego") -> DetectedBoxes:
    center = np.array([(*place, 0.0) for place in places]).reshape(-1, 3)
    made = Boxes.from_arrays(center, np.ones_like(center), np.zeros(len(center)), frame=frame)
    return DetectedBoxes(boxes=made, scores=np.ones(len(center)))


def motion_of(foreground: np.ndarray) -> MotionOutput:
    return MotionOutput(
        grid=LABELS.grid, instances=np.repeat(foreground[None, None], 5, axis=1).astype(np.int32)
    )


def test_hidden_actors_are_those_that_a_partner_alone_sees(da: DeepAccident) -> None:
    """Those that the ego sees are given as boxes, and the map of all: the hidden are on the map and
    not detected.
    """
    evaluator, hidden, seen = HiddenActors(), 0, 0
    for scenario in da.scenario:
        token = f"{scenario['token']}/ego_vehicle/004"
        alone = {each.rsplit("/", 1)[1] for each in visible_instances(da, token, agents="single")}
        every = seen_actors(da, token, agents="all", frame="ego").boxes
        drawn = motion_labels(da, token, LABELS).segmentation[0] > 0
        index, inside = LABELS.grid.index_of(every.center[:, :2])
        found = []
        for actor, box, (row, column), there in zip(
            every.actor_id, every.center, index, inside, strict=True
        ):
            if actor >= 0 and there and drawn[row, column]:
                found += [tuple(box[:2])] * (str(actor) in alone)
                hidden, seen = hidden + (str(actor) not in alone), seen + (str(actor) in alone)
        evaluator.update(
            token, da, LABELS, motion_of(drawn), boxes_at(*found, (49.0, -49.0), (80.0, 0.0))
        )
    totals = {
        name: sum(each[name] for each in evaluator.counts.values()) for name in ("hidden", "seen")
    }
    assert totals == {"hidden": hidden, "seen": seen}
    assert evaluator.compute() == {
        "false_foreground": 0.0,
        "hidden_foreground": 1.0,
        "seen_foreground": 1.0,
        "hidden_detected": 0.0,
        "seen_detected": 1.0,
        "false_boxes": 1.0,  # what lies beyond the grid does not count
    }
    zeros = np.zeros((5, 2, 100, 100), dtype=np.float32)
    heads = MotionOutput.from_arrays(zeros, zeros[:, :1], zeros, zeros, grid=LABELS.grid)
    with pytest.raises(EvaluationError, match="expected instance maps, found heads"):
        evaluator.update("other", da, LABELS, heads, boxes_at())


def seeds_of(*shares: float) -> dict[str, dict[str, Any]]:
    """Ten pairs, in each ten hidden actors of which about this share is found; a seed a share."""
    made = {}
    for seed, share in enumerate(shares, 1):
        evaluators = evaluators_of("clean")
        for pair in range(10):
            found = round(10 * share) + (pair + seed) % 2
            names = (
                "seen",
                "seen_foreground",
                "seen_detected",
                "cells",
                "false_cells",
                "false_boxes",
            )
            counts = {
                "hidden": 10,
                "hidden_foreground": found,
                "hidden_detected": 0,
                **dict.fromkeys(names, 0),
            }
            evaluators[HIDDEN].add(SAMPLE.format(pair), counts)
        made[str(seed)] = {HIDDEN: evaluators[HIDDEN]}
    return made


def detections_of(*models: tuple[float, float], token: str = SAMPLE) -> dict[str, dict[str, Any]]:
    """Seeds whose models give a score to true boxes and another one to false boxes, in ten
    pairs.
    """
    made = {}
    for seed, (true_score, false_score) in enumerate(models, 1):
        evaluator = evaluators_of("clean")["detection"]
        for pair in range(10):
            truth = boxes_at((10.0, 0.0), frame="lidar").boxes
            both = boxes_at(
                (10.0, 5.0 * (not (pair + seed) % 4)), (30.0, 20.0), frame="lidar"
            ).boxes
            found = DetectedBoxes(boxes=both, scores=np.array([true_score, false_score]))
            evaluator.update(token.format(pair), found, truth)
        made[str(seed)] = {"detection": evaluator}
    return made


@pytest.mark.parametrize("models", [((0.9, 0.8), (0.3, 0.2)), ((0.9, 0.8), (0.3, 0.4), (0.6, 0.6))])
def test_a_number_over_seeds_is_the_mean_of_each_seeds_number(
    models: tuple[tuple[float, float], ...],
) -> None:
    """The curve over the boxes of both would rank the first model's false boxes above the second
    one's true boxes.
    """
    seeds = detections_of(*models)
    tokens = seeds["1"]["detection"].tokens
    alone = [each["detection"].compute().mean_average_precision for each in seeds.values()]
    found = numbers_of_rows(tokens, seeds)["map"]
    assert [*found["seeds"].values()] == alone
    assert found["value"] == pytest.approx(np.mean(alone))
    assert found["low"] <= found["value"] <= found["high"]


def test_a_number_that_a_seed_lacks_has_no_mean() -> None:
    seeds = seeds_of(0.6, 0.7)
    tokens = seeds["1"][HIDDEN].tokens
    for token in tokens:
        seeds["2"][HIDDEN]._counts[token] = {**seeds["2"][HIDDEN].counts[token], "hidden": 0}
    found = numbers_of_rows(tokens, seeds)["hidden_foreground"]
    assert (found["value"], found["low"], found["seeds"]) == (
        None,
        None,
        {"1": pytest.approx(0.65), "2": None},
    )


def test_seeds_count_together_and_each_stands_beside(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "deepaccident_devkit.plugins.study.numbers.NUMBERS",
        {"hidden_foreground": (HIDDEN, "hidden_foreground", "")},
    )
    many, few = seeds_of(0.6, 0.7, 0.8), seeds_of(0.2, 0.3, 0.4)
    tokens = many["1"][HIDDEN].tokens
    found = numbers_of_rows(tokens, many)["hidden_foreground"]
    assert found["seeds"] == {
        "1": pytest.approx(0.65),
        "2": pytest.approx(0.75),
        "3": pytest.approx(0.85),
    }
    assert found["low"] < 0.75 < found["high"]
    baseline = {"": few["1"]}
    against = numbers_of_rows(tokens, many, baseline)["hidden_foreground"]
    assert against["value"] == pytest.approx(0.5)
    assert against["seeds"] == {
        "1": pytest.approx(0.4),
        "2": pytest.approx(0.5),
        "3": pytest.approx(0.6),
    }
    assert numbers_of_rows([*tokens][:3], many)["hidden_foreground"]["low"] is None
    assert numbers_of_rows(tokens, baseline)["hidden_foreground"]["seeds"] == {}


@pytest.mark.parametrize(
    ("low", "high", "told"),
    [
        (0.1, 0.3, "wins"),
        (-0.3, -0.1, "loses"),
        (-0.1, 0.3, "not decided"),
        (0.0, 0.3, "not decided"),
        (None, None, "not decided"),
    ],
)
def test_the_verdict_follows_from_the_interval(
    low: float | None, high: float | None, told: str
) -> None:
    assert verdict({"low": low, "high": high}) == told


def test_labels_as_predictions_know_nobody_who_comes_into_sight_later(da: DeepAccident) -> None:
    later, labels = 0, replace(LABELS, agents="single")
    tokens = [f"{scenario['token']}/ego_vehicle_behind/001" for scenario in da.scenario]
    row = StudyRow(name="labels", trivial="labels", agents="single")
    for token, (motion, _, _) in predictions_of(row, None, "cpu", da, tokens, LABELS):
        told = motion_labels(da, token, labels).to_present()
        seen = {
            int(each.rsplit("/", 1)[1]) for each in visible_instances(da, token, agents="single")
        } | {OWN_BOX_ID}
        drawn = {actor for actor, number in told.id_map.items() if (told.instance == number).any()}
        assert {told.id_map[actor] for actor in drawn & seen} == set(
            np.unique(motion.instances).tolist()
        ) - {0}
        later += len(drawn - seen)
    assert later > 0


def test_strangers_are_of_another_pair() -> None:
    own = [
        f"type1_subtype1_{kind}/Town03_{name}/ego_vehicle/{frame:03d}"
        for name in "ab"
        for kind in ("accident", "normal")
        for frame in (5, 10)
    ]
    others = strangers_of(own)
    assert [each.split("/")[1] for each in others] == ["Town03_b"] * 4 + ["Town03_a"] * 4
    assert [each.rsplit("/", 1)[1] for each in others] == [each.rsplit("/", 1)[1] for each in own]
    with pytest.raises(
        NotAvailableError, match="Town03_a: there is no other pair to take strangers from"
    ):
        strangers_of(own[:4])


def test_partners_of_strangers_are_those_of_the_same_name() -> None:
    class Numbers(list):  # type: ignore[type-arg]
        def clone(self) -> "Numbers":
            return Numbers(self)

    item = {
        "token": "a",
        "agents": ("ego", "behind", "pole"),
        "images": Numbers([0, 1, 2]),
        "points": [[0], [1], [2]],
    }
    other = {
        "token": "b",
        "agents": ("ego", "pole"),
        "images": Numbers([10, 12]),
        "points": [[10], [12]],
    }
    found = with_strangers(item, other)
    assert (found["token"], found["agents"]) == ("a", item["agents"])
    assert (found["images"], found["points"]) == ([0, 1, 12], [[0], [1], [12]])
    assert item["images"] == [0, 1, 2]
