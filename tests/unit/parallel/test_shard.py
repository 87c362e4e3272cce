"""Parts of bulk work."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit.errors import ChoiceError, UnfinishedError
from deepaccident_devkit.parallel import MERGE, Shard, ShardFiles, check_whole, mine, part_of


@given(st.integers(0, 40), st.integers(1, 12))
def test_shards_are_a_partition(items: int, count: int) -> None:
    parts = [Shard(number, count).of(range(items)) for number in range(1, count + 1)]
    assert sorted(item for part in parts for item in part) == list(range(items))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_texts() -> None:
    assert Shard.parse("3/8") == Shard(3, 8) == part_of("3/8") == part_of(Shard(3, 8))
    assert str(Shard(3, 8)) == "3/8"
    assert part_of(MERGE) == MERGE
    assert part_of(None) is None
    assert mine(None, [1, 2]) == mine(MERGE, [1, 2]) == [1, 2]
    assert mine(Shard(2, 2), [1, 2]) == [2]


@pytest.mark.parametrize("text", ["0/8", "9/8", "3", "a/b", "-1/2", "1/0", "3/8/2", ""])
def test_wrong_texts(text: str) -> None:
    with pytest.raises(ChoiceError, match=r"^shard: expected K/N with K from 1 to N, such as 3/8, found "):
        part_of(text)


def test_a_whole() -> None:
    check_whole(["a", "b"], {"b", "a", "c"}, "out")
    with pytest.raises(UnfinishedError, match=r"^out: 2 of 3 are not done, such as a; run their shards again, or the"):
        check_whole(["a", "b", "c"], {"c"}, "out")


def test_the_files_of_shards(tmp_path: Path) -> None:
    files = ShardFiles(tmp_path / "bundle", "abc", ".json")
    other = ShardFiles(tmp_path / "bundle", "def", ".json")
    assert files.found() == []
    files.folder.mkdir()
    for path in (files.path(Shard(1, 2)), files.path(Shard(2, 2)), other.path(Shard(1, 2))):
        path.touch()
    files.path(Shard(1, 3)).mkdir()
    assert [path.name for path in files.found()] == ["abc.1-of-2.json", "abc.1-of-3.json", "abc.2-of-2.json"]
    files.remove()
    assert [path.name for path in files.folder.iterdir()] == ["def.1-of-2.json"]
    other.remove()
    assert not files.folder.exists()
