"""Check the hashes of a scenario's label, meta and calib files."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from support.expected_errors import assert_raises

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


def find_first_label(root: Path) -> Path:
    return min(root.glob("train/*_accident/ego_vehicle/label/*/*.txt"))


@pytest.fixture
def scenario(da_b: DeepAccident) -> str:
    return min(da_b.split_scenarios("train"))


def find_folder(root: Path, scenario: str) -> ScenarioFolder:
    folders = {folder.token: folder for folder in find_release(root).scenarios}
    return folders[scenario]


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
    """Hashes describe the files that the index was made from; other files have none."""
    release = DeepAccident(dataroot=own_release, verbose=False)
    folder = find_folder(own_release, scenario)
    before = folder_hashes(folder)
    assert release.indexed_hashes(scenario) == before
    assert scenario_hashes(release, [scenario])[scenario] == before

    path = min(own_release.glob(f"train/*_accident/{pattern}"))
    path.write_bytes(path.read_bytes()[:-1] + b" ")

    after = folder_hashes(find_folder(own_release, scenario)).as_dict()
    changed_kinds = [name for name, value in before.as_dict().items() if after[name] != value]
    assert changed_kinds == [kind]
    words = (
        str(own_release),
        "the index is out of date",
        scenario,
        "deepaccident check index DATAROOT",
    )
    assert_raises((lambda: scenario_hashes(release, [scenario]), IndexStoreError, words))
    validation = release.split_scenarios("val")
    assert list(scenario_hashes(release, validation)) == sorted(validation)


def change_points(path: Path, change: Callable[[list[int]], list[int]]) -> None:
    """Change the LiDAR points of all boxes in a label file."""
    lines = [line.split(" ") for line in path.read_text().split("\n")]
    boxes = [words for words in lines if len(words) == 13]
    counts = change([int(words[11]) for words in boxes])
    for words, count in zip(boxes, counts, strict=True):
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
    folder = find_folder(own_release, scenario)
    before = folder_hashes(folder)

    change_points(find_first_label(own_release), change)

    after = folder_hashes(folder)
    assert before != after
    assert before.is_like(after) == is_like
    assert after.is_like(before) == is_like
    assert before.boxes == after.boxes


def test_other_boxes_or_unknown_ones_are_not_alike(own_release: Path, scenario: str) -> None:
    folder = find_folder(own_release, scenario)
    before = folder_hashes(folder)
    unknown = ScenarioHashes(**before.as_dict())
    assert before.is_like(unknown)
    assert unknown.is_like(before)

    path = find_first_label(own_release)
    words = path.read_text().split(" ")
    words[5] = "9" + words[5]
    path.write_text(" ".join(words))

    after = folder_hashes(folder)
    assert after.points == before.points
    assert not before.is_like(after)
    assert not unknown.is_like(after)
    assert not replace(before, label=after.label).is_like(after)
    assert not before.is_like(None)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
def test_a_file_that_cannot_be_read_is_named(own_release: Path, scenario: str) -> None:
    release = DeepAccident(dataroot=own_release, verbose=False)
    path = find_first_label(own_release)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(
        ReleaseError, match=rf"^{path}: not a regular file \(a named pipe\); restore the file"
    ):
        scenario_hashes(release, [scenario])


def test_no_meta_and_no_such_scenario(own_release: Path, scenario: str) -> None:
    for path in own_release.glob("train/*/meta/*.txt"):
        path.unlink()
    release = DeepAccident(dataroot=own_release, verbose=False)

    hashes = scenario_hashes(release, [scenario, "type1_subtype1_accident/gone"])

    assert list(hashes) == [scenario]
    assert hashes[scenario].meta is None


def test_fingerprint_of_all_in_any_order() -> None:
    first = ScenarioHashes(label="a", meta=None, calib="c")
    second = ScenarioHashes(label="b", meta="m", calib="c")
    expected = fingerprint({"x": first, "y": second})
    assert fingerprint({"y": second, "x": first}) == expected
    assert fingerprint({"x": second, "y": first}) != expected
    assert digest_of({"a": 1, "b": [2.5]}) == digest_of({"b": [2.5], "a": 1})
