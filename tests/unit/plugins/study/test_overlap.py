"""Scenarios that a test shares with a training are known, whatever the names of scenarios and
releases.
"""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.plugins.study.overlap import known_scenarios

Change = Callable[[Path], object]


def rename_scenarios(root: Path) -> None:
    """Give all scenarios other numbers in folders, file names and split files."""
    for path in sorted(root.rglob("*scenario0*"), key=lambda path: -len(path.parts)):
        path.rename(path.with_name(path.name.replace("scenario0", "scenario7")))
    for text_file in root.rglob("*.txt"):
        if text_file.parent.name != "label":
            text_file.write_text(text_file.read_text().replace("scenario0", "scenario7"))


def remove_last_frames(root: Path) -> None:
    for path in [*root.rglob("*_003.*"), *root.rglob("*_004.*")]:
        path.unlink()


def folder_remover(word: str) -> Change:
    """Return a change that removes folders with a word in their name."""

    def change(root: Path) -> None:
        for folder in [*root.rglob(f"*{word}*")]:
            shutil.rmtree(folder, ignore_errors=True)

    return change


def open_changed(root: Path, changes: Iterable[Change] = ()) -> DeepAccident:
    for change in changes:
        change(root)
    return DeepAccident("v1", root, verbose=False, on_error="skip")


def tokens_of(dataset: DeepAccident) -> list[str]:
    return [record["token"] for record in dataset.scenario]


def test_twins_and_the_same_scenarios_of_one_release_are_known(da_b: DeepAccident) -> None:
    tokens = tokens_of(da_b)
    for token in tokens:
        pair = [other for other in tokens if cluster_of(other) == cluster_of(token)]
        assert token in pair
        assert known_scenarios((da_b, [token]), (da_b, tokens)) == pair
    assert known_scenarios((da_b, []), (da_b, tokens)) == []
    assert known_scenarios((da_b, tokens), (da_b, [])) == []


@pytest.mark.parametrize(
    "changes",
    [
        (),
        (rename_scenarios,),
        (remove_last_frames,),
        (rename_scenarios, remove_last_frames),
        (folder_remover("_behind"),),
        (rename_scenarios, folder_remover("_normal")),
        (rename_scenarios, folder_remover("_accident")),
    ],
)
def test_a_copy_is_known_by_its_actors(
    changes: tuple[Change, ...], da_b: DeepAccident, own_release: Path
) -> None:
    """A copy may have other names, fewer frames, fewer agents, or only one of the twins."""
    copy, tokens = open_changed(own_release, changes), tokens_of(da_b)
    copy_tokens = tokens_of(copy)
    assert copy_tokens
    assert known_scenarios((copy, copy_tokens), (da_b, tokens)) == tokens
    assert known_scenarios((da_b, tokens), (copy, copy_tokens)) == copy_tokens


def test_other_releases_of_the_generator_are_not_known(
    da: DeepAccident, da_b: DeepAccident, da_motion: DeepAccident
) -> None:
    releases = [(dataset, tokens_of(dataset)) for dataset in (da, da_b, da_motion)]
    for learned in releases:
        for tested in releases:
            expected = tested[1] if learned is tested else []
            assert known_scenarios(learned, tested) == expected


def make_scenario(
    name: str, moving: list[int], parked: int, layout: str = "A"
) -> tuple[Any, list[str]]:
    """Make a release of one scenario with these actors; their sizes follow from their ids."""
    ids = np.array([*moving, *range(20_001, 20_001 + parked), -1])
    rows = np.arange(len(ids))
    tables = {
        "instance": {"actor_id": ids, "scenario_row": 0 * rows, "first_annotation_row": rows},
        "annotation": {"size": np.outer(ids % 1000, [0.01, 0.02, 0.03])},
    }
    release = SimpleNamespace(
        layout=layout, dataroot=Path(name), columns=tables.get, getind=lambda *_: 0
    )
    return release, [name]


@pytest.mark.parametrize(
    ("learned", "tested", "is_known"),
    [
        ([1, 2, 3, 4], [1, 2, 3, 9], True),
        ([1, 2, 3, 4], [1, 2, 8, 9], False),
        ([1, 2, 3, 4, 5, 6, 7, 8, 9, 10], [1, 2, 3, 4, 5, 6, 7], True),  # fewer frames
        ([1, 2], [1, 2], False),  # two equal actors may be chance
        ([], [], False),
    ],
)
def test_a_town_has_the_same_parked_vehicles_in_all_scenarios(
    learned: list[int], tested: list[int], is_known: bool
) -> None:
    learned_scenario = make_scenario("a", learned, parked=20)
    tested_scenario = make_scenario("b", tested, parked=20)
    assert bool(known_scenarios(learned_scenario, tested_scenario)) == is_known
    assert bool(known_scenarios(tested_scenario, learned_scenario)) == is_known


def test_instances_of_nuscenes_are_compared_by_their_sizes() -> None:
    """Their ids differ, and an actor with id 1001 has the size of the one with id 1."""
    learned = make_scenario("a", [1, 2, 3, 4], parked=0)
    ids = [1001, 1002, 1003, 1004]
    assert known_scenarios(learned, make_scenario("b", ids, 0, layout="nuScenes")) == ["b"]
    assert known_scenarios(learned, make_scenario("b", ids, 0)) == []
