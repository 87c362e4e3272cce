"""Statistics on any executor and in shards: the same bytes as at once."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, UnfinishedError
from deepaccident_devkit.parallel import Shard
from deepaccident_devkit.statistics import (
    compute,
    dataset_statistics,
    merged_statistics,
    remove_shards,
    shards,
    statistics_shard,
)


@pytest.fixture(autouse=True)
def _short_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of two scenarios, so that a release of six has several."""
    monkeypatch.setattr(compute, "RUN_LENGTH", 2)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(deepaccident, ["stats", *map(str, arguments)], catch_exceptions=False)


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def refuse(*_: object, **__: object) -> Any:
    raise AssertionError("nothing should be counted")


@pytest.mark.parametrize("length", [1, 2, 64])
def test_runs_of_any_length_and_an_executor_give_the_same(
    both_layouts: DeepAccident, length: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compute, "RUN_LENGTH", 100)
    chosen = [record["token"] for record in both_layouts.scenario[1::2]]
    at_once = [dataset_statistics(both_layouts, which).to_json() for which in (None, chosen)]
    monkeypatch.setattr(compute, "RUN_LENGTH", length)
    assert [dataset_statistics(both_layouts, which).to_json() for which in (None, chosen)] == at_once
    with ThreadPoolExecutor(3) as executor:
        made = [dataset_statistics(both_layouts, which, executor=executor).to_json() for which in (None, chosen)]
    assert made == at_once


@pytest.mark.slow
def test_workers_give_the_same(da_b: DeepAccident) -> None:
    assert dataset_statistics(da_b, workers=2) == dataset_statistics(da_b, workers=1)
    with pytest.raises(ChoiceError, match="workers: expected a number of at least 1"):
        dataset_statistics(da_b, workers=0)


@pytest.mark.parametrize("count", [1, 3, 8])
def test_shards_merge_to_the_whole(da_b: DeepAccident, tmp_path: Path, count: int) -> None:
    out, chosen = tmp_path / "out", [record["token"] for record in da_b.scenario[1:]]
    for which in (None, chosen):
        done = [statistics_shard(da_b, Shard(number, count), out, which) for number in range(count, 0, -1)]
        assert sum(done) == len(da_b.scenario if which is None else which)
        assert merged_statistics(da_b, out, which).to_json() == dataset_statistics(da_b, which).to_json()
        remove_shards(da_b, out, which)
    assert not (tmp_path / "out.unfinished").exists()


def test_a_missing_shard_is_named(da_b: DeepAccident, tmp_path: Path) -> None:
    out, tokens = tmp_path / "out", [record["token"] for record in da_b.scenario]
    with pytest.raises(UnfinishedError, match=f"6 of 6 are not done, such as {tokens[0]}; run their shards again"):
        merged_statistics(da_b, out)
    for number in (1, 3):
        statistics_shard(da_b, Shard(number, 3), out)
    with pytest.raises(UnfinishedError, match=f"2 of 6 are not done, such as {tokens[2]}"):
        merged_statistics(da_b, out)
    statistics_shard(da_b, Shard(1, 1), out)  # what shards of other counts did counts too, once
    assert merged_statistics(da_b, out) == dataset_statistics(da_b)


def test_what_is_done_is_not_done_again(da_b: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    statistics_shard(da_b, Shard(1, 1), out)
    (path,) = (tmp_path / "out.unfinished").iterdir()
    content = path.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(compute, "tally_of", refuse)
        assert statistics_shard(da_b, Shard(1, 1), out) == 6
        whole = merged_statistics(da_b, out)
    assert whole == dataset_statistics(da_b)
    for damaged in (content[: len(content) // 2], b"", content.replace(b"lengths", b"heights", 1)):
        path.write_bytes(damaged)
        with pytest.raises(UnfinishedError, match="6 of 6"):
            merged_statistics(da_b, out)
        statistics_shard(da_b, Shard(1, 1), out)
        assert path.read_bytes() == content


def test_a_file_that_does_not_fit_together_is_none(da_b: DeepAccident, tmp_path: Path) -> None:
    statistics_shard(da_b, Shard(1, 1), tmp_path / "out")
    (path,) = (tmp_path / "out.unfinished").iterdir()
    with np.load(path, allow_pickle=False) as stored:
        arrays = dict(stored)
    odd = [np.frombuffer(text, np.uint8) for text in (b"{}", b"[1]", b'[{"first": 0}]')]
    for name, other in (("values", arrays["values"][1:]), *(("content", content) for content in odd)):
        np.savez(path, **{**arrays, name: other})
        with pytest.raises(UnfinishedError, match="6 of 6"):
            merged_statistics(da_b, tmp_path / "out")


def test_shards_of_something_else_are_not_merged(
    da: DeepAccident, da_b: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    statistics_shard(da_b, Shard(1, 1), out, [da_b.scenario[0]])
    statistics_shard(da, Shard(1, 1), out)
    with monkeypatch.context() as patch:
        patch.setattr(shards, "__version__", "0.0")
        statistics_shard(da_b, Shard(1, 1), out)
    with pytest.raises(UnfinishedError, match="6 of 6"):
        merged_statistics(da_b, out)


def test_where_nothing_can_be_written(da_b: DeepAccident, tmp_path: Path) -> None:
    (tmp_path / "out.unfinished").touch()
    with pytest.raises(ConfigError, match=r"out\.unfinished is a file; give a folder"):
        statistics_shard(da_b, Shard(1, 1), tmp_path / "out")


@pytest.mark.slow
def test_the_verb_writes_the_same_files(da_b: DeepAccident, tmp_path: Path) -> None:
    command = (da_b.dataroot, "--where", "length=1..100", "--format", "png", "--out")
    whole = run(*command, tmp_path / "whole")
    parts = [run(*command, tmp_path / "merged", "--shard", f"{number}/2") for number in (1, 2)]
    assert [part.output for part in parts] == [
        "part 1/2: 4 scenarios; next: the same with --merge\n",
        "part 2/2: 2 scenarios; next: the same with --merge\n",
    ]
    merged = run(*command, tmp_path / "merged", "--merge")
    assert merged.output == whole.output.replace(str(tmp_path / "whole"), str(tmp_path / "merged"))
    assert files_in(tmp_path / "merged") == files_in(tmp_path / "whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["merged", "whole"]
    alone = run(da_b.dataroot, "--shard", "1/2")
    assert (alone.exit_code, "give --out FOLDER too" in alone.output) == (2, True)
