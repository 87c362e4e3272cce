"""What a test and a training have in common, whatever the names of scenarios and of releases."""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.study.overlap import known_scenarios

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
    assert known_scenarios((da_b, []), (da_b, tokens)) == known_scenarios((da_b, tokens), (da_b, [])) == []


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
def test_a_copy_is_known_by_its_actors(changes: tuple[Changed, ...], da_b: DeepAccident, own_release: Path) -> None:
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
