"""What a test and a training have in common, whatever the names of scenarios and of releases."""

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

Changed = Callable[[Path], object]


def renamed(root: Path) -> None:
    """Give all scenarios other numbers: in folders, in the names of files, and in split files."""
    for path in sorted(root.rglob("*scenario0*"), key=lambda path: -len(path.parts)):
        path.rename(path.with_name(path.name.replace("scenario0", "scenario7")))
    for listed in root.rglob("*.txt"):
        if listed.parent.name != "label":
            listed.write_text(listed.read_text().replace("scenario0", "scenario7"))


def shortened(root: Path) -> None:
    """Leave out the last frames."""
    for path in [*root.rglob("*_003.*"), *root.rglob("*_004.*")]:
        path.unlink()


def without(word: str) -> Changed:
    """Leave out the folders that have a word in their name."""

    def change(root: Path) -> None:
        for folder in [*root.rglob(f"*{word}*")]:
            shutil.rmtree(folder, ignore_errors=True)

    return change


def opened(root: Path, changes: Iterable[Changed] = ()) -> DeepAccident:
    for change in changes:
        change(root)
    return DeepAccident("v1", root, verbose=False, on_error="skip")


def tokens_of(dataset: DeepAccident) -> list[str]:
    return [record["token"] for record in dataset.scenario]


def test_twins_and_the_same_scenarios_of_one_release_are_known(da_b: DeepAccident) -> None:
    tokens = tokens_of(da_b)
    for learned in tokens:
        pair = [each for each in tokens if cluster_of(each) == cluster_of(learned)]
        assert learned in pair
        assert known_scenarios((da_b, [learned]), (da_b, tokens)) == pair
    assert (
        known_scenarios((da_b, []), (da_b, tokens))
        == known_scenarios((da_b, tokens), (da_b, []))
        == []
    )


@pytest.mark.parametrize(
    "changes",
    [
        (),
        (renamed,),
        (shortened,),
        (renamed, shortened),
        (without("_behind"),),
        (renamed, without("_normal")),
        (renamed, without("_accident")),
    ],
)
def test_a_copy_is_known_by_its_actors(
    changes: tuple[Changed, ...], da_b: DeepAccident, own_release: Path
) -> None:
    """Under other names, with fewer frames, fewer agents, or of one of the twins alone."""
    copy, tokens = opened(own_release, changes), tokens_of(da_b)
    assert tokens_of(copy)
    assert known_scenarios((copy, tokens_of(copy)), (da_b, tokens)) == tokens
    assert known_scenarios((da_b, tokens), (copy, tokens_of(copy))) == tokens_of(copy)


def test_other_releases_of_the_generator_are_not_known(
    da: DeepAccident, da_b: DeepAccident, da_motion: DeepAccident
) -> None:
    releases = [(each, tokens_of(each)) for each in (da, da_b, da_motion)]
    for learned in releases:
        for tested in releases:
            assert known_scenarios(learned, tested) == (tested[1] if learned is tested else [])


def scene(name: str, moving: list[int], parked: int, layout: str = "A") -> tuple[Any, list[str]]:
    """A release of one scenario with these actors, whose sizes follow from their ids."""
    ids = np.array([*moving, *range(20_001, 20_001 + parked), -1])
    rows = np.arange(len(ids))
    tables = {
        "instance": {"actor_id": ids, "scenario_row": 0 * rows, "first_annotation_row": rows},
        "annotation": {"size": np.outer(ids % 1000, [0.01, 0.02, 0.03])},
    }
    return SimpleNamespace(
        layout=layout, dataroot=Path(name), columns=tables.get, getind=lambda *_: 0
    ), [name]


@pytest.mark.parametrize(
    ("learned", "tested", "known"),
    [
        ([1, 2, 3, 4], [1, 2, 3, 9], True),
        ([1, 2, 3, 4], [1, 2, 8, 9], False),
        ([1, 2, 3, 4, 5, 6, 7, 8, 9, 10], [1, 2, 3, 4, 5, 6, 7], True),  # fewer frames
        ([1, 2], [1, 2], False),  # may be chance
        ([], [], False),
    ],
)
def test_a_town_has_the_same_parked_vehicles_in_all_scenarios(
    learned: list[int], tested: list[int], known: bool
) -> None:
    ours, theirs = scene("a", learned, 20), scene("b", tested, 20)
    assert bool(known_scenarios(ours, theirs)) == bool(known_scenarios(theirs, ours)) == known


def test_instances_of_nuscenes_are_compared_by_their_sizes() -> None:
    """Their numbers are others: 1001 has the size of 1."""
    assert known_scenarios(
        scene("a", [1, 2, 3, 4], 0), scene("b", [1001, 1002, 1003, 1004], 0, "nuScenes")
    ) == ["b"]
    assert (
        known_scenarios(scene("a", [1, 2, 3, 4], 0), scene("b", [1001, 1002, 1003, 1004], 0)) == []
    )
