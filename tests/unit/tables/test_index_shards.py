"""An index made in shards."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import tiny
from click.testing import CliRunner

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import BrokenReleaseError, UnfinishedError
from deepaccident_devkit.parallel import Shard
from deepaccident_devkit.release import find_release
from deepaccident_devkit.tables import index_shard, open_index, open_merged_index

NAMES = [f"Town05_type001_subtype0001_scenario{number:05d}" for number in range(1, 6)]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in NAMES:
        tiny.write_tiny_release(tmp_path / "release", name=name)
    return tmp_path / "release"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("count", [1, 2, 8])
def test_shards_merge_to_the_same_bytes(root: Path, count: int) -> None:
    layout, whole, parts = find_release(root, "v1"), root.parent / "whole", root.parent / "parts"
    open_index(layout, index_dir=whole)
    done = [index_shard(layout, Shard(number, count), index_dir=parts) for number in range(1, count + 1)]
    assert sorted(each.token.split("/")[1] for part in done for each in part) == NAMES
    open_merged_index(layout, index_dir=parts)
    assert contents(parts) == contents(whole)
    open_merged_index(layout, index_dir=parts)  # again: it is there


def test_an_executor_makes_the_same_bytes(root: Path) -> None:
    layout, whole, other = find_release(root, "v1"), root.parent / "whole", root.parent / "other"
    open_index(layout, index_dir=whole)
    with ThreadPoolExecutor(3) as threads:
        assert len(DeepAccident("v1", root, other, verbose=False, executor=threads).scenario) == len(NAMES)
    assert contents(other) == contents(whole)


def test_a_missing_shard(root: Path) -> None:
    layout = find_release(root, "v1")
    index_shard(layout, Shard(1, 2))
    with pytest.raises(UnfinishedError, match=r"/v1: 2 of 5 are not done, such as \S+00002; run their shards again"):
        open_merged_index(layout)
    index_shard(layout, Shard(2, 2))
    (root / tiny.TYPE / "ego_vehicle" / "label" / NAMES[0] / f"{NAMES[0]}_001.txt").write_text("changed since\n")
    index_shard(layout, Shard(2, 2))
    with pytest.raises(BrokenReleaseError, match=NAMES[0]):  # it is looked at, and no part is missing
        open_merged_index(layout)


def test_a_scenario_that_changed_since_its_shard(root: Path) -> None:
    layout = find_release(root, "v1")
    index_shard(layout, Shard(1, 1))
    label = root / tiny.TYPE / "ego_vehicle" / "label" / NAMES[3] / f"{NAMES[3]}_001.txt"
    label.write_text(label.read_text() + "\n")
    with pytest.raises(UnfinishedError, match=rf"1 of 5 are not done, such as \S+{NAMES[3]}; run"):
        open_merged_index(layout)


def test_the_verb(root: Path) -> None:
    told = [CliRunner().invoke(deepaccident, ["index", str(root), *options.split()]) for options in (
        "--shard 1/2", "--merge", "--shard 2/2", "--merge"
    )]  # fmt: skip
    assert [each.exit_code for each in told[:1] + told[2:]] == [0, 0, 0]
    assert told[0].output.strip().endswith("part 1/2: 3 scenarios, 0 of them broken; next: the same with --merge")
    assert isinstance(told[1].exception, UnfinishedError)
    assert "5 scenarios" in told[3].output
