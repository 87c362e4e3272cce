"""The experiment on cooperation (benchmarks/cooperation) and its page: what it counts, and a tiny run of all of it."""

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.model.presets import tiny
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID
from deepaccident_devkit.v2x import cooperating_agents, visible_instances
from deepaccident_devkit.v2x.cooperation import seen_actors

TOP = Path(__file__).parents[3]
NAMES = ("numbers", "rows", "protocol", "study", "page")
LABELS = tiny().labels


@pytest.fixture(scope="module")
def scripts() -> Iterator[dict[str, ModuleType]]:
    """The experiment's modules by name; processes that they start import them, too."""
    sys.path.append(str(TOP))
    yield {name: importlib.import_module(f"benchmarks.cooperation.{name}") for name in NAMES}
    sys.path.remove(str(TOP))


@pytest.fixture
def numbers(scripts: dict[str, ModuleType]) -> ModuleType:
    return scripts["numbers"]


@pytest.fixture
def page(scripts: dict[str, ModuleType]) -> ModuleType:
    return scripts["page"]


def cells(*places: list[float]) -> np.ndarray:
    """A map in which the cells of these places are foreground."""
    foreground = np.zeros(LABELS.grid.shape, dtype=bool)
    foreground[tuple(LABELS.grid.index_of(np.array(places))[0].T)] = True
    return foreground


def test_hidden_and_seen_actors_are_counted_apart(numbers: ModuleType) -> None:
    """Three actors on the ego's left: one hidden and two seen, of which one stands beyond the hidden one.

    Found are the hidden one, one of the seen ones, and nobody.
    """
    hidden, beyond, seen = actors = [[10.5, 5.5], [20.5, 5.5], [10.5, 15.5]]
    given = {"actors": np.array(actors), "hidden": np.array([True, False, False]), "every": np.array(actors)}
    scene = numbers.Scene(labels=LABELS, foreground=cells(hidden, beyond, seen), **given)
    boxes = np.array([[20.5, 7.0], [21.5, 5.5], [10.5, 8.0], [-40.0, 0.0], [80.0, 0.0]])
    assert numbers.found_counts(scene, cells(hidden, seen, [-30.0, -30.0]), boxes) == {
        "hidden": 1,
        "seen": 2,
        "hidden_foreground": 1,
        "seen_foreground": 1,
        "hidden_detected": 0,  # the nearest box is 2.5 m away
        "seen_detected": 1,
        "cells": 3,
        "false_cells": 1,
        "false_boxes": 2,  # what lies beyond the grid does not count
    }


def test_hidden_actors_are_those_that_a_partner_alone_sees(numbers: ModuleType, da: DeepAccident) -> None:
    found = []
    for scenario in da.scenario:
        token = f"{scenario['token']}/ego_vehicle/004"
        scene = numbers.scene_of(da, token, LABELS)
        assert len(cooperating_agents(da, token, "all")) == 5
        view = seen_actors(da, token, agents="all", frame="ego")
        alone = {each.rsplit("/", 1)[1] for each in visible_instances(da, token, agents="single")}
        for actor, unseen in zip(scene.actors, scene.hidden, strict=True):
            (at,) = np.flatnonzero((view.boxes.center[:, :2] == actor).all(axis=1))
            assert view.boxes.actor_id[at] != OWN_ACTOR_ID
            assert (str(view.boxes.actor_id[at]) not in alone) == unseen
        found += scene.hidden.tolist()
    assert set(found) == {True, False}


@pytest.fixture
def summary(page: ModuleType) -> dict[str, Any]:
    """That of the experiment, a copy."""
    return json.loads(page.SUMMARY.read_text(encoding="utf-8"))  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("ends", "verdict", "told"),
    [
        ((0.5, 3.0), "more", "Cooperation wins: with all agents the model has more than alone, by +1.5 [0.5, 3.0]"),
        (
            (-3.0, -0.5),
            "less",
            "Cooperation loses: with all agents the model has less than alone, by -1.5 [-3.0, -0.5]",
        ),
        ((-0.5, 3.0), "not decided", "It is not decided whether cooperation helps: the difference is +1.5 [-0.5, 3.0]"),
        ((None, None), "not decided", "It is not decided whether cooperation helps: the difference is +1.5 points"),
    ],
)
def test_the_headline_follows_from_the_interval(
    page: ModuleType, summary: dict[str, Any], ends: tuple[Any, Any], verdict: str, told: str
) -> None:
    found = {"value": -1.5 if verdict == "less" else 1.5, "low": ends[0], "high": ends[1]}
    summary["differences"][0]["numbers"]["iou_100"] = found
    assert page.verdict(found) == verdict
    assert told in page.headline_text(summary)
    assert told.partition(":")[0] in page.page(summary).replace("\n", " ")


def test_what_is_committed_agrees(page: ModuleType, summary: dict[str, Any], scripts: dict[str, ModuleType]) -> None:
    """The page, the summary and the counts."""
    assert page.PAGE.read_text(encoding="utf-8") == page.page(summary)
    study = scripts["study"]
    again = study.summarised(scripts["rows"].read_counts(study.HERE / study.COUNTS), study.PROTOCOL)
    same_numbers(again["rows"], summary["rows"])


def same_numbers(again: dict[str, Any], told: dict[str, Any]) -> None:
    """The numbers of all rows that the packed counts give, too."""
    assert list(again) == list(told)
    for name, row in again.items():
        assert len(row["numbers"]) >= 10
        for key, each in row["numbers"].items():
            assert each == pytest.approx(told[name]["numbers"][key])
