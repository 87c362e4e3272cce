"""Hashes of a scenario's label, meta and calib files."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import IndexStoreError, ReleaseError
from deepaccident_devkit.release import ScenarioFolder, find_release
from deepaccident_devkit.release.fingerprints import (
    ScenarioHashes,
    digest_of,
    fingerprint,
    folder_hashes,
    scenario_hashes,
)


def first(root: Path, kind: str, ending: str) -> Path:
    return min(root.glob(f"train/*_accident/ego_vehicle/{kind}/*/*.{ending}"))


@pytest.fixture
def scenario(da_b: DeepAccident) -> str:
    return min(da_b.split_scenarios("train"))


def folder_of(root: Path, scenario: str) -> ScenarioFolder:
    return next(folder for folder in find_release(root).scenarios if folder.token == scenario)


@pytest.mark.parametrize(
    ("kind", "pattern"),
    [
        ("label", "ego_vehicle/label/*/*.txt"),
        ("calib", "ego_vehicle/calib/*/*.pkl"),
        ("meta", "meta/*.txt"),
    ],
)
def test_one_file_changes_one_hash_and_the_index_is_refused(
    own_release: Path, scenario: str, kind: str, pattern: str
) -> None:
    """Hashes are of the files that the index was made from: of others there are none."""
    opened = DeepAccident(dataroot=own_release, verbose=False)
    before = scenario_hashes(opened, [scenario])[scenario]
    assert (
        opened.indexed_hashes(scenario) == before == folder_hashes(folder_of(own_release, scenario))
    )
    path = min(own_release.glob(f"train/*_accident/{pattern}"))
    path.write_bytes(path.read_bytes()[:-1] + b" ")
    changed = folder_hashes(folder_of(own_release, scenario)).as_dict()
    assert [name for name, value in before.as_dict().items() if changed[name] != value] == [kind]
    named = (
        str(own_release),
        "the index is out of date",
        scenario,
        "deepaccident check index DATAROOT",
    )
    assert_refused((lambda: scenario_hashes(opened, [scenario]), IndexStoreError, named))
    others = opened.split_scenarios("val")
    assert list(scenario_hashes(opened, others)) == sorted(others)


def points_changed(path: Path, change: Callable[[list[int]], list[int]]) -> None:
    lines = [line.split(" ") for line in path.read_text().split("\n")]
    rows = [words for words in lines if len(words) == 13]
    for words, count in zip(rows, change([int(words[11]) for words in rows]), strict=True):
        words[11] = str(count)
    path.write_text("\n".join(map(" ".join, lines)))


@pytest.mark.parametrize(
    ("change", "is_like"),
    [
        (lambda counts: [counts[0] + 1, *counts[1:]], True),
        (lambda counts: [counts[0] + 200, *counts[1:]], False),
        (lambda counts: [*counts[1:], counts[0]], False),
        (lambda counts: [0] * len(counts), False),
    ],
)
def test_only_few_points_more_or_less_are_alike(
    own_release: Path, scenario: str, change: Callable[[list[int]], list[int]], is_like: bool
) -> None:
    folder = folder_of(own_release, scenario)
    before = folder_hashes(folder)
    points_changed(first(own_release, "label", "txt"), change)
    after = folder_hashes(folder)
    assert before != after
    assert (before.is_like(after), after.is_like(before)) == (is_like, is_like)
    assert before.boxes == after.boxes


def test_other_boxes_or_unknown_ones_are_not_alike(own_release: Path, scenario: str) -> None:
    folder = folder_of(own_release, scenario)
    before = folder_hashes(folder)
    unknown = ScenarioHashes(**before.as_dict())
    assert before.is_like(unknown)
    assert unknown.is_like(before)
    path = first(own_release, "label", "txt")
    words = path.read_text().split(" ")
    path.write_text(" ".join([*words[:5], "9" + words[5], *words[6:]]))
    after = folder_hashes(folder)
    assert after.points == before.points
    assert not any(
        mine.is_like(after) for mine in (before, unknown, replace(before, label=after.label))
    )
    assert not before.is_like(None)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
def test_a_file_that_cannot_be_read_is_named(own_release: Path, scenario: str) -> None:
    opened = DeepAccident(dataroot=own_release, verbose=False)
    path = first(own_release, "label", "txt")
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(
        ReleaseError, match=rf"^{path}: not a regular file \(a named pipe\); restore the file"
    ):
        scenario_hashes(opened, [scenario])


def test_no_meta_and_no_such_scenario(own_release: Path, scenario: str) -> None:
    for meta in own_release.glob("train/*/meta/*.txt"):
        meta.unlink()
    opened = DeepAccident(dataroot=own_release, verbose=False)
    found = scenario_hashes(opened, [scenario, "type1_subtype1_accident/gone"])
    assert list(found) == [scenario]
    assert found[scenario].meta is None


def test_fingerprint_of_all_in_any_order() -> None:
    one = ScenarioHashes(label="a", meta=None, calib="c")
    other = ScenarioHashes(label="b", meta="m", calib="c")
    assert fingerprint({"x": one, "y": other}) == fingerprint({"y": other, "x": one})
    assert fingerprint({"x": one, "y": other}) != fingerprint({"x": other, "y": one})
    assert digest_of({"a": 1, "b": [2.5]}) == digest_of({"b": [2.5], "a": 1})
